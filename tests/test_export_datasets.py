"""Runs in the layouts of other programs: read back, and their cameras checked by formulas written here."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_run import fields_of, make_truth, mesh_of
from laid_anew import laid_anew
from scipy.spatial.transform import Rotation

from calibration.calibration import save_calibration
from calibration.lights.files import read_lights
from calibration.scenes.importers import find_importer
from capture.errors import ReconstructionError
from capture.photos.photo import read_alpha, read_photo, write_picture
from reconstruct.export.dataset import centred
from reconstruct.export.datasets import colmap_camera
from reconstruct.export.export import ExportOptions, export
from reconstruct.fields import save_fields

LENS = (-0.12, 0.05, 0.001, -0.002, 0.01)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run folder with what an export reads, and the truth it was made from."""
    folder = tmp_path_factory.mktemp("runs") / "heap"
    folder.mkdir()
    truth = make_truth(width=64, n_lights=4)
    save_calibration(truth.calibration, folder / "calibration.json")
    fields = fields_of(truth)
    save_fields(fields, folder / "fields.safetensors")
    mesh_of(fields).export(folder / "mesh.ply")
    return folder, truth


def exported(finished, name, tmp_path, photos=None) -> Path:
    out = tmp_path / name
    export(finished[0], name, out, ExportOptions(photos=photos))
    return out


def seen_at(truth, point):
    """Where the camera sees a world point, by the pinhole formula; pixel centres are whole numbers."""
    camera, pose = truth.calibration.camera, truth.calibration.world_from_camera
    x, y, z = pose.rotation.T @ (np.array(point) - pose.translation)
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


POINTS = [(0.0, 0.0, 0.0), (30.0, -15.0, 44.0), (-60.0, 45.0, 10.0)]


def test_the_layout_of_shadowneus_reads_back_with_camera_lights_and_ground(finished, tmp_path):
    out, truth = exported(finished, "shadowneus", tmp_path), finished[1]
    importer = find_importer(out)
    assert importer is not None
    known = importer.load(out, "train")
    found, true = known.calibration, truth.calibration
    assert found.camera.fx == pytest.approx(true.camera.fx, rel=1e-9)
    np.testing.assert_allclose(found.world_from_camera.matrix(), true.world_from_camera.matrix(), atol=1e-9)
    assert found.ground_height == 0.0 and known.mask_path is not None
    for new, old in zip(found.lights, true.lights, strict=True):
        np.testing.assert_allclose(new.position, old.position, atol=1e-9)
    mask = read_alpha(known.mask_path)
    assert mask is not None
    assert ((mask > 0.5) != truth.mask).mean() < 0.02


def test_an_rti_reads_back_with_directions_and_places(finished, tmp_path):
    out, truth = exported(finished, "rti", tmp_path), finished[1]
    calibration = truth.calibration
    posed_camera = replace(calibration.posed_camera, ground_height=0.0)
    names = [light.photo for light in calibration.lights]
    places = np.array([light.position for light in calibration.lights], float)
    towards = places - posed_camera.looked_at()
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    given = read_lights(out / "heap.lp", names, posed_camera)
    np.testing.assert_allclose(np.array([x.direction for x in given.lights], float), towards, atol=1e-6)
    given = read_lights(out / "heap.dome", names, posed_camera)
    np.testing.assert_allclose(np.array([x.position for x in given.lights], float), places, atol=1e-6)
    lines = (out / "heap.lp").read_text().splitlines()
    assert lines[0] == "4" and all(len(line.split()) == 4 for line in lines[1:])  # what relight's reader asks for
    project = json.loads((out / "heap.relight").read_text())
    assert project["folder"] == "." and all((out / image["filename"]).is_file() for image in project["images"])
    assert find_importer(out) is not None


def test_a_point_seen_through_colmaps_files_is_where_our_camera_sees_it(finished, tmp_path):
    out, truth = exported(finished, "colmap", tmp_path), finished[1]
    sparse = out / "sparse" / "0"
    _, model, width, height, *numbers = (sparse / "cameras.txt").read_text().splitlines()[1].split()
    fx, fy, cx, cy = map(float, numbers)
    assert (model, int(width), int(height)) == ("PINHOLE", 64, 48)
    lines = [line for line in (sparse / "images.txt").read_text().split("\n") if not line.startswith("#")]
    w, x, y, z, *translation = map(float, lines[0].split()[1:8])
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    for point in POINTS:
        at = rotation @ np.array(point) + translation
        pixel = np.array([fx * at[0] / at[2] + cx, fy * at[1] / at[2] + cy])
        np.testing.assert_allclose(pixel, seen_at(truth, point) + 0.5, atol=1e-6)  # counted from the pixel's corner
    assert (out / "images" / lines[0].split()[9]).is_file()
    assert len([line for line in lines[::2] if line]) == 4


