import os
from pathlib import Path

import lit_table
import numpy as np
import pytest
from lit_table import TRIPOD_BOARD, save_photo

from capture.errors import CaptureError
from capture.session.session import load_session, load_settings

N_LIT = 8


def hand_held_board(rng, i):
    """The table under room light, seen from elsewhere."""
    turned = np.rot90(lit_table.table(rng), 2)
    corners = np.array([[40, 40], [260, 30 + 8 * i], [280, 200], [50 + 6 * i, 210]])
    return lit_table.photograph(lit_table.with_board(turned, corners), rng)


def save_capture(folder, in_folders, n_hand_held=3):
    """Tripod board as IMG_10 (not first by name), hand-held ones around it, lit photos after them."""
    rng = np.random.default_rng(3)
    albedo = lit_table.table(rng)
    board, photos = (folder / "board", folder / "photos") if in_folders else (folder, folder)
    for i in range(n_hand_held):
        save_photo(board / f"IMG_{8 + i + (i > 1)}.jpg", hand_held_board(rng, i), second=i)
    save_photo(board / "IMG_10.jpg", lit_table.photograph(lit_table.with_board(albedo, TRIPOD_BOARD), rng), second=5)
    for i, photo in enumerate(lit_table.lit_photos(N_LIT, rng, lit_table.with_object(albedo))):
        save_photo(photos / f"IMG_{101 + i}.jpg", photo, second=60 + i)
    return folder, albedo, rng


def names(paths):
    return [path.name for path in paths]


LIT = [f"IMG_{101 + i}.jpg" for i in range(N_LIT)]


def test_the_tripods_board_photo_comes_first_wherever_its_name_stands(tmp_path):
    folder, _, _ = save_capture(tmp_path / "my capture é", in_folders=True)
    session = load_session(folder)
    assert names(session.board) == ["IMG_10.jpg", "IMG_8.jpg", "IMG_9.jpg", "IMG_11.jpg"]
    assert names(session.lit) == LIT
    assert session.light == session.dark == ()


def test_roles_in_a_flat_folder_are_found_from_the_pictures(tmp_path):
    folder, albedo, rng = save_capture(tmp_path, in_folders=False)
    save_photo(folder / "IMG_99.jpg", lit_table.photograph(albedo * 0.01, rng), second=30)
    for i in range(4):
        turned = np.flipud(lit_table.with_object(albedo) * lit_table.flashlight(i))
        save_photo(folder / f"PXL_{i}.jpg", lit_table.photograph(turned, rng), model="Flashlight", second=70 + i)
    session = load_session(folder)
    assert names(session.board) == ["IMG_10.jpg", "IMG_8.jpg", "IMG_9.jpg", "IMG_11.jpg"]
    assert names(session.lit) == LIT
    assert names(session.light) == [f"PXL_{i}.jpg" for i in range(4)]
    assert names(session.dark) == ["IMG_99.jpg"]


def test_flashlight_photos_by_a_phone_of_the_same_model_are_told_by_when_they_were_taken(tmp_path):
    folder, albedo, rng = save_capture(tmp_path, in_folders=False)
    for i in range(N_LIT - 2):
        turned = np.rot90(lit_table.with_object(albedo) * lit_table.flashlight(i), 2)
        save_photo(folder / f"PXL_{i}.jpg", lit_table.photograph(turned, rng), second=61 + i)
    session = load_session(folder)
    assert len(session.board) == 4 and names(session.lit) == LIT and len(session.light) == N_LIT - 2


def test_links_are_followed_and_digits_of_other_scripts_and_above_the_line_are_no_numbers_to_sort_by(tmp_path):
    folder, _, _ = save_capture(tmp_path / "real", in_folders=True)
    (folder / "photos" / "IMG_101.jpg").rename(folder / "photos" / "²1.jpg")
    (tmp_path / "linked").mkdir()
    for name in ("board", "photos"):
        (tmp_path / "linked" / name).symlink_to(folder / name)
    assert names(load_session(tmp_path / "linked").lit) == [*LIT[1:], "²1.jpg"]


def test_ground_truth_and_other_files_are_left_alone(tmp_path):
    folder, _, _ = save_capture(tmp_path, in_folders=False)
    (folder / "gt").mkdir()
    (folder / "gt" / "IMG_1.jpg").write_text("must not be opened")
    (folder / "notes.txt").write_text("hello")
    (folder / "._IMG_8.jpg").write_text("a file browser's shadow")
    assert names(load_session(folder).lit) == LIT


