"""Ground truth by ray casting, in the layout that `shadowgraph evaluate` reads. World frame, mm."""

import json
from dataclasses import asdict, dataclass
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

from .beam import WARM_WHITE, profile
from .options import Setup
from .paint import albedo_of
from .pipeline import ORDER, Developed
from .poses import FLOOR_MM, LED_FROM_LENS_MM, PAPER_MM, Lamp, Viewpoint, edge_of, wall_of
from .rendering import BEAM_TEXELS, led_places
from .sheet import Sheet

LIFT_MM = 1e-2  # a shadow ray starts this far above its own triangle
COVERAGE = 3  # rays per pixel and axis of the antialiased mask
NOTHING = 128  # in shadow pictures
NOVEL_JPEG = 97  # quality
ON_WAVES = 6  # steps to where a ray meets a wavy sheet: each divides the error by the slope, some 0.01


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
    is_table: Bool[np.ndarray, "height width"]  # table or board


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


def seen(rays: Rays, view: Viewpoint, setup: Setup, laid: Sheet) -> Seen:
    """Return depth, normals and mask from the fixed camera; behind the object are table, board, floor, wall."""
    camera = view.camera
    start, along = camera_rays(camera, view)
    depth = _on_table(start, along, laid if setup.table.board_stays else None)
    is_table = np.isfinite(depth)
    normals = np.tile([0.0, 0.0, 1.0], (len(along), 1))
    edge, wall = edge_of(setup, rays.mesh), wall_of(setup, rays.mesh)
    if edge is not None:
        beyond = (start + np.where(is_table, depth, 0)[:, None] * along) @ edge.normal < edge.offset
        is_floor = is_table & beyond
        depth, is_table = np.where(is_floor, (-FLOOR_MM - start[:, 2]) / along[:, 2], depth), is_table & ~is_floor
    if wall is not None:
        towards = -(along @ wall.normal)
        to_wall = np.where(towards > 0, (start @ wall.normal - wall.offset) / np.maximum(towards, 1e-12), np.inf)
        is_wall = to_wall < depth
        depth, is_table = np.where(is_wall, to_wall, depth), is_table & ~is_wall
        normals[is_wall] = wall.normal
    face = rays.first(start, along)
    mesh, hit = rays.mesh, face >= 0
    corners = mesh.triangles[face]
    flat = normals.copy()
    flat[hit] = mesh.face_normals[face[hit]]
    reach = ((corners[:, 0] - start) * flat).sum(1)[hit] / (along * flat).sum(1)[hit]
    depth[hit] = reach
    shares = np.zeros((len(face), 3))
    shares[hit] = trimesh.triangles.points_to_barycentric(corners[hit], (start + depth[:, None] * along)[hit])
    smooth = (mesh.vertex_normals[mesh.faces[face[hit]]] * shares[hit][..., None]).sum(1)
    normals[hit] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
    points = start + np.where(np.isfinite(depth), depth, 0)[:, None] * along
    shape = (camera.height, camera.width)
    found = (depth, points, normals, flat, hit, face, shares, is_table & ~hit)
    return Seen(*(a.reshape(*shape, *a.shape[1:]) for a in found))


def _on_table(
    start: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"], laid: Sheet | None
) -> Float[np.ndarray, " n"]:
    """Return how far along each ray the table is, or the sheet on it; infinite where neither."""
    depth = (-PAPER_MM - start[:, 2]) / along[:, 2]
    if laid is not None:
        on_print = -start[:, 2] / along[:, 2]
        for _ in range(ON_WAVES):
            places = (start + on_print[:, None] * along)[:, :2]
            on_print = (laid.height(places) - start[:, 2]) / along[:, 2]
        depth = np.where(laid.holds((start + on_print[:, None] * along)[:, :2]), on_print, depth)
    return np.where(along[:, 2] < 0, depth, np.inf)


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
    """Write maps.npz, mask.png, normal.png."""
    colours = albedo_of(rays.mesh, setup.thing)
    albedo = np.zeros((*view.mask.shape, 3))
    corners = rays.mesh.faces[view.face[view.mask]]
    albedo[view.mask] = (colours[corners] * view.corner_shares[view.mask][..., None]).sum(1)
    np.savez_compressed(
        folder / "maps.npz",
        depth_mm=view.depth.astype(np.float32),
        normal=view.normals.astype(np.float16),
        mask=view.mask,
        table=view.is_table,
        albedo=_bytes(albedo),
    )
    cv2.imwrite(str(folder / "mask.png"), _bytes(coverage(rays, fixed)))
    cv2.imwrite(str(folder / "normal.png"), _bytes((view.normals + 1) / 2)[..., ::-1])


