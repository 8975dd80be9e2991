"""What the report says of lights that were refined with the surface."""

from dataclasses import replace

import numpy as np
from synthetic import BALL, Look, render

from calibration.calibration import Calibration
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
