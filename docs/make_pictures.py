"""Make the pictures of the README and the manual, docs/pictures/NAME.jpg, from finished runs.

    python docs/make_pictures.py runs/spot runs/cow
    python docs/make_pictures.py --together phones runs/spot_charuco runs/hard_table
    python docs/make_pictures.py --steps examples/spot runs/spot
    python docs/make_pictures.py --report runs/spot

Of one view: a photo, the mesh from two sides, depth and normals. Of several views and object poses: a photo of each,
and the mesh from all sides. Together: a row for each run, which ends with the view relit from a place where no lamp
was. Steps: what the method page shows of one run, from photo and shadows to the relit view. Report: two parts of its
report.
"""

import argparse
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from calibration.calibrated_views import load_views
from calibration.calibration import Calibration
from calibration.light import Light
from reconstruct.export.relit import NewLight, write_relit
from reconstruct.labels.observer import Observer
from reconstruct.run.solve_stage import prepare_scene
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source
from reconstruct.stored_run.stored_run import StoredRun
from viewer.report.document import depth_picture, mesh_picture, normal_picture

PICTURES = Path(__file__).parent / "pictures"
HEIGHT = 300  # px of every panel
SMALL, WIDE = 240, 1.45  # of several views': height, and width over height of photos
SIDES_DEG = (
    (-70.0, 25.0),
    (-10.0, 25.0),
    (50.0, 25.0),
    (110.0, 25.0),
    (170.0, 25.0),
    (-70.0, -60.0),
)  # azimuth, elevation
BRIGHT = 235  # of 255
MARGIN_SHARE = 0.35  # of the object's size around it
TURN = np.radians(130.0)  # of the lamp about the vertical, from a photo's to that of the relit view


def on_white(picture: np.ndarray, height: int = HEIGHT) -> Image.Image:
    """RGBA or RGB as a panel of a height."""
    image = Image.fromarray(picture)
    if image.mode == "RGBA":
        white = Image.new("RGBA", image.size, "white")
        image = Image.alpha_composite(white, image).convert("RGB")
    return image.resize((round(image.width * height / image.height), height), Image.Resampling.LANCZOS)


def brightened(photo: np.ndarray) -> np.ndarray:
    """The photo stretched so that its bright parts are nearly white: flashlight photos are dark."""
    gain = BRIGHT / max(float(np.percentile(photo, 99.5)), 1.0)
    return np.clip(photo * gain, 0, 255).astype(np.uint8)


