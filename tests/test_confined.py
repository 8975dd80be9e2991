"""Each limit of the process that decodes, against a decoder that tries to get past it (tests/hostile_decoders.py)."""

import os
import signal
import socket
import sys

import hostile_decoders as hostile
import numpy as np
import pytest
from PIL import Image

from capture.decode import sandbox as confined
from capture.decode.formats import decode
from capture.decode.landlock import NETWORK_FROM, SCOPES_FROM, landlock_version
from capture.decode.sandbox import Answer, decoding, stop_decoders
from capture.errors import CaptureError

on_linux = pytest.mark.skipif(not confined.IS_CONFINED, reason="limits for decoders need Linux")
pytestmark = on_linux


def needs_landlock(version):
    found = landlock_version()
    return pytest.mark.skipif(found < version, reason=f"Landlock {found}, {version} needed: nothing forbids it here")


@pytest.fixture(autouse=True)
def hostile_tasks(monkeypatch):
    """Processes of their own, which know the hostile tasks."""
    stop_decoders()
    monkeypatch.setattr(confined, "MODULES", ("capture.decode.pictures", "hostile_decoders"))
    yield
    stop_decoders()


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.tif"
    path.write_bytes(b"content")
    return path


def first_answer(task, path, *arguments, pixels=0) -> Answer:
    with decoding(task, path, *arguments) as answer:
        found = answer(hostile.GRANTED, pixels)
    assert found is not None
    return found


def assert_goes_on(folder):
    """The next file is decoded."""
    good = folder / "good.tif"
    Image.fromarray(np.full((4, 6, 3), 7, np.uint8)).save(good)
    assert (decode(good).pixels == 7).all() and decode(good).pixels.shape == (4, 6, 3)


def test_answers_come_one_by_one_from_another_process_that_is_kept(photo):
    processes = []
    for _ in range(3):
        with decoding(hostile.well_behaved, photo) as answer:
            header = answer()
            assert header is not None and header.numbers[0] == 7 and header.names == ("a", "b")
            processes.append(header.numbers[1])
            found = answer(100, 2)
            assert answer() is None
        assert found is not None and found.pixels is not None
        pixels = found.pixels
        assert pixels.tolist() == [[[0, 1, 2], [3, 4, 5]]] and pixels.dtype == np.uint16
    assert len(set(processes)) == 1 and os.getpid() not in processes


@needs_landlock(1)
@pytest.mark.parametrize("task", [hostile.makes_a_file, hostile.removes_a_file, hostile.reads_a_file])
def test_files_elsewhere_are_out_of_reach(task, photo, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    if task is not hostile.makes_a_file:
        elsewhere.write_text("secret")
    photo.write_text(str(elsewhere))
    with pytest.raises(CaptureError, match=r"photo\.tif is damaged .*Permission denied"):
        first_answer(task, photo)
    assert elsewhere.exists() == (task is not hostile.makes_a_file)
    assert_goes_on(tmp_path)


@pytest.mark.parametrize(
    ("task", "said"),
    [
        pytest.param(hostile.runs_a_program, "Permission denied", marks=needs_landlock(1)),
        pytest.param(hostile.connects, "Permission denied", marks=needs_landlock(NETWORK_FROM)),
        pytest.param(hostile.signals_its_parent, "not permitted", marks=needs_landlock(SCOPES_FROM)),
        (hostile.writes_to_what_is_open, "File too large"),
    ],
)
def test_no_program_is_run_nothing_connected_to_no_process_signalled_and_nothing_written(task, said, photo):
    heard = []
    before = signal.signal(signal.SIGUSR1, lambda *_: heard.append(1))
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            photo.write_text(str(server.getsockname()[1]))
            with pytest.raises(CaptureError, match=rf"photo\.tif is damaged .*{said}"):
                first_answer(task, photo)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert not heard


def test_few_files_can_be_open(photo):
    assert first_answer(hostile.opens_what_it_can, photo).numbers == (2,)


@pytest.mark.parametrize(
    ("task", "pixels", "limits", "said"),
    [
        (hostile.takes_memory, 10_000_000, {"FIXED_ROOM": 100 << 20, "ROOM_PER_CORE": 0}, r"0\.6 GB of memory"),
        (hostile.computes_without_end, 1, {"SECONDS": 0.5, "PATIENCE": 1000}, "1 s"),
        (hostile.waits_without_end, 0, {"PATIENCE": 0.02}, "0 s"),
    ],
)
def test_memory_and_time_are_what_the_picture_is_worth(task, pixels, limits, said, photo, tmp_path, monkeypatch):
    with monkeypatch.context() as short:
        for name, value in limits.items():
            short.setattr(confined, name, value)
        with pytest.raises(CaptureError, match=rf"photo\.tif could not be decoded within {said}"):
            first_answer(task, photo, pixels=pixels)
    assert_goes_on(tmp_path)


def test_a_decoder_that_breaks_off_is_said_with_its_file(photo, tmp_path):
    with pytest.raises(CaptureError, match=r"photo\.tif is damaged .*broke off, SIGABRT"):
        first_answer(hostile.breaks_off, photo)
    assert_goes_on(tmp_path)


@pytest.mark.parametrize(
    ("task", "arguments"),
    [
        *((task, ()) for task in (hostile.answers_too_much, hostile.answers_with_objects, hostile.keeps_its_answer)),
        *((hostile.lies, (which,)) for which in range(len(hostile.LIES))),
    ],
)
def test_an_answer_that_is_none_is_refused(task, arguments, photo, tmp_path, monkeypatch):
    monkeypatch.setattr(confined, "PATIENCE", 20)
    with pytest.raises(CaptureError, match=r"photo\.tif is damaged"):
        first_answer(task, photo, *arguments)
    assert_goes_on(tmp_path)


def test_a_process_that_went_away_while_it_waited_is_replaced(photo):
    process = int(first_answer(hostile.well_behaved, photo).numbers[1])
    os.kill(process, signal.SIGKILL)
    confined._idle[0]._process.wait()
    assert first_answer(hostile.well_behaved, photo).numbers[1] != process


def test_a_process_that_cannot_start_is_a_fault_of_the_program(photo, monkeypatch):
    monkeypatch.setattr(confined, "MODULES", ("capture.nowhere",))
    with pytest.raises(RuntimeError, match=r"did not start: .*capture\.decode\.sandbox_process"):
        first_answer(hostile.well_behaved, photo)


def test_elsewhere_than_on_linux_it_is_said_that_there_are_no_limits(photo, monkeypatch):
    assert "separate process" in confined.confinement()
    monkeypatch.setattr(confined, "IS_CONFINED", False)
    assert "in this process" in confined.confinement()
    assert first_answer(hostile.well_behaved, photo).numbers[1] == os.getpid()
    with pytest.raises(CaptureError, match=r"photo\.tif is damaged"):
        first_answer(hostile.says_it_is_damaged, photo)
    assert "capture.decode.pictures" in sys.modules
