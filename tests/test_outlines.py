"""Lights from outlines: the shadows of a ball on a plane, drawn by their equations."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_shadows import EYE, HEIGHT, MIDDLE, RADIUS, WIDTH, ball_camera, ball_lights, drawn, hits_ball, photographed
from flashlight_photos import looking_at

from calibration.flashlight.outline_lights import OUTLINES_WRONG
from calibration.ground.ground_field import GroundField
from calibration.ground.ground_shadows import GroundShadows
from calibration.ground.mirror_highlights import MirrorHighlights, find_highlights
from calibration.lights.ground_cells import ground_points
from calibration.outlines.carried_light import offset_by_outlines
from calibration.outlines.coherence import FINE, PENUMBRA, residuals, softness
from calibration.outlines.coherence_kernels import BETTER
from calibration.outlines.metric_cues import MetricCues
from calibration.outlines.outline_maps import PIXEL_ERROR, TALLEST, outline_maps, with_cues
from calibration.outlines.shadow_start import STARTS, shadow_starts
from calibration.outlines.terms import DROP_OUTLINE, FALSE_SPOT, OutlineTerms
from calibration.pose import Pose
from calibration.side_view import SideView


@pytest.fixture(scope="module")
def ball():
    return drawn()


def terms_of(maps, *spots) -> OutlineTerms:
    """The terms of all photos' outlines."""
    every = np.ones(len(ball_lights()), bool)
    return OutlineTerms(maps, EYE, 0.0, every, *spots)


def test_right_lights_agree_and_wrong_ones_contradict(ball):
    _, lights, maps = ball
    terms = terms_of(maps)
    assert np.median(terms.misfit(lights)) < 0.3
    moved = lights.copy()
    moved[3] += [60.0, -40.0, 0.0]  # about 8 degrees
    assert terms.misfit(moved)[3] > 1.0


def test_a_photo_in_which_no_shadow_is_found_empties_no_space(ball):
    _, lights, maps = ball
    others = maps.owner != 3
    fields = np.where(np.arange(len(maps.fields))[:, None, None] == 3, np.abs(maps.fields), maps.fields)
    parts = {name: getattr(maps, name)[others] for name in ("starts", "owner", "first_height")}
    assert np.median(terms_of(replace(maps, fields=fields, **parts)).misfit(lights)) < 0.3


def test_derivatives_are_those_of_differences(ball):
    _, lights, maps = ball
    every = np.ones(len(lights), bool)
    rng = np.random.default_rng(0)
    wrong = lights * (1 + 0.05 * rng.standard_normal(lights.shape))
    found = residuals(maps, wrong, EYE, every)
    k, step = 2, np.array([0.3, -0.2, 0.25])
    sides = [
        residuals(maps, wrong + sign * step * (np.arange(len(lights)) == k)[:, None], EYE, every) for sign in (1, -1)
    ]
    rows = (found.owner == k) | (found.by == k)
    slope = (found.d_owner * (found.owner == k)[:, None] + found.d_by * (found.by == k)[:, None]) @ step
    numeric = (sides[0].emptiness - sides[1].emptiness) / 2
    same = rows & (sides[0].by == found.by) & (sides[1].by == found.by) & (np.abs(found.emptiness) < 50)
    assert same.sum() > 50
    assert np.corrcoef(slope[same], numeric[same])[0, 1] > 0.97


def test_rays_of_some_views_are_those_among_all(ball):
    _, lights, maps = ball
    wrong = lights * (1 + 0.05 * np.random.default_rng(0).standard_normal(lights.shape))
    every, of = np.ones(len(lights), bool), np.arange(len(lights) + 1) == 2
    found, some = residuals(maps, wrong, EYE, every), residuals(maps, wrong, EYE, every, of=of)
    assert (some.owner == 2).all() and len(some.owner) == (found.owner == 2).sum() > 0
    np.testing.assert_allclose(some.emptiness, found.emptiness[found.owner == 2], rtol=0.05, atol=0.1 * maps.pixel)


