"""One bad photo of a scene that comes with its lights is left out with its light, whatever the layout."""

import json

import numpy as np
import pytest
from dataset_folders import (
    from_above,
    towards_lights,
    write_deepshadow,
    write_diligent,
    write_photo,
    write_rti,
    write_s3nerf,
)
from PIL import Image
from synthetic import BALL, Look, render
from test_known import write_scene

import shadowgraph
from calibration.scenes.importers import import_folder
from capture.errors import CaptureError
from reconstruct.check.verdict import read_and_check
from reconstruct.source.calibrate_source import calibrate_source
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


def truncated(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path):
    path.write_bytes(b"")


def other_size(path):
    Image.new("RGB", (SIDE + 8, SIDE), "grey").save(path)


FAULTS = {"truncated": (truncated, "unreadable"), "empty": (empty, "unreadable"), "size": (other_size, "another size")}


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
    options = RunOptions()
    source = open_source(tmp_path / "scene", options)
    photos = read_photos(source, options)
    stack = photos[0].stack
    assert stack is not None and list(stack.paths) == good
    calibration = calibrate_source(source, photos, options).first
    assert [light.photo for light in calibration.lights] == [path.name for path in good]
    wanted = np.delete(towards_lights(truth), index, axis=0)
    found = np.array([light.direction for light in calibration.lights])
    assert np.abs(found - wanted / np.linalg.norm(wanted, axis=1, keepdims=True)).max() < 1e-3
    assert [(one.photo, one.kind) for one in source.left_out()] == [(paths[index], kind)]
    (row,) = calibration.residuals["left_out_photos"]  # which the report lists
    assert row["photo"] == paths[index].name and row["reason"].startswith(kind)
    document = read_and_check(source, options).document()
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
