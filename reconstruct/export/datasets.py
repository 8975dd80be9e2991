"""A finished run in the layouts of other programs: ShadowNeuS, RTI, COLMAP and NeRF, as a folder or a zip of it.

Frames and units of each: docs/formats.md. Lengths are in the run's unit. Photos are sRGB, in the sensor's frame,
without rotation tags, so that every picture matches the exported camera.
"""

import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calibration.camera import Camera
from calibration.lights.layouts import BLENDER
from calibration.pose import Pose
from capture.files.atomic import write_json
from capture.files.title import file_stem
from capture.photos.photo import encode_srgb, write_picture
from reconstruct.export.dataset import Dataset, centred, kind_of, light_matrix, open_datasets, opengl
from reconstruct.export.export import Contents, ExportOptions, OnProgress, Writer
from reconstruct.render.g_buffer import look, surface_maps
from reconstruct.stored_run.stage_pack import ZIP_TIME
from reconstruct.stored_run.stored_run import StoredRun

POINTS_LONG_SIDE = 160  # px: some ten thousand points of the surface, as usual in sparse models
HALF = 0.5  # px: these programs count from the corner of the first pixel, we from its centre


# --- ShadowNeuS ------------------------------------------------------------------------------------------------------


def write_shadowneus(views: Sequence[Dataset], out: Path, on_progress: OnProgress) -> None:
    """Write transforms_train.json (a light pose per photo), transforms_floor.json, train/, and test_one/ with the mask.

    The layout has one focal length and no distortion, so the pictures are those of a centred camera without distortion.

    Raises:
        ReconstructionError: the run has both near and far lights.
        OSError: a file cannot be written.
    """
    data = views[0]
    camera, kind = centred(data.camera), kind_of(data.lights, "the ShadowNeuS layout")
    pose, frames = opengl(data.posed_camera.world_from_camera).tolist(), []
    for stem, light in zip(data.stems, data.lights, strict=True):
        sun = light_matrix(light, data.posed_camera).tolist()
        frames.append({"file_path": f"train/{stem}", "transform_matrix_sun": sun, "transform_matrix": pose})
    angle = 2 * np.arctan(camera.width / 2 / camera.fx)
    floor = np.eye(4)
    floor[2, 3] = data.posed_camera.ground_height
    _pictures(data, camera, out / "train", ".png", on_progress)
    maps = surface_maps(data.fields.grid, replace(data.posed_camera, camera=camera))
    alpha = np.full((camera.height, camera.width, 4), 255, np.uint8)
    alpha[..., 3] = 255 * maps.mask.numpy()
    (out / "test_one").mkdir()
    cv2.imwrite(str(out / "test_one" / "r_000.png"), alpha)
    write_json(out / "transforms_floor.json", {"frames": [{"transform_ground": floor.tolist()}]})
    write_json(out / "scene.json", {"light_type": kind, "unit": data.run.unit})
    write_json(out / "transforms_train.json", {"camera_angle_x": angle, "light_type": kind, "frames": frames})


# --- RTI -------------------------------------------------------------------------------------------------------------


