"""Poses of object, cameras and flashlight. World frame: the board's, mm, z up."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from calibration.board.board import WORLD_FROM_OPENCV_BOARD, AnyBoard
from calibration.camera import Camera
from calibration.pose import Pose
from capture.errors import CaptureError

from .options import Phone, Setup
from .paint import sheet

Vector = Float[np.ndarray, "3"]
Blocked = Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]
PAPER_MM = 0.15  # the printed side is z = 0, the table lies below
FLOOR_MM = 740.0  # below the printed side
GAP_MM = 15.0  # between board and object
FILL = 1.05  # how much higher than its content the picture is
SHADOW_ROOM = 1.6  # of the object's size: ground around it that takes its shadows
PRINCIPAL_POINT_OFF = (0.006, -0.005)  # of the width: no phone's lens sits right in the middle
AIM_SHARE = 0.04  # of the distance: by how much a hand-held phone misses the board's middle
ROLL_DEG = 6.0  # roll of a hand-held phone, one sigma
LOOK_LOW = 0.7  # of the middle's height: shadows lie on the table
SIDEWAYS_DEG = (
    75.0  # from the tripod's direction, to either side: where hand-held cameras stand that have a wall behind
)
SIDE_ELEVATION_DEG = (24.0, 40.0)  # of the photos in side/
SIDE_ALONE_DEG = 80.0  # from the tripod's direction, if there is one photo only
SIDE_FILL = 1.12
SIDE_TRIES, SIDE_STEP_DEG = 20, 5.0  # a view in which the object hides the board is drawn again, ever farther off
MOST_HIDDEN = 0.2  # of the board's corners
ROOM_TO_WALL_MM = 60.0  # flashlights stay so far before it
TRIES = 1000
SEES = (0.53, 0.41)  # of the width, from the picture's middle: a flashlight there is in it, or glares into the lens
LIGHT_PHONE_FOCAL = 27.0  # of the phone that holds the flashlight, for 35 mm film
LIGHT_PHONE_DISTORTION = (-0.041, 0.033)
LED_FROM_LENS_MM = (-13.8, 6.1, 0.0)  # in that phone's camera frame
LIGHT_ROLL_DEG = 25.0  # one sigma
GOLDEN = np.pi * (3 - np.sqrt(5))  # golden angle: any number of turns by it fills a circle evenly


@dataclass(frozen=True)
class Lamp:
    """The flashlight of one photo."""

    position: Vector
    axis: Vector
    sweep: Vector = field(
        default_factory=lambda: np.zeros(3)
    )  # way of the hand during the exposure, evenly about position


@dataclass(frozen=True)
class Viewpoint:
    """A camera and its pose."""

    camera: Camera
    world_from_camera: Pose


def board_centre(board: AnyBoard) -> Vector:
    """Return the middle of the sheet."""
    _, corner, size = sheet(board)
    return WORLD_FROM_OPENCV_BOARD.apply(np.array([*(corner + size / 2), 0.0]))


def stand(mesh: trimesh.Trimesh, setup: Setup, board: AnyBoard) -> trimesh.Trimesh:
    """Place the object on the table: where the board lay, or beside the board if both are in one photo."""
    placed = mesh.copy()
    normals = np.array(mesh.vertex_normals)
    if setup.thing.size:
        placed.apply_scale(setup.thing.size / max(placed.extents))
    turn = trimesh.transformations.rotation_matrix(np.radians(setup.thing.turn), [0, 0, 1])
    placed.apply_transform(turn)
    low, high = placed.bounds
    spot = board_centre(board)
    if setup.is_beside():
        _, _, size = sheet(board)
        spot[0] += size[0] / 2 + GAP_MM + (high[0] - low[0]) / 2
    foot = 0.0 if setup.table.on_board else -PAPER_MM
    placed.apply_translation([spot[0] - (low[0] + high[0]) / 2, spot[1] - (low[1] + high[1]) / 2, foot - low[2]])
    placed.vertex_normals = normals @ turn[:3, :3].T
    return placed


def phone_camera(phone: Phone) -> Camera:
    """Return the camera of the phone: lens and sensor."""
    height = phone.width * 3 // 4
    focal = phone.focal / 36.0 * phone.width  # a 35 mm film's picture is 36 mm wide
    centre = (0.5 + np.array(PRINCIPAL_POINT_OFF)) * [phone.width, phone.width]
    cy = centre[1] - phone.width / 2 + height / 2
    k1, k2 = phone.distortion
    return Camera(phone.width, height, focal, focal, float(centre[0] - 0.5), float(cy - 0.5), (k1, k2, 0.0, 0.0, 0.0))


def tripod(setup: Setup, board: AnyBoard, thing: trimesh.Trimesh) -> Viewpoint:
    """Return the fixed camera, aimed at the parts that must be in the picture."""
    camera, phone = phone_camera(setup.phone), setup.phone
    _, _, size = sheet(board)
    low, high = thing.bounds
    middle = (low + high) / 2
    radius = max(np.linalg.norm(size) / 2, SHADOW_ROOM * np.linalg.norm(thing.extents) / 2)
    if setup.is_beside():
        away = np.linalg.norm(middle[:2] - board_centre(board)[:2])
        middle[:2] = (middle[:2] + board_centre(board)[:2]) / 2
        radius = away / 2 + max(np.linalg.norm(size) / 2, np.linalg.norm(thing.extents) / 2)
    distance = phone.distance or FILL * radius * camera.fy / (camera.height / 2)
    target = middle * [1, 1, LOOK_LOW]
    return Viewpoint(camera, look_at(target + distance * direction(phone.elevation, phone.azimuth), target))


@dataclass(frozen=True)
class Upright:
    """An upright plane: normal . x = offset; the object is on the side of the normal."""

    normal: Vector
    offset: float

    def hides(self, place: Vector) -> bool:
        """Return whether a place is behind it or too close to it."""
        return float(self.normal @ place) - self.offset < ROOM_TO_WALL_MM


def wall_of(setup: Setup, thing: trimesh.Trimesh) -> Upright | None:
    """Return the wall behind the object."""
    if setup.table.wall <= 0:
        return None
    return _upright(setup, thing, setup.table.wall)


def edge_of(setup: Setup, thing: trimesh.Trimesh) -> Upright | None:
    """Return the upright plane at which the table ends; its normal points over the table."""
    return _upright(setup, thing, setup.table.edge, setup.table.edge_turn) if setup.table.edge > 0 else None


def _upright(setup: Setup, thing: trimesh.Trimesh, behind: float, turn: float = 0.0) -> Upright:
    """Return the plane across the camera's view, turned by so many degrees, so many mm behind the object."""
    normal = direction(0.0, setup.phone.azimuth + turn)
    return Upright(normal, float(normal @ thing.bounds.mean(0)) - behind)


