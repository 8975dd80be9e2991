"""Lit and dark rays tell a tray's rim, which is there, from the lid of its shadow hull, which is not."""

import numpy as np
import pytest
import torch
from synthetic import Box, Look, grid_of, render

from reconstruct.hull.hull_matter import hull_occupancy
from reconstruct.hull.normal_integration import integrate_within, likeness
from reconstruct.labels.labels import Labels

WALL, SIZE, HIGH, FLOOR = 5.0, 40.0, 30.0, 6.0  # mm
TRAY = (
    Box((-SIZE, -SIZE, 0.0), (SIZE, SIZE, FLOOR)),
    Box((-SIZE, -SIZE, 0.0), (-SIZE + WALL, SIZE, HIGH)),
    Box((SIZE - WALL, -SIZE, 0.0), (SIZE, SIZE, HIGH)),
    Box((-SIZE, -SIZE, 0.0), (SIZE, -SIZE + WALL, HIGH)),
    Box((-SIZE, SIZE - WALL, 0.0), (SIZE, SIZE, HIGH)),
)
LID = Box((-SIZE, -SIZE, 0.0), (SIZE, SIZE, HIGH))
SMEARED = 20.0  # mm: how far behind the wall an integral runs that misses the break at the rim


@pytest.fixture(scope="module")
def seen():
    """A scene, its truth, the hull with its lid, its exact labels, and lengths of rays: to the hull, to the truth."""
    scene, truth = render(TRAY, Look(n_lights=16))
    lidded = render((LID,), Look(n_lights=16))[1]
    visible, mask = torch.from_numpy(truth.visibility).float(), torch.from_numpy(truth.mask).float()
    told = torch.from_numpy(truth.normals).float()
    albedo = torch.zeros(*mask.shape, 3)
    labels = Labels(visible, torch.ones_like(visible), mask, torch.ones_like(mask), told, mask, albedo)
    eye = scene.eye.numpy()
    lengths = (np.where(truth.mask, np.linalg.norm(one.points - eye, axis=-1), np.nan) for one in (lidded, truth))
    return scene, truth, lidded, grid_of((LID,), 2.0), labels, *lengths


@pytest.fixture(scope="module")
def smeared(seen):
    """The integral that runs on below the rim; where the hull's matter is: in front of a wall; how alike it is."""
    _, truth, lidded, *_, lid, true = seen
    there = np.abs(true - lid) < 1.0
    return np.where(there, true + SMEARED, true), there, likeness(lidded.normals, truth.normals, truth.mask * 1.0)


def test_rays_tell_the_rim_from_the_lid(seen, smeared):
    scene, truth, _, hull, labels, *_ = seen
    behind, there, alike = smeared
    belief = hull_occupancy(hull, scene, labels, behind, 1, alike)
    right = (belief > 0.5) == there
    assert right[truth.mask].mean() > 0.9
    assert belief[there & truth.mask].mean() > 0.8
    assert belief[~there & truth.mask].mean() < 0.2
    assert (belief[~truth.mask] == 0.5).all()  # no ray tells


def test_the_integral_is_held_where_matter_is_and_breaks_beside_it(seen, smeared):
    scene, truth, lidded, _, _, lid, true = seen
    behind, there, _ = smeared
    along, trust = scene.directions.double().numpy(), truth.mask.astype(float)
    found = integrate_within(along, lid, lidded.normals, truth.normals, trust, behind, there.astype(float))
    off = np.abs(found - true)[truth.mask]
    assert np.median(off) < 1.0
    assert np.quantile(off, 0.8) < 3.0
    alone = integrate_within(along, lid, lidded.normals, truth.normals, trust)
    assert np.abs(alone - true)[truth.mask].mean() > 2 * off.mean()
