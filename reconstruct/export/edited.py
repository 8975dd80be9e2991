"""The surface as a visitor of the page has edited it: what every export of a mesh writes.

The description is `stage.json` of the run: `crop`, `smooth` and `guess`. `reconstruct/mesh/edit.py` applies it;
mesh.ply stays as it was solved, so that every edit can be undone.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Integer
from scipy.spatial import KDTree

from capture.errors import ReconstructionError
from reconstruct.detail.file import Detail
from reconstruct.fields import SolvedScene
from reconstruct.mesh.edit import Edit, edited_fields, edited_mesh, without_guess
from reconstruct.mesh.simplify import bounds_a_solid, simplified
from reconstruct.stored_run.stage_document import read_stage_document
from reconstruct.stored_run.stored_run import StoredRun


@dataclass(frozen=True)
class EditedSurface:
    """A run's surface after its edits. World frame."""

    run: StoredRun
    mesh: trimesh.Trimesh  # closed; what is a guess is still there
    edit: Edit
    edited: SolvedScene | None = None  # None: those of the run

    @property
    def fields(self) -> SolvedScene:
        """The solved scene with the same edits."""
        return self.run.fields if self.edited is None else self.edited

    @property
    def details(self) -> tuple[Detail, ...]:
        """The run's details; none after smoothing, which takes what is finer than it."""
        return () if self.edit.smooth else self.run.details

    def is_closed(self, path: Path, vertices: Float[np.ndarray, "n 3"], faces: Integer[np.ndarray, "m 3"]) -> bool:
        """Return whether what is to be written bounds a solid.

        Raises:
            ReconstructionError: it does not, and the guess is not cut away.
        """
        is_closed = bounds_a_solid(vertices, faces)
        if not is_closed and not self.edit.cuts_guess:
            raise ReconstructionError(
                f"{path.name}: {len(faces)} triangles leave holes, and a closed surface was needed. Export again with "
                "another number of faces."
            )
        return is_closed

    def edits_in_words(self) -> str:
        """Return what was edited, for a sentence about a file; "" where nothing was."""
        unit = "mm" if self.run.unit == "mm" else "units"
        said = [f"smoothed over {self.edit.smooth:g} {unit}"] if self.edit.smooth else []
        said += ["cropped"] if self.edit.low is not None else []
        said += ["the guess cut away, which leaves it open"] if self.edit.cuts_guess else []
        return "".join(f", {words}" for words in said)

    def reduced(self, faces: int | None) -> trimesh.Trimesh:
        """Return the mesh with about so many triangles (None: all), without the guess where that is cut away.

        Raises:
            ReconstructionError: it cannot be reduced so far, or nothing is left.
        """
        small = self.mesh if faces is None else simplified(self.mesh, faces)
        evidence = self.mesh.vertex_attributes.get("evidence")
        if not self.edit.cuts_guess or evidence is None:
            return small
        known = np.asarray(evidence, np.float64)
        if small is not self.mesh:
            known = known[KDTree(self.mesh.vertices).query(small.vertices)[1]]
        return without_guess(small, known)


def edited_surface(run: StoredRun) -> EditedSurface:
    """Return a run's surface after the edits that are kept with it.

    Raises:
        UserError: a file of the run cannot be used, or nothing is left of the object.
    """
    edit = _edit_of(run)
    if edit.low is None and not edit.smooth:
        return EditedSurface(run, run.mesh, edit)
    fields = edited_fields(run.fields, edit)
    return EditedSurface(run, edited_mesh(fields, run.mesh, edit), edit, fields)


def _edit_of(run: StoredRun) -> Edit:
    document = read_stage_document(run.run_dir)
    if document is None:
        return Edit()
    low, high = (tuple(document["crop"][end]) for end in ("low", "high")) if document["crop"] else (None, None)
    return Edit(low, high, float(document["smooth"]), document["guess"] == "cut")
