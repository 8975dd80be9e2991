"""One bad photo is not the end: what cannot be read, is a copy or has another size is left out by name."""

import json
import shutil
from pathlib import Path

import board_photos
import cv2
import lit_table
import numpy as np
import pytest
from lit_table import save_photo
from PIL import Image
from rich.console import Console
from small_example import small_example

import shadowgraph
from calibration.board.board import parse_board
from calibration.board.board_photos import fit_board
from calibration.board.recognise import board_finder
from calibration.camera import Camera
from capture.errors import CaptureError
from capture.session.seen import SeenPhotos
from capture.session.session import load_session
from reconstruct.check.coach import FirstLook
from shadowgraph.run_command import _print_result

LIT = [f"IMG_{101 + k}.jpg" for k in range(6)]


def save_capture(folder: Path, is_sorted: bool = True) -> Path:
    """The tripod's board and six lit photos."""
    rng = np.random.default_rng(5)
    albedo = lit_table.table(rng)
    board = lit_table.photograph(lit_table.with_board(albedo, lit_table.TRIPOD_BOARD), rng)
    save_photo(folder / ("board/IMG_1.jpg" if is_sorted else "IMG_1.jpg"), board)
    for k, photo in enumerate(lit_table.lit_photos(len(LIT), rng, lit_table.with_object(albedo))):
        save_photo(folder / ("photos" if is_sorted else "") / LIT[k], photo, second=10 + k)
    return folder


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flipped_bytes(path: Path) -> None:
    pixels = Image.open(path).convert("RGB")
    pixels.save(path, format="PNG")
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2 : len(whole) // 2 + 64] = bytes(64)
    path.write_bytes(whole)


BREAKS = {
    "truncated": truncated,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("see you tomorrow\n" * 100),
    "a damaged PNG": flipped_bytes,
    "a picture of one pixel": lambda path: Image.new("RGB", (1, 1)).save(path),
    "a strip": lambda path: Image.new("RGB", (1000, 30)).save(path),
}


def left_out(folder: Path) -> dict[str, tuple[str, str]]:
    return {one.photo.name: (one.kind, one.role) for one in load_session(folder).left_out}


@pytest.mark.parametrize(("how", "is_sorted"), [*((how, True) for how in BREAKS), ("truncated", False)])
def test_a_photo_that_cannot_be_read_is_left_out_by_name(tmp_path, how, is_sorted):
    folder = save_capture(tmp_path, is_sorted)
    BREAKS[how](folder / ("photos" if is_sorted else "") / LIT[2])
    assert left_out(folder) == {LIT[2]: ("unreadable", "lit")}
    assert [path.name for path in load_session(folder).lit] == [*LIT[:2], *LIT[3:]]


def again(path: Path, side: float = 1.0, kind: str = "jpg", **how) -> None:
    with Image.open(path) as picture:
        size = (round(side * picture.width), round(side * picture.height))
        large = picture.resize(size, Image.Resampling.LANCZOS)
    large.save(path.with_name(f"again {path.stem}.{kind}"), **how)


COPIES = {
    "the same bytes": lambda path: shutil.copy(path, path.with_name(f"again {path.name}")),
    "the same pixels without a loss": lambda path: again(path, kind="png"),
    "another quality": lambda path: again(path, kind="jpg", quality=80),
    "half the size": lambda path: again(path, 0.5, kind="jpg", quality=90),
    "twice the size": lambda path: again(path, 2.0, kind="jpg", quality=90),
    "another camera": lambda path: again(path, kind="tif"),
}


@pytest.mark.parametrize("how", COPIES)
def test_a_copy_is_left_out_and_its_original_stays(tmp_path, how):
    folder = save_capture(tmp_path)
    COPIES[how](folder / "photos" / LIT[3])
    session = load_session(folder)
    assert [path.name for path in session.lit] == LIT and not session.light
    (found,) = session.left_out
    assert found.kind == "copy" and found.photo.name.startswith("again") and LIT[3] in found.text
    looks = {one.name.split("/")[-1]: one for one in FirstLook(folder).look()}
    assert looks[found.photo.name].drop and looks[found.photo.name].remarks[0][0] == "copy"


