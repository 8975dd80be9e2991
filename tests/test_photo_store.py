"""Reduced photos are kept on disk as they are in memory, and a stopped run goes on with those that are whole."""

import json

import numpy as np
import pytest
from PIL import Image

from capture.errors import CaptureError
from capture.photos import photo
from capture.photos.photo import read_stack
from capture.photos.store import CLIPPED, COLOURS, LIST


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
