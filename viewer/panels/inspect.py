"""The tab "Inspect": evidence and uncertainty of the surface, lengths, sections, the distance to a reference."""

import threading

import numpy as np
import trimesh
import viser
from jaxtyping import UInt8

from capture.files.title import title_of
from reconstruct.evaluate.deviation import ReferenceMesh, best_fit, deviations, in_unit, summary
from reconstruct.mesh.evidence import VertexEvidence, vertex_evidence
from reconstruct.sdf.measure import PickedPoint, sigma_at
from viewer.display.pictures import vertex_colours
from viewer.display.result import Result
from viewer.panels.colouring import Colouring, by_distance, by_evidence, by_sigma, softly_lit
from viewer.panels.cut_view import CutView
from viewer.panels.ruler import Ruler
from viewer.widgets.legend import remark
from viewer.widgets.panel import PanelContext

OWN, EVIDENCE, SIGMA, DISTANCE = "Own colour", "What is known", "Uncertainty", "Distance to the reference"
NO_EVIDENCE = "This run does not say how its surface is known; run it again to see that."


class InspectPanel:
    """Colouring of the mesh, a ruler and a cut; together they determine the mesh on the page."""

    def __init__(self, context: PanelContext, tab: viser.GuiTabHandle):
        """Lay the controls out."""
        self._context = context
        self._lock = threading.RLock()
        self._comparing = threading.Lock()  # one comparison at a time: seconds, so never under _lock
        self._result: Result | None = None
        self._known: VertexEvidence | None = None
        self._colouring: Colouring | None = None
        self._distances: dict[bool, Colouring] = {}  # by whether the reference was moved onto it
        gui = context.server.gui
        with tab:
            names = (OWN, EVIDENCE, SIGMA, *((DISTANCE,) if context.reference else ()))
            self._quantity = gui.add_dropdown("Colour by", names, hint="What the colours of the surface say")
            self._fit = gui.add_checkbox("Move the reference into place first", False, visible=False)
            self._legend = gui.add_html("")
            gui.add_divider()
            self._ruler = Ruler(context, self._sigma)
            gui.add_divider()
            self._cut = CutView(context, self._draw)
        self._quantity.on_update(lambda _: self._colour())
        self._fit.on_update(lambda _: self._colour())

    def show(self, result: Result) -> None:
        """Inspect this result from now on.

        Raises:
            UserError: the reference cannot be compared with it.
        """
        with self._lock:
            self._result, self._distances, self._known = result, {}, None
            if result.mesh is not None:
                self._known = vertex_evidence(result.fields, np.asarray(result.mesh.vertices))
            self._ruler.show(result)
            self._cut.show(result)
        if self._context.reference is not None:
            in_unit(self._context.reference, result.calibration.unit)
        self._colour()

    def close(self) -> None:
        """Listen to no more clicks."""
        self._ruler.close()

    def lengths(self) -> list[str]:
        """Return the measured lengths as text."""
        return self._ruler.lengths()

    def _sigma(self, picked: PickedPoint) -> tuple[float | None, float]:
        """Return one sigma of a point, None if it is unknown, and the part of it that all points share."""
        result, known = self._result, self._known
        if result is None or result.mesh is None:
            return None, 0.0
        vertices = np.asarray(result.mesh.vertices)
        if known is None:
            return sigma_at(picked, vertices, None), 0.0
        return sigma_at(picked, vertices, known.sigma), sigma_at(picked, vertices, known.lean) or 0.0

    # --- colours -----------------------------------------------------------------------------------------------------

    def _colour(self) -> None:
        """Colour by the chosen quantity."""
        wanted = quantity, is_moved = str(self._quantity.value), bool(self._fit.value)
        result = self._result
        self._fit.visible = quantity == DISTANCE
        if quantity != OWN:
            self._legend.content = remark("Being computed ...")
        colouring = None if result is None or result.mesh is None else self._colouring_by(quantity, is_moved, result)
        with self._lock:
            if wanted != (self._quantity.value, self._fit.value) or result is not self._result:
                return  # chosen anew meanwhile: that choice's thread shows it
            self._colouring = colouring
            missing = remark(NO_EVIDENCE) if quantity in (EVIDENCE, SIGMA) else ""
            self._legend.content = missing if colouring is None else colouring.legend
            self._draw()

    def _colouring_by(self, quantity: str, is_moved: bool, result: Result) -> Colouring | None:
        unit, mesh = result.calibration.unit if result.calibration.unit == "mm" else "units", result.mesh
        if mesh is None or quantity == OWN:
            return None
        if quantity == DISTANCE and self._context.reference is not None:
            with self._comparing:
                if is_moved not in self._distances:
                    self._distances[is_moved] = compared(result, mesh, self._context.reference, is_moved, unit)
                return self._distances[is_moved]
        if self._known is None:
            return None
        return by_evidence(mesh, self._known) if quantity == EVIDENCE else by_sigma(self._known.sigma, unit)

    def _draw(self) -> None:
        """Put the mesh together: its colours, and what the cut leaves of it."""
        with self._lock:
            result, colouring = self._result, self._colouring
            if result is None or result.mesh is None:
                return
            mesh = result.mesh
            colours = vertex_colours(mesh) if colouring is None else softly_lit(mesh, colouring.colours)
            cut = self._cut.apply(mesh, colours)
            if cut is None and colouring is None:
                self._context.show_mesh(self, None)
                return
            self._context.show_mesh(self, _in_colours(*(cut or (mesh, colours))), is_lit=colouring is None)


def compared(result: Result, mesh: trimesh.Trimesh, reference: ReferenceMesh, is_moved: bool, unit: str) -> Colouring:
    """Colour the mesh by its distance from a reference, which is aligned with it first if `is_moved`."""
    other = in_unit(reference, result.calibration.unit)
    if is_moved:
        motion = best_fit(other, mesh)
        other = trimesh.Trimesh(motion.apply(np.asarray(other.vertices)), other.faces, process=False)
    distance = deviations(mesh, other)
    is_namesake = reference.name == title_of(result.run_dir)  # another run of the same photos, as a rule
    name = "the other run" if is_namesake else reference.name
    return by_distance(distance, summary(mesh, distance), unit, name)


def _in_colours(mesh: trimesh.Trimesh, colours: UInt8[np.ndarray, "n 3"]) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
