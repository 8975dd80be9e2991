"""Render captures of several tripod places, and of the object laid on other sides: view_1/, view_2/, turned_1/.

Between views nothing moves but the tripod (unless --pushed says so). For each object pose, object and board lie anew;
its world is its own board's frame. docs/capture.md says how a person takes such photos.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool

from calibration.board.board import AnyBoard
from capture.errors import CaptureError

from . import poses, truth
from .options import Hand, Setup
from .rendering import Stage, stage
from .sheet import lay
from .shooting import Place, take_board, take_photos

NUMBERS = 500  # of photos per place: names of one capture differ
FEWEST_DEGREES = 25.0  # between two object poses: by less the object would have rocked only
RESTS_TRIED = 30
Say = Callable[[str], None]


def make_views(out: Path, ready: Stage, say: Say) -> None:
    """Render board/, view_*/, turned_*/ and their ground truth.

    Raises:
        CaptureError: the object has too few sides to lie on.
    """
    setup, board = ready.setup, ready.board
    motions = object_poses(ready.thing, setup.around.object_poses)
    rng = np.random.default_rng([setup.seed, 1])
    fixed = poses.tripod(setup, board, ready.thing)
    shared = {f"IMG_{i:04d}.jpg": v for i, v in enumerate(poses.handheld(fixed, board, setup, rng), 2)}
    take_board(out / "board", ready, shared, -1, rng, say)
    truth.write_scene(out / "gt", lay(board, setup), shared or {"": fixed}, setup, ready.thing)
    (out / "gt" / "camera.json").unlink()
    truth.write_object(out / "gt", ready.thing, setup)
    (out / "session.toml").write_text(f'board = "{board.spec()}"\n')
    rays = truth.Rays(ready.thing)
    seen = _views(out, ready, "", setup.around.views, 0, rays, say)
    for index, motion in enumerate(motions):
        name, taken = f"turned_{index + 1}", len(seen)
        laid = _laid(ready, motion, index)
        seen |= _views(out, laid, name, setup.around.pose_views, taken, truth.Rays(laid.thing), say)
        truth.write_motion(out / "gt" / name, _motion(laid.thing.vertices, ready.thing.vertices))
    truth.write_seen(out / "gt", seen)


def _views(
    out: Path, ready: Stage, object_pose: str, count: int, taken: int, rays: truth.Rays, say: Say
) -> dict[str, Bool[np.ndarray, " faces"]]:
    """Render the places of the tripod around the object as it lies now.

    Args:
        object_pose: its folder, in which each of several views has its own; "" for the first.
        taken: places that were rendered before.

    Returns:
        Which triangles each place sees, by its name.
    """
    seen = {}
    for index in range(count):
        own = f"view_{index + 1}" if count > 1 or not object_pose else ""
        name = "/".join(filter(None, (object_pose, own)))
        say(name)
        stood = ready if object_pose and count == 1 else _at_place(ready, index, count, is_first=not object_pose)
        view = _take(Place(out / name, out / "gt" / name, (taken + index) * NUMBERS), stood, say)
        seen[name] = truth.faces_seen(rays if stood.thing is ready.thing else truth.Rays(stood.thing), view)
    return seen


def _take(place: Place, ready: Stage, say: Say) -> poses.Viewpoint:
    """Render the photos of one place of the tripod; return it."""
    setup, rng = ready.setup, np.random.default_rng([ready.setup.seed, 2, place.first])
    fixed = poses.tripod(setup, ready.board, ready.thing)
    named = {f"IMG_{place.first + 1:04d}.jpg": fixed}
    take_board(place.folder / "board", ready, named, place.first, rng, say)
    place.truth.mkdir(parents=True)
    truth.write_scene(place.truth, lay(ready.board, setup), named, setup, ready.thing)
    take_photos(place, ready, fixed, rng, say)
    return fixed


def _at_place(ready: Stage, index: int, count: int, is_first: bool) -> Stage:
    """Return the scene with the tripod at one of its places; what goes wrong does so in the first object pose alone."""
    around, setup = ready.setup.around, ready.setup
    apart = 360.0 / count if around.apart is None else around.apart
    phone = replace(setup.phone, azimuth=setup.phone.azimuth + index * apart)
    setup = replace(setup, phone=phone)
    if around.fault_view not in (0, index + 1):
        setup = _faultless(setup)
    if not is_first or around.pushed <= 0 or index + 1 < count:
        return replace(ready, setup=setup)
    way = setup.stream("pushed").uniform(0, 2 * np.pi)
    pushed = _copied(
        ready.thing,
        trimesh.transformations.translation_matrix(around.pushed * np.array([np.cos(way), np.sin(way), 0.0])),
    )
    return stage(setup, ready.board, pushed, ready.lens.camera, np.random.default_rng(setup.seed))


def _laid(ready: Stage, motion: np.ndarray, index: int) -> Stage:
    """Return the scene of the object laid on another side, the board anew on the table."""
    setup = _faultless(ready.setup)
    thing = poses.stand(
        _copied(ready.thing, motion), replace(setup, thing=replace(setup.thing, size=None)), ready.board
    )
    return stage(setup, ready.board, thing, ready.lens.camera, np.random.default_rng([setup.seed, 3, index]))


def _faultless(setup: Setup) -> Setup:
    return replace(setup, hand=Hand(), exposure=replace(setup.exposure, moved=()))


def object_poses(mesh: trimesh.Trimesh, count: int) -> list[np.ndarray]:
    """Return rotations (4x4) that lay a mesh on other sides, on which it rests.

    Raises:
        CaptureError: it has fewer.
    """
    if count == 0:
        return []
    found, shares = mesh.compute_stable_poses(n_samples=1)
    downs = [np.array([0.0, 0.0, 1.0])]
    out = []
    for pose in found[np.argsort(-shares)][:RESTS_TRIED]:
        up = pose[2, :3]  # of the pose, in the object's frame
        if all(up @ other < np.cos(np.radians(FEWEST_DEGREES)) for other in downs):
            downs.append(up)
            rotation = np.eye(4)
            rotation[:3, :3] = pose[:3, :3]
            out.append(rotation)
    if len(out) < count:
        raise CaptureError(f"--object-poses {count}: the object rests on {len(out)} other sides. Ask for fewer.")
    return out[:count]


def _copied(mesh: trimesh.Trimesh, motion: np.ndarray) -> trimesh.Trimesh:
    moved, normals = mesh.copy(), np.array(mesh.vertex_normals)
    moved.apply_transform(motion)
    moved.vertex_normals = normals @ motion[:3, :3].T
    return moved


def _motion(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rigid motion (4x4) that moves points to where they are found (Kabsch 1976)."""
    middle, goal = start.mean(0), end.mean(0)
    left, _, right = np.linalg.svd((start - middle).T @ (end - goal))
    turn = right.T @ np.diag([1, 1, np.sign(np.linalg.det(right.T @ left.T))]) @ left.T
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, goal - turn @ middle
    return out


def with_places(setup: Setup) -> Setup:
    """Return the setup of a capture of several places: the board stays."""
    return replace(setup, table=replace(setup.table, board_stays=True)) if setup.has_places() else setup


def refuse_impossible(setup: Setup, board: AnyBoard) -> None:
    """Check what does not go with several places.

    Raises:
        CaptureError: a wall, a table's edge, side photos, or light photos.
    """
    table, further = setup.table, setup.further
    if setup.has_places() and (table.wall > 0 or table.edge > 0 or further.side_photos or further.light_photos):
        without = "--wall, --edge, --side-photos and --light-photos"
        raise CaptureError(f"--views and --object-poses go without {without} ({board.spec()}).")
