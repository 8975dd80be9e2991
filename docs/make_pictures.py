"""Make docs/pictures/spot.jpg from a finished run: a photo, the mesh from two sides, depth and normals.

python docs/make_pictures.py runs/spot
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from calibration.calibration import load_calibration
from viewer.display.pictures import depth_picture, mesh_picture, normal_picture

HEIGHT = 300  # px of every panel
BRIGHT = 235  # of 255
MARGIN_SHARE = 0.35  # of the object's size around it


def on_white(picture: np.ndarray) -> Image.Image:
    """RGBA or RGB as a panel of the common height."""
    image = Image.fromarray(picture)
    if image.mode == "RGBA":
        white = Image.new("RGBA", image.size, "white")
        image = Image.alpha_composite(white, image).convert("RGB")
    return image.resize((round(image.width * HEIGHT / image.height), HEIGHT), Image.Resampling.LANCZOS)


def brightened(photo: np.ndarray) -> np.ndarray:
    """The photo stretched so that its bright parts are nearly white: flashlight photos are dark."""
    gain = BRIGHT / max(float(np.percentile(photo, 99.5)), 1.0)
    return np.clip(photo * gain, 0, 255).astype(np.uint8)


def crop_box(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the object with some margin."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    pad = int(MARGIN_SHARE * max(np.ptp(rows), np.ptp(columns)))
    return (
        slice(max(rows[0] - pad, 0), rows[-1] + pad),
        slice(max(columns[0] - pad, 0), columns[-1] + pad),
    )


def panels(run: Path) -> list[Image.Image]:
    """The pictures in a row."""
    calibration = load_calibration(run / "calibration.json")
    mask = np.asarray(Image.open(run / "mask.png")) > 127
    box = crop_box(mask)
    used = [light.photo for light in calibration.lights if light.used]
    thumb = Image.open(run / "thumbs" / f"{Path(used[len(used) // 3]).stem}.jpg").resize(mask.shape[::-1])
    mesh = trimesh.load_mesh(run / "mesh.ply", process=False)
    eye = calibration.world_from_camera.translation - mesh.bounds.mean(0)
    aside = np.array([-eye[1], eye[0], 0.5 * eye[2]])
    return [
        on_white(brightened(np.asarray(thumb)[box])),
        on_white(mesh_picture(mesh, eye, (400, 400))),
        on_white(mesh_picture(mesh, aside, (400, 400))),
        on_white(depth_picture(np.load(run / "depth.npy"), mask)[box]),
        on_white(normal_picture(np.load(run / "normal.npy"), mask)[box]),
    ]


def main() -> None:
    """Put the panels side by side."""
    row = panels(Path(sys.argv[1]))
    sheet = Image.new("RGB", (sum(p.width for p in row), HEIGHT), "white")
    left = 0
    for panel in row:
        sheet.paste(panel, (left, 0))
        left += panel.width
    target = Path(__file__).parent / "pictures" / "spot.jpg"
    target.parent.mkdir(exist_ok=True)
    sheet.save(target, quality=88)


if __name__ == "__main__":
    main()
