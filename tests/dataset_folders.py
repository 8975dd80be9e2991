"""Synthetic scenes as folders in the layouts of other programs, each written from its documentation alone."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from synthetic import Truth

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.known_scene import KnownScene
from calibration.light import Light
from calibration.pose import Pose
from calibration.scenes.importers import find_importer
from capture.photos.photo import encode_srgb
from reconstruct.source.calibrate_source import calibrate_source
from reconstruct.source.photos import Photos, read_photos
from reconstruct.source.source import RunOptions, Source, open_source


def loaded(folder: Path) -> KnownScene:
    """A folder of another program, by the importer that knows it."""
    importer = find_importer(folder)
    assert importer is not None
    return importer.load(folder, "train")


def calibrated(folder: Path, **options: Any) -> tuple[Source, tuple[Photos, ...], Calibration]:
    """The folder as a run with these options finds it: its source, photos, and the calibration of its first view."""
    chosen = RunOptions(**options)
    source = open_source(folder, chosen)
    photos = read_photos(source, chosen)
    return source, photos, calibrate_source(source, photos, chosen).first


OPENGL = np.diag([1.0, -1.0, -1.0])  # camera axes x right, y up, z back, from OpenCV's


def from_above(side: int, height: float = 40.0) -> tuple[Camera, Pose]:
    """A distant camera that looks straight down at `height` mm, where a pixel is 1 mm wide."""
    focal = 10.0 * side
    camera = Camera(side, side, focal, focal, side / 2 - 0.5, side / 2 - 0.5)
    return camera, Pose(OPENGL, np.array([0.0, 0.0, height + focal]))


def write_photo(path: Path, linear: np.ndarray, curve: str = "sRGB") -> None:
    """8-bit sRGB, or 8- or 16-bit linear."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scaled = {"sRGB": encode_srgb, "linear8": lambda x: np.round(255 * x).astype(np.uint8)}
    values = scaled[curve](linear) if curve in scaled else np.round(65535 * linear).astype(np.uint16)
    assert cv2.imwrite(str(path), values[..., ::-1])


def write_grey(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.round(255 * values).astype(np.uint8))


def towards_lights(truth: Truth) -> np.ndarray:
    """Directions of directional lights in the picture's axes: x right, y up, z towards the camera."""
    pose = truth.calibration.world_from_camera
    world = np.array([light.direction for light in truth.calibration.lights], float)
    return pose.inverse().rotate(world) @ OPENGL


def places(truth: Truth) -> np.ndarray:
    return np.array([light.position for light in truth.calibration.lights], float)


def write_diligent(folder: Path, truth: Truth, intensities: np.ndarray, background: float = 0.0) -> None:
    """The object in the dark, 16 bits, numbered; intensities (photos, 3) scale each photo."""
    keep = np.where(truth.mask, 1.0, background)[..., None]
    for i, rgb in enumerate(truth.stack.rgb):
        write_photo(folder / f"{i + 1:03d}.png", np.clip(rgb * keep * intensities[i], 0, 1), "linear16")
    names = [f"{i + 1:03d}.png" for i in range(len(truth.stack.rgb))]
    (folder / "filenames.txt").write_text("\n".join(names) + "\n")
    np.savetxt(folder / "light_directions.txt", towards_lights(truth), fmt="%.8f")
    np.savetxt(folder / "light_intensities.txt", intensities, fmt="%.8f")
    write_grey(folder / "mask.png", truth.mask)
    write_photo(folder / "Normal_gt.png", truth.normals / 2 + 0.5)


def write_rti(folder: Path, truth: Truth, decimal: str = ".", prefix: str = "") -> list[str]:
    """jpeg-exports/ and assembly-files/*.lp as RTIBuilder leaves them, but PNG; returns the .lp's lines."""
    lines = [str(len(truth.stack.rgb))]
    for i, (rgb, towards) in enumerate(zip(truth.stack.rgb, towards_lights(truth), strict=True)):
        write_photo(folder / "jpeg-exports" / f"stone_{i + 1:02d}.png", rgb)
        numbers = " ".join(f"{x:.6f}".replace(".", decimal) for x in towards)
        lines.append(f"{prefix}stone_{i + 1:02d}.jpg {numbers}")
    (folder / "assembly-files").mkdir()
    (folder / "assembly-files" / "stone.lp").write_text("\n".join(lines))
    return lines


