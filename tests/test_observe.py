"""Labels from photos against the truth of synthetic scenes."""

from dataclasses import replace

import numpy as np
import pytest
import synthetic
import torch
from synthetic import BALL, HEAP, Box, Look, default_lights, render

from reconstruct.labels import ground_test as ground_module
from reconstruct.labels.labels import assemble_labels, not_isolated
from reconstruct.labels.matting import coverage_at_edges
from reconstruct.labels.photometric_stereo import label_object
from reconstruct.scene import Scene

PLAIN = Look(width=160, height=120, n_lights=20)
HARD = replace(PLAIN, texture=0.3, noise=0.004, ambient=0.05, lobe=(1.5, 0.5))


def tensor(values) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


@pytest.fixture(scope="module", params=[PLAIN, HARD, replace(PLAIN, kind="directional")], ids=["plain", "hard", "suns"])
def heap(request):
    scene, truth = render(HEAP, request.param)
    return scene, truth, ground_module.test_ground(scene)


def test_the_object_is_what_does_not_behave_as_ground(heap):
    scene, truth, found = heap
    if scene.lights[0, 3] == 0:  # under suns a flat top shades exactly as the ground does
        scene, truth = render((BALL,), replace(PLAIN, kind="directional", texture=0.2))
        found = ground_module.test_ground(scene)
    assert truth.overlap(found.mask) > 0.95  # an outline pixel either way would be 0.9


def test_shadows_on_the_ground_are_found_and_full_ones_read_zero(heap):
    _, truth, found = heap
    assert truth.wrong(found) < 0.003
    clear = (truth.visibility == 0) & ~truth.mask & (found.confidence.numpy() > 0.5)
    assert np.median(found.visibility.numpy()[clear]) == 0
    assert found.confidence.numpy()[:, ~truth.mask].mean() > 0.9


def test_the_albedo_of_the_ground_is_found_under_ambient_light():
    scene, truth = render((BALL,), HARD)
    found = ground_module.test_ground(scene)
    on = (found.albedo.sum(-1) > 0).numpy() & ~truth.mask
    error = np.abs(found.albedo.numpy() / truth.albedo.clip(0.1) - 1)[on]
    assert on[~truth.mask].mean() > 0.97 and np.median(error) < 0.01


def test_of_two_levels_that_as_many_photos_show_the_brighter_is_lit_ground():
    shown = torch.tensor([[0.5, 0.3, 0.5, 0.3, 0.5, 0.3], [0.3, 0.3, 0.3, 0.3, 0.5, 0.5]])
    assert ground_module._densest(shown).tolist() == pytest.approx([0.5, 0.3])


def test_the_light_inside_shadows_is_taken_out():
    scene, truth = render((BALL,), replace(PLAIN, ambient=0.16))
    found = ground_module.test_ground(replace(scene, ambient=torch.zeros(3)))  # as if it were light between surfaces
    full = (truth.visibility == 0) & ~truth.mask & (found.confidence.numpy() > 0.9)
    assert full.sum() > 1000 and np.quantile(found.visibility.numpy()[full], 0.9) < 0.03


def test_normals_and_shadows_of_the_object_are_read_at_its_true_depth(heap):
    scene, truth, ground = heap
    found = label_object(scene, tensor(truth.points), None, tensor(truth.mask), ground)
    inner = truth.mask & (found.normal_confidence.numpy() > 0.5)
    assert inner[truth.mask].mean() > 0.4
    assert truth.degrees(found.normals)[inner].mean() < 4
    assert truth.wrong(found, truth.mask) < 0.01
    ratio = found.albedo.numpy()[inner] / truth.albedo[inner]
    assert abs(np.median(ratio) - 1) < 0.02


def test_a_highlight_does_not_bend_the_normals():
    scene, truth = render((BALL,), PLAIN)
    bright = scene.rgb.clone()
    rows, columns = np.nonzero(truth.mask)
    rng = np.random.default_rng(3)
    for row, column in zip(rows, columns, strict=True):
        bright[rng.integers(len(bright)), row, column] = 0.95
    found = label_object(replace(scene, rgb=bright), tensor(truth.points), None, tensor(truth.mask))
    trusted = truth.mask & (found.normal_confidence.numpy() > 0.5)
    assert np.median(truth.degrees(found.normals)[trusted]) < 0.3


