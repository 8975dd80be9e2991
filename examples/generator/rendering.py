"""Render flashlight, its indirect light and room light with Mitsuba. Linear radiance, in the lens's pinhole view.

The scalar variant needs no LLVM on the machine; both use all cores by themselves.
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import trimesh
from jaxtyping import Float
from scipy import ndimage

from calibration.board.board import AnyBoard, Blank
from calibration.camera import Camera
from capture.errors import CaptureError

from .beam import WIDEST_DEG, beam, leds
from .lens import Lens, lens_of
from .options import Flashlight, Setup
from .paint import albedo_of, outline, sheet, table_top
from .poses import FLOOR_MM, GOLDEN, PAPER_MM, Lamp, Upright, Viewpoint, edge_of, wall_of
from .sheet import GRID, lay

Picture = Float[np.ndarray, "height width 3"]
FINER = 2  # pinhole pixels per photo pixel and axis: resampling blurs half of one of them
TABLE_MM = 1000.0  # half of its side
FLOOR_SIDE_MM = 8000.0
FLOOR_DARKER = 0.5  # than a table of stone
WALL_MM = (3000.0, 2400.0)  # width and height
WALL_BRIGHTER = 1.15  # than a plain table
EMITTER_POINTS = 16  # of a round emitter, and of its way during the exposure: penumbras come in so many steps
STRIDE = 7  # steps of the way are taken in another order than those of the disc
BEAM_TEXELS = 1024
ROOM_SAMPLES = 16  # per photo pixel: one picture serves all photos
BOUNCE_SAMPLES = 2  # smoothed afterwards
SMOOTH_PX = 12  # indirect light varies slowly
GLOSS_BOUNCE_SAMPLES, GLOSS_SMOOTH_PX = 8, 4  # where a varnished table mirrors the object; of half the size
SPARK_PX = 5  # width of the median that takes single bright paths out, such as by way of the varnish to the wall
ROOM_SMOOTH_PX = 6
SHAPE_MM = 40.0  # distance that weighs as much as a change of the normal by one radian
SAME_SHAPE = 1e-4  # variance of the guide within a window, below which it is one smooth surface
DARKEST = 0.01  # albedo: nothing is black
MOST_LIGHT = 1.5  # of a room, in radiance of the sky: more is an edge
EMPTY = 1.0  # albedo where there is nothing: the sky's light stays what it is
DIRECT = {"type": "path", "max_depth": 2}
ONE_BOUNCE = {"type": "path", "max_depth": 3}


@dataclass(frozen=True)
class Stage:
    """The scene of table, board and object for the renderer, and the camera's lens."""

    setup: Setup
    board: AnyBoard
    thing: trimesh.Trimesh
    lens: Lens
    coarse: Lens  # the same with a pinhole pixel per photo pixel
    shapes: dict[str, Any]  # Mitsuba's, by name: table, board, thing, perhaps wall and what is in single photos
    beam: Any  # Mitsuba's picture of the flashlight's beam

    def with_arm(self, mesh: trimesh.Trimesh, colour: Float[np.ndarray, "vertices 3"]) -> "Stage":
        """Return the scene with somebody's arm in it."""
        bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        return replace(self, shapes=self.shapes | {"arm": _mesh("arm", mesh, bsdf, colour)})

    def seen_by(self, camera: Camera) -> "Stage":
        """Return the scene for another camera."""
        return replace(self, lens=lens_of(camera, FINER), coarse=lens_of(camera, 1))

    def showing(self, has_thing: bool, has_board: bool) -> dict[str, Any]:
        """Return the shapes of one photo."""
        gone = {name for name, is_there in (("thing", has_thing), ("board", has_board)) if not is_there}
        return {name: shape for name, shape in self.shapes.items() if name not in gone}


