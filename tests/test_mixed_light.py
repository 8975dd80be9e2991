"""Light that is mixed: two groups of photos are told by their own test, with its cause, and the work stays bounded."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import lit_table
import numpy as np
import pytest
from flashlight_photos import POSED_CAMERA, Recipe, handheld_lights, photograph

import calibration.calibrate as glue
import calibration.flashlight.light_estimate as light_estimate
from calibration.flashlight.fit import collect, first_fits, fit_flashlights, photo_quality
from calibration.flashlight.light_estimate import LightFit
from calibration.flashlight.model import free_tangent
from calibration.lights.mixed_light import MixedLight, PhotoLight, find_mixture
from capture.checks.ambient_light import find_shadows
from capture.checks.check_stack import check_stack
from capture.session.session import Session, SessionSettings

pytestmark = pytest.mark.usefixtures("few_starts")
N, WIDTH = 18, 160


@pytest.fixture(scope="module")
def lights():
    return handheld_lights(N, np.random.default_rng(4))


def numbers(stack) -> PhotoLight:
    """What the ground's shading and the shadows say of each photo."""
    evidence, _ = collect(stack, POSED_CAMERA, np.ones(N, bool))
    fit = fit_flashlights(first_fits(evidence).best(), evidence, free_tangent)
    return PhotoLight.of(find_shadows(stack, [True] * N), fit.flashlights.log_power, photo_quality(fit)[0])


def of_power(lights, ratio, photos):
    return tuple(replace(x, power=x.power * (ratio if k in photos else 1)) for k, x in enumerate(lights))


def test_ordinary_photos_are_one_group():
    assert find_mixture(numbers(photograph(Recipe(n_photos=N, width=WIDTH)).stack)) is None


@pytest.mark.parametrize("photos", [range(12), range(12, 26), range(18, 26)], ids=str)
def test_a_second_light_that_came_or_went_is_told_where_powers_are_hardly_known(photos):
    """As in pictures of a phone's pipeline: one photo's power says little, their order says the rest."""
    rng, n = np.random.default_rng(1), 26
    both = np.isin(np.arange(n), photos)
    clear = rng.random(n) < np.where(both, 0.2, 0.9)
    in_shadow = np.where(clear, 0.08 + 0.08 * both + 0.01 * rng.normal(size=n), np.nan)
    found = find_mixture(
        PhotoLight(0.7 * both + 0.25 * rng.normal(size=n), in_shadow, 0.35 * rng.normal(size=n), clear)
    )
    assert found is not None and (found.spoilt() == both).all()


@pytest.mark.parametrize("photos", [range(8), range(19, 27), range(0, 27, 2)], ids=str)
@pytest.mark.parametrize("more", [0.003, 0.006, 0.02])
def test_photos_with_lighter_shadows_that_are_no_brighter_have_no_second_light(photos, more):
    rng, n = np.random.default_rng(2), 27
    lighter = np.isin(np.arange(n), photos)
    in_shadow = 0.004 + more * lighter + 0.0005 * rng.normal(size=n)
    noise = 0.001 * rng.normal(size=n), 0.07 * rng.normal(size=n)
    assert find_mixture(PhotoLight(noise[0], in_shadow, noise[1], rng.random(n) < 0.8)) is None


def test_a_flashlight_that_changes_its_power_is_told_from_which_photo_on(lights):
    ratio, first = 1.6, 12
    stack = photograph(
        Recipe(width=WIDTH, lights=of_power(of_power(lights, 0.5, range(N)), ratio, range(first, N)))
    ).stack
    found = find_mixture(numbers(stack))
    assert found is not None and found.cause == "power" and not found.spoilt().any()
    names = [path.name for path in stack.paths]
    told = found.ratio if found.groups[-1] else 1 / found.ratio
    assert told == pytest.approx(ratio, rel=0.06)
    assert found.sentence(names).startswith(f"from {names[first]} on the light is {told:.2g} times as bright as ")


@pytest.fixture
def calibrated(monkeypatch):
    residuals = {"board": "checkerboard:9x6:20", "notes": [], "pose_covariance": np.zeros((6, 6)).tolist()}
    sheet = SimpleNamespace(on_sheet=lambda corners: corners)
    monkeypatch.setattr(glue, "fit_board", lambda *_: (POSED_CAMERA, sheet, residuals))
    return lambda stack: glue.calibrate(Session(Path("capture"), (), stack.paths, (), (), SessionSettings()), stack)


def with_another(lights, both):
    """Photos under one flashlight, and those of `both` under another of its power, too."""
    every = range(len(lights))
    stack = photograph(Recipe(width=WIDTH, lights=of_power(lights, 0.5, every))).stack
    other = photograph(Recipe(width=WIDTH, lights=of_power((*lights[5:], *lights[:5]), 0.5, every))).stack
    return replace(stack, rgb=stack.rgb + other.rgb * both[:, None, None, None])


def test_photos_under_two_flashlights_are_told_and_left_out_before_outlines_are_looked_for(calibrated, monkeypatch):
    """Outlines cost most, and hide the second light: with them the powers are held alike."""
    lights = handheld_lights(12, np.random.default_rng(4))
    both, asked = np.arange(12) < 6, []
    monkeypatch.setattr(light_estimate, "with_outlines", lambda *given: asked.append(given[3]))
    found = calibrated(with_another(lights, both))
    left_out = np.array(["a second light is on" in light.reason for light in found.lights])
    assert (left_out == both).mean() > 0.9 and "a second light is on" in found.residuals["warnings"][0]
    assert not any((usable & left_out).any() for usable in asked)


@pytest.mark.parametrize("photos", [range(9), range(0, 18, 2), range(12)], ids=str)
def test_room_light_in_half_of_the_photos_is_named_and_the_others_are_right_also_where_they_are_fewer(photos):
    rng = np.random.default_rng(1)
    albedo = lit_table.with_object(lit_table.table(rng))
    sent = [lit_table.flashlight(2 * np.pi * 5 * k / N, 0.03) for k in range(N)]
    room = 0.15 * np.median(sent, axis=0)
    taken = [lit_table.photograph(albedo * (x + room * (k in photos)), rng) for k, x in enumerate(sent)]
    found = check_stack(lit_table.stack_of(taken))
    assert {(one.photo.name, one.kind) for one in found if one.drop} == {
        (f"IMG_{k}.jpg", "ambient light") for k in photos
    }


@pytest.mark.parametrize("cause", [None, "power", "second light"])
def test_lights_are_looked_for_once_more_at_most_and_only_where_photos_were_left_out(
    lights, calibrated, monkeypatch, cause
):
    """The bound on the work, counted in fits: trouble at most doubles them, also if the second fit is no better."""
    truth, asked = photograph(Recipe(width=WIDTH, lights=lights), 3), []

    def search(*given):
        usable = given[-1]
        asked.append(int(usable.sum()))
        own = tuple(x for x, use in zip(truth.lights, usable, strict=True) if use)
        return LightFit(own, (), np.zeros(3)), []

    mixed = None if cause is None else MixedLight(cause, np.arange(N) < 5, 2.0)
    monkeypatch.setattr(glue, "_lights", search)
    monkeypatch.setattr(glue, "_mixture", lambda *_: mixed)
    found = calibrated(truth.stack)
    assert asked == ([N, N - 5] if cause == "second light" else [N])
    left = [light.photo for light in found.lights if not light.used]
    assert left == ([x.photo for x in truth.lights[:5]] if cause == "second light" else [])
    assert len(found.residuals["warnings"]) == (cause is not None)