def handheld(view: Viewpoint, board: AnyBoard, setup: Setup, rng: np.random.Generator) -> list[Viewpoint]:
    """Return hand-held views of the board with the same phone, all round or, with a wall, before it."""
    count = setup.further.board_photos
    centre = board_centre(board)
    distance = float(np.linalg.norm(view.world_from_camera.translation - centre))
    start = rng.uniform(0, 360)
    views = []
    for i in range(count):
        elevation, around = rng.uniform(38, 80), start + 360 * i / count + rng.uniform(-15, 15)
        if setup.table.wall > 0:
            around = setup.phone.azimuth + SIDEWAYS_DEG * ((around - setup.phone.azimuth + 180) % 360 - 180) / 180
        away = direction(elevation, around)
        target = centre + np.append(AIM_SHARE * distance * rng.uniform(-1, 1, 2), 0.0)
        level = look_at(target + distance * rng.uniform(0.8, 1.15) * away, target)
        views.append(Viewpoint(view.camera, rolled(level, ROLL_DEG * rng.standard_normal())))
    return views


def rolled(level: Pose, degrees: float) -> Pose:
    """Return world_from_camera turned about the camera's own axis."""
    roll = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])[:3, :3]
    return Pose(level.rotation @ roll, level.translation)


def sides(view: Viewpoint, board: AnyBoard, thing: trimesh.Trimesh, setup: Setup, blocked: Blocked) -> list[Viewpoint]:
    """Return hand-held views of object and board with the same phone, from other sides than the tripod's.

    Args:
        blocked: tells of rays (start, direction) whether the object is in their way: most of the board is seen.
    """
    count, rng = setup.further.side_photos, setup.stream("side")
    corners = np.concatenate([thing.bounds, board_centre(board) + np.outer([-1, 1], [*sheet(board)[2] / 2, 0])])
    target = (corners.min(0) + corners.max(0)) / 2
    radius = np.linalg.norm(corners.max(0) - corners.min(0)) / 2
    distance = SIDE_FILL * radius * view.camera.fy / (view.camera.height / 2)
    first, last = (-SIDEWAYS_DEG, SIDEWAYS_DEG) if setup.table.wall > 0 else (60.0, 300.0)
    out = []
    for around in np.linspace(first, last, count) if count > 1 else [SIDE_ALONE_DEG]:
        for i in range(SIDE_TRIES):
            degrees = np.clip(around + SIDE_STEP_DEG * (1 + i) * rng.uniform(-1, 1), first, last)
            away = direction(rng.uniform(*SIDE_ELEVATION_DEG), setup.phone.azimuth + degrees)
            aim = target + np.append(rng.uniform(-15, 15, 2), 0.0)
            level = look_at(aim + distance * rng.uniform(0.95, 1.1) * away, aim)
            rays = board.points() - level.translation
            if blocked(np.broadcast_to(level.translation, rays.shape), rays).mean() < MOST_HIDDEN:
                break
        out.append(Viewpoint(view.camera, rolled(level, ROLL_DEG * rng.standard_normal())))
    return out


