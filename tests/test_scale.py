"""One known length of the object gives photos without a board their scale."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from dataset_folders import from_above, write_rti
from synthetic import Look, Sphere, grid_of, render

from capture.errors import CaptureError
from capture.session.session import load_settings, parse_length
from reconstruct.fields import SolvedScene
from reconstruct.source.calibrate_source import in_millimetres, with_scale_of
from reconstruct.source.source import RunOptions, open_source

RADIUS = 25.0
ON_GROUND = Sphere((0.0, 0.0, RADIUS), RADIUS)


def solved(truth, scene) -> SolvedScene:
    """The sphere itself as a solved scene, in units of the scene."""
    albedo = torch.zeros(*scene.directions.shape)
    place = (scene.camera, scene.world_from_camera, 0.0, "scene")
    return SolvedScene(grid_of((ON_GROUND,), 2.0), albedo, *place)


@pytest.mark.parametrize(("is_known", "what"), [(True, "height above the ground"), (False, "largest extent")])
def test_a_known_length_scales_surface_camera_and_lights_alike(is_known, what):
    """The sphere's height and its extent across the picture are both its diameter."""
    scene, truth = render((ON_GROUND,), Look(width=160, height=160, n_lights=3), from_above(160))
    scaled = in_millimetres(solved(truth, scene), 120.0, is_known)
    factor = 120.0 / (2 * RADIUS)
    assert scaled.unit == "mm" and scaled.grid.spacing == pytest.approx(2.0 * factor, rel=0.02)
    calibration = replace(truth.calibration, unit="scene", residuals={"notes": ["scale: unknown"]})
    brought = with_scale_of(calibration, scaled, 120.0, is_known)
    assert brought.unit == "mm" and len(brought.residuals["notes"]) == 1 and what in brought.residuals["notes"][0]
    np.testing.assert_allclose(brought.world_from_camera.translation, scaled.world_from_camera.translation, rtol=1e-6)
    grown = scaled.grid.spacing / 2.0 * calibration.lights[0].position
    np.testing.assert_allclose(brought.lights[0].position, grown, rtol=1e-4)
    sent = [light.power / np.sum(np.square(light.position)) for light in (calibration.lights[0], brought.lights[0])]
    np.testing.assert_allclose(sent[1], sent[0], rtol=1e-4)  # irradiance stays when the unit changes


@pytest.mark.parametrize(("text", "length"), [("120 mm", 120.0), ("12cm", 120.0), ("0.12 m", 120.0), ("2 in", 50.8)])
def test_lengths_are_read_with_their_unit(text, length):
    assert parse_length(text, "--scale") == pytest.approx(length)


@pytest.mark.parametrize("text", ["120", "0 mm", "-3 mm", "1.2.3 mm", "12 feet", 120])
def test_what_is_no_length_is_refused(text):
    with pytest.raises(CaptureError, match=r"--scale is .*\"120 mm\""):
        parse_length(text, "--scale")


def test_the_scale_of_session_toml_is_that_of_photos_without_a_board(tmp_path):
    _, truth = render((ON_GROUND,), Look(width=32, height=32, n_lights=6, kind="directional"), from_above(32))
    write_rti(tmp_path, truth)
    (tmp_path / "session.toml").write_text('scale = "120 mm"\n')
    assert load_settings(tmp_path).scale == 120.0
    source = open_source(tmp_path, RunOptions())
    assert source.known is not None and source.scale(RunOptions()) == 120.0
    assert source.scale(RunOptions(scale="5 cm")) == 50.0