def crop_box(mask: np.ndarray, aspect: float = 0.0) -> tuple[slice, slice]:
    """Rows and columns of the object with some margin; `aspect` times as wide as high, at least."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    pad = int(MARGIN_SHARE * max(np.ptp(rows), np.ptp(columns)))
    top, bottom = max(rows[0] - pad, 0), min(rows[-1] + pad, mask.shape[0])
    more = max(0, int(aspect * (bottom - top) - np.ptp(columns) - 2 * pad) // 2)
    return (slice(top, bottom), slice(max(columns[0] - pad - more, 0), columns[-1] + pad + more))


def panels(run: Path) -> list[list[Image.Image]]:
    """The pictures of a run, row by row."""
    mesh = trimesh.load_mesh(run / "mesh.ply", process=False)
    found = load_views(run / "calibration.json")
    places = [(view.name, view.calibration) for one in (found, *found.object_poses) for view in one.views]
    if len(places) > 1:
        photos = [photo_panel(run, name, calibration, SMALL, WIDE) for name, calibration in places]
        sides = [mesh_panel(mesh, azimuth, elevation) for azimuth, elevation in SIDES_DEG]
        return [photos, sides]
    mask = np.asarray(Image.open(run / "mask.png")) > 127
    box = crop_box(mask)
    eye = places[0][1].world_from_camera.translation - mesh.bounds.mean(0)
    aside = np.array([-eye[1], eye[0], 0.5 * eye[2]])
    shape = [on_white(mesh_picture(mesh, way, (400, 400))) for way in (eye, aside)]
    maps = [depth_picture(np.load(run / "depth.npy"), mask), normal_picture(np.load(run / "normal.npy"), mask)]
    return [[photo_panel(run, "", places[0][1], HEIGHT), *shape, *(on_white(one[box]) for one in maps)]]


def relit_panel(run: Path) -> Image.Image:
    """The view of a run under a lamp at the place of the photo that photo_panel shows, turned about the vertical."""
    stored = StoredRun(run)
    middle, light = stored.mesh.bounds.mean(0), shown_light(stored.calibration)
    assert light.position is not None
    turn = np.array([[np.cos(TURN), -np.sin(TURN), 0], [np.sin(TURN), np.cos(TURN), 0], [0, 0, 1]])
    x, y, z = (middle + turn @ (light.position - middle)).tolist()
    mask = np.asarray(Image.open(run / "mask.png")) > 127
    with TemporaryDirectory() as folder:
        file = Path(folder) / "relit.png"
        write_relit(stored, file, NewLight(light=(x, y, z)), mask.shape[1], lambda *_: None)
        return on_white(brightened(np.asarray(Image.open(file)))[crop_box(mask)])


LIT, DARK, OBJECT = (250, 205, 90), (50, 70, 130), (235, 235, 235)  # colours of labels


def steps(run: Path, capture: Path) -> list[Image.Image]:
    """A photo, what is ground in light and in shadow in it, the hull, the surface, its normals, and the relit view."""
    found, options = load_views(run / "calibration.json"), RunOptions(preset="standard")
    source = open_source(capture, options)
    scene = prepare_scene(source, read_photos(source, options), found, options)[0]
    labels = Observer(scene).ground_labels()
    used = [light.photo for light in found.first.lights if light.used]
    lit = labels.visibility[used.index(shown_light(found.first).photo)].numpy() > 0.5
    colours = np.where(lit[..., None], LIT, DARK)
    colours[labels.mask.numpy() > 0.5] = OBJECT
    mask = np.asarray(Image.open(run / "mask.png")) > 127
    labelled = np.asarray(Image.fromarray(colours.astype(np.uint8)).resize(mask.shape[::-1]))[crop_box(mask)]
    meshes = [trimesh.load_mesh(run / name, process=False) for name in ("hull.ply", "mesh.ply")]
    eye = found.first.world_from_camera.translation - meshes[1].bounds.mean(0)
    way = np.array([-eye[1], eye[0], 0.5 * eye[2]])
    shapes = [on_white(mesh_picture(mesh, way, (400, 400))) for mesh in meshes]
    normals = on_white(normal_picture(np.load(run / "normal.npy"), mask)[crop_box(mask)])
    return [photo_panel(run, "", found.first, HEIGHT), on_white(labelled), *shapes, normals, relit_panel(run)]


def shown_light(calibration: Calibration) -> Light:
    """The light whose photo is shown."""
    used = [light for light in calibration.lights if light.used]
    return used[len(used) // 3]


def photo_panel(run: Path, view: str, calibration: Calibration, height: int, aspect: float = 0.0) -> Image.Image:
    """A photo of a view, its part around the object."""
    has_folder = (run / view / "mask.png").is_file()
    mask = np.asarray(Image.open(run / view / "mask.png" if has_folder else run / "mask.png")) > 127
    name = f"{Path(shown_light(calibration).photo).stem}.jpg"
    beside = run / "thumbs" / f"{view.replace('/', '-')}-{name}"
    thumb = Image.open(beside if beside.is_file() else run / "thumbs" / name).resize(mask.shape[::-1])
    return on_white(brightened(np.asarray(thumb)[crop_box(mask, aspect)]), height)


def mesh_panel(mesh: trimesh.Trimesh, azimuth: float, elevation: float) -> Image.Image:
    """The mesh from a side, degrees."""
    around, up = np.radians([azimuth, elevation])
    way = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    return on_white(mesh_picture(mesh, way, (400, 400)), SMALL)


def row_of(parts: list[Image.Image], width: int) -> Image.Image:
    """Pictures side by side, evenly spread over a width."""
    sheet = Image.new("RGB", (width, parts[0].height), "white")
    room, left = (width - sum(part.width for part in parts)) / max(len(parts) - 1, 1), 0.0
    for part in parts:
        sheet.paste(part, (round(left), 0))
        left += part.width + room
    return sheet


def save(rows: list[list[Image.Image]], name: str) -> None:
    """Put rows of pictures below each other, evenly spread, into docs/pictures/NAME.jpg."""
    width = max(sum(part.width for part in row) for row in rows)
    strips = [row_of(row, width) for row in rows]
    sheet = Image.new("RGB", (width, sum(strip.height for strip in strips)), "white")
    top = 0
    for strip in strips:
        sheet.paste(strip, (0, top))
        top += strip.height
    sheet.save(PICTURES / f"{name}.jpg", quality=88)


def report_parts(run: Path) -> None:
    """Write report.jpg, its verdict, and lights.jpg, the drawings of the lights. Needs Playwright and a Chromium."""
    from playwright.sync_api import sync_playwright

    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 1000, "height": 900})
        tab.goto((run / "report.html").resolve().as_uri())
        for name, heading in (("report", "h1"), ("lights", "h2:text-is('Lights')")):
            part = tab.locator("section, header", has=tab.locator(heading)).last
            part.screenshot(path=PICTURES / f"{name}.jpg", quality=85)
        browser.close()


def main() -> None:
    """Make a picture of each run, or one of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--together", metavar="NAME", help="one picture of this name, a row for each run of one view")
    parser.add_argument("--steps", metavar="CAPTURE", type=Path, help="steps.jpg of this capture's run")
    parser.add_argument("--report", action="store_true", help="report.jpg and lights.jpg of a run")
    options = parser.parse_args()
    if options.report:
        report_parts(options.runs[0])
        return
    if options.steps:
        parts = steps(options.runs[0], options.steps)
        save([parts[:3], parts[3:]], "steps")
        return
    if options.together:
        save([[*panels(run)[0], relit_panel(run)] for run in options.runs], options.together)
        return
    for run in options.runs:
        save(panels(run), run.name)


if __name__ == "__main__":
    main()
