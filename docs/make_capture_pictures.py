"""The pictures of the capture guide: one scene photographed well and badly, from several places, and plans of these.

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
from generator.options import Around, Exposure, Flashlight, Further, Phone, Setup, Thing  # noqa: E402

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
STATIONS = replace(
    GOOD,
    phone=replace(GOOD.phone, elevation=38.0),
    flashlight=replace(GOOD.flashlight, photos=1, around=(80.0, 81.0)),
    further=Further(board_photos=0),
    around=Around(views=3, object_poses=1),
)
PLACES = ("view_1", "view_2", "view_3", "turned_1")
PLAN_PX, TABLE_PX = (360, 374), 96  # of a plan; half of its table or radius of its tray
PLAN_STYLE = (
    "text{font:13px sans-serif;fill:#222}.b{font-weight:bold}.t{fill:#e8ddc9;stroke:#9c8a6a}.s{fill:#fff;stroke:#555}"
    ".o{fill:#b5532f}.p{fill:#333}.v{fill:#f6b73c;opacity:.28}.a{fill:none;stroke:#2b62c4;stroke-width:2.5}"
    ".l{fill:none;stroke:#c79a1e;stroke-dasharray:3 5;stroke-width:2}.k{fill:#2b62c4;opacity:.75}"
)


def plan(title: str, words: list[str], phones: list[float], is_tray: bool) -> str:
    """A table from above, as a group of SVG: board, object, phones at some degrees around it, the flashlight's way.

    Args:
        phones: degrees from the right, clockwise.
        is_tray: board and object lie on a tray that is turned, instead of on the table itself.
    """
    x, y, r = PLAN_PX[0] / 2, 185, TABLE_PX
    out = [f'<text class="b" x="{x}" y="22" text-anchor="middle">{title}</text>']
    if is_tray:
        out.append(f'<circle class="t" cx="{x}" cy="{y}" r="{r}"/>')
    else:
        out.append(f'<rect class="t" x="{x - r - 14}" y="{y - r}" width="{2 * r + 28}" height="{2 * r}" rx="8"/>')
    out.append(f'<circle class="l" cx="{x}" cy="{y}" r="{r - 12}"/>')
    out.append(f'<rect class="s" x="{x - 52}" y="{y - 32}" width="46" height="64"/>')
    squares = [(i, j) for i in range(4) for j in range(6) if (i + j) % 2 == 0]
    out += [f'<rect x="{x - 47 + 9 * i}" y="{y - 27 + 9 * j}" width="9" height="9"/>' for i, j in squares]
    out += [f'<rect class="k" x="{x + a}" y="{y + b}" width="12" height="7"/>' for a in (-58, -12) for b in (-36, 29)]
    out.append(f'<circle class="o" cx="{x + 30}" cy="{y}" r="19"/>')
    out.append(f'<text x="{x - 29}" y="{y + 52}" text-anchor="middle">board</text>')
    out.append(f'<text x="{x + 30}" y="{y + 36}" text-anchor="middle">object</text>')
    out.append(f'<text x="{x}" y="{y - r - 22}" text-anchor="middle">flashlight: all around, at each place</text>')
    for degrees in phones:
        out.append(
            f'<g transform="translate({x} {y}) rotate({degrees})"><path class="v" d="M{r + 32} 0L-30 -60V60Z"/>'
            f'<rect class="p" x="{r + 28}" y="-11" width="8" height="22" rx="2"/></g>'
        )
    if is_tray:
        turn = np.radians([-150.0, -30.0])
        (ax, bx), (ay, by) = x + (r + 8) * np.cos(turn), y + (r + 8) * np.sin(turn)
        out.append(f'<path class="a" d="M{ax:.0f} {ay:.0f}A{r + 8} {r + 8} 0 0 1 {bx:.0f} {by:.0f}"/>')
        out.append(f'<path class="k" d="M{bx + 6:.0f} {by + 9:.0f}l-15 -3l11 -10z"/>')
    lines = enumerate(words)
    out += [f'<text x="{x}" y="{PLAN_PX[1] - 32 + 17 * i}" text-anchor="middle">{one}</text>' for i, one in lines]
    return "".join(out)


def plans() -> str:
    """Two ways to photograph from several sides, as a page of SVG."""
    width, height = PLAN_PX
    stations = plan(
        "Three stations",
        ["Board and object stay, taped down;", "the tripod is carried on."],
        [90.0, 210.0, 330.0],
        False,
    )
    tray = plan("Turntable", ["The tripod stays; board and object", "are turned together, on one tray."], [90.0], True)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * width} {height}"><style>{PLAN_STYLE}</style>'
        f'<rect width="100%" height="100%" fill="#fff"/>{stations}<g transform="translate({width})">{tray}</g></svg>\n'
    )


def stations() -> Image.Image:
    """One photo from each place of the tripod, and one of the object laid anew."""
    with tempfile.TemporaryDirectory() as folder:
        make_capture(Path(folder) / "capture", STATIONS, lambda _: None)
        return side_by_side([next((Path(folder) / "capture" / name / "photos").glob("*.jpg")) for name in PLACES])


def strip(setup: Setup) -> Image.Image:
    """The photos of one setup, side by side."""
    with tempfile.TemporaryDirectory() as folder:
        make_capture(Path(folder) / "capture", setup, lambda _: None)
        return side_by_side(sorted((Path(folder) / "capture" / "photos").glob("*.jpg")))


def side_by_side(photos: list[Path]) -> Image.Image:
    """Small copies of photos in a row."""
    small = [np.asarray(Image.open(path).convert("RGB").resize(PHOTO_PX, Image.Resampling.BOX)) for path in photos]
    gap = np.full((PHOTO_PX[1], 8, 3), 255, np.uint8)
    return Image.fromarray(np.hstack([part for picture in small for part in (picture, gap)][:-1]))


def main() -> None:
    """Write docs/pictures/capture_NAME.jpg, and the plans."""
    folder = ROOT / "docs" / "pictures"
    (folder / "capture_plans.svg").write_text(plans())
    stations().save(folder / "capture_stations.jpg", quality=82)
    for name, setup in SETUPS.items():
        strip(setup).save(folder / f"capture_{name}.jpg", quality=82)


if __name__ == "__main__":
    main()
