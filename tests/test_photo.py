import contextlib
import io
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image

from capture.decode import formats
from capture.decode.exif import Exposure, read_header
from capture.decode.formats import decode, read_size
from capture.decode.heif import container_transfer
from capture.decode.limits import check_size
from capture.errors import CaptureError
from capture.photos import photo
from capture.photos.photo import (
    decode_srgb,
    encode_srgb,
    read_alpha,
    read_grey,
    read_photo,
    read_stack,
    read_thumbnail,
    reduced,
    write_picture,
)
from capture.photos.store import CLIPPED, COLOURS, LIST

pillow_heif.register_heif_opener()
FORMATS = {".jpg": "JPEG", ".png": "PNG", ".tif": "TIFF", ".heic": "HEIF", ".avif": "AVIF"}


def picture(height: int = 48, width: int = 64) -> np.ndarray:
    """A smooth picture that no turn or mirroring leaves as it is."""
    v, u = np.mgrid[:height, :width]
    return np.stack([u * 3, v * 4, 60 + u + v], 2).astype(np.uint8)


def exif(orientation: int = 1, time_s: float | None = None, iso: int | None = None, taken: str | None = None) -> bytes:
    tags = Image.Exif()
    tags[274] = orientation
    details = {33434: time_s, 34855: iso, 33437: 2.0, 41989: 26, 36867: taken, 37521: "250" if taken else None}
    tags.get_ifd(0x8769).update({tag: value for tag, value in details.items() if value is not None})
    return tags.tobytes()


def save(path: Path, pixels: np.ndarray, **options) -> Path:
    Image.fromarray(pixels).save(path, **({} if path.suffix in (".png", ".tif") else {"quality": 98}) | options)
    return path


@pytest.mark.parametrize(
    ("suffix", "orientation"), [*((".jpg", tag) for tag in range(1, 9)), *((suffix, 6) for suffix in FORMATS)]
)
def test_a_photo_is_read_in_the_sensors_frame_whatever_its_orientation_says(tmp_path, suffix, orientation):
    pixels = decode(save(tmp_path / f"photo{suffix}", picture(), exif=exif(orientation))).pixels
    assert pixels.shape == (48, 64, 3)
    assert np.abs(pixels.astype(float) - picture()).mean() < 4  # compression; any turn or mirroring gives 50


def stating(path: Path, transfer: int) -> Path:
    """A photo whose container states that transfer curve (nclx, ITU-T H.273)."""
    save(path, picture())
    content = path.read_bytes()
    at = content.index(b"colrnclx") + 10
    path.write_bytes(content[:at] + transfer.to_bytes(2, "big") + content[at + 2 :])
    return path


@pytest.mark.parametrize(  # libheif refuses those that H.273 reserves
    ("transfer", "suffix"), [*((k, ".heic") for k in (1, 2, *range(4, 19))), *((k, ".avif") for k in (1, 4, 16))]
)
def test_a_heic_or_avif_photo_is_read_by_the_curve_that_its_container_states(tmp_path, suffix, transfer):
    path = stating(tmp_path / f"photo{suffix}", transfer)
    curve = {16: "PQ", 18: "HLG"}.get(transfer, str(transfer))
    if transfer in (9, 10, 16, 17, 18):
        with pytest.raises(CaptureError, match=rf"curve.* {curve}\b|{curve} curve"):
            decode(path)
        assert read_size(path) == (64, 48)
        return
    found = decode(path)
    light = {4: lambda v: v**2.2, 5: lambda v: v**2.8, 8: lambda v: v}.get(transfer)
    assert found.is_linear == (light is not None)
    expected = picture() / 255.0 if light is None else light(picture() / 255.0)
    stored = found.pixels if light is not None else found.pixels / 255.0
    assert np.abs(stored - expected).mean() < 0.02


def box(name: bytes, *bodies: bytes) -> bytes:
    body = b"".join(bodies)
    return struct.pack(">I", 8 + len(body)) + name + body


