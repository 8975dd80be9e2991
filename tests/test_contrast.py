"""The contrast of pictures, which lights from outlines and shading are fitted with, and what it does to their sigma."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibration.flashlight import joint_search
from calibration.flashlight.fit import FlashlightFit
from calibration.flashlight.model import Evidence, Flashlights, free_tangent
from calibration.flashlight.outline_lights import outline_sigma
from calibration.lights.ground_cells import GroundCells
from calibration.outlines.terms import OutlineTerms

COUNT = 10
EYE = np.array([0.0, -420.0, 380.0])
MISFITS = {0.7: 0.024, 0.8: 0.016, 0.9: 0.02, 1.0: 0.028, 1.1: 0.04}  # in the pictures; least at 0.8
SHIFT = 0.3  # of a light's distance per unit of contrast


@dataclass(frozen=True)
class Silent(OutlineTerms):
    """Outlines that say nothing."""

    def cost(self, positions):
        """Agree with everything."""
        return 0.0

    def rows(self, positions):
        """Pull nowhere."""
        return np.zeros(0), np.zeros((0, len(positions), 3))


def _lights() -> np.ndarray:
    turn = 2.4 * np.arange(COUNT)
    return np.stack([300 * np.cos(turn), 300 * np.sin(turn), 400 + 10 * turn], -1)


def _evidence(cells: int) -> Evidence:
    points = np.column_stack([np.linspace(-200, 200, cells), np.linspace(150, 250, cells), np.zeros(cells)])
    grey, known = np.full((COUNT, cells, 3), 0.2), np.ones((COUNT, cells), bool)
    found = Evidence.of(GroundCells(points, grey, known, np.zeros(3), EYE), np.ones(COUNT), 0.0)
    every = np.ones(COUNT, bool)
    return replace(found, outlines=Silent(None, EYE, 0.0, every, every))  # pyright: ignore[reportArgumentType]


@pytest.fixture
def stand_ins(monkeypatch):
    """Joint fits whose misfit the contrast tells and whose lights it moves; returns the contrasts that are chosen."""
    chosen, level = [], np.log(0.2)

    def settled(like, evidence, misfit):
        contrast = level / float(evidence.log_grey[0, 0])
        chosen.append(contrast)
        state = replace(like, positions=_lights() * (1 + SHIFT * (contrast - 0.9)))
        fit = FlashlightFit(state, evidence, evidence.weight, joint_search.LOOSE, free_tangent)
        return 0.0, fit, np.interp(contrast, list(MISFITS), list(MISFITS.values())) / contrast

    monkeypatch.setattr(joint_search, "_settled", settled)
    return chosen


def _fitted(cells: int) -> FlashlightFit:
    start = Flashlights(_lights(), 0 * _lights(), np.zeros(COUNT), np.zeros(4), 0.0, np.zeros(3))
    return joint_search.at_best_contrast(start, _evidence(cells))


@pytest.mark.parametrize(
    ("cells", "contrast", "doubt"),
    [(4000, (0.77, 0.83), (0.0, 0.006)), (1, (0.8, 0.9), (0.01, 0.04))],
)
def test_the_contrast_of_least_misfit_is_taken_and_the_usual_one_where_photos_say_little(
    stand_ins, cells, contrast, doubt
):
    """Between contrasts that are about as likely lights lie 3 % of their distance apart: the fit says so."""
    fit = _fitted(cells)
    assert contrast[0] < stand_ins[-1] < contrast[1]
    off = np.sqrt(np.sum(fit.between, axis=1)) / np.linalg.norm(_lights(), axis=1)
    assert doubt[0] <= np.median(off) < doubt[1]


def test_the_stated_error_covers_the_other_fits(stand_ins):
    fit = _fitted(50)
    doubt = np.full((COUNT, 3), 40.0**2)
    with_others, alone = outline_sigma(replace(fit, between=doubt)), outline_sigma(replace(fit, between=0.0))
    np.testing.assert_allclose(with_others**2 - alone**2, doubt, rtol=1e-6)


def test_the_variance_of_a_mixture_is_about_the_fit_that_is_chosen():
    places = np.array([[[0.0, 0.0, 1.0]], [[0.0, 0.0, 3.0]]])
    about_first = joint_search.variance_about(places[0], places, np.array([1.0, 1.0]))
    np.testing.assert_allclose(about_first, [[0.0, 0.0, 2.0]])
    assert joint_search.variance_about(places[0], places, np.array([1.0, 1e-6])).max() < 1e-5
