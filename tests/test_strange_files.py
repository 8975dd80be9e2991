"""Files of strangers: whatever is in them, a reader returns or refuses in words, runs nothing and stays small."""

import io
import os
import random
import shutil
import struct
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from dataset_folders import (
    from_above,
    write_deepshadow,
    write_diligent,
    write_rti,
    write_s3nerf,
    write_shadowneus,
    write_shadowneus_real,
)
from fuzz_images import DAMAGES
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic import BALL, Look, default_camera, render

from calibration.lights.files import read_lights
from calibration.posed_camera import PosedCamera
from calibration.scenes.importers import find_importer, import_folder
from capture.errors import CalibrationError, CaptureError, UserError
from capture.files.arrays import read_npy, read_npz
from capture.files.names import inside

SMALL = Look(width=16, height=16, n_lights=4)
DESCRIPTIONS = {".json", ".txt", ".lp", ".npz", ".npy"}
SPITEFUL = (
    *(b"1e999", b"-1e999", b"nan", b"NaN", b"-1", b"0", b"9" * 400, b"9" * 5000, b"null", b"[]", b"{}", b'"x"'),
    *(b"true", b"../../x", b"/etc/passwd", b"\0", b"\xff\xfe", b"[" * 3000, b"1" + b"0" * 30, b"\n" * 50, b"1,5"),
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict[str, Path]:
    """A tiny scene of every layout."""
    root = tmp_path_factory.mktemp("scenes")
    near = render((BALL,), SMALL)[1]
    far = render((BALL,), Look(width=16, height=16, n_lights=4, kind="directional"), from_above(16))[1]
    write_shadowneus(root / "shadowneus", near, None, "shadow")
    write_deepshadow(root / "deepshadow", near)
    write_s3nerf(root / "s3nerf", near)
    write_shadowneus_real(root / "real", near)
    write_diligent(root / "diligent", far, np.ones((4, 3)))
    write_rti(root / "rti", far)
    import_folder(root / "deepshadow", "train", root / "ours")
    return {path.name: path for path in root.iterdir()}


def mutated(data: bytes, seed: int) -> bytes:
    """The bytes of a file with something wrong: damaged as pictures are, or a word or number replaced."""
    draw = random.Random(seed)
    if draw.random() < 0.67:
        return draw.choice(DAMAGES)(draw, data)
    words = data.split(b" ") if b" " in data else [data[: len(data) // 2], data[len(data) // 2 :]]
    words[draw.randrange(len(words))] = draw.choice(SPITEFUL)
    return b" ".join(words)


@pytest.mark.parametrize("name", ["shadowneus", "deepshadow", "s3nerf", "real", "diligent", "rti", "ours"])
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32), which=st.integers(0, 9))
def test_a_scene_with_something_wrong_is_read_or_refused_in_words(scenes, tmp_path_factory, name, seed, which):
    folder = scenes[name]
    files = sorted(path for path in folder.rglob("*") if path.suffix in DESCRIPTIONS)
    file = files[which % len(files)]
    whole = file.read_bytes()
    try:
        file.write_bytes(mutated(whole, seed))
        try:
            importer = find_importer(folder)
            if importer is not None:
                importer.load(folder, "train")
        except UserError as error:
            assert len(str(error)) < 1500 and "\n" not in str(error).strip()
    finally:
        file.write_bytes(whole)


@settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32), which=st.integers(0, 9))
def test_a_file_of_lights_with_something_wrong_is_read_or_refused_in_words(scenes, tmp_path_factory, seed, which):
    sources = [
        scenes["shadowneus"] / "transforms_train.json",
        scenes["s3nerf"] / "params.json",
        scenes["real"] / "params.npz",
        scenes["rti"] / "assembly-files" / "stone.lp",
        scenes["ours"] / "calibration.json",
    ]
    source = sources[which % len(sources)]
    file = tmp_path_factory.mktemp("lights") / source.name
    file.write_bytes(mutated(source.read_bytes(), seed))
    try:
        read_lights(file, [f"r_{i}.png" for i in range(4)], PosedCamera(*default_camera(16, 16), 0.0))
    except UserError as error:
        assert str(file) in str(error) or "photos" in str(error)


