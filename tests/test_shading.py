"""Lights from the ground's shading, on photos made by the formula: truth is exact."""

from dataclasses import replace

import numpy as np
import pytest
from flashlight_photos import (
    AMBIENT,
    CAMERA,
    POSED_CAMERA,
    POWER,
    WORLD_FROM_CAMERA,
    Recipe,
    Truth,
    handheld_lights,
    photograph,
)

from calibration.flashlight import light_estimate
from calibration.flashlight.duplicates import earlier_duplicate
from calibration.flashlight.fit import collect, first_fits, fit_flashlights, without_gloss
from calibration.flashlight.light_estimate import locate_lights
from calibration.flashlight.model import (
    LOWEST_COSINE,
    PER_FLASHLIGHT,
    Flashlights,
    _model,
    free_tangent,
    jacobian,
    log_irradiance,
)
from calibration.flashlight.wall import WALL_TERMS
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.photos.photo import encode_srgb


def every(stack):
    return np.ones(len(stack.rgb), bool)


@pytest.fixture(scope="module")
def truth():
    return photograph(Recipe())


@pytest.fixture(scope="module")
def found(truth):
    return locate_lights(truth.stack, POSED_CAMERA, every(truth.stack))


def test_positions_are_found_to_half_a_per_cent_despite_object_shadows_and_texture(truth, found):
    errors = truth.errors(found.lights)
    assert np.median(errors) < 0.005
    assert errors.max() < 0.02
    assert all(light.used for light in found.lights)


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize(("near", "reach"), [(0.24, (380, 850)), (2.2, (250, 700))])
def test_lights_are_found_wherever_the_camera_stands(near, reach, monkeypatch):
    """From a coin seen from 150 mm to a chair seen from 1.4 m: a hand holds the light as far away as ever.

    By shading: a small ground's lights are so uncertain that outlines would be asked, too, for half a minute.
    """
    monkeypatch.setattr(light_estimate, "with_outlines", lambda *_: None)
    recipe = Recipe(near=near, lights=handheld_lights(8, np.random.default_rng(7), reach))
    truth = photograph(recipe)
    found = locate_lights(truth.stack, recipe.posed_camera(), np.ones(8, bool))
    errors = truth.errors(found.lights)
    assert all(light.used for light in found.lights)
    assert np.median(errors) < 0.03


def test_ambient_light_is_found_relative_to_the_flashlight(found):
    power = np.median([light.power.mean() for light in found.lights])
    assert found.ambient.mean() / power == pytest.approx(AMBIENT / POWER, rel=0.2)


def test_thejacobian_is_that_of_the_model(truth):
    evidence, _ = collect(truth.stack, POSED_CAMERA, every(truth.stack))
    positions = np.stack([light.position for light in truth.lights])
    axes = np.stack([light.axis for light in truth.lights])
    n, beam = len(positions), np.array([1.5, 0.4, -0.3, 0.2])
    flashlights = Flashlights(positions, positions + 500 * axes, np.linspace(-0.1, 0.1, n), beam, 0.02, np.zeros(3))
    step = np.random.default_rng(3).normal(size=PER_FLASHLIGHT * n + len(beam) + 4 + WALL_TERMS) * 1e-4
    step[PER_FLASHLIGHT * n + len(beam) + 1 :] = 0  # no wall
    there, back = (log_irradiance(flashlights.moved(s, 0.0), evidence) for s in (step, -step))
    flashlight, shared = jacobian(flashlights, evidence)
    linear = (
        np.einsum("kjp,kp->kj", flashlight, step[: PER_FLASHLIGHT * n].reshape(-1, PER_FLASHLIGHT))
        + shared @ step[PER_FLASHLIGHT * n : -3]
    )
    inside = _model(flashlights, evidence).cosine > LOWEST_COSINE  # below, the beam is clamped
    np.testing.assert_allclose(((there - back) / 2)[inside], linear[inside], atol=1e-8)  # third order of 1e-4 steps


@pytest.mark.usefixtures("few_starts")
def test_a_photo_not_lit_by_the_flashlight_is_refused_and_spoils_no_other(truth):
    rng = np.random.default_rng(5)
    rgb = truth.stack.rgb.copy()
    rgb[3] = np.clip(0.05 * np.exp(rng.normal(size=rgb[3].shape)), 0, 0.9)
    found = locate_lights(replace(truth.stack, rgb=rgb), POSED_CAMERA, every(truth.stack))
    assert not found.lights[3].used and "misfits" in found.lights[3].reason
    assert np.delete(truth.errors(found.lights), 3).max() < 0.025


@pytest.mark.usefixtures("few_starts")
def test_one_flashlight_is_not_five_times_as_strong_in_one_photo_as_in_the_others(truth):
    """A fifth weaker it may be: auto exposure that the file does not tell."""
    rgb = truth.stack.rgb.copy()
    rgb[3] *= 0.2
    rgb[6] *= 0.8
    lights = locate_lights(replace(truth.stack, rgb=rgb), POSED_CAMERA, every(truth.stack)).lights
    assert [k for k, light in enumerate(lights) if not light.used] == [3] and "times as strong" in lights[3].reason


