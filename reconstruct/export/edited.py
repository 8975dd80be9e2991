"""The surface as a visitor of the page has edited it: what every export of a mesh writes.

The description is `stage.json` of the run: `crop`, `smooth` and `guess`. `reconstruct/mesh/edit.py` applies it;
mesh.ply stays as it was solved, so that every edit can be undone.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree

from reconstruct.detail.file import Detail
from reconstruct.fields import SolvedScene
from reconstruct.mesh.edit import Edit, edited_fields, edited_mesh, without_guess
from reconstruct.mesh.simplify import simplified
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


def edit_of(run: StoredRun) -> Edit:
    """Return the edits that are kept with a run.

    Raises:
        CalibrationError: stage.json cannot be read.
    """
    document = read_stage_document(run.run_dir)
    if document is None:
        return Edit()
    low, high = (tuple(document["crop"][end]) for end in ("low", "high")) if document["crop"] else (None, None)
    return Edit(low, high, float(document["smooth"]), document["guess"] == "cut")


def edited_surface(run: StoredRun) -> EditedSurface:
    """Return a run's surface after the edits that are kept with it.

    Raises:
        UserError: a file of the run cannot be used, or nothing is left of the object.
    """
    edit = edit_of(run)
    if edit.low is None and not edit.smooth:
        return EditedSurface(run, run.mesh, edit)
    fields = edited_fields(run.fields, edit)
    return EditedSurface(run, edited_mesh(fields, run.mesh, edit), edit, fields)


def edits_in_words(run: StoredRun) -> str:
    """Return what was edited, for a sentence about a file; "" where nothing was."""
    edit, unit = edit_of(run), "mm" if run.unit == "mm" else "units"
    said = [f"smoothed over {edit.smooth:g} {unit}"] if edit.smooth else []
    said += ["cropped"] if edit.low is not None else []
    said += ["the guess cut away, which leaves it open"] if edit.cuts_guess else []
    return "".join(f", {words}" for words in said)
