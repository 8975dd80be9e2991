"""Render a whole capture, in the order in which a person would take it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from calibration.board.board import parse_board
from capture.errors import CaptureError

from . import around, hand, poses, truth
from .options import Setup, Thing, switched_on
from .paint import PAPER
from .photo_file import ROOM_ISO, PhotoFile, developed, write_photo
from .rendering import Stage, room, stage
from .shapes import build
from .sheet import lay
from .shooting import WHITE, Place, take_board, take_photos

MOST_BOARD_PHOTOS, MOST_SIDE_PHOTOS, MOST_PLACES = 14, 8, 6
FIRST_SIDE, SIDE_NUMBER = 51, 16  # number in the name, and in the order taken
Say = Callable[[str], None]


def make_capture(out: Path, setup: Setup, say: Say) -> None:
    """Render a capture folder: board/, photos/, gt/ and what else is wanted, as docs/generator.md describes them.

    Raises:
        CaptureError: the folder is not empty, the mesh cannot be read, or the settings leave nothing to see.
    """
    if out.exists() and any(out.iterdir()):
        raise CaptureError(f"{out} is not empty. Name a new folder.")
    setup = around.with_places(switched_on(setup))
    _refuse_impossible(setup)
    rng = np.random.default_rng(setup.seed)
    board = parse_board(setup.table.board)
    around.refuse_impossible(setup, board)
    thing = poses.stand(load_thing(setup.thing), setup, board)
    fixed = poses.tripod(setup, board, thing)
    ready = stage(setup, board, thing, fixed.camera, rng)
    (out / "gt").mkdir(parents=True)
    if setup.has_places():
        around.make_views(out, ready, say)
        return
    views = {f"IMG_{i:04d}.jpg": v for i, v in enumerate([fixed, *poses.handheld(fixed, board, setup, rng)], 1)}
    take_board(out / "board", ready, views, 0, rng, say)
    truth.write_scene(out / "gt", lay(board, setup), views, setup, thing)
    truth.write_object(out / "gt", thing, setup)
    if setup.further.side_photos:
        take_sides(out, ready, fixed, say)
    take_photos(Place(out, out / "gt"), ready, fixed, rng, say)


def take_sides(out: Path, ready: Stage, fixed: poses.Viewpoint, say: Say) -> None:
    """Render the hand-held photos of object and board in room light."""
    setup, rng = ready.setup, ready.setup.stream("noise of side photos")
    rays = truth.Rays(ready.thing)
    views = poses.sides(fixed, ready.board, ready.thing, setup, rays.blocked)
    named = {f"IMG_{FIRST_SIDE + i:04d}.jpg": view for i, view in enumerate(views)}
    for number, (name, view) in enumerate(named.items()):
        say(f"side, photo {number + 1} of {len(named)}")
        picture = room(ready, view, has_thing=True, has_board=True, seed=SIDE_NUMBER + number, has_furniture=True)
        pixels = developed(picture * WHITE / PAPER, setup, rng, ROOM_ISO, name)
        write_photo(PhotoFile(out / "side" / name, SIDE_NUMBER + number), pixels, setup)
    truth.write_sides(out / "gt", named, lay(ready.board, setup), rays)


def load_thing(thing: Thing) -> trimesh.Trimesh:
    """Return the object's mesh.

    Raises:
        CaptureError: the file is no mesh.
    """
    if thing.mesh is None:
        return build(thing.shape)
    if not thing.mesh.is_file():
        raise CaptureError(f"{thing.mesh} is not a file. Give a mesh that trimesh reads, such as .ply, .obj or .glb.")
    mesh = trimesh.load_mesh(thing.mesh, process=False)
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise CaptureError(f"{thing.mesh} holds no triangles. Give a triangle mesh.")
    return mesh


def _refuse_impossible(setup: Setup) -> None:
    further = setup.further
    if further.light_photos and not setup.table.board_stays:
        raise CaptureError("--light-photos show the board beside the object. Add --board-stays.")
    if setup.table.on_board and not setup.table.board_stays:
        raise CaptureError("--on-board: the object stands on the board in all photos. Add --board-stays.")
    for name, count, most in (
        ("--board-photos", further.board_photos, MOST_BOARD_PHOTOS),
        ("--side-photos", further.side_photos, MOST_SIDE_PHOTOS),
        ("--views", setup.around.views, MOST_PLACES),
        ("--object-poses", setup.around.object_poses, MOST_PLACES),
    ):
        if not 0 <= count <= most:
            raise CaptureError(f"{name} {count}: give 0 to {most}.")
    if not 1 <= setup.around.pose_views <= MOST_PLACES:
        raise CaptureError(f"--pose-views {setup.around.pose_views}: give 1 to {MOST_PLACES}.")
    hand.refuse_impossible(setup)