def write_object(folder: Path, mesh: trimesh.Trimesh, setup: Setup) -> None:
    """Write object.ply."""
    painted = mesh.copy()
    painted.visual = trimesh.visual.ColorVisuals(painted, vertex_colors=_bytes(albedo_of(mesh, setup.thing)))
    painted.export(folder / "object.ply", vertex_normal=True)


def write_seen(folder: Path, seen: dict[str, Bool[np.ndarray, " faces"]]) -> None:
    """Write seen.npz: which faces of object.ply each view sees."""
    np.savez_compressed(folder / "seen.npz", names=np.array(list(seen)), seen=np.stack(list(seen.values()), 1))


def faces_seen(rays: Rays, view: Viewpoint) -> Bool[np.ndarray, " faces"]:
    """Return which triangles have a middle that the camera sees."""
    mesh, camera, eye = rays.mesh, view.camera, view.world_from_camera.translation
    middles, normals = np.array(mesh.triangles_center), np.array(mesh.face_normals)
    along = eye - middles
    local = view.world_from_camera.inverse().apply(middles)
    pixels = camera.project(np.where(local[:, 2:] > 0, local, [0.0, 0.0, 1.0]))
    inside = ((pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(1) & (local[:, 2] > 0)
    out = inside & ((along * normals).sum(1) > 0)
    out[out] = ~rays.blocked(middles[out] + LIFT_MM * normals[out], along[out])
    return out


def write_motion(folder: Path, object_from_turned: Float[np.ndarray, "4 4"]) -> None:
    """Write pose.json: the rigid motion between two object poses, each in its own board frame, mm."""
    back = np.linalg.inv(object_from_turned)
    note = "X_object = T_object_from_turned X_turned, where X_object is where the same point lay during view_*"
    pose = {"T_object_from_turned": object_from_turned.tolist(), "T_turned_from_object": back.tolist(), "note": note}
    _write(folder / "pose.json", pose)


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


def write_scene(folder: Path, laid: Sheet, views: dict[str, Viewpoint], setup: Setup, thing: trimesh.Trimesh) -> None:
    """Write camera.json, board.json, board_photos.json, ground.json. The first of `views` is the tripod's."""
    board, fixed = laid.board, view_json(next(iter(views.values())))
    _write(folder / "camera.json", {"exif_orientation": 1, "upright": fixed, "stored": fixed})
    corners = {
        "type": board.kind if isinstance(board, Board) else "blank",
        "spec": board.spec(),
        "inner_corners_mm": laid.corners().tolist(),
        "world_from_opencv_board": WORLD_FROM_OPENCV_BOARD.matrix().tolist(),
        "stays_on_table_during_photos": setup.table.board_stays,
        "T_fixedcam_from_board": fixed["T_cam_from_board"],
    }
    if isinstance(board, Board):
        corners["inner_corners"] = list(board.corner_counts())
        corners |= {"square_mm": board.square_mm, "marker_mm": board.marker_mm, "dictionary": board.dictionary}
    if setup.table.wavy > 0:
        corners["inner_corners_nominal_mm"] = board.points().tolist()
    _write(folder / "board.json", corners)
    photos = _with_board(views, laid)
    for i, entry in enumerate(photos):
        entry["fixed_camera"] = i == 0
    _write(folder / "board_photos.json", photos)
    ground: dict[str, Any] = {"normal": [0, 0, 1], "offset_mm": -PAPER_MM}
    for name, plane in (("wall", wall_of(setup, thing)), ("edge", edge_of(setup, thing))):
        if plane is not None:
            ground[name] = {"normal": plane.normal.tolist(), "offset_mm": plane.offset}
    _write(folder / "ground.json", ground)


def _with_board(views: dict[str, Viewpoint], laid: Sheet) -> list[dict[str, Any]]:
    """Return camera and board corners of photos with the board."""
    photos = []
    for name, view in views.items():
        pixels = view.camera.project(view.world_from_camera.inverse().apply(laid.corners()))
        entry = {"file": name, "exif_orientation": 1, "fixed_camera": False, "stored": view_json(view)}
        photos.append(entry | {"upright": view_json(view), "inner_corners_px_upright": pixels.round(3).tolist()})
    return photos


def write_sides(folder: Path, views: dict[str, Viewpoint], laid: Sheet, rays: Rays) -> None:
    """Write side_photos.json, and the object's antialiased mask in each photo to side/."""
    _write(folder / "side_photos.json", _with_board(views, laid))
    (folder / "side").mkdir(parents=True, exist_ok=True)
    for name, view in views.items():
        cv2.imwrite(str(folder / "side" / f"{Path(name).stem}_mask.png"), _bytes(coverage(rays, view)))


def write_light_phone(
    folder: Path, photos: dict[str, tuple[str, Viewpoint, Lamp]], laid: Sheet, clock_s: float
) -> None:
    """Write light_phone.json: the camera of the phone with the flashlight, and its pose in each photo.

    Args:
        photos: by name: the tripod's photo of the same moment, view, flashlight.
    """
    entries = []
    for name, (photo, view, lamp) in photos.items():
        pose, camera = view_json(view), view.camera
        pixels = camera.project(view.world_from_camera.inverse().apply(laid.corners()))
        is_inside = bool(np.all((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1])))
        entry = {"file": name, "photo": photo, "led_mm": lamp.position.tolist(), "board_inside_frame": is_inside}
        entries.append(entry | {key: pose[key] for key in ("T_cam_from_board", "centre_mm")})
    lens = {key: pose[key] for key in ("width", "height", "K", "dist_k1_k2_p1_p2_k3")} if photos else {}
    offset = {"led_offset_in_lens_frame_mm": list(LED_FROM_LENS_MM), "clock_offset_s": clock_s}
    _write(folder / "light_phone.json", lens | offset | {"photos": entries})


def write_lights(folder: Path, lights: list[dict[str, Any]], setup: Setup, intensity: float) -> None:
    """Write lights.json: emitter, room light, one entry per photo; isp.json: the phone's pipeline, if it is on."""
    light = setup.flashlight
    emitter = {
        "type": "disc" if light.radius > 0 else "point",
        "radius_mm": light.radius,
        **({"half_angle_deg": light.beam} if light.optics == "even" else {}),
        "profile": f"{profile(light)}, as a picture of {BEAM_TEXELS} px; irradiance I cos/d^2",
        "color": list(WARM_WHITE),
        "exposure_times_I0": intensity,
    }
    if light.sweep > 0:
        emitter["sweep"] = "the emitter moves by sweep_mm, evenly about position_mm, during the exposure"
    ambient = {
        "fraction_of_flash_at_mean_distance": setup.exposure.ambient,
        "mean_distance_mm": float(np.mean(light.reach)),
    }
    _write(folder / "lights.json", {"emitter": emitter, "ambient": ambient, "photos": lights})
    if setup.pipeline.pipeline:
        _write(folder / "isp.json", asdict(setup.pipeline) | {"order": ORDER})


def lamp_json(name: str, lamp: Lamp) -> dict[str, Any]:
    """Return one light's entry of a lights file."""
    return {"file": name, "position_mm": lamp.position.tolist(), "axis": lamp.axis.tolist()}


def photo_json(photo: Developed, lamp: Lamp, setup: Setup) -> dict[str, Any]:
    """Return what further is true of one photo under the flashlight, as far as the setup has it."""
    out: dict[str, Any] = {}
    if setup.flashlight.sweep > 0:
        out["sweep_mm"] = lamp.sweep.tolist()
    if setup.flashlight.optics == "two-leds":
        out["leds_mm"] = led_places(lamp, setup.flashlight)
    if setup.pipeline.pipeline:
        out |= {"exposure_gain": photo.gain, "white_balance": list(photo.white_balance)}
    return out | {"clipped_fraction": float((photo.pixels == 255).any(2).mean())}


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
