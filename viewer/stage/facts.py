"""What the page's scripts read about a scene besides its mesh and pictures: one JSON object.

The cameras of a run and the photos that they took, each with its light, as the page's scripts read them.

All are in the frame of the surface: what a camera saw in another object pose is carried there with its lights, so that
the page knows one object that does not move. The first camera is that of the run's pictures; the others show their
photos.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.light import Light
from calibration.pose import Pose
from capture.errors import UserError
from capture.photos.photo import decode_srgb
from reconstruct.appearance.brdf import MATERIALS, SHARPNESS, facing_reflectances
from reconstruct.export.export import UNIT_WORDS
from reconstruct.export.stage_scene import FULL_WEIGHT, GROUND_HALF, LAMP, SKY, StageScene
from reconstruct.fields import SolvedScene
from reconstruct.render.studio import KEY_DISTANCE, LAMP_RADII, Studio, direction_of, looking_at, towards
from reconstruct.stored_run.stage_pack import FORMAT
from reconstruct.stored_run.stored_run import StoredRun
from viewer.display.run_follower import size_text

MOST_LIGHTS = 200  # markers that are drawn
STRAIGHT_DOWN = 1.5  # rad: above this elevation a camera's azimuth is told by its picture's lower edge
BACKGROUND = (24, 26, 31)  # sRGB, as of the page's style
FADE = (2.5, 7.0)  # radii of the object from its middle, over which ground outside the photo goes into the background
LARGEST_LAMP = 3.0  # radii of the object
OUTLINE_WAYS = 200  # 8 degrees apart: an outline is short by less than a hundredth
FIRST_MARGIN = 1.6  # side of the first picture over the object's larger one
LEGEND = {  # by the evidence of a run
    "seen": ("seen", "seen in the photos"),
    "shadow": ("shadow", "held by shadows"),
    "unconstrained": ("guess", "a guess"),
}


def camera_facts(seen: SolvedScene, studio: Studio) -> dict[str, Any]:
    """Return a capture camera in shares of its picture's width and height, so that it holds at every size.

    `home` is the view from its place, towards the object: radians and world length.
    """
    camera, pose = seen.camera, seen.world_from_camera
    pose = pose if seen.object_from_world is None else seen.object_from_world @ pose
    offset = pose.translation - studio.centre
    azimuth, elevation = direction_of(offset)
    if elevation > STRAIGHT_DOWN:
        azimuth = direction_of(pose.rotation[:, 1])[0]
    return {
        "view": seen.view,
        "eye": pose.translation.tolist(),
        "axes": pose.rotation.T.tolist(),  # right, down, forward
        "focal": [camera.fx / camera.width, camera.fy / camera.height],
        "middle": [(camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height],
        "distortion": list(camera.distortion),
        "fisheye": camera.fisheye,
        "field": camera.field,
        "size": [camera.width, camera.height],
        "home": {"azimuth": azimuth, "elevation": elevation, "distance": float(np.linalg.norm(offset))},
    }


def lit_photos(run: StoredRun) -> list[tuple[str, int, Light, SolvedScene]]:
    """Return each photo's name, the number of its camera, its light, and what that camera saw.

    A photo of a further view is called VIEW/NAME, as its small copy is. Without a calibration that can be read there
    are none.
    """
    try:
        views = run.views
    except UserError:
        return []
    return [
        (f"{name}/{light.photo}" if number else light.photo, number, light, seen)
        for number, (name, calibration, seen) in enumerate(views)
        for light in calibration.lights
    ][:MOST_LIGHTS]


def light_facts(run: StoredRun, studio: Studio) -> list[dict[str, Any]]:
    """Return the calibrated lights as places; a direction is a place far away."""
    return [
        {
            "photo": name,
            "camera": number,
            "place": _place(light, seen, studio).tolist(),
            "used": light.used,
            "far": light.position is None,
        }
        for name, number, light, seen in lit_photos(run)
    ]


def _place(light: Light, seen: SolvedScene, studio: Studio) -> Float[np.ndarray, "3"]:
    motion = seen.object_from_world
    if light.position is not None:
        return seen.in_common(light.position[None])[0]
    assert light.direction is not None
    direction = light.direction if motion is None else motion.rotate(light.direction[None])[0]
    return studio.centre + KEY_DISTANCE * studio.radius * direction


def stage_facts(
    run: StoredRun,
    studio: Studio,
    scene: StageScene,
    parts: Mapping[str, Any],
    lamp: tuple[float, float],
    addresses: Mapping[str, Any],
) -> dict[str, Any]:
    """Return what the page's scripts read. World lengths, radians, linear colours.

    Args:
        parts: of the packed mesh, what `packed` says of them.
        lamp: azimuth and elevation of the first one, rad.
        addresses: of the parts: "block", "object", "ground", "first", "photos" by name; "normals", and "fine" with
            "fineNormals", or None.
    """
    fields = run.fields
    return {
        "format": FORMAT,
        "name": run.name,
        "unit": UNIT_WORDS[run.unit],
        "size": size_text(run.mesh.extents, run.unit),
        "legend": legend(run),
        "centre": studio.centre.tolist(),
        "radius": studio.radius,
        "bounds": np.asarray(run.mesh.bounds).tolist(),
        "spacing": fields.grid.spacing,
        "groundHeight": fields.ground_height,
        "groundMean": decode_srgb(scene.ground_mean).tolist(),
        "background": decode_srgb(np.array(BACKGROUND, np.uint8)).tolist(),
        "fade": list(FADE),
        "groundHalf": GROUND_HALF,
        "isWhole": any(one.object_from_world is not None for one in fields.further),
        "cameras": [camera_facts(seen, studio) for seen in fields.views()],
        "outline": outline_points((scene.vertices - studio.centre) / studio.radius).tolist(),
        "first": first_window(scene.vertices, fields, studio),
        "lamp": {
            "azimuth": float(lamp[0]),
            "elevation": float(lamp[1]),
            "distance": KEY_DISTANCE * studio.radius,
            "radius": LAMP_RADII * studio.radius,
            "strength": LAMP,
        },
        "largestLamp": LARGEST_LAMP * studio.radius,
        "ambient": SKY,
        "lights": light_facts(run, studio),
        "parts": parts,
        "objectWindow": list(scene.object_window),
        "gloss": _gloss(fields, scene),
        "materials": _materials(),
        "addresses": dict(addresses),
    }


def legend(run: StoredRun) -> list[dict[str, Any]]:
    """Return what is known of the surface: signs of the page's style, words, and shares where the run states them."""
    try:
        evidence = run.report.get("mesh", {}).get("evidence") or {}
    except UserError:  # a run without a report can be looked at, too
        evidence = {}
    return [
        {"sign": sign, "words": words, "share": float(evidence[kind]["share"]) if kind in evidence else None}
        for kind, (sign, words) in LEGEND.items()
    ]