# --- arrays ----------------------------------------------------------------------------------------------------------


@contextmanager
def staying_small() -> Iterator[None]:
    """Python's own memory stays below 5 MB."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


HUGE = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 100000, 100), }", b"\0" * 64)
CALLS = npy("{'descr': __import__('os').system('touch /tmp/was_here'), 'fortran_order': False, 'shape': (1,), }")


def pickled() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": os.getcwd}], dtype=object), allow_pickle=True)
    return stream.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        HUGE,
        CALLS,
        pickled(),
        b"",
        b"\x93NUMPY",
        npy("{'descr': '<f8'}"),
        npy("(" * 100),
        npy("{'descr': '<U9', 'fortran_order': False, 'shape': (1,), }", b"\0" * 36),
    ],
    ids=["huge", "calls", "pickled", "empty", "cut", "half a header", "brackets", "text"],
)
def test_an_array_that_is_none_is_refused_without_running_or_allocating(tmp_path, data):
    (tmp_path / "a.npy").write_bytes(data)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as packed:
        packed.writestr("light_pose.npy", data)
    with staying_small(), pytest.raises(CalibrationError, match=r"a\.npy"):
        read_npy(tmp_path / "a.npy")
    with staying_small(), pytest.raises(CalibrationError, match=r"a\.npz"):
        read_npz(tmp_path / "a.npz", ("light_pose",))
    assert not Path("/tmp/was_here").exists()


def test_an_archive_that_unpacks_to_gigabytes_is_refused_before_it_is_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("light_pose.npy", b"\0" * (80 * 2**20))
    with staying_small(), pytest.raises(CalibrationError, match="unpacks to more than 64 MB"):
        read_npz(tmp_path / "bomb.npz", ("light_pose",))


def test_an_archive_that_lies_about_its_size_gives_no_more_than_it_said(tmp_path):
    path = tmp_path / "lies.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("light_pose.npy", b"\0" * (20 * 2**20))
    data = path.read_bytes().replace(struct.pack("<I", 20 * 2**20), struct.pack("<I", 100))
    path.write_bytes(data)
    with staying_small(), pytest.raises(CalibrationError):
        read_npz(path, ("light_pose",))


def test_an_archive_whose_name_runs_into_its_data_is_refused_without_quoting_them(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, light_pose=np.random.default_rng(0).normal(size=(40, 4)))
    data = bytearray(path.read_bytes())
    data[26:28] = struct.pack("<H", 1200)  # the length of the first name, in the header before its data
    path.write_bytes(bytes(data))
    with pytest.raises(CalibrationError) as refused:
        read_npz(path, ("light_pose",))
    assert str(path) in str(refused.value) and len(str(refused.value)) < len(str(path)) + 500


# --- names -----------------------------------------------------------------------------------------------------------


def test_names_stay_in_their_folder(tmp_path):
    folder = tmp_path / "scene"
    (folder / "photos").mkdir(parents=True)
    for path in (folder / "photos" / "a.png", tmp_path / "secret.png"):
        path.write_bytes(b"x")
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "loop.png").symlink_to(folder / "loop.png")
    assert inside(folder, "photos/a.png", "list") == folder / "photos" / "a.png"
    for name in ("../secret.png", str(tmp_path / "secret.png"), "link.png", "photos/../../secret.png"):
        with pytest.raises(CaptureError, match=r"list .* leaves the folder"):
            inside(folder, name, "list")
    for name in ("loop.png", "a\0b", "x" * 5000, "nothing.png", ""):
        with pytest.raises(CaptureError, match="list"):
            inside(folder, name, "list")


def test_a_list_whose_names_lead_out_of_the_folder_reads_no_file_there(scenes, tmp_path):
    shutil.copytree(scenes["diligent"], tmp_path / "scene")
    shutil.copy(scenes["diligent"] / "001.png", tmp_path / "outside.png")
    (tmp_path / "scene" / "filenames.txt").write_text("../outside.png\n002.png\n003.png\n004.png\n")
    with pytest.raises(CalibrationError, match=r"filenames.txt .* it lacks outside"):
        import_folder(tmp_path / "scene", "train", tmp_path / "ours")
    assert not (tmp_path / "ours").exists()
