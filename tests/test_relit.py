"""Truth: the renderer's own picture under the same light, and shadows whose place is known."""

import struct

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

import shadowgraph
from capture.decode.exr import LARGEST_FILE, read_exr, read_panorama, write_exr
from capture.errors import CaptureError
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


# --- environment maps from anywhere ----------------------------------------------------------------------------------


def ramp(rows: int = 8, columns: int = 16) -> np.ndarray:
    return np.linspace(0.1, 9.0, rows * columns * 3, dtype=np.float32).reshape(rows, columns, 3)


def hdr(picture: np.ndarray) -> bytes:
    return cv2.imencode(".hdr", np.ascontiguousarray(picture[..., ::-1]))[1].tobytes()


def exr(folder, picture: np.ndarray, **more: np.ndarray) -> bytes:
    path = folder / "map.exr"
    channels = {name: np.ascontiguousarray(picture[..., i]) for i, name in enumerate("RGB")} | more
    OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}, channels).write(str(path))
    return path.read_bytes()


def test_both_kinds_are_read_as_linear_light_and_told_apart_by_content(tmp_path):
    np.testing.assert_allclose(read_panorama(hdr(ramp()), "a.exr")[:, ::-1], ramp(), rtol=0.02)  # 8-bit mantissas
    np.testing.assert_allclose(read_panorama(exr(tmp_path, ramp()), "a.hdr")[:, ::-1], ramp(), rtol=1e-6)


def test_turning_right_in_a_panorama_is_turning_clockwise_as_seen_from_above(tmp_path):
    picture = np.zeros((8, 16, 3), np.float32)
    picture[3, 5] = 1.0  # right of column 4
    assert read_panorama(exr(tmp_path, picture), "x")[3, 16 - 1 - 5].min() == 1.0


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (b"", "neither"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "neither"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n", "no size"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4096 +X 8192\n", "8192 x 4096"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 9999999 +X 9999999\n", "at most"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 512 +X 512\n", "twice as wide"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n", "twice as wide"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n\x02\x02", "cut off"),
        (b"\x76\x2f\x31\x01\x02\x00\x00\x00" + bytes(50), "not a readable"),
    ],
)
def test_what_is_no_whole_map_of_a_sphere_is_refused_by_what_is_wrong_with_it(data, word):
    with pytest.raises(CaptureError, match=word):
        read_panorama(data, "sky")


def test_a_file_cut_off_anywhere_is_refused_or_read_but_never_a_fault(tmp_path):
    for data in (hdr(ramp(16, 32)), exr(tmp_path, ramp())):
        for length in range(0, len(data) - 1, max(1, len(data) // 25)):
            with pytest.raises(CaptureError):
                read_panorama(data[:length], "sky")


def test_a_map_too_large_of_many_channels_or_with_an_infinite_sun_is_refused(tmp_path):
    huge, sun = exr(tmp_path, ramp()), ramp()
    window = struct.pack("<4i", 0, 0, 15, 7)
    assert huge.count(window) == 2  # display and data window
    sun[2, 3] = np.inf
    more = {f"layer{i}.R": np.ascontiguousarray(ramp()[..., 0]) for i in range(8)}
    for data, said in (
        (huge.replace(window, struct.pack("<4i", 0, 0, 59999, 29999)), "60000 x 30000"),  # before it is decoded
        (exr(tmp_path, ramp(), **more), "11 channels"),
        (exr(tmp_path, sun), "1 pixels are infinite"),
        (b"#?" + bytes(LARGEST_FILE), "MB"),  # unread
    ):
        with pytest.raises(CaptureError, match=said):
            read_panorama(data, "sky")
