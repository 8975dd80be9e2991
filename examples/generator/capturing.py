"""Render a whole capture, in the order in which a person would take it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from calibration.board.board import parse_board
from capture.errors import CaptureError

from . import poses, truth
from .options import Setup, Thing
from .paint import PAPER
from .photo_file import DARK_ISO, ROOM_ISO, PhotoFile, developed, write_photo
from .rendering import Stage, flash, guide, room, stage
from .shapes import build

WHITE = 0.8  # pixel value of paper in room light
NOVEL_SEED = 1000  # of the renderer, beyond those of the photos
Say = Callable[[str], None]


def make_capture(out: Path, setup: Setup, say: Say) -> None:
    """Render a capture folder: board/, photos/ and gt/, as described in the manual's formats.

    Raises:
        CaptureError: the folder is not empty, the mesh cannot be read, or the settings leave nothing to see.
    """
    if out.exists() and any(out.iterdir()):
        raise CaptureError(f"{out} is not empty. Name a new folder.")
    rng = np.random.default_rng(setup.seed)
    board = parse_board(setup.table.board)
    thing = poses.stand(load_thing(setup.thing), setup, board)
    fixed = poses.tripod(setup, board, thing)
    ready = stage(setup, board, thing, fixed.camera, rng)
    (out / "gt" / "shadow").mkdir(parents=True)
    views = {f"IMG_{i:04d}.jpg": view for i, view in enumerate([fixed, *poses.handheld(fixed, board, rng)], 1)}
    for number, (name, view) in enumerate(views.items()):
        say(f"board, photo {number + 1} of {len(views)}")
        picture = room(ready, view, has_thing=setup.table.board_stays and number == 0, has_board=True, seed=number)
        pixels = developed(picture * WHITE / PAPER, setup, rng)
        write_photo(PhotoFile(out / "board" / name, number, ROOM_ISO), pixels, setup)
    truth.write_scene(out / "gt", board, views, setup)
    take_photos(out, ready, fixed, rng, say)


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


def take_photos(out: Path, ready: Stage, fixed: poses.Viewpoint, rng: np.random.Generator, say: Say) -> None:
    """Render the photos under the flashlight, and write their shadows and the other ground truth."""
    setup = ready.setup
    exposure, light = setup.exposure, setup.flashlight
    rays = truth.Rays(ready.thing)
    seen = truth.seen(rays, fixed, setup, ready.board)
    if not seen.mask.any():
        raise CaptureError("the camera does not see the object. Change --elevation, --distance or --board-stays.")
    truth.write_maps(out / "gt", seen, rays, fixed, setup)
    level = exposure.exposure / PAPER
    intensity = level * np.pi * np.mean(light.reach) ** 2
    dim = exposure.ambient * level
    ambient = dim * room(ready, fixed, True, setup.table.board_stays, seed=0) if dim > 0 else np.float32(0)
    entries, shown = [], guide(ready, fixed)
    for i, lamp in enumerate(poses.lamps(light, light.photos, ready.thing, setup.phone.azimuth, rng), 1):
        say(f"photo {i} of {light.photos}")
        name, is_moved = f"IMG_{100 + i:04d}", i in exposure.moved
        view = poses.nudged(fixed, exposure.moved_mm, rng) if is_moved else fixed
        linear = intensity * flash(ready, view, guide(ready, view) if is_moved else shown, lamp, seed=i) + ambient
        pixels = developed(linear, setup, rng)
        write_photo(PhotoFile(out / "photos" / f"{name}.jpg", 30 + i, DARK_ISO), pixels, setup)
        cv2.imwrite(str(out / "gt" / "shadow" / f"{name}.png"), truth.shadow(rays, seen, lamp))
        verdict: dict[str, Any] = {"usable": not is_moved} | ({"bad": "camera moved"} if is_moved else {})
        clipped = {"clipped_fraction": float((pixels == 255).any(2).mean())}
        entries.append(truth.lamp_json(f"{name}.jpg", lamp) | verdict | clipped)
    truth.write_lights(out / "gt", entries, setup, float(intensity))
    further = poses.lamps(light, exposure.novel, ready.thing, setup.phone.azimuth, rng)
    for i, lamp in enumerate(further, 1):
        say(f"picture under a further light, {i} of {len(further)}")
        picture = intensity * flash(ready, fixed, shown, lamp, seed=NOVEL_SEED + i) + ambient
        truth.write_novel(out / "gt" / "novel", f"NOVEL_{i:02d}", picture, truth.shadow(rays, seen, lamp))
    if further:
        truth.write_novel_lights(out / "gt" / "novel", further)
