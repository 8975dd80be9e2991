"""The pictures of the capture guide: one scene photographed well and badly, by the generator of examples/.

pip install '.[generator]'
python docs/make_capture_pictures.py
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "examples")]
from generator.capturing import make_capture  # noqa: E402
from generator.options import Exposure, Flashlight, Phone, Setup, Thing  # noqa: E402

PHOTOS, PHOTO_PX = 3, (320, 240)
GOOD = Setup(
    thing=Thing(shape="figurine", paint="two-tone"),
    phone=Phone(width=480, elevation=42.0),
    flashlight=Flashlight(photos=PHOTOS, height=(28.0, 60.0), around=(60.0, 330.0)),
    exposure=Exposure(samples=32),
)
SETUPS = {
    "good": GOOD,
    "frontal": replace(GOOD, flashlight=replace(GOOD.flashlight, around=(-12.0, 12.0), height=(38.0, 46.0))),
    "low": replace(GOOD, flashlight=replace(GOOD.flashlight, height=(5.0, 9.0))),
    "bright": replace(GOOD, exposure=replace(GOOD.exposure, ambient=0.8, exposure=0.5)),
    "close": replace(GOOD, phone=replace(GOOD.phone, distance=230.0)),
}


def strip(setup: Setup) -> Image.Image:
    """The photos of one setup, side by side."""
    with tempfile.TemporaryDirectory() as folder:
        make_capture(Path(folder) / "capture", setup, lambda _: None)
        photos = sorted((Path(folder) / "capture" / "photos").glob("*.jpg"))
        small = [np.asarray(Image.open(path).convert("RGB").resize(PHOTO_PX, Image.Resampling.BOX)) for path in photos]
    gap = np.full((PHOTO_PX[1], 8, 3), 255, np.uint8)
    return Image.fromarray(np.hstack([part for picture in small for part in (picture, gap)][:-1]))


def main() -> None:
    """Write docs/pictures/capture_NAME.jpg."""
    for name, setup in SETUPS.items():
        strip(setup).save(ROOT / "docs" / "pictures" / f"capture_{name}.jpg", quality=82)


if __name__ == "__main__":
    main()
