"""Ruler: lengths between two clicked points of the surface, drawn into the scene."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
import viser
from trimesh.visual import ColorVisuals

from reconstruct.sdf.measure import Length, PickedPoint, length_between
from viewer.display.layers import PageScale, mesh_glb
from viewer.display.result import Result
from viewer.widgets.legend import QUIET, remark
from viewer.widgets.panel import PanelContext
from viewer.widgets.pointer import Ray, Tool

COLOUR = (255, 196, 84)
END_RADIUS, THICKNESS = 0.022, 0.012  # page units
START, STOP = "Measure a length", "Stop measuring"
FIRST, SECOND = "Click the first point on the surface.", "Click the second point."


@dataclass(frozen=True)
class DrawnLength:
    """The drawing of one length, or of its first point."""

    nodes: tuple[viser.SceneNodeHandle, ...]

    def remove(self) -> None:
        """Take it off the page."""
        for node in self.nodes:
            node.remove()


class Ruler:
    """A button, what to do next, and the lengths measured so far. Two clicks make a length."""

    def __init__(self, context: PanelContext, sigma_of: Callable[[PickedPoint], tuple[float | None, float]]):
        """Lay the controls out in the container of the caller's `with`.

        Args:
            sigma_of: the uncertainty of a point and the part of it that all points share, world length.
        """
        gui = context.server.gui
        self._context, self._sigma_of = context, sigma_of
        self._lock = threading.RLock()
        self._result: Result | None = None
        self._first: tuple[PickedPoint, float] | None = None  # and one sigma of pointing at it, world length
        self._drawn: list[DrawnLength] = []
        self._lengths: list[str] = []
        self._tool = Tool(self._clicked, self._stopped)
        self._is_on = False
        self._button = gui.add_button(START, icon=viser.Icon.RULER)
        self._text = gui.add_html("")
        self._clear = gui.add_button("Clear the lengths", icon=viser.Icon.TRASH, color=QUIET, visible=False)
        self._button.on_click(lambda _: self._toggle())
        self._clear.on_click(lambda _: self.clear())

    def show(self, result: Result) -> None:
        """Measure this result from now on, and remove the lengths of the last one."""
        self._result = result
        self.clear()

    def close(self) -> None:
        """Stop listening to clicks."""
        self._context.pointer.release(self._tool)

    def clear(self) -> None:
        """Remove all lengths."""
        with self._lock:
            for drawn in self._drawn:
                drawn.remove()
            self._drawn, self._lengths, self._first = [], [], None
            self._say()

    def lengths(self) -> list[str]:
        """Return the lengths as text, the oldest first."""
        return list(self._lengths)

    def _toggle(self) -> None:
        if self._is_on:
            self._context.pointer.release(self._tool)
            self._stopped()
            return
        self._context.pointer.take(self._tool)
        with self._lock:
            self._is_on = True
            self._say()

    def _stopped(self) -> None:
        with self._lock:
            self._is_on = False
            if self._first is not None:
                self._drawn.pop().remove()
                self._first = None
            self._say()

    def _clicked(self, ray: Ray) -> None:
        result = self._result
        if result is None:
            return
        picked = ray.pick(result)
        if picked is None:
            return
        pointing = ray.pointing_sigma(result)
        with self._lock:
            name = f"/lengths/{len(self._drawn)}"
            if self._first is None:
                self._first = picked, pointing
                self._drawn.append(DrawnLength((_end(self._context.server, f"{name}/start", picked, result.scale),)))
            else:
                (first, first_pointing), self._first = self._first, None
                sigmas, leans = zip(self._sigma(first, first_pointing), self._sigma(picked, pointing), strict=True)
                length = length_between(first.place, picked.place, sigmas, leans)
                words = length_text(length, result.calibration.unit)
                self._lengths.append(words)
                self._drawn.append(_line(self._context.server, name, (first, picked), words, result.scale))
            self._say()

    def _sigma(self, end: PickedPoint, pointing: float) -> tuple[float | None, float]:
        """Return one sigma of an end, by the surface there and by pointing at it, and the part that all ends share."""
        surface, lean = self._sigma_of(end)
        return (None if surface is None else float(np.hypot(surface, pointing))), lean

    def _say(self) -> None:
        """Show the measured lengths and the next step."""
        self._button.label = STOP if self._is_on else START
        self._clear.visible = bool(self._lengths)
        numbered = [f"{i}. {words}" for i, words in enumerate(self._lengths, 1)]
        hint = "" if not self._is_on else FIRST if self._first is None else SECOND
        self._text.content = "".join(remark(line) for line in [*numbered, hint])


def length_text(length: Length, unit: str) -> str:
    """Return a length with its uncertainty as text."""
    digits = 1 if unit == "mm" else 3
    known = "" if not length.sigma else f" \N{PLUS-MINUS SIGN} {length.sigma:.{digits}f}"
    return f"{length.value:.{digits}f}{known} {unit if unit == 'mm' else 'units'}"


def _end(server: viser.ViserServer, name: str, picked: PickedPoint, scale: PageScale) -> viser.SceneNodeHandle:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=END_RADIUS)
    ball.visual = ColorVisuals(ball, vertex_colors=np.tile(np.array(COLOUR, np.uint8), (len(ball.vertices), 1)))
    glb = mesh_glb(ball, is_lit=False)
    return server.scene.add_glb(name, glb, position=scale.to_page(picked.place), cast_shadow=False)


def _line(
    server: viser.ViserServer, name: str, ends: tuple[PickedPoint, PickedPoint], words: str, scale: PageScale
) -> DrawnLength:
    """Draw the line between two points, its second end and its label."""
    places = np.stack([scale.to_page(end.place) for end in ends])
    line = server.scene.add_line_segments(f"{name}/line", places[None], COLOUR, thickness=THICKNESS)
    label = server.scene.add_label(
        f"{name}/label", words, position=places.mean(0), anchor="bottom-center", font_screen_scale=1.1
    )
    return DrawnLength((_end(server, f"{name}/end", ends[1], scale), line, label))