def test_photos_that_are_alike_by_their_purpose_are_no_copies(tmp_path):
    folder, rng = save_capture(tmp_path), np.random.default_rng(7)
    dark = lit_table.table(rng) * 0.02
    for k in range(3):  # each with its own noise
        save_photo(folder / "dark" / f"D{k}.jpg", lit_table.photograph(dark, rng))
    albedo = lit_table.with_object(lit_table.table(np.random.default_rng(5)))
    for k in range(1, 4):  # the light goes on by two degrees each time
        radiance = albedo * lit_table.flashlight(k / 30)
        save_photo(folder / "photos" / f"near {k}.jpg", lit_table.photograph(radiance, rng))
    session = load_session(folder)
    assert not session.left_out and len(session.dark) == 3 and len(session.lit) == len(LIT) + 3


SIZES = {
    "a crop": lambda picture: picture.crop((0, 0, 280, 200)),
    "upright": lambda picture: picture.transpose(Image.Transpose.ROTATE_90),
    "a larger crop": lambda picture: picture.crop((40, 30, 280, 210)).resize((640, 480)),
}


@pytest.mark.parametrize(("how", "role"), [*((how, "photos") for how in SIZES), ("a crop", "dark")])
def test_a_photo_of_another_size_is_left_out(tmp_path, how, role):
    folder = save_capture(tmp_path)
    rng = np.random.default_rng(5)
    fresh = lit_table.photograph(lit_table.table(rng) * lit_table.flashlight(0.4), rng)
    path = save_photo(folder / role / "IMG_150.jpg", fresh)
    SIZES[how](Image.open(path)).save(path, quality=95)
    assert left_out(folder) == {"IMG_150.jpg": ("another size", "lit" if role == "photos" else "dark")}


@pytest.mark.parametrize("is_sorted", [True, False])
def test_where_too_few_are_left_one_error_lists_all_faults(tmp_path, is_sorted):
    folder = save_capture(tmp_path, is_sorted)
    photos = folder / "photos" if is_sorted else folder
    for name, how in zip(LIT, ("truncated", "empty", "text"), strict=False):
        BREAKS[how](photos / name)
    shutil.copy(photos / LIT[5], photos / "IMG_106 copy.jpg")
    with pytest.raises(CaptureError) as caught:
        load_session(folder)
    said = str(caught.value)
    assert all(name in said for name in (*LIT[:3], "IMG_106 copy.jpg"))
    assert "3 photos" in said or "4 photos" in said


# --- what a photo shows ----------------------------------------------------------------------------------------------

CLOSE = np.array([[-60, -50], [340, -30], [330, 290], [-40, 270]])


@pytest.mark.parametrize(  # before and between the lit photos; angle of the flashlight: a close-up is dim at one side
    ("second", "model", "light"), [(5, "Tripod", 1.0), (13, "Another", 1.0), (13, "Tripod", 3.0)]
)
def test_a_photo_in_which_a_board_is_found_is_one_of_the_board(tmp_path, second, model, light):
    folder, rng = save_capture(tmp_path, is_sorted=False), np.random.default_rng(2)
    close = lit_table.with_board(lit_table.table(rng), CLOSE) * lit_table.flashlight(light, in_shadow=1.0)
    path = save_photo(folder / "IMG_103_close.jpg", lit_table.photograph(close, rng), model=model, second=second)
    seen = SeenPhotos(lambda one: one == path)
    assert path in load_session(folder, seen=seen).board
    looks = {one.name: one for one in FirstLook(folder, SeenPhotos(lambda one: one == path)).look()}
    assert looks[path.name].role == "board" and not looks[path.name].remarks
    assert sum(one.role == "lit" for one in looks.values()) == len(LIT)


