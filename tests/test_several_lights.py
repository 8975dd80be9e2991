"""Photos under two lights at once, added up from photos under one: shares, labels, files and a whole solve."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from dataset_folders import write_photo
from synthetic import BALL, Look, render
from test_known import write_scene
from test_solver import Listener

from calibration.scenes.shadowneus import load_known_scene
from capture.errors import CalibrationError, ReconstructionError
from capture.photos.photo import read_stack
from reconstruct.labels import ground_test as ground
from reconstruct.labels.multiple_lights import check_lights, is_shared, split_on_ground
from reconstruct.labels.observer import Observer
from reconstruct.scene import Scene, build_scene
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.trainer import train

LOOK = Look(n_lights=24, noise=0.003)


def added(scene: Scene, together: int = 2) -> Scene:
    """Neighbouring photos as one, at half of every light's power so that nothing clips."""
    assert scene.rgb is not None
    photo = torch.arange(len(scene.lights)) // together
    sums = torch.stack([scene.rgb[photo == number].mean(0) for number in range(int(photo.max()) + 1)])
    return replace(scene, rgb=sums[photo], power=scene.power / together, photo_of_light=photo)


def test_a_scene_of_one_light_each_is_left_alone():
    scene, _ = render((BALL,), LOOK)
    assert scene.photo_of_light is None and not is_shared(scene)
    assert split_on_ground(scene) is scene


def test_ground_shadows_of_both_lights_and_the_object_are_found():
    scene, truth = render((BALL,), LOOK)
    found = ground.test_ground(split_on_ground(added(scene)))
    assert truth.overlap(found.mask) > 0.9 and truth.wrong(found) < 0.002
    assert found.confidence.numpy()[:, ~truth.mask].mean() > 0.85


def test_two_lights_that_send_the_same_are_not_told_apart_where_one_of_them_is_hidden():
    scene, truth = render((BALL,), replace(LOOK, kind="directional", noise=0.0))
    assert scene.rgb is not None
    cosine = scene.lights[:, 2]
    twins = replace(scene, power=scene.power / cosine[:, None], rgb=scene.rgb / cosine[:, None, None, None])
    single = split_on_ground(added(twins))
    one = (truth.visibility[0::2] != truth.visibility[1::2]).repeat(2, 0) & ~truth.mask
    assert single.usable.numpy()[one].mean() < 0.1 < 0.95 < single.usable.numpy()[~one & ~truth.mask].mean()


def test_a_list_of_suns_in_a_frame_is_a_photo_under_all_of_them(tmp_path):
    truth = write_two_lights(tmp_path)
    known = load_known_scene(tmp_path)
    lights = known.calibration.lights
    assert [x.photo for x in lights] == ["r_000.png", "r_000.png", "r_002.png", "r_002.png", "r_004.png", "r_004.png"]
    assert np.allclose(lights[3].homogeneous(), truth.calibration.lights[3].homogeneous())
    assert known.shadow_paths is None and known.rgb_paths is not None and len(known.rgb_paths) == 3
    expected = truth.calibration.lights[0].power / 2 * 0.6 / 0.9  # see test_known: the ground's albedo is 0.6
    assert np.allclose(lights[0].power, expected, rtol=0.35)
    scene = build_scene(read_stack(known.rgb_paths, 60), known.calibration, 60)
    assert scene.photo_of_light is not None and scene.photo_of_light.tolist() == [0, 0, 1, 1, 2, 2]
    assert scene.rgb is not None and torch.equal(scene.rgb[2], scene.rgb[3]) and is_shared(scene)


def write_two_lights(folder):
    truth = write_scene(folder, light_type="point")
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    frames = content["frames"]
    for i in range(0, len(frames), 2):
        frames[i]["transform_matrix_sun"] = [frames[i + k]["transform_matrix_sun"] for k in range(2)]
        write_photo(folder / "train" / f"r_{i:03d}.png", (truth.stack.rgb[i] + truth.stack.rgb[i + 1]) / 2)
    path.write_text(json.dumps(content | {"frames": frames[::2]}))
    return truth


def test_shadow_pictures_alone_cannot_say_which_of_two_lights_is_hidden(tmp_path):
    write_scene(tmp_path, light_type="point", pictures="shadow")
    path = tmp_path / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][1]["transform_matrix_sun"] = [content["frames"][k]["transform_matrix_sun"] for k in (1, 2)]
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match="shadow pictures of several lights"):
        load_known_scene(tmp_path)


def test_too_many_lights_uneven_ground_and_a_trained_field_are_refused():
    scene, truth = render((BALL,), replace(LOOK, n_lights=10))
    check_lights(added(scene, 4))
    with pytest.raises(ReconstructionError, match="lit by 5 lights at once, at most 4"):
        Observer(added(scene, 5))
    with pytest.raises(ReconstructionError, match="level ground"):
        Observer(replace(added(scene), ground_depth=torch.full(truth.depth.shape, 500.0)))
    with pytest.raises(ReconstructionError, match="several lights at once"):
        train(added(scene), TrainConfig(), Listener())


def test_a_photo_of_which_one_light_is_unusable_is_left_out_whole():
    _, truth = render((BALL,), replace(LOOK, n_lights=4))
    lights = [replace(x, photo=truth.stack.paths[k // 2].name) for k, x in enumerate(truth.calibration.lights)]
    lights[1] = replace(lights[1], used=False, reason="broken")
    scene = build_scene(truth.stack, replace(truth.calibration, lights=tuple(lights)), 120)
    assert scene.photo_names == (lights[2].photo, lights[3].photo)
