"""Scenes in other programs' layouts, written to disk and read back: camera, lights, ground, and a solve on them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from dataset_folders import (
    calibrated,
    from_above,
    loaded,
    places,
    towards_lights,
    write_diligent,
    write_photo,
    write_rti,
    write_s3nerf,
    write_shadowneus_real,
)
from PIL import Image
from synthetic import BALL, HEAP, Look, Sphere, render

import shadowgraph
from calibration.calibration import save_calibration
from calibration.scenes.distant_camera import picture_camera
from calibration.scenes.importers import find_importer, import_folder
from capture.errors import CalibrationError, CaptureError, ReconstructionError
from reconstruct.initialization.choose_start import ShadingStart, choose_start
from reconstruct.labels.observer import Observer
from reconstruct.labels.outline import bright_object
from reconstruct.render.g_buffer import surface_maps
from reconstruct.run.presets import preset
from reconstruct.scene import build_scene
from reconstruct.source.source import RunOptions, open_source


def seen_from_above(shapes=(BALL,), side=64, n_lights=12):
    look = Look(width=side, height=side, n_lights=n_lights, kind="directional")
    return render(shapes, look, from_above(side))[1]


def scene_of(folder, **options):
    source, (pictures,), calibration = calibrated(folder, **options)
    scene = build_scene(pictures.stack, calibration, 320, pictures.shadow, pictures.mask)
    return replace(scene, ground_known=source.ground_is_known(RunOptions(**options)))


def start_of(scene):
    begin = choose_start(scene, Observer(scene), preset("draft", 0)[1])
    assert isinstance(begin, ShadingStart)
    return begin.surface()


def height_error(scene, surface, truth, where):
    """Median |height - true height| of pixels, mm, after taking off the median; scale and axes are as assumed."""
    maps = surface_maps(surface, replace(scene.posed_camera, ground_height=-1e9))
    assert maps.mask.numpy()[where].all()
    wrong = maps.points.numpy()[where][:, 2] - truth.points[where][:, 2]
    return float(np.median(np.abs(wrong - np.median(wrong))))


# --- DiLiGenT --------------------------------------------------------------------------------------------------------


@pytest.mark.slow  # 7 s
def test_a_ball_in_the_dark_is_found_by_shading_to_two_per_cent_of_its_radius(tmp_path):
    truth = seen_from_above((Sphere((0, 0, 40), 25),))
    intensities = np.linspace(0.5, 1.5, 12)[:, None] * np.array([1.0, 0.8, 0.6])
    write_diligent(tmp_path, truth, intensities)
    scene = scene_of(tmp_path)
    inner = truth.mask & (truth.normals[..., 2] > 0.4)
    assert height_error(scene, start_of(scene), truth, inner) < 0.5


def test_intensities_are_powers_and_sixteen_bits_are_linear(tmp_path):
    truth = seen_from_above(side=32, n_lights=6)
    intensities = np.random.default_rng(0).uniform(0.5, 1.5, (6, 3))
    write_diligent(tmp_path, truth, intensities)
    known = loaded(tmp_path)
    power = np.array([light.power for light in known.calibration.lights])
    np.testing.assert_allclose(power / power.mean(), intensities / intensities.mean(), rtol=1e-6)
    found = np.array([light.direction for light in known.calibration.lights])
    np.testing.assert_allclose(found, towards_lights(truth), atol=1e-6)
    assert known.is_linear and not known.ground_known and known.mask_path is not None
    assert [path.name for path in known.rgb_paths or ()] == [f"{i:03d}.png" for i in range(1, 7)]
    assert any("focal length 320 px" in note for note in known.notes) and any("scale" in note for note in known.notes)


def test_directions_in_columns_are_read_and_photos_go_by_number_without_a_list(tmp_path):
    truth = seen_from_above(side=32, n_lights=11)
    write_diligent(tmp_path, truth, np.ones((11, 3)))
    for name in ("filenames.txt", "light_intensities.txt"):
        (tmp_path / name).unlink()
    for i in range(11):
        (tmp_path / f"{i + 1:03d}.png").rename(tmp_path / f"frog_{i + 1}.png")
    np.savetxt(tmp_path / "light_directions.txt", towards_lights(truth).T)
    known = loaded(tmp_path)
    assert [path.name for path in known.rgb_paths or ()] == [f"frog_{i + 1}.png" for i in range(11)]
    np.testing.assert_allclose(known.calibration.lights[9].direction, towards_lights(truth)[9], atol=1e-6)


def test_without_a_mask_the_object_is_what_is_bright_before_a_dark_background():
    truth = seen_from_above((Sphere((0, 0, 40), 20),))
    rgb = truth.stack.rgb * np.where(truth.mask, 1, 0.01)[..., None].astype(np.float32)
    rgb[:, 32, 32] = 0  # dark paint
    found = bright_object(torch.from_numpy(rgb)).numpy() > 0.5
    assert (found != truth.mask).mean() < 0.02 and found[32, 32]
    assert bright_object(torch.from_numpy(truth.stack.rgb)).all()  # a light ground is no dark background


# --- RTI -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("decimal", "prefix"), [(".", ""), (",", "C:\\Captures\\My stone\\")])
def test_an_rti_folder_gives_directions_by_name_from_its_subfolders(tmp_path, decimal, prefix):
    truth = seen_from_above(side=32, n_lights=6)
    lines = write_rti(tmp_path, truth, decimal, prefix)
    (tmp_path / "assembly-files" / "stone.lp").write_text("\n".join([lines[0], *reversed(lines[1:])]))
    known = loaded(tmp_path)
    assert [path.name for path in known.rgb_paths or ()] == [f"stone_{i:02d}.png" for i in range(6, 0, -1)]
    found = np.array([light.direction for light in known.calibration.lights])
    np.testing.assert_allclose(found, towards_lights(truth)[::-1], atol=2e-6)
    assert any("by name" in note for note in known.notes)


def test_three_photos_are_too_few_to_read_a_shape_from_shading(tmp_path):
    write_rti(tmp_path, seen_from_above(side=32, n_lights=3))
    scene = scene_of(tmp_path)
    with pytest.raises(ReconstructionError, match="3 photos on an unknown ground; 4 or more"):
        choose_start(scene, Observer(scene), preset("draft", 0)[1])


# --- S3-NeRF and ShadowNeuS -------------------------------------------------------------------------------------------


def test_s3nerf_gives_camera_lights_and_the_ground_that_its_shading_tells(tmp_path):
    _, truth = render(HEAP, Look(width=64, height=64, n_lights=8))
    write_s3nerf(tmp_path, truth)
    known = loaded(tmp_path)
    calibration, true = known.calibration, truth.calibration
    shift = np.array([0.3, -0.2, -1.0])
    assert known.ground_known and calibration.ground_height == pytest.approx(-1.0, abs=0.05)  # of a height of 3.7
    assert (calibration.camera.fx, calibration.camera.cx) == pytest.approx((true.camera.fx, true.camera.cx))
    expected = true.world_from_camera.translation * 0.01 + shift
    np.testing.assert_allclose(calibration.world_from_camera.translation, expected)
    np.testing.assert_allclose(calibration.world_from_camera.rotation, true.world_from_camera.rotation, atol=1e-12)
    found = np.array([light.position for light in calibration.lights], float)
    np.testing.assert_allclose(found, places(truth) * 0.01 + shift)  # photo 002 has the second light, and so on
    assert known.is_linear and len(known.shadow_paths or ()) == 8 and known.mask_path is not None


def test_an_s3nerf_scene_without_ground_is_told_in_the_frame_of_its_picture(tmp_path):
    _, truth = render(HEAP, Look(width=64, height=64, n_lights=8))
    write_s3nerf(tmp_path, replace(truth, stack=replace(truth.stack, rgb=truth.stack.rgb * truth.mask[..., None])))
    known = loaded(tmp_path)
    assert not known.ground_known
    seen = known.calibration.world_from_camera.inverse().apply(
        np.array([light.position for light in known.calibration.lights], float)
    )
    expected = truth.calibration.world_from_camera.inverse().apply(places(truth)) * 0.01
    np.testing.assert_allclose(seen, expected, atol=1e-9)  # as the camera sees them, which is all that counts
    assert known.calibration.world_from_camera.rotation[2, 2] == -1


def test_an_s3nerf_capture_has_directions_and_the_picture_as_its_frame(tmp_path):
    truth = seen_from_above(side=32, n_lights=6)
    towards = towards_lights(truth)
    for i, rgb in enumerate(truth.stack.rgb):
        write_photo(tmp_path / "rgb" / f"{i + 1:03d}.png", rgb, "linear16")
    np.save(tmp_path / "light_direction_sdps.npy", towards[None].astype(np.float32))
    k = [[320.0, 0, 16], [0, 320, 16], [0, 0, 1]]
    (tmp_path / "params.json").write_text(json.dumps({"imhw": [32, 32], "K": k, "n_light": 6}))
    known = loaded(tmp_path)
    assert not known.ground_known and any("40 units away" in note for note in known.notes)
    found = np.array([light.position for light in known.calibration.lights], float)
    np.testing.assert_allclose(found, 40 * towards, atol=1e-4)


def test_photographs_of_shadowneus_come_with_camera_floor_and_lights(tmp_path):
    _, truth = render(HEAP, Look(width=64, height=48, n_lights=6))
    write_shadowneus_real(tmp_path, truth)
    known = loaded(tmp_path)
    calibration, true = known.calibration, truth.calibration
    assert known.ground_known and calibration.ground_height == 0.5 and known.mask_path is None
    camera = calibration.camera
    expected = (true.camera.fx, true.camera.fy, true.camera.cx, true.camera.cy)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(expected)
    np.testing.assert_allclose(calibration.world_from_camera.rotation, true.world_from_camera.rotation, atol=1e-12)
    found = np.array([light.position for light in calibration.lights], float)
    np.testing.assert_allclose(found, places(truth) * 0.01 + [0, 0, 0.5])


# --- which layout it is, and our own ----------------------------------------------------------------------------------


def test_an_imported_folder_reads_back_as_the_scene_that_was_found(tmp_path):
    truth = seen_from_above(side=32, n_lights=6)
    write_diligent(tmp_path / "theirs", truth, np.full((6, 3), 0.8))
    importer, scene = import_folder(tmp_path / "theirs", "train", tmp_path / "ours")
    again = loaded(tmp_path / "ours")
    assert "DiLiGenT" in importer.layout
    assert again.calibration == scene.calibration
    assert (again.is_linear, again.ground_known, again.notes) == (scene.is_linear, scene.ground_known, scene.notes)
    for old, new in zip(scene.rgb_paths or (), again.rgb_paths or (), strict=True):
        assert old.read_bytes() == new.read_bytes()
    mine, theirs = scene_of(tmp_path / "ours"), scene_of(tmp_path / "theirs")
    assert mine.mask is not None and theirs.mask is not None and torch.equal(mine.mask, theirs.mask)


def test_import_refuses_a_folder_that_holds_something_and_leaves_it_alone(tmp_path):
    write_rti(tmp_path / "theirs", seen_from_above(side=32, n_lights=6))
    (tmp_path / "ours").mkdir()
    (tmp_path / "ours" / "note.txt").write_text("mine")
    with pytest.raises(CaptureError, match="ours exists and is not empty"):
        import_folder(tmp_path / "theirs", "train", tmp_path / "ours")
    assert [path.name for path in (tmp_path / "ours").iterdir()] == ["note.txt"]


def test_a_folder_of_two_layouts_is_called_so_and_a_list_that_is_named_for_the_lights_makes_none(tmp_path):
    truth = seen_from_above(side=32, n_lights=6)
    one, both = tmp_path / "one", tmp_path / "both"
    for folder in (one, both):
        write_rti(folder, truth)
    write_diligent(both, truth, np.ones((6, 3)))
    with pytest.raises(CaptureError, match=r"DiLiGenT .* by light_directions.txt .* and RTI .* by assembly-files"):
        find_importer(both)
    photos = one / "jpeg-exports"
    (photos / "stone_07.png").write_bytes((photos / "stone_01.png").read_bytes())
    assert find_importer(one, one / "assembly-files" / "stone.lp") is None
    assert find_importer(one, tmp_path / "lights.json") is not None


def bare_photos(folder):
    """Six photos in a folder of their own, and what they show."""
    truth = seen_from_above(side=32, n_lights=6)
    write_rti(folder / "theirs", truth)
    return truth, (folder / "theirs" / "jpeg-exports").rename(folder / "capture")


@pytest.mark.parametrize(("name", "is_named"), [("lights.csv", False), ("stone.lp", True)])
def test_a_list_with_the_light_of_every_photo_needs_no_board(tmp_path, name, is_named):
    """Wherever it lies: its lights, in the picture's frame."""
    truth, capture = bare_photos(tmp_path)
    names = [f"stone_{i + 1:02d}.png" for i in range(6)]
    rows = [f"{name};{x};{y};{z}" for name, (x, y, z) in zip(names, towards_lights(truth), strict=True)]
    file = (tmp_path if is_named else capture) / name
    file.write_text("\n".join(["6", *rows]).replace(";", " ") if is_named else "\n".join(["photo;x;y;z", *rows]))
    source, _, calibration = calibrated(capture, lights=str(file) if is_named else "auto")
    assert source.known is not None and not source.ground_is_known(RunOptions())
    assert [light.photo for light in calibration.lights] == names
    found = np.array([light.direction for light in calibration.lights])
    np.testing.assert_allclose(found, towards_lights(truth), atol=1e-5)
    assert calibration.unit == "scene" and any("distant one was assumed" in x for x in calibration.residuals["notes"])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("two.lp", "stone_01.png 0.1 0.2\nstone_02.png 0.3 0.1\n"),
        ("lights.csv", "photo,hue,gain\nstone_01.png,1,2\n"),
        ("lights.json", '{"suns": []}'),
        ("places.csv", "photo,x,y,z\n" + "".join(f"stone_{i:02d}.png,{30 * i},90,-500\n" for i in range(1, 7))),
        ("places_mm.csv", "photo,x_mm,y_mm,z_mm\n" + "".join(f"stone_{i:02d}.png,9,9,500\n" for i in range(1, 7))),
        ("near.csv", "photo,x,y,z\n" + "".join(f"stone_{i:02d}.png,{i},1,2\n" for i in range(1, 7))),
    ],
)
def test_a_file_that_the_user_names_is_the_one_that_is_refused(tmp_path, name, content):
    """Not its photos, in which then a board is looked for."""
    (_, capture), file = bare_photos(tmp_path), tmp_path / name
    file.write_text(content)
    with pytest.raises(CalibrationError) as refused:
        open_source(capture, RunOptions(lights=str(file)))
    said = str(refused.value)
    assert str(file) in said and "board in" not in said and ("Lights are read from" in said or "needed" in said)