@pytest.mark.parametrize("version", [0, 1])
@pytest.mark.parametrize(("first", "tiles", "found"), [(16, 13, 16), (None, 18, 18), (None, None, 2)])
def test_the_curve_of_a_picture_made_of_tiles_is_its_own_or_theirs_and_not_that_of_a_gain_map(
    version, first, tiles, found
):
    """Item 1 is made of tiles 2 and 3; the gain map is item 4."""
    wide = ">I" if version else ">H"
    stated = [first, tiles, tiles, 8]
    curves = [box(b"colr", b"nclx", struct.pack(">HHHB", 1, curve, 6, 128)) for curve in stated if curve is not None]
    used, rows = iter(range(1, 5)), b""
    for item, curve in enumerate(stated, 1):
        rows += struct.pack(">HB", item, curve is not None) + (bytes([next(used)]) if curve is not None else b"")
    numbers = struct.pack(wide, 1) + struct.pack(">H", 2) + struct.pack(wide, 2) + struct.pack(wide, 3)
    meta = box(
        b"meta",
        bytes(4),
        box(b"pitm", bytes(4), struct.pack(">H", 1)),
        box(b"iref", bytes([version, 0, 0, 0]), box(b"cdsc", numbers), box(b"dimg", numbers)),
        box(b"iprp", box(b"ipco", *curves), box(b"ipma", bytes(4), struct.pack(">I", 4), rows)),
    )
    assert container_transfer(box(b"ftyp", b"heic") + meta) == found
    for cut in range(8, len(meta), 7):
        with contextlib.suppress(ValueError):
            container_transfer(meta[:cut])


def test_srgb_decodes_to_the_standards_values_and_back():
    assert decode_srgb(np.array([0, 10, 188, 255], np.uint8)) == pytest.approx(
        [0, 10 / 255 / 12.92, 0.5029, 1], abs=1e-4
    )
    every = np.arange(256, dtype=np.uint8)
    assert (encode_srgb(decode_srgb(every)) == every).all()
    assert decode_srgb((every * np.uint16(257))[None]) == pytest.approx(decode_srgb(every[None]), abs=1e-6)


def test_sixteen_bit_files_keep_their_depth(tmp_path):
    values = np.array([[[1000, 1001, 40000]]], np.uint16).repeat(8, 0).repeat(8, 1)
    for name in ("deep.png", "deep.tif"):
        cv2.imwrite(str(tmp_path / name), values[..., ::-1])
        photo = read_photo(tmp_path / name)
        assert photo.rgb[0, 0, 0] != photo.rgb[0, 0, 1]
        assert photo.rgb == pytest.approx(decode_srgb(values), abs=1e-7)


def test_a_float_tiff_is_linear_already(tmp_path):
    values = np.full((8, 9, 3), 0.25, np.float32)
    values[2, 3] = 1.0
    cv2.imwrite(str(tmp_path / "linear.tif"), values)
    photo = read_photo(tmp_path / "linear.tif")
    assert read_size(tmp_path / "linear.tif") == (9, 8)
    assert photo.is_linear and photo.rgb[0, 0, 0] == 0.25
    around = np.zeros((8, 9), bool)
    around[1:4, 2:5] = True  # demosaicking has mixed the saturated sample with its neighbours
    assert (photo.clipped == around).all()


def test_a_sample_at_the_top_of_the_scale_is_clipped_and_one_just_below_is_not(tmp_path):
    pixels = np.full((4, 4, 3), 100, np.uint8)
    pixels[0, 0, 1], pixels[0, 1, 2], pixels[0, 2, 0] = 255, 254, 250
    clipped = read_photo(save(tmp_path / "a.png", pixels)).clipped
    assert clipped[0].tolist() == [True, True, False, False] and not clipped[1:].any()


def test_exposure_focal_length_and_time_come_from_exif(tmp_path):
    path = save(tmp_path / "a.jpg", picture(), exif=exif(1, 0.02, 200, "1970:01:02 00:00:10"))
    photo = read_photo(path)
    assert photo.exposure == Exposure(0.02, 200.0, 2.0) and photo.focal_35mm == 26
    assert photo.exposure.relative() == pytest.approx(1.0)
    assert read_header(path).taken_s == pytest.approx(86400 + 10.25)