BOARDS = ["charuco:5x7:30:22:DICT_4X4_50", "checkerboard:6x9:24", "charuco:6x8:25:18:DICT_5X5_100"]


@pytest.mark.parametrize(("spec", "is_named"), [*((spec, False) for spec in BOARDS), (BOARDS[1], True)])
def test_a_board_is_found_in_a_close_up_and_not_on_a_bare_table(tmp_path, spec, is_named):
    board, camera = parse_board(spec), Camera(960, 720, 900.0, 900.0, 479.5, 359.5)
    close = board_photos.look_at((80.0, -230.0, 260.0), (70.0, -90.0, 0.0), roll=0.3)
    Image.fromarray(board_photos.board_photo(board, camera, close)).convert("RGB").save(tmp_path / "close.png")
    bare = cv2.resize(lit_table.table(np.random.default_rng(4)), (960, 720))
    save_photo(tmp_path / "bare.jpg", lit_table.photograph(bare, np.random.default_rng(5)))
    shows = board_finder(spec if is_named else None)
    assert shows(tmp_path / "close.png") and not shows(tmp_path / "bare.jpg")


@pytest.mark.parametrize("window", [(250, 180, 760, 563), (400, 80, 904, 458)])
def test_a_zoomed_photo_of_the_board_does_not_spoil_the_tripods(tmp_path, window):
    folder = save_capture(tmp_path)
    (folder / "board" / "IMG_1.jpg").unlink()
    board, camera = parse_board(BOARDS[0]), Camera(1008, 756, 1000.0, 1000.0, 503.5, 377.5)
    tripod = Image.fromarray(board_photos.board_photo(board, camera, board_photos.look_at((60.0, -420.0, 380.0))))
    tripod.convert("RGB").save(tmp_path / "board" / "IMG_1.png")
    tripod.crop(window).resize(tripod.size).convert("RGB").save(tmp_path / "board" / "IMG_2.png")
    (folder / "session.toml").write_text(f'board = "{BOARDS[0]}"\nroles = {{ board = ["board/IMG_1.png"] }}\n')
    found = fit_board(load_session(folder))
    assert found.posed_camera.centre == pytest.approx([60, -420, 380], abs=12)


# --- a whole command -------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("few_starts")
def test_a_calibration_names_the_photos_that_were_left_out(tmp_path, capsys):
    folder = small_example(tmp_path / "spot", slice(3), slice(0, 36, 4))
    photos = sorted((folder / "photos").iterdir())
    truncated(photos[1])
    shutil.copy(photos[2], photos[2].with_name("IMG_0109 (1).jpg"))
    (folder / "board" / "IMG_0003.jpg").write_text("no photo")
    assert shadowgraph.main(["calibrate", str(folder), "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().out
    calibration = json.loads((tmp_path / "run" / "calibration.json").read_text())
    rows = {row["photo"]: row for row in calibration["residuals"]["left_out_photos"]}
    assert {name: row["role"] for name, row in rows.items()} == {
        photos[1].name: "lit",
        "IMG_0109 (1).jpg": "lit",
        "IMG_0003.jpg": "board",
    }
    log = (tmp_path / "run" / "log.jsonl").read_text()
    assert all(f"{name} is left out" in log for name in (photos[1].name, "IMG_0109 (1).jpg", "board/IMG_0003.jpg"))
    assert "8 of 10 photos used" in said and f"left out: {photos[1].name}" in said
    warnings = ["from a.jpg on the light is 0.55 times as bright", "in a.jpg and b.jpg a second light is on"]
    calibration["residuals"]["warnings"] = warnings * 2  # of two views
    (tmp_path / "run" / "calibration.json").write_text(json.dumps(calibration))
    _print_result(tmp_path / "run", Console(width=200))
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")] == [
        f"warning: {text}" for text in warnings
    ]