def home_pose(fields: SolvedScene, studio: Studio) -> Pose:
    """Return world_from_camera of the first view: from where the photos were taken, towards the object."""
    home = camera_facts(fields.views()[0], studio)["home"]
    eye = studio.centre + home["distance"] * towards(home["azimuth"], home["elevation"])
    return looking_at(eye, studio.centre)


def outline_points(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the points that reach farthest in any of OUTLINE_WAYS directions: all sides' outlines touch them."""
    k = np.arange(OUTLINE_WAYS) + 0.5
    z, turn = 1 - 2 * k / OUTLINE_WAYS, k * np.pi * (3 - np.sqrt(5))  # evenly over the sphere
    ways = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    return points[np.unique((points @ ways).argmax(0))]


def first_window(vertices: Float[np.ndarray, "n 3"], fields: SolvedScene, studio: Studio) -> list[float]:
    """Return what the first picture shows: a square around the object with some of its ground, in the first view.

    Left, top, right and bottom are tangents from its axis.
    """
    pose = home_pose(fields, studio)
    seen = (vertices - pose.translation) @ pose.rotation
    slopes = seen[:, :2] / seen[:, 2:]
    low, high = slopes.min(0), slopes.max(0)
    middle, half = (low + high) / 2, FIRST_MARGIN * (high - low).max() / 2
    return [*(middle - half).tolist(), *(middle + half).tolist()]


def _gloss(fields: SolvedScene, scene: StageScene) -> dict[str, Any] | None:
    if fields.gloss is None or not scene.gloss.shape[1]:
        return None
    lobes = fields.gloss.lobes[: scene.gloss.shape[1]] * scene.gloss_scale
    return {"lobes": lobes.flatten(1).tolist(), "full": FULL_WEIGHT}


def _materials() -> dict[str, Any]:
    """Return the lobes' constants, and materials to put in the place of the recovered one."""
    chosen = {
        name: {
            "albedo": None if material.albedo is None else list(material.albedo),
            "lobes": material.coefficients().flatten().tolist(),
        }
        for name, material in MATERIALS.items()
    }
    return {"sharpness": list(SHARPNESS), "facing": facing_reflectances().tolist(), "chosen": chosen}