def write_rti(views: Sequence[Dataset], out: Path, on_progress: OnProgress) -> None:
    """Write JPEG pictures, an .lp file of light directions, and .dome and .relight projects, also with positions.

    Directions and positions are in the picture's axes (x right, y up, z towards the camera), with the origin at the
    ground point in the middle of the picture; positions are in the unit of imageWidth, the picture's width there.

    Raises:
        ReconstructionError: the run has both near and far lights.
        OSError: a file cannot be written.
    """
    data = views[0]
    kind, middle = kind_of(data.lights, "an RTI"), data.posed_camera.looked_at()
    away = float(np.linalg.norm(middle - data.posed_camera.centre))
    width = away * data.camera.width / data.camera.fx
    ways, reach = zip(*(light.seen_from(middle) for light in data.lights), strict=True)
    directions = data.posed_camera.world_from_camera.inverse().rotate(np.array(ways)) @ BLENDER
    places = directions * (np.array(reach)[:, None] if kind == "point" else away)
    files = [f"{stem}.jpg" for stem in data.stems]
    _pictures(data, data.camera, out, ".jpg", on_progress)
    name = file_stem(data.run.run_dir)
    lines = [f"{file} {x:.7f} {y:.7f} {z:.7f}" for file, (x, y, z) in zip(files, directions.tolist(), strict=True)]
    (out / f"{name}.lp").write_text("\n".join([str(len(files)), *lines]) + "\n", encoding="utf-8")
    dome = {
        "label": name,
        "imageWidth": width,
        "lightConfiguration": "lights3d" if kind == "point" else "directional",
        "directions": _xyz(directions),
        "positionsSphere": _xyz(places),
        "positions3d": _xyz(places),
    }
    write_json(out / f"{name}.dome", dome)
    images = [
        {"filename": file, "skip": False, "direction": towards, "position": place}
        for file, towards, place in zip(files, _xyz(directions), _xyz(places), strict=True)
    ]
    size = {"width": data.camera.width, "height": data.camera.height}
    project = {"application": "RelightLab", "name": name, **size, "folder": ".", "images": images, "dome": dome}
    write_json(out / f"{name}.relight", project)


def _xyz(rows: np.ndarray) -> list[dict[str, float]]:
    return [dict(zip("xyz", row, strict=True)) for row in rows.tolist()]


# --- COLMAP ----------------------------------------------------------------------------------------------------------


