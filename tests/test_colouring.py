"""Colours that stand for a quantity: their classes, scales and legends."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh

from capture.photos.photo import decode_srgb
from reconstruct.evaluate.deviation import Summary
from reconstruct.mesh.evidence import SEEN, SHADOW, UNCONSTRAINED, VertexEvidence
from viewer.panels.colouring import (
    ACES_EXPOSURE,
    ACES_IN,
    ACES_OUT,
    BEHIND_TO_BEFORE,
    EVIDENCE,
    LITTLE_TO_MUCH,
    before_tone_mapping,
    by_distance,
    by_evidence,
    by_sigma,
    round_step,
    softly_lit,
)


def tone_mapped(colours: np.ndarray) -> np.ndarray:
    """three.js's ACESFilmicToneMapping, forwards; linear."""
    v = decode_srgb(colours) / ACES_EXPOSURE @ ACES_IN.T
    fitted = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.432951) + 0.238081)
    return np.clip(fitted @ ACES_OUT.T, 0, 1)


def test_every_vertex_has_the_colour_of_its_evidence_and_the_legend_its_share_of_the_surface():
    mesh = trimesh.creation.box((2, 2, 2))
    above = mesh.vertices[:, 2] > 0
    kind = np.where(above, SEEN, np.where(mesh.vertices[:, 0] > 0, SHADOW, UNCONSTRAINED)).astype(np.uint8)
    found = by_evidence(mesh, VertexEvidence(kind, *np.ones((2, 8), np.float32)))
    for wanted, (colour, name) in EVIDENCE.items():
        assert (found.colours[kind == wanted] == colour).all()
        assert name in found.legend
    assert found.legend.count("%") == 3 and "50%" in found.legend


def test_the_kinds_of_evidence_differ_in_lightness_so_that_everybody_can_tell_them_apart():
    luminance = sorted(
        float(decode_srgb(np.array(c, np.uint8)) @ [0.2126, 0.7152, 0.0722]) for c, _ in EVIDENCE.values()
    )
    assert all(lighter / darker > 1.3 for darker, lighter in pairwise(luminance))


@pytest.mark.parametrize("ramp", [LITTLE_TO_MUCH, BEHIND_TO_BEFORE[:3], BEHIND_TO_BEFORE[:1:-1]])
def test_a_ramp_only_gets_lighter(ramp):
    assert (np.diff(decode_srgb(ramp.astype(np.uint8)) @ [0.2126, 0.7152, 0.0722]) > 0).all()


def test_the_scale_of_sigma_has_round_ends_and_equal_factors():
    found = by_sigma(np.geomspace(0.09, 9.0, 101), "mm")
    assert "0.1 mm" in found.legend and "10 mm" in found.legend and "1 mm" in found.legend
    middle = found.colours[np.argmin(np.abs(np.geomspace(0.09, 9.0, 101) - 1.0))]
    np.testing.assert_allclose(middle, LITTLE_TO_MUCH[2], atol=3)
    assert "better than 0.9 mm" in found.legend


def test_distance_is_blue_inside_red_outside_and_pale_on_the_reference():
    numbers = Summary(0.0, 0.5, (-0.9, 0.0, 0.9))
    found = by_distance(np.array([-1.0, 0.0, 1.0, 7.0] + 96 * [0.9]), numbers, "mm", "the scan")
    inside, on, outside, far = found.colours[:4].astype(int)
    assert inside[2] > inside[0] + 100 and outside[0] > outside[2] + 100
    assert on.max() - on.min() < 5 and (far == outside).all()
    assert "+1 mm" in found.legend and "the scan" in found.legend and "0.9" in found.legend


def test_a_name_from_a_file_is_text_and_not_page():
    assert "<img" not in by_distance(np.ones(3), Summary(1.0, 1.0, (1.0, 1.0, 1.0)), "mm", "<img src=x>").legend


@pytest.mark.parametrize(("value", "down", "up"), [(0.37, 0.2, 0.5), (5.0, 5.0, 5.0), (730.0, 500.0, 1000.0)])
def test_steps_are_one_two_or_five_times_a_power_of_ten(value, down, up):
    assert round_step(value) == pytest.approx(down) and round_step(value, up=True) == pytest.approx(up)


def test_the_page_shows_the_colours_of_the_legend_after_its_tone_mapping():
    colours = np.array([c for c, _ in EVIDENCE.values()] + LITTLE_TO_MUCH[:-1].tolist(), np.uint8)
    shown = tone_mapped(before_tone_mapping(colours))
    np.testing.assert_allclose(shown, decode_srgb(colours), atol=0.03)


def test_soft_light_darkens_what_faces_down_only_a_little():
    ball = trimesh.creation.icosphere(subdivisions=2)
    lit = tone_mapped(softly_lit(ball, np.full((len(ball.vertices), 3), 180, np.uint8)))[:, 0]
    low, high = lit[ball.vertices[:, 2].argmin()], lit[ball.vertices[:, 2].argmax()]
    assert 0.6 < low / high < 0.8
    assert high == pytest.approx(float(decode_srgb(np.array([180], np.uint8))[0]), abs=0.01)
