"""Every kind of file that cameras and renderers leave, against pixels that are known."""

import numpy as np
import OpenEXR
import pytest
from dng import write_dng
from PIL import Image

from capture.decode.formats import format_of, read_size
from capture.errors import CaptureError
from capture.photos.photo import CLIPPED_RAW, read_photo, read_small_photo, read_stack, read_thumbnail, stack_of

BLACK, WHITE = 256, 16383


def write_exr(path, channels):
    OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}, channels).write(str(path))
    return path


@pytest.fixture(scope="module")
def ramp(tmp_path_factory):
    """Columns from black to above white, all four mosaic colours alike."""
    values = np.linspace(BLACK, WHITE + 500, 200).round().astype(int)
    path = write_dng(tmp_path_factory.mktemp("raw") / "ramp.dng", np.repeat(values[None], 40, 0), BLACK, WHITE)
    return path, (values - BLACK) / (WHITE - BLACK)


def test_raw_is_linear_from_black_to_white_level_and_clipped_near_it_with_its_neighbours(ramp):
    path, expected = ramp
    photo = read_photo(path)
    assert photo.is_linear and read_size(path) == (200, 40) == photo.rgb.shape[1::-1]
    row, inside = photo.rgb[20, 4:-4], expected[4:-4]  # the rim is extrapolated
    assert np.abs(row - inside[:, None])[inside < 0.99].max() < 1e-3
    assert row[inside > 1.01].min() == 1
    clipped = photo.clipped[20]
    assert (clipped == (expected >= CLIPPED_RAW)).mean() > 0.99
    assert clipped[expected >= CLIPPED_RAW].all()


def test_raw_colours_keep_the_sensors_own_balance(tmp_path):
    mosaic = np.zeros((40, 60))
    mosaic[::2, ::2], mosaic[::2, 1::2], mosaic[1::2, ::2], mosaic[1::2, 1::2] = 0.2, 0.4, 0.4, 0.6
    path = write_dng(tmp_path / "a.dng", BLACK + mosaic * (WHITE - BLACK), BLACK, WHITE)
    assert np.abs(read_photo(path).rgb[5:-5, 5:-5] - [0.2, 0.4, 0.6]).max() < 1e-3


def test_a_raw_file_without_picture_data_or_cut_short_is_refused(tmp_path, ramp):
    path = write_dng(tmp_path / "empty.dng", np.full((32, 32), BLACK), BLACK, WHITE)
    with pytest.raises(CaptureError, match=r"empty\.dng has no picture in it"):
        read_photo(path)
    (tmp_path / "cut.dng").write_bytes(ramp[0].read_bytes()[:9000])
    with pytest.raises(CaptureError, match=r"cut\.dng"):
        read_photo(tmp_path / "cut.dng")


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_exr_is_linear_and_keeps_what_is_brighter_than_white(tmp_path, kind):
    values = np.linspace(0, 4, 6 * 8 * 3).reshape(6, 8, 3).astype(kind)
    path = write_exr(tmp_path / "a.exr", {"RGB": values})
    photo = read_photo(path)
    assert format_of(path) == "exr" and read_size(path) == (8, 6) and photo.is_linear
    assert (photo.rgb == values.astype(np.float32)).all()
    assert photo.clipped[-1, -1] and not photo.clipped[0, 0]
    assert read_thumbnail(path, 4).dtype == np.uint8


def test_a_stack_is_linear_by_what_its_files_hold_not_by_their_names(tmp_path, ramp):
    values = np.full((6, 8, 3), 0.5, np.float32)
    linear = write_exr(tmp_path / "float.exr", {"RGB": values}).rename(tmp_path / "float.jpg")
    encoded = tmp_path / "encoded.jpg"
    Image.fromarray(np.full((6, 8, 3), 128, np.uint8)).save(encoded)
    encoded = encoded.rename(tmp_path / "encoded.exr")
    expected = {(linear,): True, (encoded,): False, (linear, encoded): False, (ramp[0],): True}
    for paths, is_linear in expected.items():
        kept = tmp_path / f"kept {len(paths)} {paths[0].name}"
        for _ in range(2):  # the second time as they are kept
            assert read_stack(paths, 8, kept=kept).is_linear == is_linear
        assert read_stack(paths, 8).is_linear == is_linear
    assert read_stack([encoded], 8, as_linear=True).is_linear
    small = [read_small_photo(one, 8) for one in (linear, encoded)]
    assert stack_of(small[:1], (8, 6)).is_linear and not stack_of(small, (8, 6)).is_linear


def test_a_grey_exr_and_one_with_alpha_are_read(tmp_path):
    grey = np.full((4, 5), 0.25, np.float32)
    assert (read_photo(write_exr(tmp_path / "y.exr", {"Y": grey})).rgb == 0.25).all()
    rgba = np.dstack([np.full((4, 5, 3), 0.5), np.ones((4, 5))]).astype(np.float32)
    assert (read_photo(write_exr(tmp_path / "a.exr", {"RGBA": rgba})).rgb == 0.5).all()


def test_exr_files_that_are_no_picture_are_refused_by_name(tmp_path):
    depth = write_exr(tmp_path / "depth.exr", {"Z": np.ones((4, 4), np.float32)})
    with pytest.raises(CaptureError, match=r"depth\.exr has the channels Z"):
        read_photo(depth)
    values = np.ones((4, 4, 3), np.float32)
    values[1, 2] = np.inf
    with pytest.raises(CaptureError, match=r"inf\.exr holds values that are not finite"):
        read_photo(write_exr(tmp_path / "inf.exr", {"RGB": values}))
    (tmp_path / "cut.exr").write_bytes(depth.read_bytes()[:-20])
    with pytest.raises(CaptureError, match=r"cut\.exr is damaged") as refusal:
        read_photo(tmp_path / "cut.exr")
    assert "/proc/self" not in str(refusal.value)  # the name of its copy in memory
