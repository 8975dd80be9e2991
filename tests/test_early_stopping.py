"""Rays that never train: what they are, when they end a level, and which surface they keep."""

from dataclasses import replace

import numpy as np
from synthetic import BALL, Look, grid_of, render

from reconstruct.labels.held_out import SHARE, draw_blocks, hold_out
from reconstruct.labels.labels import assemble_labels
from reconstruct.labels.supervision import supervise
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve.early_stopping import COOL_DOWN, REST, EarlyStopping


def ball(grow: float = 0.0) -> SdfGrid:
    """The ball grown by so many mm."""
    return grid_of((replace(BALL, radius=BALL.radius + grow),), 3.0)


def shadows():
    scene = replace(render((BALL,), Look(with_shadow=True, with_mask=True, n_lights=12))[0], rgb=None)
    return scene, supervise(scene, assemble_labels(scene, None, None))


def drawn_from(scene, rays):
    return draw_blocks(rays.pixels, scene.camera.width, len(scene.lights), 0)


def test_held_out_rays_are_a_small_share_in_blocks_and_never_train():
    scene, rays = shadows()
    trained, held_out = hold_out(rays, drawn_from(scene, rays))
    out = (rays.confidence > 0) & (trained.confidence == 0)
    assert 0.5 * SHARE < out.mean() < 1.6 * SHARE
    assert (trained.confidence[held_out.photo, held_out.pixel] == 0).all()
    assert (rays.role[held_out.pixel] != kernels.EDGE).all()
    again, _ = hold_out(rays, drawn_from(scene, rays))
    assert np.array_equal(again.confidence, trained.confidence)


def test_the_held_out_error_is_least_for_the_true_surface():
    scene, rays = shadows()
    _, held_out = hold_out(rays, drawn_from(scene, rays))
    errors = [held_out.error(ball(grow), scene) for grow in (-4.0, 0.0, 4.0)]
    assert errors[1] < 0.5 * min(errors[0], errors[2])


def test_a_level_that_gains_no_more_cools_down_and_ends():
    stopping = EarlyStopping((0.1, 0.05, 0.05, 0.0499, 0.0501))
    stalled, planned = 3 * REST, 400  # the third look finds no better surface than the second
    shares = [stopping.share(i, planned) for i in range(stalled - 1, stalled + COOL_DOWN + 1)]
    assert (np.diff(shares) > 0).all()
    assert shares[0] < 0.2 and abs(shares[-2] - 1) < 1e-9 and shares[-1] > 1


def test_a_surface_that_gets_much_worse_is_taken_back():
    good, bad = ball(), ball(4.0)
    stopping = EarlyStopping().after(0.02, good).after(0.03, bad)
    assert stopping.chosen(bad) is good
    assert EarlyStopping().after(0.02, good).after(0.021, bad).chosen(bad) is bad
