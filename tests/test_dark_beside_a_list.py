"""Pictures beside photos: dark/ is subtracted, mask.png is the object, or it is said why not."""

import numpy as np
import pytest
from dataset_folders import from_above, loaded, towards_lights, write_diligent, write_grey, write_photo, write_rti
from synthetic import BALL, Look, render

from calibration.scenes.importers import import_folder
from capture.errors import CaptureError
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source

SIDE, PHOTOS = 32, 6
ROOM = np.linspace(0.02, 0.08, SIDE)[None, :, None] * np.ones((SIDE, 1, 3))  # light of a window


def truth_with_room():
    truth = render((BALL,), Look(width=SIDE, height=SIDE, n_lights=PHOTOS, kind="directional"), from_above(SIDE))[1]
    clean = truth.stack.rgb.copy() * 0.5
    truth.stack.rgb[:] = clean + ROOM
    return truth, clean


def rti(folder, truth):
    write_rti(folder, truth)
    return folder / "jpeg-exports" / "dark", "sRGB"


def diligent(folder, truth):
    truth.mask[:] = True  # no background is cut away
    write_diligent(folder, truth, np.ones((PHOTOS, 3)))
    return folder / "dark", "linear16"


def table(folder, truth):
    lines = ["photo,dx,dy,dz"]
    for i, (rgb, towards) in enumerate(zip(truth.stack.rgb, towards_lights(truth), strict=True)):
        write_photo(folder / f"{i}.png", rgb)
        lines.append(",".join([f"{i}.png", *(f"{x:.6f}" for x in towards)]))
    (folder / "lights.csv").write_text("\n".join(lines))
    return folder / "dark", "sRGB"


@pytest.mark.parametrize("layout", [rti, diligent, table])
def test_photos_without_light_are_subtracted(tmp_path, layout):
    truth, clean = truth_with_room()
    dark, curve = layout(tmp_path / "theirs", truth)
    for name in "ab":
        write_photo(dark / f"{name}.png", ROOM, curve)
    options = RunOptions()
    source = open_source(tmp_path / "theirs", options)
    stack = read_photos(source, options)[0].stack
    assert stack is not None and np.abs(stack.rgb - clean).max() < 0.01
    assert {dark / "a.png", dark / "b.png"} <= set(source.files(options))
    assert source.known is not None and any(
        "the mean of dark/ (2) is subtracted" in note for note in source.known.notes
    )
    import_folder(tmp_path / "theirs", "train", tmp_path / "ours")
    again = read_photos(open_source(tmp_path / "ours", options), options)[0].stack
    assert again is not None and np.array_equal(again.rgb, stack.rgb)


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (ROOM[:, :20], "20 x 32 pixels, 32 x 32"),
        (ROOM + 0.7, "times as bright as those with it"),
        (None, "a.png"),  # damaged
    ],
)
def test_those_that_cannot_be_are_said(tmp_path, picture, words):
    truth, _ = truth_with_room()
    dark, curve = rti(tmp_path, truth)
    dark.mkdir()
    write_photo(dark / "a.png", picture, curve) if picture is not None else (dark / "a.png").write_text("no picture")
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
