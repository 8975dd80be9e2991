"""Frames chosen from a filmed capture whose every moment is known."""

import clips
import cv2
import lit_table
import numpy as np
import pytest
from clips import ARM_S, LIT_S, ROOM_S
from lit_table import save_photo

import capture.session.clip
from capture.errors import CaptureError
from capture.files.names import clip_of
from capture.session.clip import choose_board_frames, choose_frames
from capture.session.session import load_session
from reconstruct.run.pipeline import claim, write_thumbnails
from reconstruct.run_folder.folder import RunFolder
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source
from viewer.display.run_follower import RunFollower

N = 20


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    return clips.film(tmp_path_factory.mktemp("filmed") / "clip.mp4")


@pytest.fixture(scope="module")
def chosen(filmed):
    return choose_frames(filmed, N)[0]


def times_of(paths):
    return np.array([found[1] for path in paths if (found := clip_of(path))])


def test_sharp_moments_under_the_flashlight_from_all_around_are_chosen_and_board_and_dark_before_and_after(chosen):
    times = times_of(chosen["lit"])
    assert len(times) == N and (np.diff(times) > 0).all()
    assert times[0] >= ROOM_S + ARM_S and times[-1] <= ROOM_S + ARM_S + LIT_S
    angle = clips.light_angle(times) % (2 * np.pi)
    gaps = np.diff(np.sort(np.append(angle, angle.min() + 2 * np.pi)))
    assert np.degrees(gaps).max() < 45 and np.degrees(gaps).min() > 4  # evenly would be 18 degrees
    assert not any(clips.is_blurred(time_s) for time_s in times)
    assert len(chosen["board"]) == 1 and times_of(chosen["board"])[0] < ROOM_S
    assert len(chosen["dark"]) >= 3 and times_of(chosen["dark"]).min() >= ROOM_S + ARM_S + LIT_S


def test_memory_is_bounded_for_long_clips(filmed, monkeypatch):
    monkeypatch.setattr(capture.session.clip, "MOST_CANDIDATES", 10)
    assert len(choose_frames(filmed, N)[0]["lit"]) <= 10


def test_a_clip_in_even_light_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    frame = lit_table.photograph(0.8 * lit_table.table(rng), rng)
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 15, (320, 240))
    for _ in range(45):
        writer.write((frame * 255).astype(np.uint8))
    writer.release()
    with pytest.raises(CaptureError, match=r"a\.mp4 shows a moving flashlight in 0 of \d+ examined frames"):
        choose_frames(tmp_path / "a.mp4", N)
    assert len(choose_board_frames(tmp_path / "a.mp4")) == 1  # nothing moves: one view


# --- as a session ----------------------------------------------------------------------------------------------------


def test_a_clip_alone_in_a_folder_is_a_capture(tmp_path, filmed):
    (tmp_path / "clip.mp4").symlink_to(filmed)
    (tmp_path / "session.toml").write_text("clip_frames = 12\n")
    session = load_session(tmp_path)
    assert len(session.lit) == 12 and len(session.board) == 1 and len(session.dark) >= 3 and session.light == ()
    assert session.lit[0].parent == tmp_path and "12 frames" in session.notes[0]


def test_a_clip_in_photos_goes_with_photos_of_the_board(tmp_path, filmed):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "clip.mp4").symlink_to(filmed)
    board = lit_table.with_board(lit_table.table(np.random.default_rng(5)), lit_table.TRIPOD_BOARD)
    photo = save_photo(tmp_path / "board" / "IMG_1.jpg", np.repeat(board[..., None], 3, 2).astype(np.float32))
    session = load_session(tmp_path)
    assert len(session.lit) == 40 and photo in session.board and len(session.board) == 2


def test_the_clip_that_a_phone_stores_beside_each_photo_is_no_capture(tmp_path, filmed):
    rng = np.random.default_rng(3)
    for i, photo in enumerate(lit_table.lit_photos(5, rng, lit_table.table(rng))):
        save_photo(tmp_path / "photos" / f"IMG_{i}.jpg", photo)
        save_photo(tmp_path / "board" / f"IMG_{i}.jpg", photo[::-1])
    (tmp_path / "photos" / "IMG_3.MOV").symlink_to(filmed)
    assert not any(clip_of(path) for path in load_session(tmp_path).lit)


def test_a_clip_of_the_flashlights_phone_is_refused(tmp_path, filmed):
    for name in ("photos", "light"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "clip.mp4").symlink_to(filmed)
    with pytest.raises(CaptureError, match=r"light/clip\.mp4 is a clip; photos by"):
        load_session(tmp_path)


@pytest.mark.slow
def test_frames_run_through_manifest_thumbnails_and_resuming_like_photos(tmp_path, filmed):
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "clip.mp4").symlink_to(filmed)
    (tmp_path / "capture" / "session.toml").write_text("clip_frames = 6\n")
    options = RunOptions()
    source = open_source(tmp_path / "capture", options)
    pictures = read_photos(source, options)[0]
    for again in (source, open_source(tmp_path / "capture", options)):  # of a continued run other frames are refused
        with RunFolder(tmp_path / "run") as run:
            claim(again, options, run, "calibrate", force=False)
            with run.stage("capture"):
                write_thumbnails(again, run)
    assert pictures.stack is not None and pictures.stack.rgb.shape == (6, 240, 320, 3)
    shown = RunFollower(tmp_path / "run")
    thumbs = [shown.thumbnail(path.name) for path in source.photos()]
    assert len(thumbs) == 6 and len({thumb.tobytes() for thumb in thumbs if thumb is not None}) == 6