def light_phone(width: int) -> Camera:
    """Return the camera of the phone that holds the flashlight."""
    return phone_camera(Phone(width=width, focal=LIGHT_PHONE_FOCAL, distortion=LIGHT_PHONE_DISTORTION))


def from_the_light(lamp: Lamp, camera: Camera, rng: np.random.Generator) -> Viewpoint:
    """Return what the phone that holds the flashlight sees: its optical axis is the beam's."""
    level = look_at(lamp.position, lamp.position + lamp.axis)
    turned = rolled(level, LIGHT_ROLL_DEG * rng.standard_normal())
    return Viewpoint(camera, Pose(turned.rotation, lamp.position - turned.rotation @ np.array(LED_FROM_LENS_MM)))


def nudged(view: Viewpoint, distance: float, rng: np.random.Generator) -> Viewpoint:
    """Return the view of a tripod that was pushed: shifted, and turned by a similar amount."""
    shift = rng.standard_normal(3)
    pose = view.world_from_camera
    moved = pose.translation + distance * shift / np.linalg.norm(shift)
    turn = trimesh.transformations.rotation_matrix(np.radians(0.1 * distance), rng.standard_normal(3))[:3, :3]
    return Viewpoint(view.camera, Pose(turn @ pose.rotation, moved))


def lamps(setup: Setup, count: int, thing: trimesh.Trimesh, board: AnyBoard, rng: np.random.Generator) -> list[Lamp]:
    """Return flashlight positions spread over heights, directions and distances, in random order, aimed by hand.

    Directions are counted from the camera's. A position behind a wall or in the camera's picture is drawn again, from
    random numbers of its own.
    """
    light, azimuth = setup.flashlight, setup.phone.azimuth
    wall, fixed = wall_of(setup, thing), tripod(setup, board, thing)
    centre = thing.bounds.mean(0)
    aim = (centre + board_centre(board)) / 2 if setup.further.light_photos else centre
    first, last = light.around
    low, high = np.sin(np.radians(light.height))
    spin = rng.uniform(0, 2 * np.pi)
    again = setup.stream(f"{count} flashlights")
    grip = setup.stream("grip").uniform(0, 2 * np.pi)  # in which way the hand holds the phone askew
    out = []
    for i in range(count):
        share = ((i * GOLDEN + spin) / (2 * np.pi)) % 1
        sine = low + (high - low) * (i + rng.uniform()) / count  # even over the sphere
        away = direction(float(np.degrees(np.arcsin(sine))), azimuth + first + (last - first) * share)
        position = centre + rng.uniform(*light.reach) * away
        for _ in range(TRIES):
            if not _is_in_the_way(position, wall, fixed):
                break
            sine = again.uniform(*np.sin(np.radians(light.height)))
            away = direction(float(np.degrees(np.arcsin(sine))), azimuth + again.uniform(first, last))
            position = centre + again.uniform(*light.reach) * away
        else:
            raise CaptureError(
                "wall and picture leave no place for the flashlight. Change --wall, --reach, --height or --around."
            )
        miss = np.radians(light.aim_error) * rng.standard_normal(3) / np.sqrt(2)
        towards = (aim - position) / np.linalg.norm(aim - position)
        if light.aim_off > 0:
            frame = look_at(position, aim).rotation
            miss = miss + np.tan(np.radians(light.aim_off)) * frame @ [np.cos(grip), np.sin(grip), 0.0]
        axis = towards + miss
        out.append(Lamp(position, axis / np.linalg.norm(axis)))
    return [out[i] for i in rng.permutation(count)]


def _is_in_the_way(position: Vector, wall: Upright | None, fixed: Viewpoint) -> bool:
    """Return whether a flashlight is behind the wall, or the fixed camera sees it."""
    if wall is not None and wall.hides(position):
        return True
    local = fixed.world_from_camera.inverse().apply(position)
    if local[2] <= 0:
        return False
    return bool(np.all(np.abs(local[:2]) <= local[2] * np.array(SEES) * fixed.camera.width / fixed.camera.fx))


def direction(elevation: float, azimuth: float) -> Vector:
    """Return the unit vector at these degrees above the table and from the x axis."""
    up, round_ = np.radians(elevation), np.radians(azimuth)
    return np.array([np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)])


def look_at(centre: Vector, target: Vector) -> Pose:
    """Return world_from_camera of a level camera at `centre` that looks at `target`."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [1e-4, 0, 1.0])  # the small x component matters for a camera right above
    right /= np.linalg.norm(right)
    return Pose(np.stack([right, np.cross(forward, right), forward], 1), np.asarray(centre, float))
