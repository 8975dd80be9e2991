"""Truth: the renderer's own picture under the same light, and shadows whose place is known."""

import cv2
import numpy as np
import pytest
import torch

import shadowgraph
from capture.decode.exr import read_exr, write_exr
from capture.photos.photo import encode_srgb
from reconstruct.render.g_buffer import look
from reconstruct.render.relight import relight
from reconstruct.stored_run.stored_run import StoredRun

WIDTH = 64


def relit(run, tmp_path, *arguments, name="it.exr"):
    file = tmp_path / name
    assert shadowgraph.main(["relight", str(run), *arguments, "--out", str(file), "--width", str(WIDTH)]) == 0
    return file


def colours(file):
    channels = read_exr(file)
    return np.stack([channels[name] for name in "RGB"], -1)


def test_at_the_place_of_a_capture_light_it_is_that_light(run, tmp_path, capsys):
    it = StoredRun(run)
    light = it.calibration.lights[0]
    place = ",".join(f"{x:.6f}" for x in light.position)
    picture = colours(relit(run, tmp_path, "--light", place))
    wanted = relight(look(it.fields, WIDTH), light, it.calibration.beam, it.calibration.ambient).numpy()
    assert np.allclose(picture, wanted, atol=2e-3)  # all lights of the capture have one power
    assert f"{WIDTH} x 48 pixels" in capsys.readouterr().out


def test_a_png_is_the_same_picture_in_srgb(run, tmp_path):
    linear = colours(relit(run, tmp_path, "--light", "100,-200,400"))
    png = cv2.imread(str(relit(run, tmp_path, "--light", "100,-200,400", name="it.png")))[..., ::-1]
    assert np.array_equal(png, encode_srgb(linear))


def test_a_lamp_of_some_size_has_softer_shadows(run, tmp_path):
    hard = colours(relit(run, tmp_path, "--direction", "1,0,1"))
    soft = colours(relit(run, tmp_path, "--direction", "1,0,1", "--lamp-size", "60"))
    assert np.abs(hard - soft).max() > 0.05  # a third of what lit ground sends
    assert np.median(np.abs(hard - soft)) < 0.02


def test_a_map_that_shines_from_one_side_casts_shadows_to_the_other_and_turns(run, tmp_path):
    panorama = np.zeros((16, 32, 3), np.float32)
    panorama[4, 31] = 50.0  # 40 degrees high at azimuth 2 pi / 64: columns run backwards in a photographed panorama
    write_exr(tmp_path / "sky.exr", {name: panorama[..., i] for i, name in enumerate("RGB")}, {})
    pictures = [
        colours(relit(run, tmp_path, "--env", str(tmp_path / "sky.exr"), "--rotate", turn)) for turn in ("0", "180")
    ]
    it = StoredRun(run)
    view = look(it.fields, WIDTH)
    ground = torch.isfinite(view.maps.depth).numpy() & ~view.maps.mask.numpy()
    for picture, side in zip(pictures, (-1, 1), strict=True):
        dark = ground & (picture.sum(-1) < 0.1 * np.median(picture[ground].sum(-1)))
        assert dark.sum() > 30
        assert side * (view.maps.points[..., 0].numpy()[dark].mean() - 10) > 10


def test_an_orbit_is_a_video(run, tmp_path, capsys):
    relit(run, tmp_path, "--orbit", "4", name="it.gif")
    assert "4 frames" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "none was given"),
        (["--light", "1,2,3", "--direction", "0,0,1"], "--light and --direction was given"),
        (["--light", "1,2"], "three numbers"),
        (["--light", "a,b,c"], "three numbers"),
        (["--light", "nan,0,1"], "finite"),
        (["--direction", "0,0,0"], "leads nowhere"),
        (["--light", "1,2,3", "--lamp-size", "-1"], "not negative"),
        (["--light", "1,2,300", "--out", "it.jpg"], "ends in .png, .exr"),
        (["--orbit", "8", "--out", "it.png"], "ends in .mp4, .webm, .gif"),
        (["--orbit", "1"], "2 to 3600"),
        (["--light", "1,2,300", "--width", "5"], "16 to 4096"),
        (["--env", "nowhere.hdr"], "nowhere.hdr cannot be read"),
    ],
)
def test_what_cannot_be_made_is_refused_in_one_sentence(run, tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert shadowgraph.main(["relight", str(run), *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error
