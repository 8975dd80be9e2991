"""Captures that cannot give a good shape get a true verdict at once, and never an empty mesh without a word."""

import numpy as np
import pytest
import synthetic
from brief_drafts import NORMAL_STEPS
from synthetic import BALL, Box, Look, Sphere, render
from test_crash import TINY, Stop

from calibration.light import Light
from capture.checks.check_stack import check_stack
from capture.errors import UserError
from reconstruct.check.light_coverage import shadow_cover
from reconstruct.check.readiness import judge, refuse_hopeless
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.shading import joint_normals
from reconstruct.solve.solver import fit

LOOK = Look(width=96, height=72, n_lights=10)
ROUND = np.linspace(0, 2 * np.pi, LOOK.n_lights, endpoint=False)
EYE = np.array([0.0, -368.0, 368.0])


def lights_at(places: np.ndarray) -> list[Light]:
    power = np.full(3, 0.6 * 400.0**2)
    return [Light(f"photo_{i:02d}.png", "point", position=place, power=power) for i, place in enumerate(places)]


def ring(radius: float, height: float, start: float = 0.0, end: float = 2 * np.pi) -> np.ndarray:
    turn = np.linspace(start, end, LOOK.n_lights, endpoint=False)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(len(turn), height)], 1)


CASES = {
    "all lights beside the camera": ((BALL,), EYE + 15 * np.stack([np.cos(ROUND), np.sin(ROUND), 0 * ROUND], 1)),
    "light from behind the camera only": ((BALL,), ring(450.0, 250.0, np.radians(-120), np.radians(-60))),
    "light from above only, no shadow beside the object": ((BALL,), ring(20.0, 600.0)),
    "no bare ground in view": ((Box((-400, -300, 0), (400, 900, 30)),), ring(400.0, 400.0)),
    "an empty table": ((), ring(400.0, 300.0)),
    "a speck": ((Sphere((0, 0, 2), 2.0),), ring(400.0, 300.0)),
}


@pytest.mark.parametrize("name", CASES)
def test_a_wrong_capture_is_told_before_the_solve_and_never_gives_an_empty_mesh(name, monkeypatch):
    shapes, places = CASES[name]
    monkeypatch.setattr(synthetic, "default_lights", lambda look: lights_at(places))
    monkeypatch.setattr(joint_normals, "STEPS", NORMAL_STEPS)
    scene, truth = render(shapes, LOOK)
    verdict = judge(truth.calibration, check_stack(truth.stack, None), shadow_cover(scene))
    assert verdict.grade in ("poor", "hopeless"), verdict.sentence()
    assert verdict.reasons and verdict.advice
    try:
        refuse_hopeless(verdict)
        mesh = extract_mesh(fit(scene, TINY, Stop()))
    except UserError as error:
        assert len(str(error)) > 40
    else:
        assert len(mesh.faces) and mesh.is_watertight
