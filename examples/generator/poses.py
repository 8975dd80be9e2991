"""Poses of object, cameras and flashlight. World frame: the board's, mm, z up."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float

from calibration.board.board import WORLD_FROM_OPENCV_BOARD, Board
from calibration.camera import Camera
from calibration.pose import Pose

from .options import Flashlight, Phone, Setup
from .paint import sheet

Vector = Float[np.ndarray, "3"]
PAPER_MM = 0.15  # the printed side is z = 0, the table lies below
GAP_MM = 15.0  # between board and object
FILL = 1.05  # how much higher than its content the picture is
SHADOW_ROOM = 1.6  # of the object's size: ground around it that takes its shadows
PRINCIPAL_POINT_OFF = (0.006, -0.005)  # of the width: no phone's lens sits right in the middle
HANDHELD = 8  # photos of the board for the lens
ROLL_DEG = 6.0  # roll of a hand-held phone, one sigma
LOOK_LOW = 0.7  # of the middle's height: shadows lie on the table
GOLDEN = np.pi * (3 - np.sqrt(5))  # golden angle: any number of turns by it fills a circle evenly


@dataclass(frozen=True)
class Lamp:
    """The flashlight of one photo."""

    position: Vector
    axis: Vector


@dataclass(frozen=True)
class Viewpoint:
    """A camera and its pose."""

    camera: Camera
    world_from_camera: Pose


def board_centre(board: Board) -> Vector:
    """Return the middle of the sheet."""
    _, corner, size = sheet(board)
    return WORLD_FROM_OPENCV_BOARD.apply(np.array([*(corner + size / 2), 0.0]))


def stand(mesh: trimesh.Trimesh, setup: Setup, board: Board) -> trimesh.Trimesh:
    """Place the object on the table: where the board lay, or beside the board if it stays."""
    placed = mesh.copy()
    normals = np.array(mesh.vertex_normals)
    if setup.thing.size:
        placed.apply_scale(setup.thing.size / max(placed.extents))
    turn = trimesh.transformations.rotation_matrix(np.radians(setup.thing.turn), [0, 0, 1])
    placed.apply_transform(turn)
    low, high = placed.bounds
    spot = board_centre(board)
    if setup.table.board_stays:
        _, _, size = sheet(board)
        spot[0] += size[0] / 2 + GAP_MM + (high[0] - low[0]) / 2
    placed.apply_translation([spot[0] - (low[0] + high[0]) / 2, spot[1] - (low[1] + high[1]) / 2, -PAPER_MM - low[2]])
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


def tripod(setup: Setup, board: Board, thing: trimesh.Trimesh) -> Viewpoint:
    """Return the fixed camera, aimed at the parts that must be in the picture."""
    camera, phone = phone_camera(setup.phone), setup.phone
    _, _, size = sheet(board)
    low, high = thing.bounds
    middle = (low + high) / 2
    radius = max(np.linalg.norm(size) / 2, SHADOW_ROOM * np.linalg.norm(thing.extents) / 2)
    if setup.table.board_stays:
        away = np.linalg.norm(middle[:2] - board_centre(board)[:2])
        middle[:2] = (middle[:2] + board_centre(board)[:2]) / 2
        radius = away / 2 + max(np.linalg.norm(size) / 2, np.linalg.norm(thing.extents) / 2)
    distance = phone.distance or FILL * radius * camera.fy / (camera.height / 2)
    target = middle * [1, 1, LOOK_LOW]
    return Viewpoint(camera, look_at(target + distance * direction(phone.elevation, phone.azimuth), target))


def handheld(view: Viewpoint, board: Board, rng: np.random.Generator) -> list[Viewpoint]:
    """Return hand-held views of the board with the same phone."""
    centre = board_centre(board)
    distance = float(np.linalg.norm(view.world_from_camera.translation - centre))
    start = rng.uniform(0, 360)
    views = []
    for i in range(HANDHELD):
        away = direction(rng.uniform(38, 80), start + 360 * i / HANDHELD + rng.uniform(-15, 15))
        target = centre + np.append(rng.uniform(-25, 25, 2), 0.0)
        level = look_at(target + distance * rng.uniform(0.8, 1.15) * away, target)
        roll = trimesh.transformations.rotation_matrix(np.radians(ROLL_DEG * rng.standard_normal()), [0, 0, 1])[:3, :3]
        views.append(Viewpoint(view.camera, Pose(level.rotation @ roll, level.translation)))
    return views


def nudged(view: Viewpoint, distance: float, rng: np.random.Generator) -> Viewpoint:
    """Return the view of a tripod that was pushed: shifted, and turned by a similar amount."""
    shift = rng.standard_normal(3)
    pose = view.world_from_camera
    moved = pose.translation + distance * shift / np.linalg.norm(shift)
    turn = trimesh.transformations.rotation_matrix(np.radians(0.1 * distance), rng.standard_normal(3))[:3, :3]
    return Viewpoint(view.camera, Pose(turn @ pose.rotation, moved))


def lamps(
    light: Flashlight, count: int, thing: trimesh.Trimesh, azimuth: float, rng: np.random.Generator
) -> list[Lamp]:
    """Return flashlight positions spread over heights, directions and distances, in random order, aimed by hand.

    Args:
        azimuth: degrees of the camera's direction, from which the flashlight's are counted.
    """
    centre = thing.bounds.mean(0)
    first, last = light.around
    spin = rng.uniform(0, 2 * np.pi)
    out = []
    for i in range(count):
        share = ((i * GOLDEN + spin) / (2 * np.pi)) % 1
        low, high = np.sin(np.radians(light.height))
        sine = low + (high - low) * (i + rng.uniform()) / count  # even over the sphere
        away = direction(float(np.degrees(np.arcsin(sine))), azimuth + first + (last - first) * share)
        position = centre + rng.uniform(*light.reach) * away
        miss = np.radians(light.aim_error) * rng.standard_normal(3) / np.sqrt(2)
        axis = (centre - position) / np.linalg.norm(centre - position) + miss
        out.append(Lamp(position, axis / np.linalg.norm(axis)))
    return [out[i] for i in rng.permutation(count)]


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
