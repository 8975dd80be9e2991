"""What the report says of lights that were refined with the surface."""

import re
from dataclasses import replace

import numpy as np
from synthetic import BALL, Look, render

from calibration.calibration import Calibration
from viewer.report.figures import lights_from_above
from viewer.report.numbers import refinement_part


def uncertain() -> Calibration:
    """Four lights to 5 mm."""
    calibration = render((BALL,), Look(width=24, height=18, n_lights=4))[1].calibration
    return replace(calibration, lights=tuple(replace(x, sigma=np.full(3, 5.0)) for x in calibration.lights))


def told(calibration: Calibration, by: list[float], accepted: bool) -> dict:
    """report.json of a run that moved its lights along x."""
    rows = [
        {
            "photo": x.photo,
            "position": x.homogeneous()[:3] + np.array([d, 0, 0]),
            "moved": d,
            "sigma": [5.0] * 3,
            "sigmas": d,
        }
        for x, d in zip(calibration.lights, by, strict=True)
    ]
    trial = {"accepted": accepted, "sentence": "refined lights decided upon", "noise": 0.1}
    return {"refined_lights": rows, "light_trial": trial}


def test_the_report_tells_how_far_each_light_moved_and_why_it_was_kept():
    calibration = uncertain()
    page = refinement_part(told(calibration, [1.0, 2.0, 3.0, 4.0], True), calibration, None)
    assert "Refined lights decided upon." in page and "photo_03.png" in page
    assert "<td" in page and "2.5" in page  # the median


def test_lines_lead_to_where_the_lights_went_and_say_how_much_longer_they_are():
    calibration = uncertain()
    there = {
        x.photo: x.homogeneous()[:3] + np.array([d, 0, 0])
        for x, d in zip(calibration.lights, (2, 2, 2, 4), strict=True)
    }
    drawing = lights_from_above(calibration, None, there)
    ways = np.array(re.findall(r'd="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)" stroke', drawing), float)
    assert ways.shape == (4, 4)
    lengths = ways[:, 2] - ways[:, 0]
    np.testing.assert_allclose(lengths / lengths[0], [1, 1, 1, 2], atol=0.02)
    np.testing.assert_allclose(ways[:, 1], ways[:, 3], atol=0.1)
    assert re.search(r"lines: \d+ times as long", drawing)
    assert "times as long" not in lights_from_above(calibration, None)