@pytest.mark.parametrize("fits", [True, False])
def test_photos_in_room_light_beside_listed_ones_need_no_board(tmp_path, fits):
    """What only looks like the board's photo shows none: the list decides, and is named where it fits no photos."""
    truth = seen_from_above(HEAP, side=64, n_lights=8)
    lines = write_rti(tmp_path / "theirs", truth)[1:]
    capture = (tmp_path / "theirs" / "jpeg-exports").rename(tmp_path / "capture")
    write_photo(capture / "room.png", truth.stack.rgb.mean(0) * 0.8)
    file = tmp_path / "some.lp"
    file.write_text("\n".join(lines).replace("jpg", "png").replace("stone", "stone" if fits else "bust"))
    if fits:
        known = open_source(capture, RunOptions(lights=str(file))).known
        assert known is not None and len(known.rgb_paths or ()) == 8
    else:
        with pytest.raises(CaptureError, match=r"some.lp lists 8 lights and .* holds 9 photos"):
            open_source(capture, RunOptions(lights=str(file)))


def test_a_calibration_of_another_run_brings_camera_and_ground_to_photos_without_a_board(tmp_path):
    truth, capture = bare_photos(tmp_path)
    names = [f"stone_{i + 1:02d}.png" for i in range(6)]
    lights = [replace(light, photo=name) for light, name in zip(truth.calibration.lights, names, strict=True)]
    save_calibration(replace(truth.calibration, lights=tuple(lights)), tmp_path / "calibration.json")
    source, _, calibration = calibrated(capture, lights=str(tmp_path / "calibration.json"))
    assert source.ground_is_known(RunOptions()) and calibration.unit == truth.calibration.unit
    assert calibration.camera == truth.calibration.camera


