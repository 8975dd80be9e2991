"""The coach: roles, faults and lights of photos while they arrive, on the example's photos, and what it says next."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import shadowgraph
from calibration.calibration import load_calibration
from capture.session import seen
from reconstruct.check.coach import Coach, FirstLook, SeenLight, missing_sides, next_words, seen_lines

SPOT = Path(__file__).parent.parent / "examples" / "spot"
LIT = [f"IMG_0{number}.jpg" for number in (101, 105, 109, 113, 117, 121, 125)]


def flat_capture(folder: Path, lit: list[str], capture: Path = SPOT) -> Path:
    """As phones give it: one flat folder, nothing said about roles."""
    folder.mkdir()
    shutil.copy(capture / "board" / "IMG_0001.jpg", folder)
    for name in lit:
        shutil.copy(capture / "photos" / name, folder)
    return folder


@pytest.fixture(scope="module")
def looked(tmp_path_factory):
    """Seven good photos, then one of each fault, as they would arrive."""
    folder = flat_capture(tmp_path_factory.mktemp("coach") / "spot", LIT)
    look = FirstLook(folder)
    first = look.look()
    original = Image.open(SPOT / "photos" / "IMG_0129.jpg")
    photo, exif = np.asarray(original, float), original.getexif()
    faults = {
        "IMG_0201.jpg": photo * 0.1,  # the flashlight was off
        "IMG_0202.jpg": photo * 2.6,  # over-exposed
        "IMG_0203.jpg": np.roll(photo, (14, 9), (0, 1)),  # the camera was knocked
    }
    for name, pixels in faults.items():
        Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)).save(folder / name, quality=95, exif=exif)
    (folder / "IMG_0204.jpg").write_bytes((SPOT / "photos" / "IMG_0129.jpg").read_bytes()[:3000])
    decoded = []
    reader = seen.features_of
    seen.features_of = lambda path: decoded.append(path) or reader(path)
    try:
        return first, look.look(), decoded
    finally:
        seen.features_of = reader


def test_what_is_wrong_with_a_photo_is_named_at_once_and_only_new_photos_are_read(looked):
    _, second, decoded = looked
    kinds = {one.name: {kind for kind, _ in one.remarks} for one in second if one.drop}
    assert kinds["IMG_0202.jpg"] >= {"over-exposed"}
    assert kinds["IMG_0203.jpg"] & {"camera moved", "another scene", "blurred"}
    assert "unreadable" in kinds["IMG_0204.jpg"]
    dark = next(one for one in second if one.name == "IMG_0201.jpg")
    assert dark.role == "dark" or "flash off" in {kind for kind, _ in dark.remarks}
    assert kinds.keys() <= {"IMG_0201.jpg", "IMG_0202.jpg", "IMG_0203.jpg", "IMG_0204.jpg"}
    assert {path.name for path in decoded} == {f"IMG_020{k}.jpg" for k in (1, 2, 3, 4)}


@pytest.mark.slow  # the truth is the calibration of a whole run
def test_lights_of_single_photos_are_where_the_whole_calibration_puts_them(phone_run, tmp_path):
    capture, calibration = phone_run[0], load_calibration(phone_run[1] / "calibration.json")
    lit = sorted(path.name for path in (capture / "photos").iterdir())[::2]
    folder = flat_capture(tmp_path / "spot", lit[:5], capture)
    coach = Coach(folder)
    coach.look()
    for name in lit[5:]:
        shutil.copy(capture / "photos" / name, folder)
    seen = {light.photo: light for light in coach.look().lights}
    centre = calibration.posed_camera.looked_at()
    for light in calibration.lights:
        if light.photo in seen:
            way = np.asarray(light.position) - centre
            height = np.degrees(np.arcsin(way[2] / np.linalg.norm(way)))
            assert abs(seen[light.photo].elevation - height) < 4
    assert len(seen) == len(lit)


def ring(*azimuths: float, elevation: float = 40.0) -> tuple[SeenLight, ...]:
    return tuple(SeenLight(f"{azimuth}.jpg", float(azimuth), float(elevation)) for azimuth in azimuths)


def test_sides_without_a_low_light_are_missing_and_the_middle_of_the_widest_gap_comes_next():
    assert missing_sides(ring(*range(-180, 180, 45))) == ()
    assert missing_sides(ring(*range(-180, 180, 45), elevation=75)) == tuple(range(8))
    front = ring(-45, 0, 45, 90, -90)
    assert missing_sides(front) == (3, 4, 5)
    assert "from behind the object" in next_words(front, missing_sides(front))


def test_the_coach_says_when_it_is_enough():
    some = ring(*range(-180, 180, 45))
    assert "all are at one height" in next_words(some, ())
    two = some + ring(*range(-180, 180, 45), elevation=65)
    assert "That is enough" in next_words(two, ())
    assert next_words(two + two, ()).startswith("Done")


def test_an_empty_folder_and_one_without_a_board_are_told_what_comes_first(tmp_path):
    assert "photograph the board" in Coach(tmp_path).look().advice
    shutil.copy(SPOT / "photos" / "IMG_0101.jpg", tmp_path)
    seen = Coach(tmp_path).look()
    assert "photograph the board" in seen.advice and seen_lines(seen) == []


def test_watch_says_what_is_there_and_what_comes_next(tmp_path, capsys):
    shutil.copy(SPOT / "board" / "IMG_0001.jpg", tmp_path)
    (tmp_path / "broken.jpg").write_bytes(b"no photo")
    assert shadowgraph.main(["watch", str(tmp_path), "--once"]) == 0
    said = capsys.readouterr().out
    assert "broken.jpg: TAKE IT AGAIN. unreadable" in said
    assert "IMG_0001.jpg: board" in said and "Next: room light off" in said
    assert shadowgraph.main(["watch", str(tmp_path / "nowhere")]) == 2