def test_a_photo_at_odds_with_the_others_tells_by_its_own_rays(ball):
    _, lights, maps = ball
    terms, moved = terms_of(maps), lights.copy()
    right = terms.own_cost(3, moved), terms.own_cost(5, moved)
    moved[3] += [60.0, -40.0, 0.0]  # in place: what was asked before is not taken for it
    assert terms.own_cost(3, moved) > right[0] + 1.0
    assert terms.own_cost(3, moved) - right[0] > terms.own_cost(5, moved) - right[1]
    at_odds = terms.cost(moved)
    moved[3] = lights[3]
    assert terms.cost(moved) < at_odds


def _at_many_heights(maps, lights: np.ndarray, start: np.ndarray, own: int) -> float:
    """Emptiness of a ray by brute force: 4000 heights, every view at each."""
    views, soft = np.concatenate([lights, EYE[None]]), np.append(softness(maps, lights), 0.0)
    heights = np.linspace(0, TALLEST * maps.size, 4000)
    ray = start + (views[own, :2] - start) * heights[:, None] / views[own, 2]
    proven = np.full((len(views), len(heights)), -np.inf)
    for k, view in enumerate(views):
        if k != own:
            at = ray + (ray - view[:2]) * (heights / (view[2] - heights))[:, None]
            place = ((at - maps.corner) / maps.cell - 0.5).astype(np.float32)
            inside = np.clip(place, 0, len(maps.fields[k]) - 1.01) if k == len(lights) else place
            value = cv2.remap(maps.fields[k], inside[:, 1], inside[:, 0], cv2.INTER_LINEAR, borderValue=-1e3)
            wide = np.sqrt(1 + heights**2 * (soft[own] ** 2 + soft[k] ** 2))
            proven[k] = value * (view[2] - heights) / view[2] / wide
    return max(float(proven.max(0).min()), 0.0)


@pytest.mark.parametrize("off", [0.0, 0.02, 0.1])
def test_a_ray_meets_what_it_only_grazes(ball, off):
    """Rays beside an outline cross a millimetre of the object: looks at fixed heights pass over it."""
    _, lights, maps = ball
    wrong = lights * (1 + off * np.random.default_rng(2).standard_normal(lights.shape))
    maps.first_height[:] = 0
    found = residuals(maps, wrong, EYE, np.ones(len(lights), bool))
    some = np.random.default_rng(3).choice(len(found.emptiness), 60, replace=False)
    least = [_at_many_heights(maps, wrong, maps.starts[k], int(found.owner[k])) for k in some]
    above = found.emptiness[some] - np.array(least)
    assert (above < FINE * maps.pixel + BETTER * np.array(least) + 0.01 * maps.pixel).all()
    assert (above > -0.03 * maps.pixel - 0.01 * np.array(least)).all()


def test_outlines_show_where_the_led_sits_beside_its_phones_lens(ball):
    camera, lights, maps = ball
    every, offset = np.ones(len(lights), bool), np.array([16.0, -9.0, 2.0])
    poses = [looking_at(light, MIDDLE) for light in lights]
    poses = [Pose(pose.rotation, light - pose.rotate(offset)) for pose, light in zip(poses, lights, strict=True)]
    terms = OutlineTerms(maps, EYE, camera.ground_height, every & (np.arange(len(lights)) != 3))
    found, covariance = offset_by_outlines(terms, [*poses[:3], None, *poses[4:]], lights)
    sigma = np.sqrt(np.diag(covariance))
    assert (np.abs(found - offset) < 2 * sigma).all() and np.linalg.norm(
        (found - offset)[:2]
    ) < 7  # of 18; a pixel is 2.2 mm
    assert sigma[:2].max() < 5


def test_a_penumbra_is_wider_the_higher_its_edge_and_the_lower_its_light(ball):
    """R h / (z - h) times distance / z on the ground (similar triangles), and (z - h) / z of that at the edge."""
    _, _, maps = ball
    for angle in np.radians([20, 40, 80]):
        light, height, radius = (
            500 * np.array([np.cos(angle), 0, np.sin(angle)]) + maps.foot,
            40.0,
            PENUMBRA * maps.size,
        )
        light[2] -= maps.foot[2]
        sides = light + radius * np.array([[-np.sin(angle), 0, np.cos(angle)], [np.sin(angle), 0, -np.cos(angle)]])
        edge = maps.foot * [1, 1, 0] + [0.0, 0.0, height]
        ends = edge[:2] + (edge[:2] - sides[:, :2]) * (height / (sides[:, 2:] - height))
        half = np.linalg.norm(ends[0] - ends[1]) / 2 * (light[2] - height) / light[2]
        found = softness(maps, light[None])[0] * height * PIXEL_ERROR * maps.pixel
        assert found == pytest.approx(half, rel=0.35)  # the edge is not at the foot, and h is not small


