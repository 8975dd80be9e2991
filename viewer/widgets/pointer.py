"""Pointer: gives the clicks into the scene to one tool at a time."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import viser
from jaxtyping import Float

if TYPE_CHECKING:  # nothing can be clicked at before there is a result
    from reconstruct.sdf.measure import PickedPoint
    from reconstruct.sdf.section import Plane
    from viewer.display.result import Result


OBLIQUE = 10.0  # times the distance straight across that half a pixel spans on a surface seen at 6 degrees


@dataclass(frozen=True)
class Ray:
    """The ray from the visitor's eye through a click; page units."""

    origin: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    hidden: "Plane | None"  # what lies above it is hidden; world
    pixel: float = 0.0  # rad between neighbouring pixels of the visitor's window

    def pick(self, result: "Result") -> "PickedPoint | None":
        """Return the point of object or ground that was clicked; None where it is neither."""
        from reconstruct.sdf.measure import pick

        origin, along = result.scale.to_world(self.origin), self.direction / np.linalg.norm(self.direction)
        span = (0.0, np.inf) if self.hidden is None else self.hidden.span(origin, along)
        return pick(result.fields.grid, result.calibration.ground_height, origin, along, span)

    def pointing_sigma(self, result: "Result") -> float:
        """Return one sigma of the picked place along the surface by pointing alone: half a pixel, world length.

        It is how far the pick moves when the click moves by half a pixel to either side, at most OBLIQUE half pixels
        straight across: beyond, the neighbouring pixel shows another surface.
        """
        here = self.pick(result)
        if here is None or self.pixel <= 0:
            return 0.0
        along = self.direction / np.linalg.norm(self.direction)
        right = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        half = 0.5 * self.pixel
        straight = half * float(np.linalg.norm(here.place - result.scale.to_world(self.origin)))
        moves = []
        for aside in (right, -right, np.cross(along, right), -np.cross(along, right)):
            there = replace(self, direction=along + half * aside).pick(result)
            away = np.inf if there is None else float(np.linalg.norm(there.place - here.place))
            moves.append(min(away, OBLIQUE * straight))
        return float(np.sqrt(np.mean(np.square(moves))))


@dataclass(frozen=True)
class Tool:
    """Something that takes clicks: the ruler, the brush."""

    click: Callable[[Ray], None]
    release: Callable[[], None]  # another tool gets the clicks now


class Pointer:
    """Gives every click to the tool that was taken last. A tool is called in viser's threads, under no lock."""

    def __init__(self, server: viser.ViserServer):
        """Start without a tool and without listening to clicks."""
        self._scene = server.scene
        self._lock = threading.RLock()
        self._tool: Tool | None = None
        self._hidden: Plane | None = None

    def hide_above(self, plane: "Plane | None") -> None:
        """Ignore everything above this plane (world) in clicks; None: ignore nothing."""
        self._hidden = plane

    def take(self, tool: Tool) -> None:
        """Give the clicks to this tool, and call `release` of the one before."""
        with self._lock:
            before, self._tool = self._tool, tool
            if before is None:
                self._scene.on_click()(self._clicked)
        if before is not None and before is not tool:
            before.release()

    def release(self, tool: Tool) -> None:
        """Give this tool no more clicks."""
        with self._lock:
            if self._tool is tool:
                self._tool = None
                self._scene.remove_click_callback(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin, direction = (np.asarray(v, dtype=np.float64) for v in (event.ray_origin, event.ray_direction))
        if not (np.isfinite(origin).all() and np.isfinite(direction).all() and direction.any()):
            return  # a browser sends what it likes
        tool = self._tool
        if tool is not None:
            camera = event.client.camera
            tool.click(Ray(origin, direction, self._hidden, _pixel(camera.fov, camera.image_height)))


def _pixel(fov: float, height: int) -> float:
    """Return the angle between pixels in the middle of a window, rad, given its vertical field of view; 0: unknown."""
    is_known = np.isfinite(fov) and 0 < fov < np.pi and height > 0  # a browser sends what it likes
    return float(2 * np.tan(fov / 2) / height) if is_known else 0.0