def stage(setup: Setup, board: AnyBoard, thing: trimesh.Trimesh, camera: Camera, rng: np.random.Generator) -> Stage:
    """Build the scene of table, board and object for one camera, at any pose.

    Raises:
        CaptureError: there is no LLVM for the variant that needs it.
    """
    try:
        mi.set_variant("llvm_ad_rgb" if setup.exposure.llvm else "scalar_rgb")
    except ImportError as error:
        raise CaptureError(f"--llvm cannot be used: {error}. Leave it out.") from error
    top = _painted(table_top(setup.table.table, rng), setup.table.varnish, setup.table.varnish_roughness)
    edge = edge_of(setup, thing)
    shapes = {
        "table": _table(top) if edge is None else _table_to(edge, top),
        "board": _board(board, setup),
        "thing": _solid(thing, setup),
    }
    wall = wall_of(setup, thing)
    if wall is not None:
        paint = np.clip(WALL_BRIGHTER * table_top("plain", setup.stream("wall")), 0, 0.95)
        shapes["wall"] = mi.load_dict(_upright(wall, thing) | {"bsdf": _painted(paint)})
    if edge is not None:
        paint = _painted(FLOOR_DARKER * table_top("stone", setup.stream("floor")))
        shapes["floor"] = mi.load_dict(_rectangle(np.zeros(2), FLOOR_SIDE_MM * np.ones(2), -FLOOR_MM) | {"bsdf": paint})
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
    return _guide(stage.coarse, scene, view, ROOM_SAMPLES)


def _guide(lens: Lens, scene: dict[str, Any], view: Viewpoint, samples: int, empty: float = DARKEST) -> Guide:
    wanted = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,position:position"}
    pictures = _rendered(scene, wanted, lens, view, samples, seed=0)
    albedo, normal, position = pictures[..., :3], pictures[..., 3:6], pictures[..., 6:9]
    albedo = np.where(normal.any(-1, keepdims=True), np.maximum(albedo, DARKEST), empty)
    return Guide(albedo, np.ascontiguousarray(normal + position / SHAPE_MM))


def flash(stage: Stage, view: Viewpoint, seen: Guide, lamp: Lamp, seed: int) -> Picture:
    """Render the photo under one flashlight of intensity 1 on its axis: albedo / pi * cos / d^2 if unoccluded."""
    setup = stage.setup
    scene = stage.showing(has_thing=True, has_board=setup.table.board_stays) | _emitter(
        lamp, setup.flashlight, stage.beam
    )
    direct = _rendered(scene, DIRECT, stage.lens, view, setup.exposure.samples, seed)
    if not setup.exposure.indirect:
        return stage.lens.photo(direct)
    if setup.table.varnish > 0:
        lens, samples, width = stage.coarse.halved(), GLOSS_BOUNCE_SAMPLES, GLOSS_SMOOTH_PX
    else:
        lens, samples, width = stage.coarse, BOUNCE_SAMPLES, SMOOTH_PX
    size = (lens.pinhole.width, lens.pinhole.height)
    both = _rendered(scene, ONE_BOUNCE, lens, view, samples, seed)
    bounced = both - cv2.resize(direct, size, interpolation=cv2.INTER_AREA)
    bounced = _smoothed(bounced, seen, width)
    return stage.lens.photo(direct) + stage.coarse.photo(seen.albedo * np.maximum(bounced, 0))


def _smoothed(light: Picture, seen: Guide, width: int) -> Picture:
    """Return light divided by albedo, smoothed within each smooth surface, at the guide's size."""
    height, columns = light.shape[:2]
    full = seen.albedo.shape[1::-1]
    if full == (columns, height):
        return cv2.ximgproc.guidedFilter(seen.shape, light / seen.albedo, width, SAME_SHAPE)
    light = cv2.medianBlur(np.ascontiguousarray(light), SPARK_PX)
    albedo, shape = (cv2.resize(p, (columns, height), interpolation=cv2.INTER_AREA) for p in (seen.albedo, seen.shape))
    return cv2.resize(cv2.ximgproc.guidedFilter(shape, light / albedo, width, SAME_SHAPE), full)


def room(
    stage: Stage, view: Viewpoint, has_thing: bool, has_board: bool, seed: int, has_furniture: bool = False
) -> Picture:
    """Render the view under uniform light from all directions: the result is the albedo where nothing occludes.

    Args:
        has_furniture: the light is not uniform, and what is seen beyond the table is a room, not white.
    """
    sky = {"type": "constant", "radiance": 1.0} if not has_furniture else _furniture(stage.setup)
    scene = stage.showing(has_thing, has_board) | {"sky": sky}
    even = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0}  # no noise in the open
    if stage.setup.table.wall > 0 or stage.setup.table.varnish > 0 or has_furniture:  # what is noisy everywhere
        fine = _guide(stage.lens, scene, view, stage.setup.exposure.samples, EMPTY)
        coarse = _guide(stage.coarse, scene, view, ROOM_SAMPLES, EMPTY)
        light = _rendered(scene, even, stage.coarse, view, ROOM_SAMPLES, seed)
        light = cv2.resize(_smoothed(light, coarse, ROOM_SMOOTH_PX), fine.albedo.shape[1::-1])
        return stage.lens.photo(fine.albedo * np.clip(light, 0, MOST_LIGHT))
    samples = ROOM_SAMPLES if has_thing else stage.setup.exposure.samples
    return stage.lens.photo(_rendered(scene, even, stage.lens, view, samples, seed))