def spots_on(residual: np.ndarray, camera, mask: np.ndarray, usable: np.ndarray) -> MirrorHighlights:
    """The highlights of bare ground around the object's mask, of which photos show this residual."""
    flat, likelihood = np.zeros((HEIGHT, WIDTH), np.float32), np.where(mask, 1.0, -1.0).astype(np.float32)
    field = GroundField(flat, 0 * residual, residual, usable, flat + 1)
    shadows = GroundShadows(np.ones_like(residual), np.full(len(residual), -2.0), likelihood, mask)
    return find_highlights(field, shadows, ground_points(camera)[0])


def _mirrored(lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the ground mirrors each light into the eye: image points of a light under the ground, seen through it."""
    below = lights * [1, 1, -1]
    share = EYE[2] / (EYE[2] + lights[:, 2])
    points = EYE + (below - EYE) * share[:, None]
    pixels = ball_camera().project(points)
    seen = np.all(pixels > 20, axis=1) & np.all(pixels < np.array([WIDTH, HEIGHT]) - 20, axis=1)
    return points, seen


def test_a_varnished_table_shows_where_it_mirrors_the_lights(ball):
    camera, _, _ = ball
    turn = 0.7 * np.arange(9)
    lights = np.stack([150 * np.cos(turn), 330 + 120 * np.sin(turn), 300 + 20 * turn], -1)
    points, seen = _mirrored(lights)
    assert seen.sum() >= 5
    ground, _ = ground_points(camera)
    excess = np.exp(-((np.linalg.norm(ground - points[:, None, None], axis=-1) / 25) ** 2)).astype(np.float32)
    mask = hits_ball(np.broadcast_to(EYE, ground.shape), ground)
    spots = spots_on(excess, camera, mask, np.ones(excess.shape, bool))
    assert len(spots) >= 5
    half = [
        (lights[k] - p) / np.linalg.norm(lights[k] - p) + (EYE - p) / np.linalg.norm(EYE - p)
        for k, p in zip(spots.photos, spots.points, strict=True)
    ]
    lean = np.linalg.norm(np.array([one / np.linalg.norm(one) for one in half])[:, :2], axis=1)
    assert np.median(lean) < np.radians(1.0)


def test_a_saturated_spot_at_the_border_is_found_and_one_whose_middle_is_out_of_sight_is_not(ball):
    """Nor is a fainter one taken in its place; the first photo's is whole, which tells how high spots are."""
    camera, _, _ = ball
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    middles = [(WIDTH / 2, HEIGHT - 40.0), (80.0, HEIGHT - 8.0), (80.0, HEIGHT + 10.0)]
    light = np.stack([3 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 20**2) for x, y in middles]).astype(np.float32)
    light[2] += 0.3 * np.exp(-((u - 50) ** 2 + (v - HEIGHT / 2) ** 2) / 10**2)
    spots = spots_on(np.minimum(light, 1.2), camera, np.zeros((HEIGHT, WIDTH), bool), light < 1)
    assert spots.photos.tolist() == [0, 1]
    assert np.abs(camera.project(spots.points) - middles[:2]).max() < 2.5  # px
    assert spots.sigma[1] > spots.sigma[0]


def test_matt_tables_show_no_highlights(ball):
    camera, lights, _ = ball
    rng = np.random.default_rng(3)
    noise = (0.03 * rng.standard_normal((len(lights), HEIGHT, WIDTH))).astype(np.float32)
    assert len(spots_on(noise, camera, np.zeros((HEIGHT, WIDTH), bool), np.ones(noise.shape, bool))) == 0


