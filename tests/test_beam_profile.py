"""Beams with a hot centre and a ring: their profile, and where they point."""

import numpy as np

from calibration.flashlight.beam_profile import (
    RING_SPAN,
    RING_TERMS,
    SMOOTH_TERMS,
    derivatives,
    log_gain,
    without_splines,
)
from calibration.flashlight.descent import refine
from calibration.flashlight.fit import ALIKE_POWER, FAR, NEAR, START_BEAM
from calibration.flashlight.model import Evidence, Flashlights
from calibration.flashlight.pictured import bent, places_held
from calibration.lights.ground_cells import GroundCells

SCALE = 600.0  # mm


def _led(angle: np.ndarray) -> np.ndarray:
    """An LED behind a lens: a hot centre, a dark ring and a bright one; degrees off the axis."""
    rings = 0.07 * np.exp(-(((angle - 34) / 6) ** 2)) - 0.06 * np.exp(-(((angle - 24) / 5) ** 2))
    return 0.58 * np.exp(-((angle / 17) ** 2)) + 0.42 * np.exp(-((angle / 46) ** 2)) + rings


def _table(n_photos: int = 12):
    """Flashlights and axes about a textured table, and what its ground sends to a camera: evidence without outlines."""
    draw = np.random.default_rng(3)
    along = np.linspace(-400.0, 400.0, 17)
    points = np.stack([*np.meshgrid(along, along), np.zeros((17, 17))], -1).reshape(-1, 3)
    turn, rise = draw.uniform(0, 2 * np.pi, n_photos), np.radians(draw.uniform(28, 70, n_photos))
    reach = draw.uniform(450, 700, n_photos)
    places = reach[:, None] * np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], -1)
    aims = np.concatenate([draw.uniform(-160, 160, (n_photos, 2)), np.zeros((n_photos, 1))], 1)
    axes = (aims - places) / np.linalg.norm(aims - places, axis=1, keepdims=True)
    to = points - places[:, None]
    distance = np.linalg.norm(to, axis=-1)
    off = np.degrees(np.arccos(np.clip(np.einsum("kjx,kx->kj", to, axes) / distance, -1, 1)))
    light = _led(off) * places[:, 2:] * SCALE**2 / distance**3
    grey = 0.1 * draw.uniform(0.3, 0.8, len(points)) * light * np.exp(draw.normal(0, 0.01, light.shape))
    rgb = np.repeat(grey[..., None], 3, -1)
    cells = GroundCells(points, rgb, np.ones(grey.shape, bool), np.zeros(3), np.array([0.0, -500.0, 400.0]))
    return places, axes, Evidence.of(cells, np.ones(n_photos), 0.0)


def test_aims_and_powers_of_beams_with_rings_are_found():
    places, axes, evidence = _table()
    n, middle = len(places), np.zeros((len(places), 3))
    start = Flashlights(places, middle, np.zeros(n), np.array([START_BEAM, 0.0, 0.0, 0.0]), 0.0, np.zeros(3))
    found, _ = refine(bent(start, evidence), evidence, ALIKE_POWER, places_held, FAR + NEAR)
    off = np.degrees(np.arccos(np.clip((found.axes() * axes).sum(1), -1, 1)))
    assert np.median(off) < 1.0
    assert off.max() < 3.0
    assert found.log_power.std() < 0.03
    angle = np.arange(0.0, 45.0)[None]
    profile = log_gain(np.cos(np.radians(angle)), found.beam) - np.log(_led(angle))
    assert np.ptp(profile) < 0.15  # log units, of a profile that falls by 1.9 and has a ring


def test_derivatives_of_the_profile_are_those_of_differences():
    draw = np.random.default_rng(0)
    beam = np.r_[2.0, 0.5, -1.0, 2.0, draw.normal(0, 1, RING_TERMS)]
    cosine, step = draw.uniform(0.3, 0.999, (2, 50)), 1e-5
    by_cosine, by_term = derivatives(cosine, beam)
    across = (log_gain(cosine + step, beam) - log_gain(cosine - step, beam)) / (2 * step)
    assert np.median(np.abs(by_cosine - across)) < 0.2  # of slopes of 30: the profile is tabulated
    one = np.eye(len(beam))[SMOOTH_TERMS + 5] * 0.1
    np.testing.assert_allclose(
        0.1 * by_term[..., SMOOTH_TERMS + 5], log_gain(cosine, beam + one) - log_gain(cosine, beam), atol=1e-4
    )
    inside = by_term[..., SMOOTH_TERMS:].sum(-1)[(cosine > 0.6) & (cosine < 1 - RING_SPAN / RING_TERMS)]
    np.testing.assert_allclose(inside, 1, atol=1e-12)  # B-splines are a partition of unity


def test_a_beam_without_splines_that_is_nearest_keeps_the_light_where_it_falls():
    cosine = np.cos(np.radians(np.linspace(0, 40, 200)))[None]
    beam = np.r_[3.0, 0.2, 0.0, 0.0, np.full(RING_TERMS, 0.3)]  # splines that add up to a constant
    smooth, lack = without_splines(beam, cosine, np.ones_like(cosine), 5.0)
    np.testing.assert_allclose(log_gain(cosine, np.array(smooth)) + lack, log_gain(cosine, beam), atol=0.03)
    odd = np.r_[3.0, 0.2, 0.0, 0.0, np.where(np.arange(RING_TERMS) < 3, 0.8, 0.0)]  # hotter within 30 degrees
    cosine = np.cos(np.radians(np.linspace(0, 60, 300)))[None]
    weight = np.where(cosine < np.cos(np.radians(33)), 1.0, 1e-4)
    smooth, lack = without_splines(odd, cosine, weight, 5.0)
    off = np.abs(log_gain(cosine, np.array(smooth)) + lack - log_gain(cosine, odd))
    assert off[weight == 1].max() < 0.02 < 0.2 < off[weight < 1].max()  # it is near where there is light to tell
    assert without_splines(beam[:SMOOTH_TERMS], cosine, np.ones_like(cosine), 5.0) == ((3.0, 0.2, 0.0, 0.0), 0.0)
