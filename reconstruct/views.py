"""Scenes of several cameras that look at one object on one ground, in one world frame.

A scene is what one camera sees, with its own lights, exposure and photos. Functions of the solver take one scene or a
tuple of them: one is the same as a tuple of one. Photos and lights are numbered through all scenes, in their order.

Where the object was laid anew, the scenes of that object pose keep their own world, in which the ground is level:
pictures are read there. Their `object_from_world` carries them into the frame of the surface (`placed`), in which rays
are cast. A ray knows its length to its own ground, so that no code that casts rays needs a ground in that frame.
"""

from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from capture.errors import ReconstructionError, Remedy
from reconstruct.scene import Scene, carried_lights

SAME_GROUND = 1e-3  # of the cameras' height: one ground for all
Thing = TypeVar("Thing")
Scenes = tuple[Scene, ...]
Some = TypeVar("Some", Scene, Scenes)  # a function of one that gives the same of several


def each(given: Thing | tuple[Thing, ...]) -> tuple[Thing, ...]:
    """Return a tuple of one thing, or the tuple itself."""
    return given if isinstance(given, tuple) else (given,)


def first_photos(scenes: Scenes) -> list[int]:
    """Return the number of each scene's first photo."""
    return np.cumsum([0, *(len(scene.lights) for scene in scenes[:-1])]).tolist()


def photo_names(scenes: Scenes) -> tuple[str, ...]:
    """Return the names of all photos; with the name of their view, where it has one."""
    return tuple(f"{scene.view}/{name}" if scene.view else name for scene in scenes for name in scene.photo_names)


def placed(scene: Some) -> Some:
    """Return a scene, or scenes, with camera, lights and beams in the frame of the surface.

    A scene whose world is that frame is returned as it is. In the others the ground is no longer z = ground_height:
    they are for casting rays, not for reading pictures.
    """
    if isinstance(scene, tuple):
        return tuple(placed(one) for one in scene)
    motion = scene.object_from_world
    if motion is None:
        return scene

    def turned(directions: Tensor) -> Tensor:
        return torch.from_numpy(motion.rotate(directions.double().numpy())).float()

    return replace(
        scene,
        eye=torch.from_numpy(motion.apply(scene.eye.double().numpy())).float(),
        directions=turned(scene.directions),
        forward=turned(scene.forward),
        lights=torch.from_numpy(carried_lights(scene.lights.double().numpy(), motion)).float(),
        axis=turned(scene.axis),
        world_from_camera=motion @ scene.world_from_camera,
        object_from_world=None,
    )


def check_common(scenes: Scenes) -> None:
    """Check that scenes can be solved together.

    Raises:
        ReconstructionError: they differ in unit or ground, or one of several has an unknown or an uneven ground.
    """
    first = scenes[0]
    if first.object_from_world is not None:
        raise ValueError("the first scene's world is the frame of the surface: it has no object_from_world")
    for scene in scenes[1:]:
        height = abs(float(first.eye[2]) - first.ground_height)
        is_off = abs(scene.ground_height - first.ground_height) > SAME_GROUND * height
        if scene.unit != first.unit or (scene.object_from_world is None and is_off):
            raise ReconstructionError(
                f"the ground of view {scene.view} is z = {scene.ground_height:.4g} {scene.unit}, that of "
                f"{first.view} z = {first.ground_height:.4g} {first.unit}; one ground for all views was needed. "
                "Calibrate them together."
            )
    if len(scenes) > 1 and not all(scene.ground_known and scene.ground_depth is None for scene in scenes):
        raise ReconstructionError(
            f"{len(scenes)} views on ground that is unknown or uneven; views are solved together on one known, level "
            "ground.",
            "solve one view alone",
            Remedy.GROUND,
        )
