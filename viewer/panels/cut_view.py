"""CutView: a plane through the object, its outline and area, and the object without one side of it."""

import threading
from collections.abc import Callable

import numpy as np
import trimesh
import viser
from jaxtyping import UInt8

from reconstruct.sdf.section import Plane, Section, below, section
from viewer.display.result import Result
from viewer.panels.colouring import round_step
from viewer.widgets.legend import remark
from viewer.widgets.panel import PanelContext

NONE = "No cut"
BEYOND, BEFORE = "Beyond the cut", "Before the cut"
HIDE = (BEYOND, BEFORE, "Nothing")
AXES = {"Level, at a height": 2, "Upright, across x": 0, "Upright, across y": 1}
OUTLINE = (255, 196, 84)
CUT_FACE = (232, 142, 60)
THICKNESS = 0.014  # page units
STEPS = 200  # of the slider over the object
FIRST_SHARE = 0.5  # of the object, where a cut begins
OFF = 0.005  # of the slider's range: outlines are drawn a little off the surface that is left

Coloured = tuple[trimesh.Trimesh, UInt8[np.ndarray, "n 3"]]


class CutView:
    """The controls and the drawing of a cut. While the slider is dragged, only its newest place is cut."""

    def __init__(self, context: PanelContext, changed: Callable[[], None]):
        """Lay the controls out in the container of the caller's `with`.

        Args:
            changed: called when `apply` would give another mesh.
        """
        gui = context.server.gui
        self._context, self._changed = context, changed
        self._lock = threading.RLock()
        self._result: Result | None = None
        self._drawn: tuple[str, float] | None = None
        self._section: tuple[Plane, Section] | None = None
        self._lines: viser.LineSegmentsHandle | None = None
        self._axis = gui.add_dropdown("Cut", (NONE, *AXES), hint="A plane through the surface found")
        self._place = gui.add_slider("At", 0.0, 1.0, 0.01, 0.5, visible=False)
        self._hide = gui.add_dropdown("Hide", HIDE, visible=False, hint="Take a part away to look inside")
        self._text = gui.add_html("")
        self._axis.on_update(lambda _: self._choose_axis())
        self._place.on_update(lambda _: self._draw())
        self._hide.on_update(lambda _: self._changed())

    def show(self, result: Result) -> None:
        """Cut this result from now on."""
        with self._lock:
            self._result, self._drawn = result, None
        self._choose_axis()

    def apply(self, mesh: trimesh.Trimesh, colours: UInt8[np.ndarray, "n 3"]) -> Coloured | None:
        """Return the mesh without its hidden part, closed by the face of the cut; None: nothing is hidden."""
        plane, found = self._hidden(), self._section
        self._context.pointer.hide_above(plane)
        if plane is None or found is None:
            return None
        vertices, faces, kept = below(mesh, colours.astype(float), plane)
        places, triangles = found[1].cap
        whole = np.concatenate([vertices, places]), np.concatenate([faces, triangles + len(vertices)])
        every = np.concatenate([kept, np.tile(np.array(CUT_FACE, float), (len(places), 1))])
        return trimesh.Trimesh(*whole, process=False), np.round(every).astype(np.uint8)

    def _hidden(self) -> Plane | None:
        """Return the plane above which everything is hidden."""
        hidden = str(self._hide.value)
        if self._section is None or hidden not in (BEYOND, BEFORE):
            return None
        plane = self._section[0]
        return plane if hidden == BEYOND else Plane(-plane.normal, -plane.offset)

    def _choose_axis(self) -> None:
        """Set the slider's range to the object's extent along the chosen axis, and its value to the middle."""
        result, axis = self._result, AXES.get(str(self._axis.value))
        is_cut = axis is not None and result is not None and result.mesh is not None
        self._place.visible = self._hide.visible = is_cut
        if axis is not None and result is not None and result.mesh is not None:
            low, high = (float(v) for v in result.mesh.bounds[:, axis])
            self._place.label = f"{'Height' if axis == 2 else 'xyz'[axis]} ({result.calibration.unit})"
            step = round_step((high - low) / STEPS)
            self._place.min, self._place.max = step * np.floor(low / step), step * np.ceil(high / step)
            self._place.step, self._place.value = step, step * round((low + FIRST_SHARE * (high - low)) / step)
        self._draw()

    def _draw(self) -> None:
        """Cut where the slider is now, unless that is done already."""
        with self._lock:
            name, result, wanted = (
                str(self._axis.value),
                self._result,
                (str(self._axis.value), float(self._place.value)),
            )
            if wanted == self._drawn or result is None:
                return
            self._drawn = wanted
            if self._lines is not None:
                self._lines.remove()
                self._lines = None
            if name == NONE:
                self._section, self._text.content = None, ""
            else:
                self._cut(result, Plane(np.eye(3)[AXES[name]], wanted[1]))
        self._changed()

    def _cut(self, result: Result, plane: Plane) -> None:
        found = section(result.fields.grid, result.calibration.ground_height, plane)
        self._section = plane, found
        segments = found.segments()
        length = float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum())
        self._text.content = remark(area_text(found.area, length, result.calibration.unit))
        if len(segments):
            off = OFF * (self._place.max - self._place.min) * plane.normal
            lines = result.scale.to_page(segments + off)
            self._lines = self._context.server.scene.add_line_segments("/cut", lines, OUTLINE, thickness=THICKNESS)


def area_text(area: float, length: float, unit: str) -> str:
    """Return area and outline of a cut as text."""
    if area == 0:
        return "The plane does not meet the object here."
    if unit == "mm":
        return f"Area {area:,.0f} mm², outline {length:,.0f} mm"
    return f"Area {area:.3g} square units, outline {length:.3g} units"
