"""Effects of phones, rooms and hands in generated captures: poses, beams, sheets and accidents."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from test_generator import seen_points, truth

from calibration.board.board import parse_board
from calibration.board.corners import find_board
from capture.decode.exif import read_header
from capture.errors import CaptureError
from capture.session.session import load_session
from examples.generator import hand, poses
from examples.generator.options import Exposure, Flashlight, Further, Hand, Phone, Setup, Table, Thing
from examples.generator.sheet import lay

BOARD = parse_board("charuco:5x7:30:22:DICT_4X4_50")
pytestmark = pytest.mark.slow  # rendering takes half a minute
LARGE_BOARD = "checkerboard:5x4:36"
BALL = trimesh.creation.icosphere(subdivisions=2, radius=40)


def scene(setup: Setup) -> tuple[trimesh.Trimesh, poses.Viewpoint]:
    thing = poses.stand(BALL, setup, BOARD)
    return thing, poses.tripod(setup, BOARD, thing)


def never(start: np.ndarray, along: np.ndarray) -> np.ndarray:
    return np.zeros(len(along), bool)


def test_side_views_hold_object_and_board():
    setup = Setup(further=Further(side_photos=4))
    thing, fixed = scene(setup)
    for view in poses.sides(fixed, BOARD, thing, setup, never):
        points = np.concatenate([thing.vertices, BOARD.points()])
        pixels = view.camera.project(view.world_from_camera.inverse().apply(points))
        assert np.all((pixels > 0) & (pixels < [view.camera.width, view.camera.height]))
        off = view.world_from_camera.translation - thing.bounds.mean(0)
        tripod = fixed.world_from_camera.translation - thing.bounds.mean(0)
        assert off[:2] @ tripod[:2] < 0.9 * np.linalg.norm(off[:2]) * np.linalg.norm(tripod[:2])


def test_photos_that_there_are_not_cannot_be_spoilt():
    few = Setup(flashlight=Flashlight(photos=5))
    with pytest.raises(CaptureError, match="--no-flash 6: there are photos 1 to 5"):
        hand.refuse_impossible(replace(few, hand=Hand(no_flash=(6,))))
    with pytest.raises(CaptureError, match="before photo 1"):
        hand.refuse_impossible(replace(few, hand=Hand(twice=(1,))))


# --- a rendered one --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hard_capture(renderer, tmp_path_factory):
    """A small capture with everything on, and photos from the side, from the flashlight and without it."""
    from examples.generator import rendering
    from examples.generator.capturing import make_capture

    folder = tmp_path_factory.mktemp("hard")
    BALL.export(folder / "ball.ply")
    setup = Setup(
        Thing(mesh=folder / "ball.ply", albedo=(0.5, 0.5, 0.5)),
        Table(LARGE_BOARD, board_stays=True),
        Phone(width=240, focal=30.0),
        Flashlight(photos=6),
        Exposure(samples=4, noise=0.3),
        hand=Hand(arm=(2,), shaken=(3,), no_flash=(4,), tapped=(5,), twice=(6,)),
        further=Further(board_photos=1, side_photos=1, light_photos=True, dark_photos=1),
        hard=True,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "ROOM_SAMPLES", 8)  # noisier, in half of the time
        make_capture(folder / "capture", setup, lambda text: None)
    return folder / "capture"


def test_the_session_reads_it_and_the_truth_says_what_went_wrong(hard_capture):
    session = load_session(hard_capture)
    assert [len(role) for role in (session.board, session.lit, session.light, session.dark)] == [2, 6, 6, 1]
    photos = truth(hard_capture, "lights")["photos"]
    assert [entry["usable"] for entry in photos] == [True, False, False, False, True, True]
    assert all(word in photos[i]["bad"] for i, word in ((1, "arm"), (2, "shaken"), (3, "did not fire")))
    assert "camera" not in photos[3] and photos[4]["camera"]["width"] == 240
    assert 0.3 < np.linalg.norm(photos[4]["shift_px"]) < 4  # 5 px at 1008
    assert photos[5]["same_place_as"] == "IMG_0105.jpg"
    assert np.linalg.norm(np.subtract(photos[5]["position_mm"], photos[4]["position_mm"])) < 10
    assert len(photos[0]["leds_mm"]) == 2 and np.linalg.norm(photos[0]["sweep_mm"]) <= 6
    assert np.allclose(np.mean(photos[0]["leds_mm"], axis=0), photos[0]["position_mm"])


def test_corners_of_the_wavy_board_are_where_the_truth_says_from_everywhere(hard_capture):
    board = parse_board(LARGE_BOARD)
    for folder, name in (("board", "board_photos"), ("side", "side_photos")):
        for entry in truth(hard_capture, name):
            found = find_board(cv2.imread(str(hard_capture / folder / entry["file"]), cv2.IMREAD_GRAYSCALE), board)
            assert found is not None, entry["file"]
            pixels = np.array(entry["inner_corners_px_upright"])
            assert len(found.pixels) >= len(pixels) - 1, entry["file"]  # one may lie at the picture's border
            off = found.pixels - pixels[np.linalg.norm(found.pixels[:, None] - pixels, axis=-1).argmin(1)]
            assert np.abs(off).max() < 0.5 and np.abs(off.mean(0)).max() < 0.1
    flat, wavy = (np.array(truth(hard_capture, "board")[f"inner_corners_{k}mm"]) for k in ("nominal_", ""))
    assert np.abs(flat - wavy).max() > 0.1


def test_the_wall_is_in_the_maps_and_is_no_table(hard_capture):
    wall, (points, maps) = truth(hard_capture, "ground")["wall"], seen_points(hard_capture)
    behind = ~maps["table"] & ~maps["mask"] & np.isfinite(maps["depth_mm"])
    assert behind.mean() > 0.02
    assert np.allclose(points[behind] @ wall["normal"], wall["offset_mm"], atol=0.01)


def test_a_table_ends_at_its_edge_and_a_floor_lies_below(renderer):
    from examples.generator import truth as maps
    from examples.generator.rendering import stage

    setup = Setup(table=Table(edge=100.0), phone=Phone(width=120, azimuth=-90.0))
    thing, fixed = scene(setup)
    edge = poses.edge_of(setup, thing)
    assert edge is not None and poses.wall_of(setup, thing) is None
    seen = maps.seen(maps.Rays(thing), fixed, setup, lay(BOARD, setup))
    floor, table = ~seen.is_table & ~seen.mask, seen.is_table
    assert floor.mean() > 0.05 and np.allclose(seen.points[floor][:, 2], -poses.FLOOR_MM)
    assert (seen.points[table] @ edge.normal).min() >= edge.offset
    turned = poses.edge_of(Setup(table=Table(edge=100.0, edge_turn=30.0), phone=setup.phone), thing)
    assert turned is not None and turned.normal @ edge.normal == pytest.approx(np.cos(np.radians(30)))
    shapes = stage(setup, BOARD, thing, fixed.camera, np.random.default_rng(0)).shapes
    top, below = shapes["table"].bbox(), shapes["floor"].bbox()
    assert top.max[1] == pytest.approx(-edge.offset) and np.allclose(edge.normal, [0, -1, 0])
    assert below.max[2] == pytest.approx(-poses.FLOOR_MM)


def test_the_masks_from_the_side_show_the_object(hard_capture):
    (entry,) = truth(hard_capture, "side_photos")
    mask = cv2.imread(str(hard_capture / "gt/side" / f"{entry['file'][:-4]}_mask.png"), cv2.IMREAD_GRAYSCALE) > 127
    vertices = trimesh.load(hard_capture / "gt" / "object.ply").vertices
    camera = entry["stored"]
    pixels, _ = cv2.projectPoints(
        vertices,
        cv2.Rodrigues(np.array(camera["T_cam_from_board"])[:3, :3])[0],
        np.array(camera["T_cam_from_board"])[:3, 3],
        np.array(camera["K"]),
        np.array(camera["dist_k1_k2_p1_p2_k3"]),
    )
    hull = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(pixels.astype(np.float32)).round().astype(np.int32), 1)
    assert (mask & (hull > 0)).sum() / (mask | (hull > 0)).sum() > 0.93  # a ball is convex
    assert mask.sum() > 200


def test_the_flashlight_phone_sets_its_own_exposure_and_its_clock_is_ahead(hard_capture):
    light = truth(hard_capture, "light_phone")
    assert len(light["photos"]) == 6 and light["width"] == 240
    lights = truth(hard_capture, "lights")["photos"]
    for entry, lit in zip(light["photos"], lights, strict=True):
        assert entry["photo"] == lit["file"] and np.allclose(entry["led_mm"], lit["position_mm"])
    headers = [
        read_header(hard_capture / folder / f"IMG_{n}.jpg") for folder, n in (("light", "0201"), ("photos", "0101"))
    ]
    assert headers[0].camera != headers[1].camera
    assert headers[0].taken_s - headers[1].taken_s == pytest.approx(light["clock_offset_s"], abs=0.01)