def plain_room(stage: Stage, seen: Guide) -> Picture:
    """Return a view under uniform light that nothing occludes: the albedo. For cameras that take a single photo."""
    return stage.coarse.photo(seen.albedo)


def _rendered(
    scene: dict[str, Any], integrator: dict[str, Any], lens: Lens, view: Viewpoint, samples: int, seed: int
) -> Float[np.ndarray, "height width channels"]:
    """Render the lens's pinhole picture, with about `samples` rays per photo pixel."""
    whole = {"type": "scene", "integrator": integrator, "camera": _sensor(lens.pinhole, view), **scene}
    picture = mi.render(mi.load_dict(whole), spp=max(1, samples // lens.finer**2), seed=seed)
    return np.nan_to_num(np.array(picture, np.float32))  # a principled surface seen edge-on can give NaN


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
    """Return point emitters spread over a disc, or one per LED, and over the hand's way, each with the same beam."""
    side = np.cross(lamp.axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    count = EMITTER_POINTS if light.radius > 0 else 1
    out = {}
    for number, led in enumerate(leds(light)):
        for i in range(count):
            angle, radius = i * GOLDEN, light.radius * np.sqrt((i + 0.5) / count)
            place = lamp.position + radius * (np.cos(angle) * side + np.sin(angle) * np.cross(lamp.axis, side))
            place = place + led.aside_mm * side + ((STRIDE * i % count + 0.5) / count - 0.5) * lamp.sweep
            out[f"lamp{number * count + i}"] = {
                "type": "spot",
                "to_world": mi.ScalarTransform4f().look_at(list(place), list(place + lamp.axis), list(side)),
                "intensity": {"type": "rgb", "value": [led.share * c / count for c in led.colour]},
                "cutoff_angle": WIDEST_DEG,
                "beam_width": WIDEST_DEG,
                "texture": texture,
            }
    return out


def led_places(lamp: Lamp, light: Flashlight) -> list[list[float]]:
    """Return the middle of each LED."""
    side = np.cross(lamp.axis, [0.3, 0.5, 0.8])
    return [(lamp.position + led.aside_mm * side / np.linalg.norm(side)).tolist() for led in leds(light)]


def _beam_picture(light: Flashlight) -> Any:
    """Return the texture of the beam: its picture on a wall straight ahead."""
    slope = ((np.arange(BEAM_TEXELS) + 0.5) / BEAM_TEXELS * 2 - 1) * np.tan(np.radians(WIDEST_DEG))
    cosine = 1 / np.sqrt(1 + slope[:, None] ** 2 + slope[None] ** 2)
    picture = mi.Bitmap(beam(cosine, light).astype(np.float32))
    return mi.load_dict({"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"})


def _furniture(setup: Setup) -> dict[str, Any]:
    """Return a room as light from far away: a bright side, a darker floor, soft patches."""
    rng = setup.stream("furniture")
    rows, columns = 64, 128
    up = np.linspace(1, -1, rows)[:, None]  # Mitsuba's first row is straight above, which is y; turned to z below
    around = 2 * np.pi * np.arange(columns) / columns
    light = 0.75 + 0.35 * np.clip(up, 0, 1) + 0.2 * np.cos(around - rng.uniform(0, 2 * np.pi))
    patches = ndimage.gaussian_filter(rng.standard_normal((rows, columns)), 6, mode=("nearest", "wrap"))
    light = np.maximum(light + 0.12 * patches / patches.std() - 0.45 * np.exp(-((up / 0.25) ** 2)), 0.1)
    picture = (light[..., None] * np.array([1.0, 0.98, 0.94])).astype(np.float32)
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(picture), "to_world": upright}


def _painted(art: Picture, gloss: float = 0.0, roughness: float = 0.5) -> Any:
    """Return the surface of a picture whose last row is at the top; Mitsuba's first row is at the smallest v."""
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(art[::-1], np.float32)), "raw": True}
    if gloss > 0:
        return mi.load_dict({"type": "principled", "base_color": texture, "roughness": roughness, "specular": gloss})
    return mi.load_dict({"type": "diffuse", "reflectance": texture})


