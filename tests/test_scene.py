"""From a calibration to tensors: which photos, which grid, which rays, how much light."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import BALL, HEAP, Look, render

from calibration.light import beam_gain
from capture.errors import ReconstructionError
from reconstruct.scene import build_scene, ground_points, irradiance, reduced

SMALL = Look(width=60, height=44, n_lights=5)


def test_every_ray_meets_the_surface_at_the_true_depth():
    scene, truth = render((BALL,), SMALL)
    t = torch.tensor(truth.depth, dtype=torch.float32) / (scene.directions @ scene.forward)
    points = scene.eye + t[..., None] * scene.directions
    assert np.allclose(points.numpy(), truth.points, atol=1e-3)  # float32 at 500 mm


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_irradiance_times_albedo_is_what_the_photos_show(kind):
    look = replace(SMALL, kind=kind, ambient=0.1, lobe=() if kind == "directional" else (1.5, 0.4))
    scene, truth = render(HEAP, look)
    towards, strength = irradiance(scene, torch.tensor(truth.points, dtype=torch.float32).reshape(-1, 3))
    normals = torch.tensor(truth.normals, dtype=torch.float32).reshape(-1, 3)
    visible = torch.tensor(truth.visibility, dtype=torch.float32).reshape(len(towards), -1)
    direct = strength * ((towards * normals).sum(-1).clamp(min=0) * visible)[..., None]
    expected = torch.tensor(truth.albedo, dtype=torch.float32).reshape(-1, 3) * (direct + scene.ambient)
    assert torch.allclose(expected.reshape(scene.rgb.shape), scene.rgb, atol=1e-5)


def test_the_lobe_is_the_one_that_calibration_fits():
    scene, truth = render((BALL,), replace(SMALL, lobe=(1.2, 0.7, -0.9)))
    points = torch.tensor(truth.points, dtype=torch.float32).reshape(-1, 3)
    with_lobe = irradiance(scene, points)[1]
    without = irradiance(replace(scene, lobe=torch.zeros(0)), points)[1]
    towards = irradiance(scene, points)[0]
    cosine = -(towards * scene.axis[:, None]).sum(-1).numpy()
    assert np.allclose((with_lobe / without)[..., 0].numpy(), beam_gain(cosine, (1.2, 0.7, -0.9)), rtol=1e-4)


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


def test_no_usable_light_is_told_with_the_numbers():
    _, truth = render((BALL,), SMALL)
    lights = tuple(replace(light, used=False) for light in truth.calibration.lights)
    with pytest.raises(ReconstructionError, match="0 of 5 photos"):
        build_scene(truth.stack, replace(truth.calibration, lights=lights), 60)


def test_photos_of_another_size_than_the_calibration_are_refused():
    _, truth = render((BALL,), SMALL)
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


def test_a_clipped_pixel_taints_the_reduced_one():
    _, truth = render((BALL,), SMALL)
    clipped = np.zeros_like(truth.stack.clipped)
    clipped[3, 7, 9] = True
    scene = build_scene(replace(truth.stack, clipped=clipped), truth.calibration, 30)
    assert (~scene.usable).nonzero().tolist() == [[3, 3, 4]]


def test_ground_points_lie_on_the_ground_in_front_of_the_camera():
    scene, truth = render((), SMALL)
    assert np.allclose(ground_points(scene).numpy(), truth.points, atol=1e-3)


def test_a_ray_above_the_horizon_has_no_ground_point():
    scene, _ = render((BALL,), SMALL)
    up = replace(scene, directions=-scene.directions)
    assert ground_points(up).isnan().all()
