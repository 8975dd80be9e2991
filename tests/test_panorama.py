"""Environment maps come from anywhere: written here by hand, whole, cut off, huge and of other kinds."""

import struct

import cv2
import numpy as np
import OpenEXR
import pytest

from capture.decode.exr import LARGEST_FILE, read_panorama
from capture.errors import CaptureError


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


def test_an_exr_whose_header_claims_a_huge_picture_is_refused_before_it_is_decoded(tmp_path):
    data = exr(tmp_path, ramp())
    window = struct.pack("<4i", 0, 0, 15, 7)
    assert data.count(window) == 2  # display and data window
    with pytest.raises(CaptureError, match="60000 x 30000"):
        read_panorama(data.replace(window, struct.pack("<4i", 0, 0, 59999, 29999)), "sky")


def test_an_exr_of_many_channels_is_refused(tmp_path):
    more = {f"layer{i}.R": np.ascontiguousarray(ramp()[..., 0]) for i in range(8)}
    with pytest.raises(CaptureError, match="11 channels"):
        read_panorama(exr(tmp_path, ramp(), **more), "sky")


def test_an_infinite_sun_is_named(tmp_path):
    picture = ramp()
    picture[2, 3] = np.inf
    with pytest.raises(CaptureError, match="1 pixels are infinite"):
        read_panorama(exr(tmp_path, picture), "sky")


def test_a_file_too_large_is_refused_unread():
    with pytest.raises(CaptureError, match="MB"):
        read_panorama(b"#?" + bytes(LARGEST_FILE), "sky")
