"""Render flashlight, its indirect light and room light with Mitsuba. Linear radiance, in the lens's pinhole view.

The scalar variant needs no LLVM on the machine; it uses all cores by itself.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import trimesh
from jaxtyping import Float

from calibration.board.board import WORLD_FROM_OPENCV_BOARD, Board
from calibration.camera import Camera

from .lens import Lens, lens_of
from .options import Flashlight, Setup
from .paint import albedo_of, sheet, table_top
from .poses import GOLDEN, PAPER_MM, Lamp, Viewpoint

mi.set_variant("scalar_rgb")

Picture = Float[np.ndarray, "height width 3"]
FINER = 2  # pinhole pixels per photo pixel and axis: resampling blurs half of one of them
TABLE_MM = 1000.0  # half of its side
WARM_WHITE = (1.0, 0.965, 0.9)
EMITTER_POINTS = 16  # of a round emitter: penumbras come in so many steps
WIDEST_DEG = 86.0  # off the beam's axis; beyond it is dark
BEAM_TEXELS = 1024
ROOM_SAMPLES = 16  # per photo pixel: one picture serves all photos
BOUNCE_SAMPLES = 2  # smoothed afterwards
SMOOTH_PX = 12  # indirect light varies slowly
SHAPE_MM = 40.0  # distance that weighs as much as a change of the normal by one radian
SAME_SHAPE = 1e-4  # variance of the guide within a window, below which it is one smooth surface
DARKEST = 0.01  # albedo: nothing is black
DIRECT = {"type": "path", "max_depth": 2}
ONE_BOUNCE = {"type": "path", "max_depth": 3}


@dataclass(frozen=True)
class Stage:
    """The scene of table, board and object for the renderer, and the camera's lens."""

    setup: Setup
    board: Board
    thing: trimesh.Trimesh
    lens: Lens
    coarse: Lens  # the same with a pinhole pixel per photo pixel
    shapes: dict[str, Any]  # Mitsuba's, by name: table, board, thing
    beam: Any  # Mitsuba's picture of the flashlight's beam

    def showing(self, has_thing: bool, has_board: bool) -> dict[str, Any]:
        """Return the shapes of one photo."""
        gone = {name for name, is_there in (("thing", has_thing), ("board", has_board)) if not is_there}
        return {name: shape for name, shape in self.shapes.items() if name not in gone}


def stage(setup: Setup, board: Board, thing: trimesh.Trimesh, camera: Camera, rng: np.random.Generator) -> Stage:
    """Build the scene of table, board and object for one camera, at any pose."""
    art, corner, size = sheet(board)
    middle = WORLD_FROM_OPENCV_BOARD.apply(np.array([*(corner + size / 2), 0.0]))
    shapes = {
        "table": _rectangle(table_top(setup.table.table, rng), np.zeros(2), 2 * TABLE_MM * np.ones(2), -PAPER_MM),
        "board": _rectangle(np.repeat(art, 3, 2), middle[:2], size, 0.0),
        "thing": _solid(thing, setup),
    }
    return Stage(
        setup, board, thing, lens_of(camera, FINER), lens_of(camera, 1), shapes, _beam_picture(setup.flashlight)
    )


@dataclass(frozen=True)
class Guide:
    """Pictures of a view independent of light: albedo, and a guide whose edges are those of shape. Coarse pinhole."""

    albedo: Picture
    shape: Picture


def guide(stage: Stage, view: Viewpoint) -> Guide:
    """Render the pictures that guide the smoothing of indirect light."""
    scene = stage.showing(has_thing=True, has_board=stage.setup.table.board_stays)
    wanted = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,position:position"}
    pictures = _rendered(scene, wanted, stage.coarse, view, ROOM_SAMPLES, seed=0)
    albedo, normal, position = pictures[..., :3], pictures[..., 3:6], pictures[..., 6:9]
    return Guide(np.maximum(albedo, DARKEST), np.ascontiguousarray(normal + position / SHAPE_MM))


def flash(stage: Stage, view: Viewpoint, seen: Guide, lamp: Lamp, seed: int) -> Picture:
    """Render the photo under one flashlight of intensity 1 on its axis: albedo / pi * cos / d^2 if unoccluded."""
    setup = stage.setup
    scene = stage.showing(has_thing=True, has_board=setup.table.board_stays) | _emitter(
        lamp, setup.flashlight, stage.beam
    )
    direct = _rendered(scene, DIRECT, stage.lens, view, setup.exposure.samples, seed)
    if not setup.exposure.indirect:
        return stage.lens.photo(direct)
    both = _rendered(scene, ONE_BOUNCE, stage.coarse, view, BOUNCE_SAMPLES, seed)
    bounced = both - cv2.resize(direct, both.shape[1::-1], interpolation=cv2.INTER_AREA)
    bounced = cv2.ximgproc.guidedFilter(seen.shape, bounced / seen.albedo, SMOOTH_PX, SAME_SHAPE)
    return stage.lens.photo(direct) + stage.coarse.photo(seen.albedo * np.maximum(bounced, 0))


