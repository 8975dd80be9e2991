"""Scenes of several cameras that look at one object on one ground, in one world frame.

A scene is what one camera sees, with its own lights, exposure and photos. Functions of the solver take one scene or a
tuple of them: one is the same as a tuple of one. Photos and lights are numbered through all scenes, in their order.
"""

from typing import TypeVar

import numpy as np

from capture.errors import ReconstructionError
from reconstruct.scene import Scene

SAME_GROUND = 1e-3  # of the cameras' height: one ground for all
Thing = TypeVar("Thing")
Scenes = tuple[Scene, ...]


def each(given: Thing | tuple[Thing, ...]) -> tuple[Thing, ...]:
    """Return a tuple of one thing, or the tuple itself."""
    return given if isinstance(given, tuple) else (given,)


def by_scene(scenes: Scenes, values: np.ndarray) -> list[np.ndarray]:
    """Split values, one for each photo of all scenes, into those of each scene."""
    return np.split(values, np.cumsum([len(scene.lights) for scene in scenes])[:-1])


def first_photos(scenes: Scenes) -> list[int]:
    """Return the number of each scene's first photo."""
    return np.cumsum([0, *(len(scene.lights) for scene in scenes[:-1])]).tolist()


def photo_names(scenes: Scenes) -> tuple[str, ...]:
    """Return the names of all photos; with the name of their view, where it has one."""
    return tuple(f"{scene.view}/{name}" if scene.view else name for scene in scenes for name in scene.photo_names)


def check_common(scenes: Scenes) -> None:
    """Check that scenes can be solved together.

    Raises:
        ReconstructionError: they differ in unit or ground, or one of several has an unknown or an uneven ground.
    """
    first = scenes[0]
    for scene in scenes[1:]:
        height = abs(float(first.eye[2]) - first.ground_height)
        if scene.unit != first.unit or abs(scene.ground_height - first.ground_height) > SAME_GROUND * height:
            raise ReconstructionError(
                f"the ground of view {scene.view} is z = {scene.ground_height:.4g} {scene.unit}, that of "
                f"{first.view} z = {first.ground_height:.4g} {first.unit}; one ground for all views was needed. "
                "Calibrate them together."
            )
    if len(scenes) > 1 and not all(scene.ground_known and scene.ground_depth is None for scene in scenes):
        raise ReconstructionError(
            f"{len(scenes)} views on ground that is unknown or uneven; views are solved together on one known, level "
            "ground. Give its height with --ground, or solve one view alone."
        )
