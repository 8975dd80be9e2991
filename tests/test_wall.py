"""A wall beside the ground sends light back: its quadrature, its derivatives, and lights found in spite of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad

from calibration.flashlight import wall as walls
from calibration.flashlight.fit import fit_flashlights
from calibration.flashlight.model import Evidence, Flashlights, free_tangent, log_irradiance
from calibration.flashlight.wall import wall_light
from calibration.lights.ground_cells import GroundCells

BEAM = np.array([2.0, 0.3, 0.0, 0.0])
MIDDLE = np.array([20.0, -30.0, 0.0])
PLACES = [(2.0, 350.0), (-1.5, 200.0)]  # azimuth, distance


def brute(azimuth, distance, light, axis, point):
    """The integral of wall.py's docstring for albedo 1, by adaptive quadrature."""
    away = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    side = np.array([-away[1], away[0], 0.0])

    def sent(v, u):
        at = MIDDLE + distance * away + u * side + [0, 0, v]
        to, on = at - light, point - at
        far, near = np.linalg.norm(to), np.linalg.norm(on)
        cosine = to @ axis / far
        gain = cosine ** BEAM[0] * np.exp(BEAM[1] * (1 - cosine) ** 2) if cosine > 0 else 0.0
        return gain * max(to @ away, 0) / far**3 * max(-(on @ away), 0) * v / near**4 / np.pi

    reach = 6 * distance
    return dblquad(sent, -reach, reach, 0, reach, epsrel=1e-3, epsabs=0)[0]


@pytest.mark.parametrize(("azimuth", "distance"), PLACES)
def test_light_by_way_of_the_wall_is_the_integral_over_it(azimuth, distance):
    light, point = np.array([-150.0, -80.0, 260.0]), np.array([[35.0, 10.0, 0.0]])
    axis = (MIDDLE - light) / np.linalg.norm(MIDDLE - light)
    found = wall_light(np.array([azimuth, np.log(distance), 1.0]), light[None], axis[None], BEAM, 1e-3, point, MIDDLE)
    assert found[0, 0] == pytest.approx(brute(azimuth, distance, light, axis, point[0]), rel=0.05)


def ground(n_photos: int, seed: int, wall) -> tuple[Evidence, Flashlights]:
    """What textured ground beside a wall shows of flashlights, without noise, and where they are."""
    draw = np.random.default_rng(seed)
    along = np.linspace(-130.0, 130.0, 17)
    points = np.stack([*np.meshgrid(along, along), np.zeros((17, 17))], -1).reshape(-1, 3) + MIDDLE
    away = wall[0] + np.pi + draw.uniform(-1.6, 1.6, n_photos)
    rise, reach = np.radians(draw.uniform(20, 65, n_photos)), draw.uniform(450, 750, n_photos)
    at = np.stack([np.cos(rise) * np.cos(away), np.cos(rise) * np.sin(away), np.sin(rise)], -1)
    places = MIDDLE + reach[:, None] * at
    aims = MIDDLE + np.concatenate([draw.normal(0, 25, (n_photos, 2)), np.zeros((n_photos, 1))], 1)
    truth = Flashlights(places, aims, draw.normal(0, 0.003, n_photos), BEAM, 0.01, MIDDLE, np.array(wall))
    nothing = np.zeros((n_photos, len(points)))
    rgb = np.ones((n_photos, len(points), 3))
    cells = GroundCells(points, rgb, rgb[..., 0] > 0, MIDDLE, np.array([0.0, -250.0, 300.0]))
    evidence = Evidence(cells, 0.0, nothing, nothing + 1e4)
    texture = draw.uniform(-1, 0, len(points))
    grain = draw.normal(0, 0.002, nothing.shape)
    return Evidence(cells, 0.0, log_irradiance(truth, evidence) + texture + grain, evidence.weight), truth


@pytest.mark.parametrize(("azimuth", "distance"), PLACES)
def test_a_wall_keeps_lights_in_place_that_move_without_its_light(azimuth, distance, monkeypatch):
    evidence, truth = ground(10, 2, (azimuth, np.log(distance), 0.6))
    assert off(truth, evidence, truth) < 0.02
    monkeypatch.setattr(walls, "LARGEST_STEP", 0.0)
    assert off(replace(truth, wall=walls.NO_WALL), evidence, truth) > off(truth, evidence, truth)


def off(start: Flashlights, evidence: Evidence, truth: Flashlights) -> float:
    """Median error of the places that a fit from a start gives, of their distance."""
    found = fit_flashlights(start, evidence, free_tangent).flashlights
    reach = np.linalg.norm(truth.positions - MIDDLE, axis=1)
    return float(np.median(np.linalg.norm(found.positions - truth.positions, axis=1) / reach))
