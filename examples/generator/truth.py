"""Ground truth by ray casting, in the layout that `shadowgraph evaluate` reads. World frame, mm."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

from calibration.board.board import WORLD_FROM_OPENCV_BOARD, Board
from calibration.camera import Camera
from capture.photos.photo import encode_srgb

from .options import Setup
from .paint import albedo_of, sheet
from .poses import PAPER_MM, Lamp, Viewpoint
from .rendering import BEAM_TEXELS, WARM_WHITE, WIDEST_DEG

LIFT_MM = 1e-2  # a shadow ray starts this far above its own triangle
COVERAGE = 3  # rays per pixel and axis of the antialiased mask
NOTHING = 128  # in shadow pictures
NOVEL_JPEG = 97  # quality


@dataclass(frozen=True, eq=False)
class Seen:
    """The surface at each pixel centre of the fixed camera. World frame; depth is z-depth."""

    depth: Float[np.ndarray, "height width"]
    points: Float[np.ndarray, "height width 3"]
    normals: Float[np.ndarray, "height width 3"]  # as used for shading
    flat: Float[np.ndarray, "height width 3"]  # of the triangles
    mask: Bool[np.ndarray, "height width"]
    face: Int[np.ndarray, "height width"]
    corner_shares: Float[np.ndarray, "height width 3"]


class Rays:
    """A mesh for ray casting."""

    def __init__(self, mesh: trimesh.Trimesh):
        self.mesh = mesh
        self.tracer = RayMeshIntersector(mesh)

    def first(self, start: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Return the first triangle that each ray hits; -1 if none."""
        return np.asarray(self.tracer.intersects_first(start, along), dtype=int)

    def blocked(self, start: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return True for each ray that hits anything."""
        return np.asarray(self.tracer.intersects_any(start, along), dtype=bool)


def camera_rays(camera: Camera, view: Viewpoint) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return start and direction (z = 1 in the camera frame) of the ray through every pixel centre."""
    along = view.world_from_camera.rotate(camera.unproject(camera.pixel_grid()).reshape(-1, 3))
    return np.broadcast_to(view.world_from_camera.translation, along.shape), along


def seen(rays: Rays, view: Viewpoint, setup: Setup, board: Board) -> Seen:
    """Return depth, normals and mask from the fixed camera; behind the object are the table and a board that stays."""
    camera = view.camera
    start, along = camera_rays(camera, view)
    depth = (-PAPER_MM - start[:, 2]) / along[:, 2]
    if setup.table.board_stays:
        on_print = start + (-start[:, 2] / along[:, 2])[:, None] * along
        depth = np.where(_on_sheet(on_print, board), -start[:, 2] / along[:, 2], depth)
    depth = np.where((along[:, 2] < 0), depth, np.inf)
    face = rays.first(start, along)
    mesh, hit = rays.mesh, face >= 0
    corners = mesh.triangles[face]
    normals, flat = np.tile([0.0, 0.0, 1.0], (len(face), 1)), np.tile([0.0, 0.0, 1.0], (len(face), 1))
    flat[hit] = mesh.face_normals[face[hit]]
    reach = ((corners[:, 0] - start) * flat).sum(1)[hit] / (along * flat).sum(1)[hit]
    depth[hit] = reach
    shares = np.zeros((len(face), 3))
    shares[hit] = trimesh.triangles.points_to_barycentric(corners[hit], (start + depth[:, None] * along)[hit])
    smooth = (mesh.vertex_normals[mesh.faces[face[hit]]] * shares[hit][..., None]).sum(1)
    normals[hit] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
    points = start + np.where(np.isfinite(depth), depth, 0)[:, None] * along
    shape = (camera.height, camera.width)
    return Seen(*(a.reshape(*shape, *a.shape[1:]) for a in (depth, points, normals, flat, hit, face, shares)))


def _on_sheet(points: Float[np.ndarray, "n 3"], board: Board) -> Bool[np.ndarray, " n"]:
    _, corner, size = sheet(board)
    place = WORLD_FROM_OPENCV_BOARD.inverse().apply(points)[:, :2] - corner
    return np.all((place >= 0) & (place <= size), axis=1)


def coverage(rays: Rays, view: Viewpoint) -> Float[np.ndarray, "height width"]:
    """Return the share of each pixel that shows the object."""
    camera = view.camera
    fine = camera.resized(COVERAGE * camera.width, COVERAGE * camera.height)
    hit = rays.first(*camera_rays(fine, view)).reshape(fine.height, fine.width) >= 0
    return cv2.resize(hit.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def shadow(rays: Rays, view: Seen, lamp: Lamp) -> np.ndarray:
    """Return 255 where the emitter's centre is visible, 0 if occluded or facing away, 128 where there is no surface."""
    points, flat = view.points.reshape(-1, 3), view.flat.reshape(-1, 3)
    along = lamp.position - points
    faces = (along * flat).sum(1) > 0
    lit = faces.copy()
    lit[faces] = ~rays.blocked(points[faces] + LIFT_MM * flat[faces], along[faces])
    picture = np.where(lit, 255, 0).astype(np.uint8)
    picture[~np.isfinite(view.depth).ravel()] = NOTHING
    return picture.reshape(view.depth.shape)


def write_maps(folder: Path, view: Seen, rays: Rays, fixed: Viewpoint, setup: Setup) -> None:
    """Write maps.npz, mask.png, normal.png, object.ply."""
    colours = albedo_of(rays.mesh, setup.thing)
    albedo = np.zeros((*view.mask.shape, 3))
    corners = rays.mesh.faces[view.face[view.mask]]
    albedo[view.mask] = (colours[corners] * view.corner_shares[view.mask][..., None]).sum(1)
    np.savez_compressed(
        folder / "maps.npz",
        depth_mm=view.depth.astype(np.float32),
        normal=view.normals.astype(np.float16),
        mask=view.mask,
        table=~view.mask & np.isfinite(view.depth),
        albedo=_bytes(albedo),
    )
    cv2.imwrite(str(folder / "mask.png"), _bytes(coverage(rays, fixed)))
    cv2.imwrite(str(folder / "normal.png"), _bytes((view.normals + 1) / 2)[..., ::-1])
    painted = rays.mesh.copy()
    painted.visual = trimesh.visual.ColorVisuals(painted, vertex_colors=_bytes(colours))
    painted.export(folder / "object.ply", vertex_normal=True)


def _bytes(share: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(share, 0, 1)).astype(np.uint8)


def view_json(view: Viewpoint) -> dict[str, Any]:
    """Return a camera as camera.json stores it."""
    camera, pose = view.camera, view.world_from_camera
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.matrix().tolist(),
        "dist_k1_k2_p1_p2_k3": list(camera.distortion),
        "T_cam_from_board": pose.inverse().matrix().tolist(),
        "centre_mm": pose.translation.tolist(),
    }


def write_scene(folder: Path, board: Board, views: dict[str, Viewpoint], setup: Setup) -> None:
    """Write camera.json, board.json, board_photos.json, ground.json. The first of `views` is the tripod's."""
    fixed = view_json(next(iter(views.values())))
    _write(folder / "camera.json", {"exif_orientation": 1, "upright": fixed, "stored": fixed})
    corners = {
        "type": board.kind,
        "spec": board.spec(),
        "inner_corners": list(board.corner_counts()),
        "square_mm": board.square_mm,
        "marker_mm": board.marker_mm,
        "dictionary": board.dictionary,
        "inner_corners_mm": board.points().tolist(),
        "world_from_opencv_board": WORLD_FROM_OPENCV_BOARD.matrix().tolist(),
        "stays_on_table_during_photos": setup.table.board_stays,
        "T_fixedcam_from_board": fixed["T_cam_from_board"],
    }
    _write(folder / "board.json", corners)
    photos = []
    for i, (name, view) in enumerate(views.items()):
        pixels = view.camera.project(view.world_from_camera.inverse().apply(board.points()))
        entry = {"file": name, "exif_orientation": 1, "fixed_camera": i == 0, "stored": view_json(view)}
        photos.append(entry | {"upright": view_json(view), "inner_corners_px_upright": pixels.round(3).tolist()})
    _write(folder / "board_photos.json", photos)
    _write(folder / "ground.json", {"normal": [0, 0, 1], "offset_mm": -PAPER_MM})


def write_lights(folder: Path, lights: list[dict[str, Any]], setup: Setup, intensity: float) -> None:
    """Write lights.json: emitter, room light, one entry per photo."""
    light = setup.flashlight
    emitter = {
        "type": "disc" if light.radius > 0 else "point",
        "radius_mm": light.radius,
        "half_angle_deg": light.beam,
        "profile": f"I0 2^-(theta/half_angle)^2, theta from axis, dark beyond {WIDEST_DEG:g} deg, as a picture of "
        f"{BEAM_TEXELS} px; irradiance I cos/d^2",
        "color": list(WARM_WHITE),
        "exposure_times_I0": intensity,
    }
    ambient = {
        "fraction_of_flash_at_mean_distance": setup.exposure.ambient,
        "mean_distance_mm": float(np.mean(light.reach)),
    }
    _write(folder / "lights.json", {"emitter": emitter, "ambient": ambient, "photos": lights})


def lamp_json(name: str, lamp: Lamp) -> dict[str, Any]:
    """Return one light's entry of a lights file."""
    return {"file": name, "position_mm": lamp.position.tolist(), "axis": lamp.axis.tolist()}


def write_novel(folder: Path, name: str, linear: Float[np.ndarray, "height width 3"], lit: np.ndarray) -> None:
    """Write a noiseless sRGB picture under a light that no photo has, and its shadow."""
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / f"{name}.jpg"), encode_srgb(linear)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, NOVEL_JPEG])
    cv2.imwrite(str(folder / f"{name}_shadow.png"), lit)


def write_novel_lights(folder: Path, lamps: list[Lamp]) -> None:
    """Write novel.json: the lights of those pictures."""
    _write(folder / "novel.json", [lamp_json(f"NOVEL_{i:02d}.jpg", lamp) for i, lamp in enumerate(lamps, 1)])


def _write(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1))
