"""Captures of several views: the folders, the file, and the boards of several views together."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import lit_table
import numpy as np
import pytest
from board_photos import board_photo, look_at, slanted

from calibration.board.board import parse_board
from calibration.board.board_photos import BoardFit, fit_boards
from calibration.calibrated_views import CalibratedView, CalibratedViews, load_views, save_views
from calibration.calibration import Calibration, load_calibration, save_calibration
from calibration.camera import Camera
from calibration.light import Light
from capture.errors import CalibrationError, CaptureError
from capture.session.capture import load_capture
from capture.session.session import Session, SessionSettings
from reconstruct.run_folder.folder import content_hash
from reconstruct.source.source import RunOptions, open_source

BOARD = parse_board("charuco:5x7:30:22:DICT_4X4_50")
OTHER = parse_board("charuco:6x4:30:22:DICT_5X5_50")
CAMERA = Camera(1000, 750, 1000.0, 1000.0, 503.0, 371.0)
PLACES = [(150.0, -520.0, 330.0), (560.0, 120.0, 340.0), (-380.0, 60.0, 360.0)]


def photos(folder: Path, count: int, first: int = 0) -> None:
    """Small pictures that differ."""
    folder.mkdir(parents=True)
    for i in range(count):
        picture = np.random.default_rng(first + i).integers(0, 255, (40, 60, 3), np.uint8)
        cv2.imwrite(str(folder / f"IMG_{i:04d}.png"), picture)


def capture_of(folder: Path, *places: str) -> Path:
    for k, place in enumerate(places):
        photos(folder / place / "photos", 4, 100 * k)
        photos(folder / place / "board", 1, 100 * k + 50)
    return folder


# --- folders ---------------------------------------------------------------------------------------------------------


def test_views_and_object_poses_are_read_in_natural_order_and_one_view_is_a_capture_of_one(tmp_path):
    folder = capture_of(
        tmp_path / "all", "view_1", "view_10", "view_2", "turned_1", "turned_2/view_1", "turned_2/view_2"
    )
    photos(folder / "board", 2, 900)
    photos(folder / "side", 3, 950)
    (folder / "session.toml").write_text('board = "checkerboard:9x6:24.25"')
    capture = load_capture(folder)
    assert [session.name for session in capture.views] == ["view_1", "view_2", "view_10"]
    assert [one.name for one in capture.object_poses] == ["turned_1", "turned_2"]
    assert [s.name for s in capture.sessions()][3:] == ["turned_1", "turned_2/view_1", "turned_2/view_2"]
    assert all(session.settings.board == "checkerboard:9x6:24.25" for session in capture.sessions())
    assert len(capture.board) == 2 and [len(session.side) for session in capture.views] == [1, 1, 1]
    alone = load_capture(folder / "view_2")
    assert alone.views[0].name == "" and alone.views[0].lit == capture.views[1].lit and not alone.object_poses
    source = open_source(folder, RunOptions())
    assert len(source.views()) == 6 and len(source.photos()) == 24
    assert len(content_hash(source.files(RunOptions()))) == len(source.files(RunOptions())) == 6 * 5 + 2 + 3 + 1


def test_more_places_than_are_solved_together_are_refused_with_their_number(tmp_path, monkeypatch):
    folder = capture_of(tmp_path / "all", "view_1", "view_2", "turned_1/view_1", "turned_1/view_2")
    monkeypatch.setattr("capture.session.capture.MOST_VIEWS", 3)
    with pytest.raises(CaptureError, match=r"4 places of the tripod, those of turned_\* included; at most 3"):
        load_capture(folder)


def test_a_view_that_cannot_be_read_is_named_and_the_others_are_used(tmp_path):
    folder = capture_of(tmp_path, "view_1", "view_3")
    photos(folder / "view_2" / "photos", 2, 300)
    capture = load_capture(folder)
    assert [session.name for session in capture.views] == ["view_1", "view_3"]
    assert capture.left_out[0][0] == "view_2" and "2 photos lit by the flashlight" in capture.left_out[0][1]


def test_what_is_unclear_is_refused_by_name(tmp_path):
    folder = capture_of(tmp_path, "view_1", "view_2")
    (folder / "session.toml").write_text('roles = { board = ["view_1/photos/IMG_0000.png"] }')
    with pytest.raises(CaptureError, match=r"names roles.*view_1/session.toml"):
        load_capture(folder)
    (folder / "session.toml").unlink()
    with pytest.raises(CaptureError, match=r"2 views.*one view only"):
        lights = tmp_path / "lights.txt"
        lights.write_text("")
        open_source(folder, RunOptions(lights=str(lights)))
    photos(folder / "photos", 4, 700)
    with pytest.raises(CaptureError, match=r"photos/ beside view_1/"):
        load_capture(folder)


# --- a flat folder ---------------------------------------------------------------------------------------------------


def flat(folder: Path, places: int, per_place: int = 6, push_px: int = 0) -> Path:
    """Photos of `places` tripod places one after the other, each with its photo of the board, and one from the hand."""
    rng = np.random.default_rng(3)
    table = lit_table.with_object(lit_table.table(rng))
    second = 0
    for place in range(places):
        corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240]], np.float32)
        seen_at = np.roll(corners, place, 0) if not push_px else corners + np.float32([push_px * place, 0])
        to_photo = cv2.getPerspectiveTransform(corners, seen_at.astype(np.float32))
        size = (table.shape[1], table.shape[0])
        albedo = cv2.warpPerspective(table, to_photo, size, borderMode=cv2.BORDER_REFLECT)
        if place == 0 or not push_px:
            on_table = lit_table.with_board(albedo, np.add(lit_table.TRIPOD_BOARD, (70 * place, 23 * place)))
            board = lit_table.photograph(on_table, rng)
            lit_table.save_photo(folder / f"IMG_{100 * place}.jpg", board, second=second)
        for i in range(per_place):
            photo = lit_table.photograph(albedo * lit_table.flashlight(2 * np.pi * i / per_place), rng)
            lit_table.save_photo(folder / f"IMG_{100 * place + 1 + i}.jpg", photo, second=second + 1 + i)
        second += 100
    return folder


def test_a_flat_folder_in_which_the_tripod_was_moved_is_split_by_the_pictures(tmp_path):
    capture = load_capture(flat(tmp_path, 2))
    assert [view.name for view in capture.views] == ["view_1", "view_2"]
    for k, view in enumerate(capture.views):
        assert [path.name for path in view.lit] == [f"IMG_{100 * k + 1 + i}.jpg" for i in range(6)]
        assert [path.name for path in view.board] == [f"IMG_{100 * k}.jpg"]
    assert "2 places of the tripod" in capture.views[0].notes[0]


def test_a_tripod_that_was_only_pushed_stays_one_view(tmp_path):
    capture = load_capture(flat(tmp_path, 2, push_px=9))
    assert len(capture.views) == 1 and capture.views[0].name == ""


# --- the file --------------------------------------------------------------------------------------------------------


def calibration(place=PLACES[0], photo="a.jpg") -> Calibration:
    light = Light(photo, "point", np.array([100.0, 0, 300.0]), power=np.ones(3), sigma=np.ones(3))
    covariance = {"pose_covariance": (1e-4 * np.eye(6)).tolist()}
    return Calibration(CAMERA, look_at(place), 0.0, (light,), residuals=covariance)


def views() -> CalibratedViews:
    names = ("view_1", "view_2", "view_3")
    some = tuple(CalibratedView(n, calibration(p, f"{n}.jpg")) for n, p in zip(names, PLACES, strict=True))
    object_pose = CalibratedViews((CalibratedView("turned_1", calibration(PLACES[2], "t.jpg")),), name="turned_1")
    return CalibratedViews(some, (("view_4", "no board found"),), (object_pose,))


def test_the_file_of_several_views_returns_them_and_a_reader_of_one_view_finds_the_first(tmp_path):
    path, here = tmp_path / "calibration.json", views()
    save_views(here, path)
    there = load_views(path)
    assert [view.name for view in there.views] == ["view_1", "view_2", "view_3"]
    assert all(a.calibration == b.calibration for a, b in zip(here.views, there.views, strict=True))
    assert there.left_out == here.left_out and there.object_poses[0].name == "turned_1"
    assert there.object_poses[0].first == here.object_poses[0].first and load_calibration(path) == here.first
    assert there.views[1].calibration.residuals == here.views[1].calibration.residuals


def test_the_file_of_one_view_is_that_of_a_calibration(tmp_path):
    save_views(CalibratedViews.of(calibration()), tmp_path / "views.json")
    save_calibration(calibration(), tmp_path / "one.json")
    assert (tmp_path / "views.json").read_bytes() == (tmp_path / "one.json").read_bytes()
    assert load_views(tmp_path / "one.json").views[0].name == ""


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: d["further_views"][0]["ground"].update(offset=3.0), "ground of the first view"),
        (lambda d: d["further_views"][1].update(view="view_2"), "a name of its own"),
        (lambda d: d["further_views"][0].update(view="../view_2"), "the name of a f"),
        (lambda d: d["further_views"][0]["camera"].pop("fx"), r"further_views\[0\].camera.fx is missing"),
        (lambda d: d["lies"][0].update(lies=[d["lies"][0].copy()]), "no object poses of an object pose"),
        (lambda d: d.update(further_views=[{}] * 1000), "further_views"),
    ],
)
def test_a_damaged_file_is_refused_by_the_name_of_its_field(tmp_path, spoil, message):
    path = tmp_path / "calibration.json"
    save_views(views(), path)
    document = json.loads(path.read_text())
    spoil(document)
    path.write_text(json.dumps(document))
    with pytest.raises(CalibrationError, match=message):
        load_views(path)


# --- boards ----------------------------------------------------------------------------------------------------------


def session(folder: Path, name: str, pictures: list[np.ndarray], lit: list[np.ndarray] = []) -> Session:  # noqa: B006
    paths = []
    for kind, some in (("board", pictures), ("photos", lit)):
        (folder / name / kind).mkdir(parents=True)
        paths.append(tuple(folder / name / kind / f"{name}_{i}.png" for i in range(len(some))))
        for path, picture in zip(paths[-1], some, strict=True):
            cv2.imwrite(str(path), picture)
    return Session(folder / name, paths[0], paths[1], (), (), SessionSettings(board=BOARD.spec()), name=name)


@cache
def seen_from(place: tuple[float, float, float], board=BOARD, focal=1000.0) -> np.ndarray:
    return board_photo(board, replace(CAMERA, fx=focal, fy=focal), look_at(place))


@pytest.fixture(scope="module")
def shared(tmp_path_factory) -> list[Path]:
    """Three photos for the lens."""
    rng = np.random.default_rng(1)
    paths = [tmp_path_factory.mktemp("board") / f"shared_{i}.png" for i in range(3)]
    for path in paths:
        cv2.imwrite(str(path), board_photo(BOARD, CAMERA, slanted(rng, rng.uniform(0.3, 0.8), 520)))
    return paths


def off(fit: BoardFit | CalibrationError, place) -> float:
    """How far the camera is from where it stood, mm."""
    assert isinstance(fit, BoardFit), fit
    return float(np.linalg.norm(fit.posed_camera.world_from_camera.translation - place))


def test_views_share_a_lens_and_each_is_placed_better_than_alone(tmp_path, shared):
    sessions = [session(tmp_path, f"v{i}", [seen_from(p)]) for i, p in enumerate(PLACES)]
    together = fit_boards(sessions, shared)
    alone = [fit_boards([one])[0] for one in sessions]
    assert len({fit.posed_camera.camera.fx for fit in together if isinstance(fit, BoardFit)}) == 1
    apart = [off(fit, place) for fit, place in zip(together, PLACES, strict=True)]
    assert max(apart) < 0.8 and np.mean(apart) < 0.7 * np.mean([off(f, p) for f, p in zip(alone, PLACES, strict=True)])
    for fit, place in zip(together, PLACES, strict=True):
        assert isinstance(fit, BoardFit)
        covariance = np.array(fit.residuals["pose_covariance"])
        away = fit.posed_camera.world_from_camera.translation - place
        assert away @ np.linalg.solve(covariance[3:, 3:], away) < 16  # chi-square of three: one in a thousand


def test_a_view_with_another_board_is_named_and_the_others_are_fitted(tmp_path):
    boards = (BOARD, OTHER, BOARD)
    pictures = [seen_from(p, board) for board, p in zip(boards, PLACES, strict=True)]
    fits = fit_boards([session(tmp_path, f"v{i}", [picture]) for i, picture in enumerate(pictures)])
    assert off(fits[0], PLACES[0]) < 4 and off(fits[2], PLACES[2]) < 4
    assert isinstance(fits[1], CalibrationError)
    assert "v1_0.png" in str(fits[1]) and "not found" in str(fits[1]) and "6x4" in str(fits[1])


def test_a_view_without_a_board_photo_is_placed_by_its_photos_under_the_flashlight(tmp_path, shared):
    rng = np.random.default_rng(2)
    clean = seen_from(PLACES[1]).astype(float)
    lit = [np.clip(clean + rng.normal(0, 2, clean.shape), 0, 255).astype(np.uint8) for _ in range(3)]
    sessions = [session(tmp_path, "v0", [seen_from(PLACES[0])]), session(tmp_path, "v1", [], lit)]
    fits = fit_boards(sessions, shared)
    assert off(fits[1], PLACES[1]) < 0.8
    bare = [np.full((75, 100), 90, np.uint8)] * 4
    fits = fit_boards([sessions[0], session(tmp_path, "v2", [], bare)])
    assert isinstance(fits[1], CalibrationError) and "v2" in str(fits[1]) and "photo in room light" in str(fits[1])


def test_a_view_that_was_zoomed_gets_a_lens_of_its_own(tmp_path, shared):
    pictures = [seen_from(p, BOARD, f) for f, p in zip((1000.0, 1250.0, 1000.0), PLACES, strict=True)]
    sessions = [session(tmp_path, f"v{i}", [picture]) for i, picture in enumerate(pictures)]
    fits = fit_boards(sessions, shared)
    assert isinstance(fits[1], BoardFit) and abs(fits[1].posed_camera.camera.fx / 1250 - 1) < 0.02
    assert any("does not fit the lens of the other views" in note for note in fits[1].residuals["notes"])
    assert off(fits[0], PLACES[0]) < 0.8 and off(fits[2], PLACES[2]) < 0.8