@pytest.mark.parametrize("suffix", list(FORMATS))
def test_a_truncated_photo_is_refused_by_name(tmp_path, suffix):
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (64, 64, 3)).astype(np.uint8)
    whole = io.BytesIO()
    Image.fromarray(noise).save(whole, FORMATS[suffix])
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole.getvalue()[: len(whole.getvalue()) * 2 // 3])
    with pytest.raises(CaptureError, match="cut"):
        read_photo(path)


def test_a_jpeg_under_the_name_of_a_raw_file_and_a_header_that_claims_a_gigapixel_are_refused(tmp_path):
    path = save(tmp_path / "a.jpg", picture()).rename(tmp_path / "a.nef")
    with pytest.raises(CaptureError, match="JPEG data under the name of a RAW file"):
        read_photo(path)
    with pytest.raises(CaptureError, match="200 megapixels"):
        check_size(tmp_path / "huge.png", 40000, 40000)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pictures_too_large_to_be_held_are_used_at_half_their_size_everywhere(tmp_path, suffix, monkeypatch):
    pixels = picture(601, 803)
    pixels[4, 6] = 255
    path = save(tmp_path / f"large{suffix}", pixels)
    whole = read_photo(path)
    monkeypatch.setattr(formats, "LARGEST_WHOLE", 400_000)
    half = read_photo(path)
    assert half.rgb.shape == (300, 401, 3) and read_size(path) == (401, 300)
    four = whole.rgb[:600, :802].reshape(300, 2, 401, 2, 3).mean((1, 3))
    assert half.rgb == pytest.approx(four, abs=1e-6)  # averaged in linear colour
    assert (half.clipped == whole.clipped[:600, :802].reshape(300, 2, 401, 2).any((1, 3))).all() and half.clipped[2, 3]
    stack = read_stack([path, path], 100)
    assert (stack.full_width, stack.full_height) == (401, 300) == read_grey(path).shape[::-1]


def test_a_stack_divides_relative_exposure_out(tmp_path):
    dim = save(tmp_path / "1.png", encode_srgb(np.full((8, 8, 3), 0.2, np.float32)), exif=exif(1, 0.01, 100))
    bright = save(tmp_path / "2.png", encode_srgb(np.full((8, 8, 3), 0.4, np.float32)), exif=exif(1, 0.02, 100))
    stack = read_stack([dim, bright, dim], 8)
    assert stack.gains == pytest.approx((1, 2, 1))
    assert stack.rgb.mean((1, 2, 3)) == pytest.approx([0.2] * 3, abs=0.002)  # 8-bit steps
    on_its_scale = read_stack([bright], 8, reference=stack.reference)
    assert on_its_scale.gains == pytest.approx((2,))


def test_a_stack_is_area_averaged_as_a_resized_camera_sees_it(tmp_path):
    ramp = np.repeat(np.linspace(0.1, 0.9, 64, dtype=np.float32)[None, :, None], 32, 0).repeat(3, 2)
    stack = read_stack([save(tmp_path / "a.png", encode_srgb(ramp))], 16)
    assert stack.rgb.shape == (1, 8, 16, 3) and (stack.full_width, stack.full_height) == (64, 32)
    u = (np.arange(16) + 0.5) * 4 - 0.5  # where the reduced pixel centres lie in the photo
    assert stack.rgb[0, 0, :, 0] == pytest.approx(np.interp(u, np.arange(64), ramp[0, :, 0]), abs=0.003)
    assert reduced(stack, 8).rgb.shape == (1, 4, 8, 3)


def test_masks_and_alpha_are_read_without_any_curve(tmp_path):
    pixels = np.dstack([picture(), np.full((48, 64), 128, np.uint8)])
    pixels[..., :3] = 51
    path = save(tmp_path / "a.png", pixels)
    assert read_grey(path) == pytest.approx(np.full((48, 64), 0.2), abs=1e-6)
    assert read_alpha(path) == pytest.approx(np.full((48, 64), 128 / 255), abs=1e-6)
    assert read_alpha(save(tmp_path / "b.png", picture())) is None
    with pytest.raises(CaptureError, match="missing"):
        read_grey(tmp_path / "missing.png")


def test_a_written_picture_reads_back_as_it_was_and_leaves_nothing_else(tmp_path):
    linear = decode_srgb(picture())
    write_picture(tmp_path / "out.png", linear)
    assert read_photo(tmp_path / "out.png").rgb == pytest.approx(linear)
    write_picture(tmp_path / "out.jpg", linear)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.jpg", "out.png"]


def test_a_thumbnail_keeps_the_sensors_frame_and_brightness(tmp_path):
    path = save(tmp_path / "a.jpg", cv2.resize(picture(), (1024, 768)), exif=exif(6))
    small = read_thumbnail(path, 64)
    assert small.shape == (48, 64, 3)
    assert np.abs(small.astype(float) - picture()).mean() < 4


# --- reduced photos that are kept on disk ----------------------------------------------------------------------------


@pytest.fixture
def paths(tmp_path):
    rng = np.random.default_rng(0)
    files = []
    for number in range(5):
        files.append(tmp_path / f"{number}.png")
        exif = Image.Exif()
        exif[33434], exif[34855] = 0.01 * (1 + (number == 2)), 100  # the third one is exposed twice as long
        Image.fromarray(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)).save(files[-1], exif=exif)
    return files


