"""Pictures of a scene that comes with its lights: a bad one is left out with its light, dark/ and mask.png are used."""

import json
from dataclasses import replace

import numpy as np
import pytest
from dataset_folders import (
    calibrated,
    from_above,
    loaded,
    towards_lights,
    write_deepshadow,
    write_diligent,
    write_grey,
    write_photo,
    write_rti,
    write_s3nerf,
)
from PIL import Image
from synthetic import BALL, Look, render
from test_known import write_scene
from test_left_out import BREAKS, truncated

import shadowgraph
from calibration.scenes.importers import import_folder
from capture.errors import CaptureError
from reconstruct.check.verdict import read_and_check
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source

SIDE, PHOTOS = 48, 8


@pytest.fixture(scope="module")
def truth():
    return render((BALL,), Look(width=SIDE, height=SIDE, n_lights=PHOTOS, kind="directional"), from_above(SIDE))[1]


def rti(folder, truth):
    write_rti(folder, truth)
    return folder / "jpeg-exports"


def diligent(folder, truth):
    write_diligent(folder, truth, np.ones((PHOTOS, 3)))
    return folder


def by_order(folder, truth):
    for i, rgb in enumerate(truth.stack.rgb):
        write_photo(folder / f"{'abcdefgh'[i]}.png", rgb)
    np.savetxt(folder / "lights.csv", towards_lights(truth), fmt="%.6f", delimiter=",")
    return folder


def other_size(path):
    Image.new("RGB", (SIDE + 8, SIDE), "grey").save(path)


FAULTS = {how: (BREAKS[how], "unreadable") for how in ("truncated", "empty")} | {"size": (other_size, "another size")}


def photos_of(place):
    others = ("mask", "Normal_gt")
    return sorted(p for p in place.glob("*.png") if p.stem not in others and not p.stem.endswith("_white_"))


@pytest.mark.parametrize(
    ("layout", "fault", "index"),
    [(rti, "truncated", 0), (diligent, "size", 3), (by_order, "empty", 3), (by_order, "size", 0)],
)
def test_a_bad_photo_is_left_out_with_its_light(tmp_path, truth, layout, fault, index):
    place = layout(tmp_path / "scene", truth)
    spoil, kind = FAULTS[fault]
    paths = photos_of(place)
    spoil(paths[index])
    good = [path for path in paths if path != paths[index]]
    source, (photos,), calibration = calibrated(tmp_path / "scene")
    assert photos.stack is not None and list(photos.stack.paths) == good
    assert [light.photo for light in calibration.lights] == [path.name for path in good]
    wanted = np.delete(towards_lights(truth), index, axis=0)
    found = np.array([light.direction for light in calibration.lights])
    assert np.abs(found - wanted / np.linalg.norm(wanted, axis=1, keepdims=True)).max() < 1e-3
    assert [(one.photo, one.kind) for one in source.left_out()] == [(paths[index], kind)]
    (row,) = calibration.residuals["left_out_photos"]  # which the report lists
    assert row["photo"] == paths[index].name and row["reason"].startswith(kind)
    document = read_and_check(source, RunOptions()).document()
    assert [(one["photo"], one["kind"]) for one in document["findings"] if one["drop"]] == [(paths[index].name, kind)]


@pytest.mark.parametrize("layout", [rti, diligent, by_order])
def test_too_few_good_photos_are_one_error_that_names_all_bad_ones(tmp_path, truth, layout):
    paths = photos_of(layout(tmp_path / "scene", truth))
    for path, (spoil, _) in zip(paths[1:], [*FAULTS.values(), FAULTS["empty"], FAULTS["truncated"]], strict=False):
        spoil(path)
    with pytest.raises(CaptureError, match=r"3 of 8 photos .* 4 are needed") as refused:
        open_source(tmp_path / "scene", RunOptions())
    assert all(path.name in str(refused.value) for path in paths[1:6])


def ours(folder, truth):
    rti(folder.with_name("theirs"), truth)
    import_folder(folder.with_name("theirs"), "train", folder)
    return folder / "photos"


def s3nerf(folder, truth):
    write_s3nerf(folder, truth)
    return folder / "rgb"


def shadowneus(folder, _):
    write_scene(folder, Look(width=SIDE, height=SIDE, n_lights=PHOTOS))
    return folder / "train"