def room(stage: Stage, view: Viewpoint, has_thing: bool, has_board: bool, seed: int) -> Picture:
    """Render the view under uniform light from all directions: the result is the albedo where nothing occludes."""
    scene = stage.showing(has_thing, has_board) | {"sky": {"type": "constant", "radiance": 1.0}}
    samples = ROOM_SAMPLES if has_thing else stage.setup.exposure.samples
    even = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0}  # no noise in the open
    return stage.lens.photo(_rendered(scene, even, stage.lens, view, samples, seed))


def beam(cosine: Float[np.ndarray, "*batch"], half_angle_deg: float) -> Float[np.ndarray, "*batch"]:
    """Return the share of the intensity on the axis: 2 ** -(angle / half angle)^2, dark beyond WIDEST_DEG."""
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return np.where(angle < WIDEST_DEG, np.exp2(-((angle / half_angle_deg) ** 2)), 0.0)


def _rendered(
    scene: dict[str, Any], integrator: dict[str, Any], lens: Lens, view: Viewpoint, samples: int, seed: int
) -> Float[np.ndarray, "height width channels"]:
    """Render the lens's pinhole picture, with about `samples` rays per photo pixel."""
    whole = {"type": "scene", "integrator": integrator, "camera": _sensor(lens.pinhole, view), **scene}
    picture = mi.render(mi.load_dict(whole), spp=max(1, samples // lens.finer**2), seed=seed)
    return np.array(picture, np.float32)


def _sensor(pinhole: Camera, view: Viewpoint) -> dict[str, Any]:
    """Return Mitsuba's sensor; its camera frame has x to the left and y up."""
    turned = view.world_from_camera.matrix() @ np.diag([-1.0, -1.0, 1.0, 1.0])
    film = {"type": "hdrfilm", "width": pinhole.width, "height": pinhole.height, "rfilter": {"type": "box"}}
    fov = float(2 * np.degrees(np.arctan(pinhole.width / 2 / pinhole.fx)))
    return {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "x",
        "near_clip": 1.0,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(turned),
        "film": film | {"pixel_format": "rgb", "component_format": "float32"},
    }


def _emitter(lamp: Lamp, light: Flashlight, texture: Any) -> dict[str, Any]:
    """Return point emitters spread over a disc, each with the same beam."""
    side = np.cross(lamp.axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    count = EMITTER_POINTS if light.radius > 0 else 1
    out = {}
    for i in range(count):
        angle, radius = i * GOLDEN, light.radius * np.sqrt((i + 0.5) / count)
        place = lamp.position + radius * (np.cos(angle) * side + np.sin(angle) * np.cross(lamp.axis, side))
        out[f"lamp{i}"] = {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at(list(place), list(place + lamp.axis), list(side)),
            "intensity": {"type": "rgb", "value": [c / count for c in WARM_WHITE]},
            "cutoff_angle": WIDEST_DEG,
            "beam_width": WIDEST_DEG,
            "texture": texture,
        }
    return out


def _beam_picture(light: Flashlight) -> Any:
    """Return the texture of the beam: its picture on a wall straight ahead."""
    slope = ((np.arange(BEAM_TEXELS) + 0.5) / BEAM_TEXELS * 2 - 1) * np.tan(np.radians(WIDEST_DEG))
    cosine = 1 / np.sqrt(1 + slope[:, None] ** 2 + slope[None] ** 2)
    picture = mi.Bitmap(np.repeat(beam(cosine, light.beam)[..., None], 3, 2).astype(np.float32))
    return mi.load_dict({"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"})


def _rectangle(art: Picture, middle: Float[np.ndarray, "2"], size: Float[np.ndarray, "2"], z: float) -> Any:
    """Return a flat matt picture whose first row is at the largest y; Mitsuba's first row is at the smallest."""
    place = mi.ScalarTransform4f().translate([*middle, z]).scale([*(size / 2), 1.0])
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(art[::-1])), "raw": True}
    bsdf = {"type": "diffuse", "reflectance": texture}
    return mi.load_dict({"type": "rectangle", "to_world": place, "bsdf": bsdf})


def _solid(mesh: trimesh.Trimesh, setup: Setup) -> Any:
    """Return the object with its albedo per vertex and, if glossy, a dielectric specular layer."""
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    thing = setup.thing
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": colour}
    if thing.gloss > 0:
        bsdf = {"type": "principled", "base_color": colour, "roughness": thing.roughness, "specular": thing.gloss}
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    out = mi.Mesh("thing", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=properties)
    out.add_attribute("vertex_color", 3, albedo_of(mesh, thing).astype(np.float32).ravel())
    parameters = mi.traverse(out)
    parameters["vertex_positions"] = np.ascontiguousarray(mesh.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.ascontiguousarray(mesh.vertex_normals, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    parameters.update()
    return out