def test_every_camera_is_exported_where_it_stands_also_that_of_another_object_pose(finished, tmp_path):
    truth = finished[1]
    folder = laid_anew(tmp_path / "whole", truth)
    nerf, colmap = exported((folder, truth), "nerf", tmp_path), exported((folder, truth), "colmap", tmp_path)
    frames = json.loads((nerf / "transforms.json").read_text())["frames"]
    assert len(frames) == 8 and len({frame["file_path"] for frame in frames}) == 8
    for first, second in zip(frames[:4], frames[4:], strict=True):
        for name in ("transform_matrix", "transform_matrix_sun"):
            np.testing.assert_allclose(np.array(first[name])[:, 2:], np.array(second[name])[:, 2:], atol=1e-5)
    lines = (colmap / "sparse" / "0" / "images.txt").read_text().splitlines()[2::2]
    poses = np.array([line.split()[1:8] for line in lines], float)
    np.testing.assert_allclose(poses[0], poses[4], atol=1e-6)
    points = np.array([x.split()[1:4] for x in (colmap / "sparse" / "0" / "points3D.txt").read_text().splitlines()[1:]])
    half = len(points) // 2
    away = np.linalg.norm(points[:half].astype(float) - points[half:].astype(float), axis=1)
    assert np.quantile(away, 0.99) < 0.1  # all but pixels on outlines


def test_a_point_seen_through_nerfs_transforms_is_where_our_camera_sees_it(finished, tmp_path):
    out, truth = exported(finished, "nerf", tmp_path), finished[1]
    document = json.loads((out / "transforms.json").read_text())
    frame = document["frames"][2]
    world_from_camera = np.array(frame["transform_matrix"])
    for point in POINTS:
        x, y, z, _ = np.linalg.inv(world_from_camera) @ np.array([*point, 1.0])
        assert z < 0  # such cameras look along -z, with y up
        pixel = [document["fl_x"] * x / -z + document["cx"], -document["fl_y"] * y / -z + document["cy"]]
        np.testing.assert_allclose(pixel, seen_at(truth, point) + 0.5, atol=1e-6)
    sun = np.array(frame["transform_matrix_sun"])
    np.testing.assert_allclose(sun[:3, 3], truth.calibration.lights[2].position)
    np.testing.assert_allclose(sun[:3, :3] @ sun[:3, :3].T, np.eye(3), atol=1e-12)
    assert (out / frame["file_path"]).is_file()


def test_lenses_keep_their_terms_under_colmaps_names(finished):
    camera = replace(finished[1].calibration.camera, distortion=LENS)
    assert colmap_camera(camera)[0] == "FULL_OPENCV" and len(colmap_camera(camera)[1]) == 12
    assert colmap_camera(replace(camera, distortion=(*LENS[:4], 0.0)))[0] == "OPENCV"
    assert colmap_camera(replace(camera, distortion=(*LENS[:4], 0.0), fisheye=True))[0] == "OPENCV_FISHEYE"


def test_a_centred_camera_sees_nothing_beyond_the_picture_it_is_made_from(finished):
    camera = replace(finished[1].calibration.camera, distortion=LENS, cx=35.0, fy=140.0)
    plain = centred(camera)
    assert (plain.cx, plain.cy, plain.fx) == (31.5, 23.5, plain.fy) and not any(plain.distortion)
    pixels = camera.project(plain.unproject(plain.pixel_grid()))
    assert pixels.min() > -1e-2 and (pixels[..., 0] < 63.01).all() and (pixels[..., 1] < 47.01).all()
    assert pixels[..., 0].min() < 1 or pixels[..., 1].min() < 1 or pixels[..., 0].max() > 62  # and loses little


def test_photos_of_the_capture_are_exported_where_they_are_given(finished, tmp_path):
    truth = finished[1]
    for light, rgb in zip(truth.calibration.lights, truth.stack.rgb, strict=True):
        write_picture(tmp_path / "capture" / "photos" / light.photo, rgb)
    out = exported(finished, "shadowneus", tmp_path, tmp_path / "capture")
    original = read_photo(tmp_path / "capture" / "photos" / "photo_01.png").rgb
    np.testing.assert_array_equal(read_photo(out / "train" / "photo_01.png").rgb, original)


def test_a_missing_photo_is_named_nothing_is_left_and_a_folder_that_holds_something_is_left_alone(finished, tmp_path):
    (tmp_path / "capture").mkdir()
    with pytest.raises(ReconstructionError, match=r"capture holds no photo_00\.png.*--photos"):
        exported(finished, "rti", tmp_path, tmp_path / "capture")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture"]
    (tmp_path / "rti").mkdir()
    (tmp_path / "rti" / "note.txt").write_text("mine")
    with pytest.raises(ReconstructionError, match="exists and is not empty"):
        exported(finished, "rti", tmp_path)
    assert [path.name for path in (tmp_path / "rti").iterdir()] == ["note.txt"]


@pytest.mark.parametrize("name", ["shadowneus", "rti", "colmap", "nerf"])
def test_every_layout_can_be_had_as_a_zip(finished, tmp_path, name):
    written = export(finished[0], name, tmp_path / "heap.zip")
    assert "4 pictures of the relit surface, camera and lights" in written.sentence()