@pytest.mark.parametrize(
    ("layout", "pictures", "fault"),
    [
        (s3nerf, "visibility/*.png", "size"),
        (shadowneus, "train/*_white_.png", "truncated"),
        (write_deepshadow, "0/*_shadow1.png", "empty"),
    ],
)
def test_a_bad_picture_of_shadows_is_left_out_with_its_photo_and_light(tmp_path, layout, pictures, fault):
    point_lights = Look(width=SIDE, height=SIDE, n_lights=PHOTOS)
    layout(tmp_path / "scene", render((BALL,), point_lights, from_above(SIDE))[1])
    shadows = sorted((tmp_path / "scene").glob(pictures))
    bad = shadows.pop(2)
    FAULTS[fault][0](bad)
    options = RunOptions(input="shadow")
    source = open_source(tmp_path / "scene", options)
    known = source.known
    assert [(one.photo, one.kind) for one in source.left_out()] == [(bad, FAULTS[fault][1])]
    assert known is not None and list(known.shadow_paths or ()) == shadows
    named = known.rgb_paths or known.shadow_paths or ()
    assert [light.photo for light in known.calibration.lights] == [path.name for path in named]
    read = read_photos(source, options)[0].shadow
    assert read is not None and len(read) == PHOTOS - 1


def test_an_import_names_what_it_left_out_and_a_command_says_it(tmp_path, truth, capsys):
    paths = photos_of(rti(tmp_path / "theirs", truth))
    truncated(paths[4])
    _, scene = import_folder(tmp_path / "theirs", "train", tmp_path / "ours")
    assert any(paths[4].name in note for note in scene.notes)
    assert len(list((tmp_path / "ours" / "photos").iterdir())) == PHOTOS - 1
    assert shadowgraph.main(["check", str(tmp_path / "theirs"), "--out", str(tmp_path / "checked")]) == 0
    assert paths[4].name in capsys.readouterr().out
    assert json.loads((tmp_path / "checked" / "check.json").read_text())["findings"][0]["photo"] == paths[4].name


# --- pictures beside the photos --------------------------------------------------------------------------------------

ROOM = np.linspace(0.02, 0.08, SIDE)[None, :, None] * np.ones((SIDE, 1, 3))  # light of a window


def with_room(truth):
    """The scene with light of a window, and without it."""
    clean = truth.stack.rgb * 0.5
    return replace(
        truth, stack=replace(truth.stack, rgb=clean + ROOM), mask=truth.mask | True
    ), clean  # none is cut away


@pytest.mark.parametrize("layout", [rti, diligent, by_order])
def test_photos_without_light_are_subtracted(tmp_path, truth, layout):
    lit, clean = with_room(truth)
    dark = layout(tmp_path / "theirs", lit) / "dark"
    for name in "ab":
        write_photo(dark / f"{name}.png", ROOM, "linear16" if layout is diligent else "sRGB")
    options = RunOptions()
    source = open_source(tmp_path / "theirs", options)
    stack = read_photos(source, options)[0].stack
    assert stack is not None and np.abs(stack.rgb - clean).max() < 0.01
    assert {dark / "a.png", dark / "b.png"} <= set(source.files(options))
    assert source.known is not None
    assert any("the mean of dark/ (2) is subtracted" in note for note in source.known.notes)
    import_folder(tmp_path / "theirs", "train", tmp_path / "ours")
    again = read_photos(open_source(tmp_path / "ours", options), options)[0].stack
    assert again is not None and np.array_equal(again.rgb, stack.rgb)


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (ROOM[:, :20], "20 x 48 pixels, 48 x 48"),
        (ROOM + 0.7, "times as bright as those with it"),
        (None, "a.png"),  # damaged
    ],
)
def test_those_that_cannot_be_are_said(tmp_path, truth, picture, words):
    dark = rti(tmp_path, with_room(truth)[0]) / "dark"
    dark.mkdir()
    write_photo(dark / "a.png", picture) if picture is not None else (dark / "a.png").write_text("no picture")
    known = loaded(tmp_path)
    said = known.calibration.residuals["warnings"]
    assert known.dark_paths == () and any("dark is not used: " in text and words in text for text in said)


@pytest.mark.parametrize(
    ("size", "split", "words"),
    [((48, 36), 24, None), ((40, 36), 20, r"mask\.png is 40 x 36"), ((48, 36), 0, "one colour")],
)
def test_a_mask_beside_the_settings_is_the_object(tmp_path, size, split, words):
    pattern = np.random.default_rng(0).uniform(0.1, 0.5, (36, 48, 3))
    write_photo(tmp_path / "board" / "IMG_0.png", pattern[::-1])
    for i in range(4):
        write_photo(tmp_path / "photos" / f"IMG_{i}.png", pattern * (1 + 0.2 * i))
    mask = np.ones(size[::-1])
    mask[:, :split] = 0
    write_grey(tmp_path / "mask.png", mask)
    source = open_source(tmp_path, RunOptions())
    assert tmp_path / "mask.png" in source.files(RunOptions())
    assert read_photos(source, RunOptions(mask="none"))[0].mask is None
    if words is None:
        found = read_photos(source, RunOptions())[0].mask
        assert found is not None and np.array_equal(found, mask)
    else:
        with pytest.raises(CaptureError, match=words):
            read_photos(source, RunOptions())
