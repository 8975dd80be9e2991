"""Scenes that come with their camera, ground and lights: the layout of ShadowNeuS, NeRF-synthetic plus light poses.

Uneven ground of such a scene: a depth map of the bare ground, on the grid of the photos.

Photographs in its layout: params.npz, image/ and mask.png. `light_pose` (N x 4 x 4, of the phone that held the light),
`camera_pose` (OpenCV axes), `camera_intrinsics` (pixel centres at +0.5), `floor_height`; world z is up. The lights
stand where that phone's camera was. mask.png is white where the object is or may be, so it is no silhouette: the
outline is found from the photos.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.known_scene import Importer, KnownScene
from calibration.light import Light
from calibration.lights.layouts import FROM_BLENDER, Floor, Frame, Frames, read_params, rigid
from calibration.lights.photo_lists import photos_in
from calibration.lights.power import LONG_SIDE, preview, shading_misfit, with_common_power
from calibration.pose import Pose
from capture.decode.exr import read_exr
from capture.decode.formats import read_size
from capture.errors import CalibrationError
from capture.files.arrays import read_npy
from capture.files.names import inside
from capture.files.schema import read_scene
from capture.photos.photo import read_photo, read_stack
from capture.session.sorting import scene_photos

SAME_CAMERA_TOLERANCE = 1e-4  # scene units or unit vectors: exporters round to six digits
SHADOW_PICTURE_SHARE = 0.98  # of the pixels are black or white in a picture of shadows
PATTERN = "floor/*_depth_*"  # of the authors' bumpy scenes
LARGEST_DEPTH = 2**30  # bytes: float64 of 130 megapixels
KINDS = (".exr", ".npy")
FEWEST_KNOWN = 0.02  # of the picture: with less ground nothing can be bounded by shadows on it
NOTHING = 1e6  # renderers write 1e10 or so where they hit nothing
PHOTOGRAPHS, MASK, INTRINSICS = "image", "mask.png", "camera_intrinsics"
TRAIN = "train"


class _Kind(Struct):
    light_type: Literal["point", "directional"] | None = None


class _Description(Frames):
    camera_angle_x: Annotated[float, Meta(gt=0, lt=np.pi, description="radians between 0 and pi")]


def _recognised(folder: Path) -> str | None:
    return next((path.name for path in sorted(folder.glob("transforms_train*.json"))), None)


def load_known_scene(folder: Path, split: str = "train") -> KnownScene:
    """Load camera, ground, lights and picture files of a scene in the ShadowNeuS layout, world frame, scene units.

    The kind of light is `light_type` ("point" or "directional") in transforms_{split}.json or scene.json. Without it,
    the shading decides: photos in which the ground follows 1/d^2 better than a constant have point lights. Without
    photos it is a point, because transform_matrix_sun has a place.
    Every light has the same power. The layout does not give it, so it is set such that the albedo of the brightest 1 %
    of the pixels is about 0.9.

    Args:
        folder: holds transforms_{split}.json, transforms_floor.json and the pictures.
        split: which list of photos, e.g. "train5".

    Raises:
        CalibrationError: a file or field is missing or impossible; the message names both.
    """
    source = folder / f"transforms_{split}.json"
    if not source.is_file():
        others = ", ".join(sorted(p.name for p in folder.glob("transforms_*.json"))) or "no transforms_*.json"
        raise CalibrationError(f"{source} does not exist; the folder has {others}.")
    description = read_scene(source, _Description)
    frames = description.frames
    pictures = _pictures(frames, source)
    shadow_paths = _shadow_paths(pictures)
    usable = scene_photos(pictures, *([shadow_paths] if shadow_paths else []))
    every, pictures, kept = pictures, usable.paths, {path.name for path in usable.paths}
    shadow_paths = shadow_paths and [shadow_paths[row] for row in usable.rows]
    is_shadow_only = _is_shadow_picture(pictures[0]) and _is_shadow_picture(pictures[-1])
    shadow_paths = shadow_paths or (pictures if is_shadow_only else None)
    if any(len(frame.transform_matrix_sun) > 1 for frame in frames):
        if is_shadow_only:
            raise CalibrationError(f"{source}: shadow pictures of several lights at once; one light each is needed.")
        shadow_paths = None  # they do not show which of the lights is hidden
    stack = read_stack(pictures, LONG_SIDE)
    focal = stack.full_width / 2 / np.tan(description.camera_angle_x / 2)
    camera = Camera.centred(stack.full_width, stack.full_height, focal)
    world_from_camera = _fixed_camera(frames, source)
    height = read_scene(folder / "transforms_floor.json", Floor).frames[0].transform_ground[2][3]
    if world_from_camera.translation[2] <= height:
        raise CalibrationError(f"{source}: the camera is below the ground (z = {height:g}); one above it was needed.")
    candidates = {
        kind: tuple(light for light in _lights(frames, every, kind, height, source) if light.photo in kept)
        for kind in ("point", "directional")
    }
    scene = folder / "scene.json"
    kind = description.light_type or (read_scene(scene, _Kind).light_type if scene.is_file() else None)
    calibration = Calibration(camera, world_from_camera, height, candidates[kind or "point"], unit="scene")
    if not is_shadow_only:
        options = [replace(calibration, lights=candidates[k]) for k in ([kind] if kind else candidates)]
        calibration = with_common_power(min(options, key=lambda option: shading_misfit(stack, option)), stack)
    mask = folder / "test_one" / "r_000.png"
    return KnownScene(
        calibration,
        None if is_shadow_only else tuple(pictures),
        tuple(shadow_paths) if shadow_paths else None,
        mask if mask.is_file() else None,
        ground_depth_path=find_ground_depth(folder),
        photos=usable,
    )


def _pictures(frames: Sequence[Frame], source: Path) -> list[Path]:
    pictures = [
        inside(source.parent, f"{frame.file_path.removesuffix('.png')}.png", f"{source}, frame {i}: 'file_path'")
        for i, frame in enumerate(frames)
    ]
    if len({p.name for p in pictures}) < len(pictures):
        raise CalibrationError(f"{source}: two frames share the file name of their 'file_path'; give each its own.")
    return pictures


def _shadow_paths(pictures: list[Path]) -> list[Path] | None:
    paths = [p.with_name(p.stem + "_white_.png") for p in pictures]
    missing = [p.name for p in paths if not p.is_file()]
    if missing and len(missing) < len(paths):
        raise CalibrationError(
            f"{paths[0].parent}: {len(missing)} of {len(paths)} shadow pictures are missing ({missing[0]}, ...); "
            "give all of them or none."
        )
    return None if missing else paths


def _is_shadow_picture(path: Path) -> bool:
    rgb = read_photo(path).rgb
    grey = rgb[..., 1]
    two_valued = np.mean((grey < 0.02) | (grey > 0.98)) > SHADOW_PICTURE_SHARE
    return bool(two_valued and np.allclose(rgb, grey[..., None], atol=0.005))


def _fixed_camera(frames: Sequence[Frame], source: Path) -> Pose:
    matrices = [np.array(frame.transform_matrix) for frame in frames]
    moved = [i for i, m in enumerate(matrices) if not np.allclose(m, matrices[0], atol=SAME_CAMERA_TOLERANCE)]
    if moved:
        raise CalibrationError(
            f"{source}: 'transform_matrix' of frame {moved[0]} differs from frame 0; all photos must share one camera."
        )
    return rigid(matrices[0] @ FROM_BLENDER, f"{source}, frame 0", "'transform_matrix'")


def _lights(frames: Sequence[Frame], pictures: list[Path], kind: str, height: float, source: Path) -> tuple[Light, ...]:
    lights = []
    for i, (frame, path) in enumerate(zip(frames, pictures, strict=True)):
        for matrix in np.array(frame.transform_matrix_sun):
            place, towards = matrix[:3, 3], matrix[:3, 2]  # the light shines along its -z
            if kind != "point":
                length = max(float(np.linalg.norm(towards)), 1e-12)
                lights.append(Light(path.name, kind, direction=towards / length))
            elif place[2] > height:
                lights.append(Light(path.name, kind, position=place))
            else:
                below = f"puts the light below the ground (z = {height:g})."
                raise CalibrationError(f"{source}, frame {i}: 'transform_matrix_sun' {below}")
    return tuple(lights)


IMPORTER = Importer("ShadowNeuS, rendered (transforms_*.json)", _recognised, load_known_scene)


def find_ground_depth(folder: Path) -> Path | None:
    """Return the first floor/*_depth_*.exr or .npy of a scene, by name; None if the ground is a plane."""
    paths = sorted(path for path in folder.glob(PATTERN) if path.suffix.lower() in KINDS)
    return paths[0] if paths else None


def read_ground_depth(path: Path, camera: Camera) -> Float[np.ndarray, "height width"]:
    """Return z-depth of the bare ground at pixel centres, OpenCV camera axes, scene units; nan without ground.

    Args:
        path: .npy, or .exr whose first channel is read.
        camera: of the photos, whose size the map must have.

    Raises:
        CaptureError: not readable.
        CalibrationError: another size than the photos, or hardly any ground in it.
    """
    if path.suffix.lower() == ".exr":
        channels = read_exr(path)
        depth = channels[next((n for n in ("Z", "R", "V", "Y", "B") if n in channels), min(channels))].astype(float)
    else:
        depth = read_npy(path, LARGEST_DEPTH)
    if depth.shape != (camera.height, camera.width):
        raise CalibrationError(
            f"{path} is {' x '.join(map(str, depth.shape[::-1]))}, {camera.width} x {camera.height} pixels as the "
            "photos was needed. Render the bare ground with the camera of the photos."
        )
    known = np.isfinite(depth) & (depth > 0) & (depth < NOTHING)
    if known.mean() < FEWEST_KNOWN:
        raise CalibrationError(
            f"{path}: {100 * known.mean():.2g} % of the pixels have a positive, finite depth, {100 * FEWEST_KNOWN:g} % "
            "were needed. It must hold the z-depth of the bare ground in the unit of the scene."
        )
    return np.where(known, depth, np.nan)


# --- photographs: params.npz -----------------------------------------------------------------------------------------


def _has_photographs(folder: Path) -> str | None:
    files = sorted(folder.glob("params*.npz"))
    is_one = bool(files) and bool(photos_in(folder / PHOTOGRAPHS))
    return f"{files[0].name} and {PHOTOGRAPHS}/" if is_one else None


def _load_photographs(folder: Path, split: str) -> KnownScene:
    """Load camera, ground, point lights (world) and photos.

    Args:
        split: "train" reads params.npz where there is no params_train.npz.

    Raises:
        CalibrationError, CaptureError: an array is missing or impossible, or does not fit the photos.
    """
    source = folder / f"params_{split}.npz"
    if split == TRAIN and not source.is_file():
        source = folder / "params.npz"
    places, pose, height, content = read_params(source, INTRINSICS)
    photos = photos_in(folder / PHOTOGRAPHS)
    if len(photos) != len(places):
        raise CalibrationError(
            f"{source}: light_pose gives {len(places)} lights and {folder / PHOTOGRAPHS} holds {len(photos)} photos; "
            "as many were needed, in the same order."
        )
    usable = scene_photos(photos)
    photos, places = usable.paths, places[usable.rows]
    camera = _stated_camera(content[INTRINSICS], read_size(photos[0]), source)
    low = [path.name for path, place in zip(photos, places, strict=True) if place[2] <= height]
    if pose.translation[2] <= height or low:
        raise CalibrationError(
            f"{source}: floor_height {height:g} lies above {f'the light of {low[0]}' if low else 'the camera'}; a "
            "floor below it was needed (world z is up)."
        )
    lights = [Light(path.name, "point", position=place) for path, place in zip(photos, places, strict=True)]
    calibration = Calibration(camera, pose, height, tuple(lights), unit="scene")
    notes = ["lights: assumed at the camera of the phone that held them"]
    if (folder / MASK).is_file():
        notes.append(f"{MASK}: not used, it marks all possible object pixels; the outline is found from the photos")
    return KnownScene(
        with_common_power(calibration, preview(photos)), tuple(photos), None, None, notes=tuple(notes), photos=usable
    )


def _stated_camera(intrinsics: np.ndarray, size: tuple[int, int], source: Path) -> Camera:
    is_matrix = intrinsics.shape in ((3, 3), (4, 4)) and np.isfinite(intrinsics).all()
    if not is_matrix or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise CalibrationError(
            f"{source}: camera_intrinsics has the shape {intrinsics.shape}, a 4 x 4 matrix with positive focal lengths "
            "was needed."
        )
    fx, fy, cx, cy = (float(intrinsics[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (0 < cx < size[0] and 0 < cy < size[1]):
        raise CalibrationError(
            f"{source}: camera_intrinsics puts the optical axis at ({cx:g}, {cy:g}), outside the photos of {size[0]} x "
            f"{size[1]} pixels; the intrinsics of these photos were needed."
        )
    return Camera(*size, fx, fy, cx - 0.5, cy - 0.5)


OF_PHOTOGRAPHS = Importer("ShadowNeuS, photographs (params.npz)", _has_photographs, _load_photographs)