def read_again(paths, kept, monkeypatch, side=8):
    """The stack, and the names of the photos that were opened for it."""
    opened, real = [], photo.read_photo
    monkeypatch.setattr(photo, "read_photo", lambda path, *rest: (opened.append(path.name), real(path, *rest))[1])
    stack = read_stack(paths, side, kept=kept)
    monkeypatch.setattr(photo, "read_photo", real)
    return stack, sorted(opened)


def test_a_stack_on_disk_is_that_in_memory_bit_for_bit_and_is_not_read_twice(paths, tmp_path, monkeypatch):
    plain = read_stack(paths, 8)
    assert plain.gains[2] == 2
    for expected in ([path.name for path in paths], []):
        stack, opened = read_again(paths, tmp_path / "kept", monkeypatch)
        assert opened == expected
        assert np.array_equal(stack.rgb, plain.rgb) and np.array_equal(stack.clipped, plain.clipped)
        assert (stack.gains, stack.reference, stack.full_width) == (plain.gains, plain.reference, plain.full_width)
        stack.rgb[:] = 0  # what a reader does to its copy does not reach the files


def test_photos_that_were_not_finished_or_are_damaged_are_read_again_and_only_these(paths, tmp_path, monkeypatch):
    kept = tmp_path / "kept"
    plain, _ = read_again(paths, kept, monkeypatch)
    lines = (kept / LIST).read_text().splitlines()
    order = [json.loads(line)["index"] for line in lines[1:]]
    (kept / LIST).write_text("\n".join(lines[:-1]) + "\n" + lines[-1][:20])  # killed while the last line was written
    with (kept / COLOURS).open("r+b") as file:
        file.seek(order[0] * 12 * 48)
        file.write(b"\xff")
    with (kept / CLIPPED).open("r+b") as file:
        file.seek(order[1] * 48)
        file.write(b"\x07")
    stack, opened = read_again(paths, kept, monkeypatch)
    assert opened == sorted(paths[i].name for i in (order[0], order[1], order[-1]))
    assert np.array_equal(stack.rgb, plain.rgb) and np.array_equal(stack.clipped, plain.clipped)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[]\n[]\n", b'{"format": 1}\n{"index": 7}\n', b"[" * 9999])
def test_a_list_that_is_none_starts_anew(paths, tmp_path, monkeypatch, content):
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / LIST).write_bytes(content)
    stack, opened = read_again(paths, kept, monkeypatch)
    assert len(opened) == len(paths) and np.array_equal(stack.rgb, read_stack(paths, 8).rgb)


def test_photos_of_another_size_are_refused_by_name_in_memory_and_on_disk(paths, tmp_path):
    Image.new("RGB", (20, 10)).save(paths[3])
    for kept in (None, tmp_path / "kept", tmp_path / "kept"):
        with pytest.raises(CaptureError, match=r"1 of 5 photos .* 3\.png \(20 x 10\)"):
            read_stack(paths, 8, kept=kept)
