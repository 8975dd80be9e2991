"""From a calibration to tensors: which photos, which grid, which rays, how much light."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import BALL, Look, render

from calibration.light import Light
from calibration.light import irradiance as irradiance_by_calibration
from capture.errors import ReconstructionError
from reconstruct.scene import build_scene, irradiance, reduced

SMALL = Look(width=60, height=44, n_lights=5)


@pytest.mark.parametrize("kind", ["point", "directional"])
@pytest.mark.parametrize("beam", [(), (1.2,), (1.2, 0.7, -0.9)])
def test_irradiance_in_torch_is_that_of_calibration(kind, beam):
    scene, truth = render((BALL,), replace(SMALL, kind=kind, lobe=beam if kind == "point" else ()))
    points = truth.points.reshape(-1, 3)
    towards, strength = irradiance(scene, torch.tensor(points, dtype=torch.float32))
    for k, xyzw in enumerate(scene.lights.double().numpy()):
        place = {"position" if kind == "point" else "direction": xyzw[:3]}
        axis = scene.axis[k].double().numpy()
        light = Light("", kind, **place, power=scene.power[k].double().numpy(), axis=axis if axis.any() else None)
        arriving = irradiance_by_calibration(points, None, light, beam)
        np.testing.assert_allclose(strength[k].expand(len(points), 3).numpy(), arriving, rtol=1e-4)
        facing = irradiance_by_calibration(points, towards[k].expand(len(points), 3).double().numpy(), light, beam)
        np.testing.assert_allclose(facing, arriving, rtol=1e-6)


def test_photos_of_unused_lights_are_left_out():
    _, truth = render((BALL,), SMALL)
    lights = list(truth.calibration.lights)
    lights[1] = replace(lights[1], used=False, reason="flash off")
    scene = build_scene(truth.stack, replace(truth.calibration, lights=tuple(lights)), 60, shadow=truth.visibility)
    assert scene.photo_names == tuple(x.photo for i, x in enumerate(lights) if i != 1)
    assert np.allclose(scene.rgb.numpy(), np.delete(truth.stack.rgb, 1, 0))
    assert np.allclose(scene.shadow.numpy(), np.delete(truth.visibility, 1, 0))


def test_photos_find_their_lights_by_name_in_any_order():
    _, truth = render((BALL,), SMALL)
    stack = replace(truth.stack, rgb=truth.stack.rgb[::-1].copy(), paths=truth.stack.paths[::-1])
    scene = build_scene(stack, truth.calibration, 60)
    assert np.allclose(scene.rgb.numpy(), truth.stack.rgb)


def test_photos_without_a_usable_light_or_of_another_size_are_refused():
    _, truth = render((BALL,), SMALL)
    lights = tuple(replace(light, used=False) for light in truth.calibration.lights)
    with pytest.raises(ReconstructionError, match="0 of 5 photos"):
        build_scene(truth.stack, replace(truth.calibration, lights=lights), 60)
    with pytest.raises(ReconstructionError, match="120 x 44"):
        build_scene(replace(truth.stack, full_width=120), truth.calibration, 60)


def test_a_reduced_scene_looks_through_the_middle_of_the_pixels_it_joins():
    scene, _ = render((BALL,), SMALL)
    half = reduced(scene, 30)
    quads = scene.directions.reshape(22, 2, 30, 2, 3).mean((1, 3))
    assert half.rgb.shape == (5, 22, 30, 3)
    assert torch.allclose(half.rgb, scene.rgb.reshape(5, 22, 2, 30, 2, 3).mean((2, 4)), atol=1e-6)
    cosine = (half.directions * quads / quads.norm(dim=-1, keepdim=True)).sum(-1)
    assert cosine.min() > 1 - 1e-6  # 0.08 degrees, a tenth of a pixel
    assert half.pixel_angle == pytest.approx(2 * scene.pixel_angle)