def test_settings_overrule_what_was_found(tmp_path):
    folder, _, _ = save_capture(tmp_path, in_folders=False)
    (folder / "session.toml").write_text(
        'board = "checkerboard:9x6:24.25"\nboard_thickness_mm = 3\nled_offset_mm = [12, -6, 1.5]\n'
        '[roles]\nboard = ["IMG_9.jpg"]\ndark = ["IMG_108.jpg"]\n'
    )
    session = load_session(folder)
    assert session.settings.board == "checkerboard:9x6:24.25" and session.settings.led_offset_mm == (12.0, -6.0, 1.5)
    assert session.settings.board_thickness_mm == 3.0
    assert names(session.board)[0] == "IMG_9.jpg"
    assert names(session.lit)[-1] == "IMG_107.jpg" and names(session.dark) == ["IMG_108.jpg"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("board = 5", "board is 5"),
        ("bored = 'x'", "unknown entry 'bored'"),
        ("led_offset_mm = [1, 2]", "three numbers"),
        ("led_offset_mm = [nan, 0, 1]", "three numbers"),
        (f"led_offset_mm = [{'9' * 400}, 0, 1]", "three numbers"),
        (f"clip_frames = {'9' * 5000}", "not valid TOML"),
        *((f"clip_frames = {count}", f"clip_frames is {count}") for count in ("3", "1000", "'many'", "12.5")),
        ("board_thickness_mm = -1", "millimetres from the table"),
        ("board = ", "not valid TOML"),
        ("roles = { lid = ['a.jpg'] }", "lists of file names"),
    ],
)
def test_a_wrong_entry_in_session_toml_is_named(tmp_path, text, message):
    (tmp_path / "session.toml").write_text(text)
    with pytest.raises(CaptureError, match=message):
        load_settings(tmp_path)


@pytest.mark.parametrize(
    ("in_folders", "message"),
    [
        (True, r"^3 photos lit by .* 4 needed at least, 12 or more advised"),
        (False, r"^3 photos found .* at least 5 are needed: the board in room light, and 4 lit .*12 or more advised"),
    ],
)
def test_three_photos_are_too_few(tmp_path, in_folders, message):
    rng = np.random.default_rng(0)
    where = tmp_path / "photos" if in_folders else tmp_path
    for i, photo in enumerate(lit_table.lit_photos(3, rng, lit_table.table(rng))):
        save_photo(where / f"{i}.jpg", photo)
    with pytest.raises(CaptureError, match=message):
        load_session(tmp_path)


@pytest.mark.parametrize(("role", "count"), [("photos", N_LIT), ("board", 4)])
def test_photos_beside_the_folders_are_not_read_and_the_refusal_says_so(tmp_path, role, count):
    folder, _, _ = save_capture(tmp_path, in_folders=True)
    for path in (folder / role).iterdir():
        path.rename(folder / path.name)
    with pytest.raises(CaptureError, match=rf"{count} photos or clips are beside its folders .*move them"):
        load_session(folder)


def test_a_clip_beside_photos_is_not_read_and_that_is_said(tmp_path):
    folder, _, _ = save_capture(tmp_path, in_folders=True)
    (folder / "photos" / "clip.mov").write_bytes(b"never opened")
    assert load_session(folder).notes == ("photos/clip.mov was left out: there are photos beside it",)
    for name in LIT[3:]:
        (folder / "photos" / name).unlink()
    with pytest.raises(CaptureError, match=r"3 photos lit .*clip\.mov is not read beside photos: remove"):
        load_session(folder)


@pytest.mark.parametrize(
    "names",
    [["IMG_1.jxl"], ["a.webp", "b.WebP", "c.bmp"], ["x.jp2"], ["k.nrw", "raw.x3f"], [os.fsdecode(b"caf\xe9.jpg")]],
)
@pytest.mark.parametrize("in_folders", [False, True])
def test_pictures_that_cannot_be_read_are_named_in_one_line_beside_photos_and_where_photos_are_missing(
    tmp_path, in_folders, names
):
    save_capture(tmp_path / "vase", in_folders)
    for folder in (tmp_path / "vase", tmp_path / "alone"):
        for name in names:
            place = folder / "photos" if in_folders else folder
            place.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(b"what no decoder is asked for")
    (note,) = [note for note in load_session(tmp_path / "vase").notes if "skipped" in note]
    first = Path(names[0]).name.encode("utf-8", "replace").decode()
    assert first in note and "JPEG, PNG, TIFF or DNG" in note and "\n" not in note
    assert (f"{len(names) - 1} more" in note) == (len(names) > 1)
    with pytest.raises(CaptureError, match=r"no photos found in .*skipped.*Export them as JPEG"):
        load_session(tmp_path / "alone")
