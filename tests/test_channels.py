"""Pictures of a view's own maps, against geometry."""

import numpy as np
import pytest
import torch
from test_relight import fields

from calibration.light import Light
from reconstruct.appearance.brdf import MATERIALS
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.material_edit import Edit, GroundRegion, ObjectRegion, apply_edits
from reconstruct.render.relight import lit_share
from viewer.panels.channels import CHANNELS, ChannelPicture

LAMP = Light("", "point", position=np.array([0.5, -2.0, 3.0]))


@pytest.fixture(scope="module")
def view() -> RenderView:
    return look(fields(), width=48)


def drawn(name: str, view: RenderView) -> ChannelPicture:
    channel = CHANNELS[name]
    assert channel is not None
    return channel(view, LAMP, "mm")


def test_every_channel_is_a_picture_with_a_legend(view):
    for name, channel in CHANNELS.items():
        if channel is not None:
            shown = drawn(name, view)
            assert shown.picture.shape == (*view.maps.depth.shape, 3) and shown.picture.dtype == np.uint8
            assert "<div" in shown.legend


def test_the_ground_faces_up_and_the_ball_all_ways(view):
    picture = drawn("Direction", view).picture
    ground = (torch.isfinite(view.maps.depth) & ~view.maps.mask).numpy()
    assert (np.abs(picture[ground].astype(int) - [128, 128, 255]) <= 1).all()
    assert np.ptp(picture[view.maps.mask.numpy()].astype(int), axis=0).min() > 60


def test_the_legend_of_the_distance_has_its_ends_in_millimetres(view):
    depth = view.maps.depth[view.maps.mask]
    legend = drawn("Distance", view).legend
    assert f"{float(depth.min()):.1f} mm" in legend and f"{float(depth.max()):.1f} mm" in legend


def test_shadow_is_black_where_the_lamp_is_hidden(view):
    grey = drawn("Shadow", view).picture[..., 0]
    share = lit_share(view, LAMP).numpy()
    seen = torch.isfinite(view.maps.depth).numpy()
    np.testing.assert_allclose(grey[seen], 255 * share[seen], atol=0.51)
    assert (share[seen] == 0).any() and (share[seen] == 1).any()


def test_roughness_is_that_of_the_material_put_in(view):
    gold = apply_edits(view, [Edit(MATERIALS["gold"], ObjectRegion()), Edit(MATERIALS["plaster"], GroundRegion())])
    grey = drawn("Roughness", gold).picture[..., 0]
    mask = view.maps.mask.numpy()
    np.testing.assert_allclose(grey[mask], 255 * MATERIALS["gold"].roughness, atol=6)
    assert (grey[torch.isfinite(view.maps.depth).numpy() & ~mask] == 255).all()
    assert "matt" in drawn("Roughness", view).legend
