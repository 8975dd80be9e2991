"""What the archive of a run's stage is made of: its mesh as one packed block, its pictures, and its facts."""

import gzip
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from calibration.camera import Camera
from calibration.posed_camera import PosedCamera
from reconstruct.export.stage_scene import FirstView, StageScene, detail_pictures, stage_scene
from reconstruct.render.studio import Studio, studio_of
from reconstruct.stored_run.maps import read_thumbnails
from reconstruct.stored_run.stage_pack import stage_archive
from reconstruct.stored_run.stored_run import StoredRun
from viewer.report.document import jpeg
from viewer.stage.facts import BACKGROUND, first_window, home_pose, lit_photos, stage_facts

QUALITY, NORMAL_QUALITY, PHOTO_QUALITY = 90, 95, 82  # JPEG
LEAST_GAIN = 1.3  # of the detail over the picture that the page opens with, to be worth its bytes
MOST_PIXELS = 1 << 24  # of a detail: what a graphics card holds besides the rest
BLOCK, OBJECT, NORMALS, GROUND, FIRST = "scene.bin", "object.jpg", "normals.jpg", "ground.jpg", "first.jpg"
FINE = "fine.jpg", "fine-normals.jpg"
FIRST_SIDE, FIRST_QUALITY = 400, 80  # px, JPEG
PACKING = 6  # of gzip: 9 takes three times as long for a hundredth
STEPS_16 = 65535  # of a coordinate: 3 micrometres on 200 mm
NORMAL_16 = 32767


def packed_stage(run: StoredRun) -> bytes:
    """Return the archive of a finished run's stage (reconstruct/stored_run/stage_pack.py).

    Raises:
        UserError: a file of the run cannot be used.
    """
    return stage_archive(run.run_dir, *facts_and_parts(run))


def facts_and_parts(run: StoredRun) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return what the page's scripts read, whose "addresses" are names of parts, and the parts by their names.

    Raises:
        UserError: a file of the run cannot be used.
    """
    studio, scene = studio_of(np.asarray(run.mesh.bounds)), stage_scene(run)
    first, (block, places) = first_view(run, studio, scene), packed(scene, studio.centre, studio.radius)
    parts = {
        BLOCK: block,
        OBJECT: jpeg(scene.object_picture, QUALITY),
        GROUND: jpeg(scene.ground_picture, QUALITY),
        FIRST: jpeg(first.picture(np.array(BACKGROUND, np.uint8)), FIRST_QUALITY),
    }
    named: dict[str, Any] = {"block": BLOCK, "object": OBJECT, "ground": GROUND, "first": FIRST}
    named |= {"normals": None, "fine": None, "fineNormals": None}
    if scene.normal_picture is not None:
        named["normals"], parts[NORMALS] = NORMALS, jpeg(scene.normal_picture, NORMAL_QUALITY, is_exact=True)
    photos = read_thumbnails(run.run_dir, dict.fromkeys(name for name, *_ in lit_photos(run)))
    named["photos"] = {photo: f"photo{i}.jpg" for i, photo in enumerate(photos)}
    parts |= {named["photos"][photo]: jpeg(picture, PHOTO_QUALITY) for photo, picture in photos.items()}
    if (fine := _fine(run, scene)) is not None:
        named["fine"], named["fineNormals"] = FINE
        parts |= dict(zip(FINE, fine, strict=True))
    return stage_facts(run, studio, scene, places, first.lamp, named), parts


def first_view(run: StoredRun, studio: Studio, scene: StageScene) -> FirstView:
    """Return what stands where the page's own first picture will, until that is drawn; and its lamp."""
    left, top, right, _ = first_window(scene.vertices, run.fields, studio)
    focal = FIRST_SIDE / (right - left)
    camera = Camera(FIRST_SIDE, FIRST_SIDE, focal, focal, -left * focal - 0.5, -top * focal - 0.5)
    place = PosedCamera(camera, home_pose(run.fields, studio), run.fields.ground_height)
    return FirstView(run.fields, place, studio, scene)


def _fine(run: StoredRun, scene: StageScene) -> tuple[bytes, bytes] | None:
    """Return albedo and normals of a run's detail, on the photo's own pixels, where the page opens with fewer."""
    detail = run.detail
    if detail is None or detail.confidence.size > MOST_PIXELS:
        return None
    if max(detail.confidence.shape) < LEAST_GAIN * max(scene.object_picture.shape):
        return None
    albedo, normals = detail_pictures(detail)
    return jpeg(albedo, QUALITY), jpeg(normals, NORMAL_QUALITY, is_exact=True)


def packed(scene: StageScene, centre: Float[np.ndarray, "3"], radius: float) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Pack the mesh, for scene.js to unpack; return the block, and of each of its arrays "offset" (bytes) and "count".

    Coordinates become (x - centre) / radius on 16 bits, bytes lie in planes, corners are differences.
    """
    places = (scene.vertices - centre) / radius
    low, high = places.min(0), places.max(0)
    steps = np.round((places - low) / np.maximum(high - low, 1e-9) * STEPS_16).astype(np.uint16)
    normals = np.round(NORMAL_16 * scene.normals).astype(np.int16)
    corners = scene.faces.reshape(-1).astype(np.int64)
    moves = np.diff(corners, prepend=0)
    soft = scene.soft
    bounce_scale = float(soft.bounce.abs().max()) or 1.0
    zigzag = np.where(moves < 0, -2 * moves - 1, 2 * moves).astype(np.uint32)
    arrays = {
        "places": (_planes(steps.T), len(steps)),
        "normals": (_planes(normals.T.view(np.uint16)), len(steps)),
        "colours": (scene.colours.T, len(steps)),
        "evidence": (scene.evidence, len(steps)),
        "gloss": (scene.gloss.T, len(steps)),
        "corners": (_planes(zigzag), len(corners)),
        "sky": (_share(soft.sky.numpy()), len(steps)),
        "below": (_share((soft.sky if soft.below is None else soft.below).numpy()), len(steps)),
        "bounce": (np.round(127 * soft.bounce.numpy().T / bounce_scale).astype(np.int8), len(steps)),
        "tint": (_share(soft.tint.numpy()).T, len(steps)),
        "groundSky": (_share(scene.ground_sky), len(scene.ground_sky)),
    }
    parts, content, offset = {}, [], 0
    for name, (array, count) in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        parts[name] = {"offset": offset, "count": count}
        content.append(data)
        offset += len(data)
    parts["places"] |= {"low": low.tolist(), "high": high.tolist()}
    parts["bounce"] |= {"scale": bounce_scale}
    return gzip.compress(b"".join(content), PACKING, mtime=0), parts


def _share(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)


def _planes(values: Shaped[np.ndarray, "..."]) -> UInt8[np.ndarray, "bytes ..."]:
    """Split whole numbers into planes of their bytes, the highest first, which gzip packs best."""
    largest_first = np.ascontiguousarray(values).astype(values.dtype.newbyteorder(">"))
    return np.moveaxis(largest_first[..., None].view(np.uint8), -1, 0)