def test_a_glossy_table_is_noticed_and_its_highlights_left_out():
    truth = photograph(Recipe(n_photos=8, gloss=1.0))
    evidence, _ = collect(truth.stack, POSED_CAMERA, every(truth.stack))
    plain = fit_flashlights(first_fits(evidence).best(), evidence, free_tangent)
    careful = without_gloss(plain)
    assert (careful.evidence.weight == 0).sum() > (plain.evidence.weight == 0).sum()
    true = np.stack([light.position for light in truth.lights])
    errors = [np.median(np.linalg.norm(fit.flashlights.positions - true, axis=1)) for fit in (plain, careful)]
    assert errors[1] < errors[0]


@pytest.mark.slow
def test_beams_that_are_not_round_are_noticed_and_cost_little():
    truth = photograph(Recipe(asymmetry=0.03))
    found = locate_lights(truth.stack, POSED_CAMERA, every(truth.stack))
    assert found.residuals["beam_asymmetry"] == pytest.approx(0.03, abs=0.01)
    assert np.median(truth.errors(found.lights)) < 0.008  # 0.03 with round beams
    assert truth.share_inside(found.lights) >= 0.8


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize(
    "curve",
    [
        pytest.param({"tone": 1.25}, id="steeper by a quarter"),
        pytest.param({"contrast": 0.15}, id="S-shaped", marks=pytest.mark.slow),
    ],
)
def test_a_tone_curve_that_is_not_the_assumed_one_is_covered_by_the_stated_sigmas(curve):
    steep = photograph(Recipe(n_photos=10, **curve))
    lights = locate_lights(steep.stack, POSED_CAMERA, every(steep.stack)).lights
    in_sigmas = np.abs(steep.off(lights)) / np.array([light.sigma for light in lights])
    assert (in_sigmas < 2).mean() > 0.9 and (in_sigmas < 3).mean() > 0.985


def test_too_few_photos_over_exposed_ground_and_a_camera_that_looks_past_it_are_refused(truth):
    stack, all_photos = truth.stack, every(truth.stack)
    over_exposed = replace(stack, clipped=np.ones_like(stack.clipped))
    level = replace(WORLD_FROM_CAMERA, rotation=np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    for photos, camera, usable, said in (
        (stack, POSED_CAMERA, np.arange(len(stack.rgb)) < 3, "3 usable photos under the flashlight, 4 needed"),
        (over_exposed, POSED_CAMERA, all_photos, r"only 0 patches of bare, unclipped ground .* needed"),
        (stack, PosedCamera(CAMERA, level, 0.0), all_photos, "does not look down at the ground"),
    ):
        with pytest.raises(CalibrationError, match=said):
            locate_lights(photos, camera, usable)


# --- photos under one and the same light -----------------------------------------------------------------------------


def shaken(by_mm: float, n: int = 8) -> Truth:
    """A flashlight held in one place by a hand that trembles."""
    rng = np.random.default_rng(1)
    held = handheld_lights(6, rng)[1]
    places = np.array(held.position, float) + by_mm * rng.normal(size=(n, 3))
    lights = tuple(replace(held, photo=f"{k}.jpg", position=place) for k, place in enumerate(places))
    return photograph(Recipe(lights=lights))


@pytest.mark.parametrize("by_mm", [0.0, 3.0])
def test_a_flashlight_that_never_moves_is_refused(by_mm):
    truth = shaken(by_mm)
    with pytest.raises(CalibrationError, match="flashlight hardly moved, or these are copies"):
        collect(truth.stack, POSED_CAMERA, every(truth.stack))


@pytest.mark.slow
def test_copies_encoded_again_at_another_exposure_are_named_and_not_used():
    truth = photograph(Recipe(n_photos=8))
    rgb = truth.stack.rgb.copy()
    eight_bit = encode_srgb(rgb[2] * np.float32(0.8)).astype(np.float64) / 255
    decoded = np.where(eight_bit <= 0.04045, eight_bit / 12.92, ((eight_bit + 0.055) / 1.055) ** 2.4)
    rgb[5] = np.maximum(decoded, 1e-4)
    found = locate_lights(replace(truth.stack, rgb=rgb), POSED_CAMERA, every(truth.stack))
    assert [light.photo for light in found.lights if not light.used] == [truth.lights[5].photo]
    assert f"lit as in {truth.lights[2].photo}" in found.lights[5].reason


def test_three_lights_photographed_over_and_over_are_too_few():
    rng = np.random.default_rng(2)
    three = handheld_lights(3, rng)
    truth = photograph(Recipe(lights=tuple(replace(three[k % 3], photo=f"{k}.jpg") for k in range(9))))
    with pytest.raises(CalibrationError, match="3 different lights, 4 needed"):
        collect(truth.stack, POSED_CAMERA, every(truth.stack))


def test_a_flashlight_moved_by_fifteen_millimetres_is_another_light():
    lights = handheld_lights(5, np.random.default_rng(3))
    near = replace(lights[0], photo="near.jpg", position=np.add(np.array(lights[0].position, float), [0.0, 15.0, 0.0]))
    truth = photograph(Recipe(lights=(*lights, near)))
    evidence, _ = collect(truth.stack, POSED_CAMERA, every(truth.stack))
    assert (earlier_duplicate(evidence) == np.arange(6)).all()