def test_pixels_that_no_surface_explains_say_nothing():
    scene, truth = render((BALL,), PLAIN)
    rows, columns = (places[len(places) // 2 :][:200] for places in np.nonzero(truth.mask))
    odd = scene.rgb.clone()  # as light from other parts of the object makes them: of any brightness in any photo
    factor = np.random.default_rng(4).uniform(0.05, 1, (len(odd), len(rows), 1))
    odd[:, rows, columns] = 0.5 * torch.from_numpy(factor).float().expand(-1, -1, 3)
    plain, found = (
        label_object(replace(scene, rgb=rgb), tensor(truth.points), None, tensor(truth.mask))
        for rgb in (scene.rgb, odd)
    )
    assert plain.confidence[:, rows, columns].mean() > 0.3 and plain.normal_confidence[rows, columns].mean() > 0.3
    assert found.confidence[:, rows, columns].mean() < 0.03 and found.normal_confidence[rows, columns].mean() < 0.01
    others = truth.mask.copy()
    others[rows, columns] = False
    assert (found.confidence[:, others] - plain.confidence[:, others]).abs().mean() < 5e-3


def test_given_shadow_pictures_are_the_labels():
    scene, truth = render((BALL,), replace(PLAIN, with_shadow=True, with_mask=True))
    labels = assemble_labels(replace(scene, rgb=None), None, None)
    assert np.array_equal(labels.visibility.numpy(), truth.visibility.astype(np.float32))
    assert torch.equal(labels.confidence, not_isolated(scene.shadow)) and labels.confidence.mean() > 0.999
    assert np.array_equal(labels.mask.numpy(), truth.mask.astype(np.float32))


def test_beside_colour_shadow_pictures_give_the_shadows_and_colour_the_normals_and_albedo():
    scene, truth = render((BALL,), replace(PLAIN, with_shadow=True, noise=0.004))
    found = ground_module.test_ground(scene)
    shading = label_object(scene, tensor(truth.points), None, found.mask, found)
    labels = assemble_labels(scene, found, shading)
    assert np.array_equal(labels.visibility.numpy(), truth.visibility.astype(np.float32))
    ground = found.mask == 0
    assert torch.equal(labels.confidence[:, ground], not_isolated(scene.shadow)[:, ground])
    assert torch.equal(labels.normals, shading.normals)
    doubtful = shading.confidence > 0  # light that grazes: what the shading is not sure of is a picture's worst place
    assert (labels.confidence[doubtful] < 1).any()
    assert torch.equal(labels.albedo[found.mask > 0.5], shading.albedo[found.mask > 0.5])


def test_a_single_wrong_pixel_says_nothing_and_a_line_one_pixel_wide_does():
    shadow = torch.zeros(1, 12, 12)
    shadow[0, :, 6:] = 1.0
    shadow[0, 3] = 1.0  # a line of light, one pixel wide
    shadow[0, 8, 2] = 1.0
    shadow[0, 8, 9] = 0.0
    doubted = torch.nonzero(not_isolated(shadow)[0] == 0).tolist()
    assert doubted == [[8, 2], [8, 9]]


def under(scene, photos) -> Scene:
    parts = ("rgb", "usable", "lights", "power", "axis", "light_sigma")
    names = tuple(name for name, kept in zip(scene.photo_names, photos, strict=True) if kept)
    chosen = {part: getattr(scene, part)[torch.from_numpy(photos)] for part in parts}
    return replace(scene, **chosen, photo_names=names)


@pytest.mark.parametrize("lights, least", [(6, 0.8), (12, 0.99)])
def test_parts_that_few_photos_light_belong_to_the_object_around_them(lights, least):
    scene, truth = render(HEAP, Look(width=200, height=150, n_lights=lights, noise=0.002, ambient=0.02))
    assert truth.overlap(ground_module.test_ground(scene).mask) > least


@pytest.mark.parametrize("lights", [7, 8])
def test_a_leg_of_another_colour_that_two_lights_reach_below_a_roof_is_object(lights):
    roof, leg = Box((-45, -30, 45), (45, 30, 60)), Box((-10, -10, 0), (10, 10, 46))
    look = Look(width=200, height=150, n_lights=lights, noise=0.002, ambient=0.02, seed=1)
    (scene, truth), (_, without) = render((roof, leg), look), render((roof,), look)
    shown = truth.mask & ~without.mask
    assert (truth.visibility[:, shown].sum(0) <= 2).all()
    painted = scene.rgb * torch.tensor([1.5, 1.0, 0.6])
    rgb = torch.where(torch.from_numpy(shown)[..., None], painted, scene.rgb)
    found = ground_module.test_ground(replace(scene, rgb=rgb)).mask.numpy() > 0.5
    assert found[shown].mean() > 0.95 and not (found & ~truth.mask).any()


def suns_of_one_height(look):
    """All around, 35 degrees high: in every shadow the ambient light is the same share of the sun's."""
    lights = default_lights(look)
    azimuth = 2 * np.pi * np.arange(len(lights)) / len(lights)
    flat = np.cos(np.radians(35)) * np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    return [replace(x, direction=np.append(d, np.sin(np.radians(35)))) for x, d in zip(lights, flat, strict=True)]


def test_ground_that_is_mostly_in_shadow_has_the_albedo_that_it_shows_in_the_sun(monkeypatch):
    monkeypatch.setattr(synthetic, "default_lights", suns_of_one_height)
    scene, truth = render(HEAP, replace(PLAIN, kind="directional", ambient=0.05, n_lights=16))
    mostly_dark = (truth.visibility.mean(0) < 0.5) & (truth.visibility.sum(0) >= 3) & ~truth.mask
    assert mostly_dark.sum() > 200
    found = ground_module.test_ground(scene)
    assert np.median(found.albedo.numpy()[mostly_dark] / truth.albedo[mostly_dark]) == pytest.approx(1, abs=0.02)
    assert truth.wrong(found) < 0.003


def test_what_is_dark_where_no_shadow_of_the_object_may_fall_is_no_shadow():
    """A table ends at a line; the floor behind it stays dark under some lights, as does ground behind a flashlight."""
    scene, truth = render(HEAP, PLAIN)
    beyond = np.zeros(truth.mask.shape, bool)
    beyond[:8] = True
    dark = torch.zeros(len(scene.rgb), 1, 1, dtype=torch.bool)
    dark[::4] = True
    rgb = torch.where((dark & tensor(beyond).bool())[..., None], 0.02 * scene.rgb, scene.rgb)
    found = ground_module.test_ground(replace(scene, rgb=rgb))
    said = (found.confidence > 0) & (found.visibility < 0.5) & torch.from_numpy(beyond & (truth.visibility > 0.5))
    assert not said.any()
    kept = (truth.visibility < 0.5) & ~truth.mask & ~beyond
    assert (found.confidence.numpy()[kept] > 0).mean() > 0.9


# --- coverage of outline pixels --------------------------------------------------------------------------------------


def test_edge_pixels_are_unmixed_to_their_coverage_and_an_outline_drawn_a_pixel_too_wide_moves_back():
    """A square whose right column is covered by 0.3."""
    covered = torch.zeros(30, 30)
    covered[8:22, 8:21] = 1
    covered[8:22, 21] = 0.3
    inside, outside = torch.tensor(np.random.default_rng(1).random((2, 12, 1, 1)), dtype=torch.float32)
    photos = (inside * covered + outside * (1 - covered))[..., None]
    mask = coverage_at_edges(photos, covered > 0.5)
    assert torch.allclose(mask[12:18], covered[12:18], atol=1e-4)
    wide = torch.nn.functional.max_pool2d((covered > 0.5).float()[None], 3, 1, 1)[0] > 0
    assert torch.equal(coverage_at_edges(photos, wide)[12:18] > 0.5, covered[12:18] > 0.5)