def write_colmap(views: Sequence[Dataset], out: Path, on_progress: OnProgress) -> None:
    """Write images/ and sparse/0/: cameras.txt, images.txt (camera_from_world), points3D.txt (points of the surface).

    The pictures of a view share camera and pose. Its points are observed in the first of them only, each in a track of
    length one.
    """
    sparse = out / "sparse" / "0"
    sparse.mkdir(parents=True)
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    rows = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    image, point_id = 1, 1
    for number, view in enumerate(views, start=1):
        _pictures(view, view.camera, out / "images", ".jpg", on_progress)
        model, numbers = colmap_camera(view.camera)
        size = f"{view.camera.width} {view.camera.height}"
        cameras.append(f"{number} {model} {size} {' '.join(map(repr, numbers))}")
        points, colours, pixels = _surface_points(view)
        camera_from_world = Pose.from_matrix(view.in_common(view.posed_camera.world_from_camera.matrix())).inverse()
        x, y, z, w = Rotation.from_matrix(camera_from_world.rotation).as_quat()
        pose = " ".join(repr(float(value)) for value in (w, x, y, z, *camera_from_world.translation))
        seen = " ".join(f"{u:.4f} {v:.4f} {i}" for i, (u, v) in enumerate(pixels.tolist(), start=point_id))
        for i, (point, colour) in enumerate(zip(points.tolist(), colours.tolist(), strict=True)):
            values = [point_id + i, *(f"{p:.6g}" for p in point), *colour, 0, image, i]
            rows.append(" ".join(map(str, values)))
        for i, stem in enumerate(view.stems):
            images += [f"{image + i} {pose} {number} {stem}.jpg", seen if i == 0 else ""]
        image, point_id = image + len(view.stems), point_id + len(points)
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", rows)):
        (sparse / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """Return COLMAP's name of the lens model, and its parameters; pixel centres at +0.5."""
    numbers = [float(x) for x in (camera.fx, camera.fy, camera.cx + HALF, camera.cy + HALF)]
    lens = [float(x) for x in camera.distortion]
    if camera.fisheye:
        return "OPENCV_FISHEYE", numbers + lens[:4]
    if not any(lens):
        return "PINHOLE", numbers
    return ("OPENCV", numbers + lens[:4]) if lens[4] == 0 else ("FULL_OPENCV", [*numbers, *lens, 0.0, 0.0, 0.0])


def _surface_points(data: Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points that a camera sees (world of the first view), their sRGB colours, and their pixels in COLMAP."""
    scale = min(1.0, POINTS_LONG_SIDE / max(data.camera.width, data.camera.height))
    size = (max(1, round(data.camera.width * scale)), max(1, round(data.camera.height * scale)))
    view = look(data.fields, posed_camera=data.posed_camera.resized(*size))
    seen = view.maps.depth.isfinite()
    points = view.maps.points[seen].double().numpy()
    pixels = data.posed_camera.project(points) + HALF
    return data.fields.in_common(points), encode_srgb(view.albedo[seen].numpy()), pixels


# --- NeRF ------------------------------------------------------------------------------------------------------------


def write_nerf(views: Sequence[Dataset], out: Path, on_progress: OnProgress) -> None:
    """Write images/ and transforms.json: OpenGL cameras, the lens as in nerfstudio, and the light of each frame.

    With several views each frame has its own lens, as nerfstudio reads it.
    """
    data, frames = views[0], []
    for view in views:
        _pictures(view, view.camera, out / "images", ".jpg", on_progress)
        pose = view.in_common(opengl(view.posed_camera.world_from_camera)).tolist()
        own = _nerf_lens(view.camera) if len(views) > 1 else {}
        for stem, light in zip(view.stems, view.lights, strict=True):
            sun = view.in_common(light_matrix(light, view.posed_camera)).tolist()
            place = {"transform_matrix": pose, "transform_matrix_sun": sun, "light_type": light.kind}
            frames.append({"file_path": f"images/{stem}.jpg", **place, **own})
    document = {
        "camera_model": "OPENCV_FISHEYE" if data.camera.fisheye else "OPENCV",
        "camera_angle_x": 2 * np.arctan(data.camera.width / 2 / data.camera.fx),
        **_nerf_lens(data.camera),
        "unit": data.run.unit,
        "frames": frames,
    }
    write_json(out / "transforms.json", document)


def _nerf_lens(camera: Camera) -> dict[str, float]:
    names = ("k1", "k2", "k3", "k4") if camera.fisheye else ("k1", "k2", "p1", "p2", "k3")
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + HALF,
        "cy": camera.cy + HALF,
        "w": camera.width,
        "h": camera.height,
        **dict(zip(names, camera.distortion, strict=False)),
    }


# --- folders and archives --------------------------------------------------------------------------------------------


def _writer(layout: Callable[[Sequence[Dataset], Path, OnProgress], None], of_all_views: bool = False) -> Writer:
    """Return the function that writes a layout as a folder, or as a zip of it if the path ends in .zip."""

    def write(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
        views = open_datasets(run, options.photos)
        views = views if of_all_views else views[:1]
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / path.stem if path.suffix else path
            folder.mkdir()
            layout(views, folder, on_progress)
            if path.suffix:
                with zipfile.ZipFile(path, "w") as archive:
                    for file in sorted(part for part in folder.rglob("*") if part.is_file()):
                        entry = zipfile.ZipInfo(file.relative_to(place).as_posix(), ZIP_TIME)
                        archive.writestr(entry, file.read_bytes(), zipfile.ZIP_DEFLATED)
        count, camera = sum(len(view.lights) for view in views), views[0].camera
        source = "of the relit surface" if options.photos is None else "of the capture"
        return Contents(pixels=(camera.width, camera.height), note=f"{count} pictures {source}, camera and lights")

    return write


shadowneus, rti = _writer(write_shadowneus), _writer(write_rti)  # of one camera: the first view's
colmap, nerf = _writer(write_colmap, of_all_views=True), _writer(write_nerf, of_all_views=True)


def _pictures(data: Dataset, camera: Camera, folder: Path, suffix: str, on_progress: OnProgress) -> None:
    for i, (stem, rgb) in enumerate(zip(data.stems, data.pictures(camera), strict=True)):
        on_progress(i, len(data.stems), "pictures")
        write_picture(folder / f"{stem}{suffix}", rgb)
    on_progress(len(data.stems), len(data.stems), "pictures")