def _rectangle(middle: Float[np.ndarray, "2"], size: Float[np.ndarray, "2"], z: float) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate([*middle, z]).scale([*(size / 2), 1.0])
    return {"type": "rectangle", "to_world": place}


def _table(top: Any) -> Any:
    return mi.load_dict(_rectangle(np.zeros(2), 2 * TABLE_MM * np.ones(2), -PAPER_MM) | {"bsdf": top})


def _table_to(edge: Upright, top: Any) -> Any:
    """Return a table that ends at its edge; its picture lies where that of a table without end does."""
    along, across = TABLE_MM * np.cross([0, 0, 1], edge.normal), 2 * TABLE_MM * edge.normal
    end = edge.offset * edge.normal - [0, 0, PAPER_MM]
    corners = np.array([end - along, end + along, end + along + across, end - along + across])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    return _mesh("table", mesh, {"type": "twosided", "bsdf": top}, uv=corners[:, :2] / (2 * TABLE_MM) + 0.5)


def _upright(wall: Upright, thing: trimesh.Trimesh) -> dict[str, Any]:
    width, height = WALL_MM
    foot = thing.bounds.mean(0) * [1, 1, 0]
    middle = foot + (wall.offset - wall.normal @ foot) * wall.normal + [0, 0, height / 2 - PAPER_MM]
    place = np.eye(4)
    along = np.cross([0, 0, 1], wall.normal)
    place[:3, :3] = np.stack([along * width / 2, np.array([0, 0, height / 2]), wall.normal], 1)
    place[:3, 3] = middle
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(place)}


def _board(board: AnyBoard, setup: Setup) -> Any:
    """Return the sheet, flat or in waves."""
    bsdf = _painted(np.repeat(sheet(board)[0], 3, 2))
    if isinstance(board, Blank):
        cut = {"type": "bitmap", "bitmap": mi.Bitmap(outline(board)), "raw": True}
        bsdf = mi.load_dict({"type": "mask", "opacity": cut, "surface": bsdf})
    laid = lay(board, setup)
    if laid.height_mm <= 0:
        return mi.load_dict(_rectangle(laid.low + laid.size / 2, laid.size, 0.0) | {"bsdf": bsdf})
    grid = laid.grid().reshape(-1, 2)
    corner = np.arange(GRID * GRID).reshape(GRID, GRID)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    mesh = trimesh.Trimesh(np.column_stack([grid, laid.height(grid)]), faces, process=False)
    return _mesh("board", mesh, {"type": "twosided", "bsdf": bsdf}, uv=(grid - laid.low) / laid.size)


def _solid(mesh: trimesh.Trimesh, setup: Setup) -> Any:
    """Return the object with its albedo per vertex and, if glossy, a dielectric specular layer."""
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    thing = setup.thing
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": colour}
    if thing.gloss > 0:
        bsdf = {"type": "principled", "base_color": colour, "roughness": thing.roughness, "specular": thing.gloss}
    return _mesh("thing", mesh, {"type": "twosided", "bsdf": bsdf}, albedo_of(mesh, thing))


def _mesh(
    name: str,
    mesh: trimesh.Trimesh,
    bsdf: dict[str, Any],
    colour: Float[np.ndarray, "vertices 3"] | None = None,
    uv: Float[np.ndarray, "vertices 2"] | None = None,
) -> Any:
    """Return a mesh with its own vertex normals and a colour or a place in a picture per vertex."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    out = mi.Mesh(
        name,
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    if colour is not None:
        out.add_attribute("vertex_color", 3, colour.astype(np.float32).ravel())
    parameters = mi.traverse(out)
    if uv is not None:
        parameters["vertex_texcoords"] = np.ascontiguousarray(uv, np.float32).ravel()
    parameters["vertex_positions"] = np.ascontiguousarray(mesh.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.ascontiguousarray(mesh.vertex_normals, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    parameters.update()
    return out
