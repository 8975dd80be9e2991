"""Unseen matter that no ray speaks for goes; what shadows need stays, however thin."""

from dataclasses import replace

import numpy as np
import torch
from synthetic import Box, Look, Sphere, render

from reconstruct.labels.labels import assemble_labels
from reconstruct.labels.supervision import supervise
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import visibility
from reconstruct.solve.unseen import without_unsupported_matter

SPACING = 3.0  # mm
ORIGIN, COUNTS = np.array([-72.0, -60.0, -9.0]), (49, 45, 34)
CRATE = Box((-50, -20, 0), (50, 20, 70))
LUMP = Sphere((0.0, 32.0, 6.0), 14.0)  # behind the crate: neither seen nor lit, and its shadow falls where none is seen
LEGS = tuple(Box((x, y, 0), (x + 7, y + 7, 46)) for x in (-40, 33) for y in (-30, 23))
TABLE = (Box((-42, -32, 44), (42, 32, 52)), *LEGS)


DEEP = 60.0  # mm below the ground: a solved surface goes on there


def nodes() -> np.ndarray:
    return np.stack(np.meshgrid(*(SPACING * np.arange(n) for n in COUNTS), indexing="ij"), -1) + ORIGIN


def as_grid(sdf: np.ndarray) -> SdfGrid:
    return SdfGrid(torch.from_numpy(sdf.reshape(COUNTS)).float(), torch.from_numpy(ORIGIN).float(), SPACING)


def inside(grid: SdfGrid, part) -> float:
    """The share of a part's nodes above the ground that are matter."""
    low, high = (np.array(corner) for corner in (part.lower, part.upper))
    of_part = ((nodes() >= low) & (nodes() <= high)).all(-1)
    return float((grid.values.numpy()[of_part] < 0).mean())


def standing(shapes):
    """The distance at all nodes to shapes that go on below the ground, as a solved surface does."""
    sunk = tuple(
        replace(s, lower=(*s.lower[:2], -DEEP)) if isinstance(s, Box) and s.lower[2] == 0 else s for s in shapes
    )
    _, truth = render(sunk, Look())
    return truth.sdf(nodes().reshape(-1, 3)).reshape(COUNTS)


def shadows(shapes):
    scene, truth = render(shapes, Look(with_shadow=True, with_mask=True, n_lights=24))
    scene = replace(scene, rgb=None)
    return scene, truth, supervise(scene, assemble_labels(scene, None, None))


def test_a_lump_behind_the_object_goes_and_the_object_stays():
    scene, _, rays = shadows((CRATE,))
    lump = np.linalg.norm(nodes() - np.array(LUMP.centre), axis=-1) - LUMP.radius
    true = standing((CRATE,))
    found = without_unsupported_matter(as_grid(np.minimum(true, lump)), scene, rays)
    extra = (lump < 0) & (true > 2 * SPACING) & (nodes()[..., 2] > 0)
    assert extra.sum() > 60
    assert (found.values.numpy()[extra] < 0).mean() < 0.02
    assert inside(found, CRATE) > 0.99


def test_thin_legs_stay_because_their_shadows_need_them():
    scene, truth, rays = shadows(TABLE)
    true = truth.sdf(nodes().reshape(-1, 3)).reshape(COUNTS)
    found = without_unsupported_matter(as_grid(true), scene, rays)
    kept = [inside(found, leg) / inside(as_grid(true), leg) for leg in LEGS]
    assert min(kept) > 0.85, kept


def test_what_hangs_under_a_table_s_top_goes_though_rays_past_its_edge_run_along_it():
    scene, _, rays = shadows(TABLE)
    true, (x, y, z) = standing(TABLE), np.moveaxis(nodes(), -1, 0)
    to_edge = np.minimum(42 - abs(x), 32 - abs(y))
    hangs = np.maximum(44 - np.tan(np.radians(20)) * to_edge - z, z - 48)  # the lowest light stands at 21 degrees
    start = np.minimum(true, np.maximum(hangs, -to_edge))
    found = without_unsupported_matter(as_grid(start), scene, rays)
    extra = (start < 0) & (true > 0.5 * SPACING) & (z > 0)
    assert extra.sum() > 700
    assert (found.values.numpy()[extra] < 0).mean() < 0.3
    kept = [inside(found, part) / inside(as_grid(true), part) for part in TABLE]
    assert min(kept) > 0.9, kept


def test_no_dark_ray_that_was_blocked_comes_free():
    scene, truth, rays = shadows((CRATE, Sphere((40.0, 30.0, 40.0), 12.0)))
    start = as_grid(truth.sdf(nodes().reshape(-1, 3)))
    found = without_unsupported_matter(start, scene, rays)
    dark = truth.visibility < 0.5
    on_ground = np.broadcast_to(~truth.mask, dark.shape)
    photo, row, column = np.nonzero(dark & on_ground)
    points = torch.from_numpy(truth.points[row, column]).float()
    blocked, still = (
        visibility(grid, points, scene.lights[torch.from_numpy(photo)], 8.0 / SPACING).numpy() < 0.5
        for grid in (start, found)
    )
    assert still[blocked].mean() > 0.999
