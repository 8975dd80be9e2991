"""Few lights leave the depth of a hull open: the normals of shading say where its front is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from brief_drafts import NORMAL_STEPS
from scipy.ndimage import binary_erosion
from synthetic import BALL, Box, Look, Sphere, render

from reconstruct.config import FitConfig, Level
from reconstruct.hull import bent_hull
from reconstruct.hull.bent_hull import on_front
from reconstruct.initialization import choose_start
from reconstruct.labels.labels import Labels
from reconstruct.labels.observer import Observer
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled
from reconstruct.shading import joint_normals

SLAB = Box((-45.0, -30.0, 0.0), (45.0, 30.0, 20.0))
HEAD = Sphere((10.0, 0.0, 12.0), 22.0)
NODES = 56


@pytest.fixture(scope="module")
def seen():
    """A scene of two lights, its truth, and the true lengths of its rays (nan beside the object)."""
    scene, truth = render((SLAB, HEAD), Look(n_lights=2))
    length = np.linalg.norm(truth.points - scene.eye.numpy(), axis=-1)
    mask = torch.from_numpy(truth.mask).float()
    return replace(scene, mask=mask), truth, np.where(truth.mask, length, np.nan)


def test_the_hull_is_made_anew_behind_the_front(seen):
    scene, truth, _ = seen
    low, spacing = np.array([-60.0, -45.0, -6.0]), 120.0 / (NODES - 1)
    shape = (NODES, round(90 / spacing) + 1, round(84 / spacing) + 1)
    nodes = low + spacing * np.moveaxis(np.indices(shape), 0, -1)
    true = truth.sdf(nodes.reshape(-1, 3)).reshape(shape)
    stripe = nodes[..., 0] // 8 % 2 > 0
    speck = np.linalg.norm(nodes - [-40.0, 0.0, 60.0], axis=-1) - 4.0
    away = truth.points[truth.mask].mean(0) - scene.eye.numpy()
    back = truth.sdf((nodes - 15 * away / np.linalg.norm(away)).reshape(-1, 3)).reshape(shape)
    carved, free = np.minimum(np.where(stripe, back, true), speck), true - 8
    hull, space = (
        resampled(SdfGrid(torch.from_numpy(x).float(), torch.from_numpy(low).float(), spacing), NODES).grid()
        for x in (carved, np.minimum(free, speck))
    )
    observer = Observer(scene)
    mask = torch.from_numpy(truth.mask).float()
    nothing = torch.zeros(len(scene.lights), *mask.shape)
    told = torch.from_numpy(truth.normals).float()
    labels = Labels(nothing, nothing, mask, torch.ones_like(mask), told, mask, torch.zeros(*mask.shape, 3))
    found = on_front(hull, space, scene, observer.seen(hull), observer.seen(space)[0], labels)
    after = resampled(found, NODES).grid()
    inner = binary_erosion(truth.mask, iterations=3)
    off = [np.linalg.norm(observer.seen(g)[0].numpy() - truth.points, axis=-1)[inner] for g in (hull, after)]
    assert np.std(off[1]) < 0.5 * np.std(off[0])  # what all of it is off by, normals do not say
    assert float(after.sdf(torch.tensor([[-40.0, 0.0, 60.0]]))) > 0


@pytest.mark.parametrize("spoilt", [("on_front",), ("follow_normals",), ("on_front", "follow_normals")])
def test_a_bend_that_the_shadows_contradict_is_left_for_another_or_for_the_hull(monkeypatch, spoilt):
    scene, _ = render((BALL,), Look(width=64, height=48, n_lights=5))
    raised = 1.2 * BALL.radius

    def floats(grid: SdfGrid, *_: object) -> SdfGrid:
        return SdfGrid(grid.values, grid.origin + torch.tensor([0.0, 0.0, raised]), grid.spacing)

    for name in ("on_front", "follow_normals"):
        monkeypatch.setattr(bent_hull, name, floats if name in spoilt else lambda grid, *_: grid)
    monkeypatch.setattr(joint_normals, "STEPS", NORMAL_STEPS)
    config = FitConfig(levels=(Level(32, 1, (0.5, 0.4), 4),))
    found = choose_start.HullStart((scene,), (Observer(scene),), config, lambda _: None).surface()
    low, high = torch.tensor([BALL.centre, BALL.centre]) + torch.tensor([[0.0] * 3, [0.0, 0.0, 1.6 * BALL.radius]])
    assert float(found.sdf(low[None])) < 0 < float(found.sdf(high[None]))