def test_the_focal_length_of_exif_is_the_cameras_unless_the_picture_was_cropped(tmp_path):
    """70 mm on 36 x 24 mm: 70 / 43.27 of the picture's diagonal."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({41989: 70, 40962: 300, 40963: 200})
    for name, size in (("whole.jpg", (150, 100)), ("cropped.jpg", (100, 100))):
        Image.new("RGB", size, (90, 90, 90)).save(tmp_path / name, exif=exif)
    whole, said = picture_camera([tmp_path / "whole.jpg"])
    assert whole.camera.fx == pytest.approx(70 / 43.27 * np.hypot(150, 100)) and "EXIF" in said
    cropped, said = picture_camera([tmp_path / "cropped.jpg"])
    assert cropped.camera.fx == 1000 and "assumed" in said


# --- lights from another file, and a mask of one's own ---------------------------------------------------------------


def test_a_file_of_lights_replaces_those_of_a_scene(tmp_path):
    _, truth = render(HEAP, Look(width=48, height=36, n_lights=4))
    write_shadowneus_real(tmp_path / "scene", truth)
    names = [f"{i:03d}.png" for i in range(4)]
    moved = places(truth) * 0.01 + [0.1, 0, 0.5]
    rows = [{"photo": name, "position": place.tolist()} for name, place in zip(names, moved, strict=True)]
    (tmp_path / "lights.json").write_text(json.dumps({"lights": rows}))
    calibration = calibrated(tmp_path / "scene", lights=str(tmp_path / "lights.json"))[2]
    np.testing.assert_allclose(np.array([x.position for x in calibration.lights], float), moved)
    powers = np.array([light.power for light in calibration.lights])
    assert np.ptp(powers) == 0 and powers[0, 0] == pytest.approx(6.4, rel=0.5)  # 96 000 mm^2 at 0.01, albedo 0.6 as 0.9
    assert any("lights.json" in note for note in calibration.residuals["notes"])


def test_a_scene_needs_no_calibration_of_its_lights(tmp_path):
    write_rti(tmp_path, seen_from_above(side=32, n_lights=4))
    with pytest.raises(CaptureError, match=r"--lights shading: .* comes with its lights"):
        open_source(tmp_path, RunOptions(lights="shading"))


# --- the command -----------------------------------------------------------------------------------------------------


def test_import_says_what_was_found_and_what_was_assumed(tmp_path, capsys):
    write_rti(tmp_path / "stone", seen_from_above(side=32, n_lights=6))
    assert shadowgraph.main(["import", str(tmp_path / "stone"), "--out", str(tmp_path / "ours")]) == 0
    said = capsys.readouterr().out
    assert "RTI (.lp): 6 photos with camera and lights, no mask, ground unknown" in said and "focal length 320" in said
    assert sorted(path.name for path in (tmp_path / "ours").iterdir()) == ["calibration.json", "import.json", "photos"]


def test_check_judges_photos_without_a_ground_by_their_lights_exposure_and_powers(tmp_path):
    truth = seen_from_above(side=48, n_lights=9)
    stated = np.ones((9, 3))
    stated[2] = 1 / 1.5  # the photo is brighter than its list says
    write_diligent(tmp_path / "stone", truth, np.ones((9, 3)))
    np.savetxt(tmp_path / "stone" / "light_intensities.txt", stated)
    assert shadowgraph.main(["check", str(tmp_path / "stone"), "--out", str(tmp_path / "out")]) == 0
    said = json.loads((tmp_path / "out" / "check.json").read_text())
    assert said["verdict"] == "poor" and "9 of 9 photos can be used" in said["sentence"]
    told = said["numbers"]["photos_of_another_power"]
    assert list(told) == ["003.png"] and told["003.png"] == pytest.approx(1.5, abs=0.1)
    assert said["numbers"]["light_spread"] > 0.15


def test_an_import_that_fails_leaves_nothing(tmp_path, capsys):
    write_diligent(tmp_path / "theirs", seen_from_above(side=32, n_lights=6), np.ones((6, 3)))
    (tmp_path / "theirs" / "mask.png").write_text("no picture")
    assert shadowgraph.main(["import", str(tmp_path / "theirs"), "--out", str(tmp_path / "ours")]) == 2
    assert "mask.png" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["theirs"]