def write_s3nerf(folder: Path, truth: Truth, unit: float = 0.01, below: float = 1.0) -> None:
    """A rendered scene in another unit whose ground lies at z = -below; photos 2, 4, 6, ... of twice as many lights."""
    camera, pose = truth.calibration.camera, truth.calibration.world_from_camera
    shift = np.array([0.3, -0.2, -below])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation @ OPENGL, pose.translation * unit + shift
    lights = np.repeat(places(truth) * unit + shift, 2, axis=0)
    lights[::2] += 1.0  # those of photos 1, 3, 5, ..., which are not there
    for i, rgb in enumerate(truth.stack.rgb):
        write_photo(folder / "rgb" / f"{2 * i + 2:03d}.png", rgb, "linear8")
        write_grey(folder / "visibility" / f"{2 * i + 2:03d}.png", truth.visibility[i])
    write_grey(folder / "mask_obj.png", truth.mask)
    k = camera.matrix() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    given = {"obj_name": "heap", "imhw": [camera.height, camera.width], "K": k.tolist()}
    given |= {"pose_c2w": matrix.tolist(), "light_pos": lights.tolist(), "light_pos_test": []}
    (folder / "params.json").write_text(json.dumps(given))


def write_shadowneus_real(folder: Path, truth: Truth, unit: float = 0.01, floor: float = 0.5) -> None:
    """Photographs with params.npz: OpenCV camera axes, pixel centres at +0.5."""
    camera, pose = truth.calibration.camera, truth.calibration.world_from_camera
    lift = np.array([0.0, 0.0, floor])
    poses = np.stack([np.eye(4)] * len(truth.stack.rgb))
    poses[:, :3, 3] = places(truth) * unit + lift
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation * unit + lift
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = camera.matrix() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    arrays = {"light_pose": poses, "camera_pose": matrix, "camera_intrinsics": intrinsics, "floor_height": floor}
    for i, rgb in enumerate(truth.stack.rgb):
        write_photo(folder / "image" / f"{i:03d}.png", rgb)
    write_grey(folder / "mask.png", cv2.dilate(truth.mask.astype(np.uint8), np.ones((9, 9))))
    np.savez(folder / "params.npz", **arrays)


def sun_matrix(light: Light) -> list[list[float]]:
    """World from light in Blender axes: shines along -z."""
    place = np.array(light.position) if light.kind == "point" else 500 * np.array(light.direction)
    back = place / np.linalg.norm(place)
    side = np.cross([0.3, 0.4, 0.86], back)
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3] = np.stack([side, np.cross(back, side), back, place], 1)
    return matrix.tolist()


def write_shadowneus(folder: Path, truth: Truth, light_type: str | None = "point", pictures: str = "colour") -> Path:
    """Rendered pictures with the scene's description; pictures: "colour", "shadow", or "both" and a silhouette."""
    camera, pose = truth.calibration.camera, truth.calibration.world_from_camera
    matrix, frames = np.eye(4), []
    matrix[:3, :3], matrix[:3, 3] = pose.rotation @ OPENGL, pose.translation
    for i, (light, rgb) in enumerate(zip(truth.calibration.lights, truth.stack.rgb, strict=True)):
        name = f"train/r_{i:03d}"
        if pictures == "shadow":
            write_grey(folder / f"{name}.png", truth.visibility[i])
        else:
            write_photo(folder / f"{name}.png", rgb)
        if pictures == "both":
            write_grey(folder / f"{name}_white_.png", truth.visibility[i])
        matrices = {"transform_matrix": matrix.tolist(), "transform_matrix_sun": sun_matrix(light)}
        frames.append({"file_path": name, **matrices})
    if pictures == "both":
        (folder / "test_one").mkdir()
        silhouette = np.zeros((camera.height, camera.width, 4), np.uint8)
        silhouette[..., 3] = 255 * truth.mask
        cv2.imwrite(str(folder / "test_one" / "r_000.png"), silhouette)
    scene = {"camera_angle_x": float(2 * np.arctan(camera.width / 2 / camera.fx)), "frames": frames}
    scene |= {} if light_type is None else {"light_type": light_type}
    (folder / "transforms_train.json").write_text(json.dumps(scene))
    (folder / "transforms_floor.json").write_text(json.dumps({"frames": [{"transform_ground": np.eye(4).tolist()}]}))
    return folder


def write_deepshadow(folder: Path, truth: Truth, height: float = 400.0) -> None:
    """Grey pictures of where the light arrives, seen from this height."""
    for i, grey in enumerate(truth.visibility):
        write_grey(folder / "0" / f"cup_0_{i}_shadow1.png", grey)
    lines = [f"cup_0_{i} {x} {y} {z}" for i, (x, y, z) in enumerate(places(truth))]
    (folder / "all_object_lights.txt").write_text("\n".join(lines) + "\n")
    given = {"focal_length": 44.0, "cam_location_x": 0.0, "cam_location_y": 0.0, "cam_location_z": height}
    (folder / "params.json").write_text(json.dumps(given))
