"""Where edits of material reach, by geometry, and what they put there."""

import math

import numpy as np
import pytest
import torch
from test_relight import CENTRE, RADIUS, fields

from reconstruct.appearance.brdf import LOBES, MATERIALS, Gloss, Material, reflectance
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.material_edit import (
    BoxRegion,
    BrushRegion,
    Edit,
    GroundRegion,
    ObjectRegion,
    apply_edits,
    edited_vertex_colours,
)

GOLD, EMERALD, PLASTIC, PLASTER = (MATERIALS[name] for name in ("gold", "emerald", "plastic", "plaster"))
RED = Material((0.6, 0.05, 0.05))


@pytest.fixture(scope="module")
def view() -> RenderView:
    return look(fields(), width=48)


def coefficients(view: RenderView) -> torch.Tensor:
    assert view.gloss is not None
    return view.gloss.coefficients()


def changed(before: RenderView, after: RenderView) -> torch.Tensor:
    return (before.albedo != after.albedo).any(-1)


def test_no_edit_changes_nothing(view):
    assert apply_edits(view, []) is view


def test_an_edit_of_the_object_leaves_the_ground_alone_and_the_other_way_round(view):
    seen = torch.isfinite(view.maps.depth)
    assert torch.equal(changed(view, apply_edits(view, [Edit(RED, ObjectRegion())])), seen & view.maps.mask)
    assert torch.equal(changed(view, apply_edits(view, [Edit(RED, GroundRegion())])), seen & ~view.maps.mask)


def test_a_box_around_the_upper_half_of_a_ball_changes_the_pixels_above_its_middle(view):
    box = BoxRegion((float(CENTRE[0]), float(CENTRE[1]), float(CENTRE[2]) + 0.5), (1.0, 1.0, 0.5))
    expected = view.maps.mask & (view.maps.points[..., 2] >= CENTRE[2])
    assert torch.equal(changed(view, apply_edits(view, [Edit(RED, box)])), expected)
    assert 0 < expected.sum() < view.maps.mask.sum()


def test_a_turned_box_reaches_along_its_own_axes():
    box = BoxRegion((0.0, 0.0, 0.0), (2.0, 0.1, 1.0), turn=math.pi / 4)
    points = torch.tensor([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.9, 0.0, 0.0]])
    assert box.contains(points, torch.ones(3, dtype=torch.bool)).tolist() == [True, False, False]


def test_a_brush_paints_what_lies_within_its_radius_and_not_the_ground_below(view):
    foot = torch.tensor([CENTRE[0], CENTRE[1] - 0.4, 0.4])
    brush = BrushRegion((float(foot[0]), float(foot[1]), float(foot[2])), 0.45, on_object=True)
    near = (view.maps.points - foot).norm(dim=-1) <= 0.45
    assert (near & ~view.maps.mask & torch.isfinite(view.maps.depth)).any(), "the ball of the brush reaches the ground"
    assert torch.equal(changed(view, apply_edits(view, [Edit(RED, brush)])), near & view.maps.mask)


def test_later_edits_lie_over_earlier_ones_and_undoing_the_last_shows_them_again(view):
    gold = Edit(GOLD, ObjectRegion())
    top = Edit(EMERALD, BoxRegion((float(CENTRE[0]), float(CENTRE[1]), float(CENTRE[2]) + 0.5), (1.0, 1.0, 0.5)))
    both = apply_edits(view, [gold, top])
    upper = view.maps.mask & (view.maps.points[..., 2] >= CENTRE[2])
    lower = view.maps.mask & ~upper
    assert torch.equal(coefficients(both)[upper][0], EMERALD.coefficients())
    assert torch.equal(coefficients(both)[lower][0], GOLD.coefficients())
    assert torch.equal(apply_edits(view, [gold, top][:-1]).albedo, apply_edits(view, [gold]).albedo)
    assert torch.equal(coefficients(apply_edits(view, [top, gold]))[upper][0], GOLD.coefficients())


def test_plastic_over_gold_has_the_recovered_colour_again(view):
    plastic = apply_edits(view, [Edit(GOLD, ObjectRegion()), Edit(PLASTIC, ObjectRegion())])
    steep = (view.maps.normals * torch.nn.functional.normalize(view.eye - view.maps.points, dim=-1)).sum(-1) > 0.5
    assert torch.equal(plastic.albedo[steep], view.albedo[steep])


def test_many_strokes_of_one_material_are_one_material(view):
    strokes = [Edit(GOLD, BrushRegion((0.1 * k, 0.0, 0.5), 0.2, on_object=True)) for k in range(20)]
    gloss = apply_edits(view, strokes).gloss
    assert gloss is not None and len(gloss.lobes) == 1


def test_the_gloss_that_was_recovered_stays_where_no_edit_is():
    view = look(fields(), width=24)
    lobes = torch.rand(2, LOBES, 3, generator=torch.Generator().manual_seed(0))
    weights = (
        torch.rand(*view.maps.depth.shape, 2, generator=torch.Generator().manual_seed(1)) * view.maps.mask[..., None]
    )
    glossy = RenderView(view.maps, view.albedo, view.grid, view.eye, Gloss(lobes, weights))
    edited = apply_edits(glossy, [Edit(RED, GroundRegion())])
    assert torch.equal(coefficients(edited)[view.maps.mask], coefficients(glossy)[view.maps.mask])
    assert not coefficients(edited)[~view.maps.mask].any()


def test_nothing_that_is_put_in_sends_back_more_light_than_arrives(view):
    white = Material((1.0, 1.0, 1.0), (0.3, 0.3, 0.3), 0.3)
    for material in (*MATERIALS.values(), white):
        edited = apply_edits(view, [Edit(material, ObjectRegion()), Edit(material, GroundRegion())])
        seen = torch.isfinite(view.maps.depth)
        cosine = (view.maps.normals * torch.nn.functional.normalize(view.eye - view.maps.points, dim=-1)).sum(-1)
        sent = edited.albedo[seen] + reflectance(coefficients(edited)[seen], cosine[seen])
        assert edited.albedo.max() <= 1 and sent.max() < 1.02


def test_the_mesh_is_drawn_in_the_light_that_a_material_sends_back():
    points = (CENTRE + RADIUS * torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])).numpy()
    recovered = np.array([[0.2, 0.3, 0.4], [0.5, 0.5, 0.5]])
    box = BoxRegion((float(CENTRE[0]), float(CENTRE[1]), float(CENTRE[2]) + 0.5), (1.0, 1.0, 0.5))
    np.testing.assert_allclose(edited_vertex_colours([Edit(GOLD, box)], points, recovered), [GOLD.mirrored, [0.5] * 3])
    np.testing.assert_allclose(edited_vertex_colours([Edit(PLASTIC, box)], points, recovered)[0], recovered[0] + 0.04)