def test_rows_are_derivatives_of_the_highlights_cost(ball):
    _, lights, maps = ball
    points = np.array([[40.0, 60.0, 0.0], [-80.0, 10.0, 0.0]])
    terms = terms_of(maps, MirrorHighlights(np.array([2, 5]), points, np.array([0.02, 0.03])))
    miss, slope, owner = terms._half_vectors(lights)
    assert owner.tolist() == [2, 5]
    step = np.array([0.02, -0.03, 0.01])
    for spot, light in enumerate(owner):
        moved = [
            terms._half_vectors(lights + sign * step * (np.arange(len(lights)) == light)[:, None])[0][spot]
            for sign in (1, -1)
        ]
        np.testing.assert_allclose(slope[spot] @ step, (moved[0] - moved[1]) / 2, rtol=1e-4, atol=1e-9)
    value, slopes = terms.rows(lights)
    vote = 1 / (1 + (miss**2).sum(1, keepdims=True) / FALSE_SPOT**2)
    np.testing.assert_allclose(value[-4:], (miss * vote).ravel())
    np.testing.assert_allclose(slopes[-4:].reshape(2, 2, -1, 3)[[0, 1], :, owner], slope * vote[..., None])


def test_starts_are_of_several_heights(ball):
    """Directions of the best one are within 25 degrees; no two starts are the same."""
    camera, lights, maps = ball
    points, _ = ground_points(camera)
    starts = shadow_starts(maps, hits_ball(np.broadcast_to(EYE, points.shape), points), camera)
    assert len(starts) == STARTS
    cosine = (starts[0] * lights).sum(1) / np.linalg.norm(starts[0], axis=1) / np.linalg.norm(lights, axis=1)
    assert np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))) < 25
    assert all(np.abs(one - starts[0]).max() > 1 for one in starts[1:])


def test_a_part_that_is_lit_as_the_ground_is_makes_right_lights_contradict_unless_the_hull_is_unknown():
    """All of the ball but its rim is taken for lit ground."""
    camera, lights, field, shadows = photographed()
    inside = cv2.erode(shadows.object_mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    likelihood = np.where(inside, -1.0, shadows.likelihood).astype(np.float32)
    wrong = replace(shadows, visibility=np.where(inside, np.float32(1), shadows.visibility), likelihood=likelihood)
    wrong = replace(wrong, object_mask=shadows.object_mask & ~inside)
    tight, wide = (outline_maps(field, wrong, camera, unknown) for unknown in (False, True))
    assert tight is not None and wide is not None
    misfit = [terms_of(maps).misfit(lights) for maps in (tight, wide)]
    assert (misfit[0] > DROP_OUTLINE).mean() > OUTLINES_WRONG
    assert np.median(misfit[1]) < 0.3 and (misfit[1] < DROP_OUTLINE).all()


def _from_the_side() -> SideView:
    camera = ball_camera(np.array([380.0, 150.0, 220.0]))
    rays = camera.rays(camera.camera.pixel_grid())
    mask = hits_ball(np.broadcast_to(camera.centre, rays.shape), camera.centre + rays)
    return SideView("side.jpg", camera, (0, 0, WIDTH, HEIGHT), mask, np.ones_like(mask), 0.3)


def _moved_together(lights: np.ndarray, m: float) -> np.ndarray:
    """The homology that changes no shadow on the ground and no silhouette from the camera."""
    share = m * lights[:, 2:]
    return (lights + share * EYE) / (1 + share)


@pytest.mark.parametrize(
    ("cues", "shares"),
    [
        (MetricCues((_from_the_side(),)), (-0.1, 0.1)),
        (MetricCues((), 2 * RADIUS, 0.6), (-0.1, 0.4)),  # no light of these touches the top: taller is doubted less
    ],
)
def test_a_photo_from_the_side_and_a_height_fix_the_scale_that_shadows_leave_free(ball, cues, shares):
    camera, lights, maps = ball
    held = with_cues(maps, cues, camera)
    for share in shares:
        moved = _moved_together(lights, share / EYE[2])
        free = terms_of(maps).cost(moved) - terms_of(maps).cost(lights)
        assert terms_of(held).cost(moved) - terms_of(held).cost(lights) > free + 2.0
