"""dark/ beside a list of lights: subtracted as in captures, or said why not."""

import numpy as np
import pytest
from dataset_folders import loaded, towards_lights, write_diligent, write_photo, write_rti
from synthetic import BALL, Look, render
from test_importers import from_above

from calibration.scenes.importers import import_folder
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
