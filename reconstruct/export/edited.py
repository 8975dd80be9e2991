"""The surface as a visitor of the page has edited it: what every export of a mesh writes.

The description is `stage.json` of the run: `crop`, `smooth` and `guess`: a crop box, smoothing, and cutting away
what is a guess. mesh.ply stays as it was solved, so that every edit can be undone.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Integer
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree
from trimesh.visual import ColorVisuals

from capture.errors import ReconstructionError
from reconstruct.detail.file import Detail
from reconstruct.fields import SolvedScene
from reconstruct.mesh.mesh import MAX_NODES, seen_points, surface_mesh, vertex_colours
from reconstruct.mesh.simplify import bounds_a_solid, simplified
from reconstruct.sdf.grid import SdfGrid
from reconstruct.stored_run.stage_document import read_stage_document
from reconstruct.stored_run.stored_run import StoredRun

GUESS = 0.5  # evidence, interpolated between vertices, below which the surface is a guess: half of "held by shadows"
NEW = 1.5  # voxels from the solved surface: farther places lie on a cut, which no photo shows
RADIUS_SIGMAS = 2.0  # a radius of smoothing is so many standard deviations of its Gaussian


@dataclass(frozen=True)
class Edit:
    """What is changed of a surface; nothing by default."""

    low: tuple[float, float, float] | None = None  # corners of the crop box, world; None: the whole object
    high: tuple[float, float, float] | None = None
    smooth: float = 0.0  # radius, world length
    cuts_guess: bool = False


def edited_fields(fields: SolvedScene, edit: Edit) -> SolvedScene:
    """Return the scene with a smoothed and cropped signed distance.

    Smoothing convolves the distance with a Gaussian of standard deviation radius / 2: a relief of wavelength w on a
    plane keeps the share exp(-2 (pi sigma / w)^2) of its height, and a sphere of radius R shrinks by about sigma^2 / R.
    Cropping takes the larger of the distance and that of the box: the cut is closed, its rim bevelled by up to a voxel.
    """
    grid, values = fields.grid, fields.grid.values.numpy()
    if edit.smooth > 0:
        values = gaussian_filter(values, edit.smooth / RADIUS_SIGMAS / grid.spacing, mode="nearest")
    if edit.low is not None and edit.high is not None:
        for axis, (low, high) in enumerate(zip(edit.low, edit.high, strict=True)):
            places = float(grid.origin[axis]) + grid.spacing * np.arange(values.shape[axis])
            outside = np.maximum(low - places, places - high).astype(np.float32)
            values = np.maximum(values, outside.reshape([-1 if k == axis else 1 for k in range(3)]))
    return replace(fields, grid=SdfGrid(torch.from_numpy(np.ascontiguousarray(values)), grid.origin, grid.spacing))


def edited_mesh(fields: SolvedScene, mesh: trimesh.Trimesh, edit: Edit) -> trimesh.Trimesh:
    """Return the closed surface of edited fields; colours, evidence and sigma are those of the solved mesh nearby.

    Args:
        fields: of `edited_fields`.
        mesh: of the fields before.

    Raises:
        ReconstructionError: nothing of the object is left.
    """
    try:
        new = surface_mesh(fields.grid, fields.ground_height, MAX_NODES, seen=lambda: seen_points(fields))
    except ReconstructionError as error:
        raise ReconstructionError(
            "nothing is left of the object inside the crop box after smoothing. Make the box larger or the radius "
            f"smaller under 'Cut and smooth' in the run's page. ({error})"
        ) from error
    away, nearest = KDTree(mesh.vertices).query(new.vertices)
    new.visual = ColorVisuals(new, vertex_colors=vertex_colours(mesh)[nearest])
    is_new = away > NEW * fields.grid.spacing + edit.smooth / RADIUS_SIGMAS
    for name, values in mesh.vertex_attributes.items():
        new.vertex_attributes[name] = values[nearest]
    if "evidence" in new.vertex_attributes:
        new.vertex_attributes["evidence"][is_new] = 0
    return new


def without_guess(mesh: trimesh.Trimesh, evidence: Float[np.ndarray, " n"]) -> trimesh.Trimesh:
    """Cut a mesh along the line where its evidence, linear on each triangle, is GUESS; keep what is above.

    Args:
        evidence: per vertex: 0 a guess, 1 held by shadows, 2 seen.

    Raises:
        ReconstructionError: all of it is a guess.
    """
    value, faces = evidence - GUESS, np.asarray(mesh.faces)
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    ends, side_of = np.unique(sides, axis=0, return_inverse=True)
    side_of, (a, b) = side_of.reshape(-1, 3), ends.T
    is_crossed = (value[a] > 0) != (value[b] > 0)
    share = np.where(is_crossed, value[a] / np.where(is_crossed, value[a] - value[b], 1.0), 0.0)[is_crossed, None]
    first, second = a[is_crossed], b[is_crossed]
    on_side = np.full(len(ends), -1)
    on_side[is_crossed] = len(mesh.vertices) + np.arange(len(first))
    kept = _kept_parts(faces, value > 0, on_side[side_of])
    if not len(kept):
        raise ReconstructionError("all of this surface is a guess, so nothing is left when the guess is cut away.")

    def with_crossings(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, (1 - share) * values[first] + share * values[second]])

    corners, new_faces = np.unique(kept, return_inverse=True)
    out = trimesh.Trimesh(with_crossings(np.asarray(mesh.vertices))[corners], new_faces.reshape(-1, 3), process=False)
    normals = with_crossings(np.asarray(mesh.vertex_normals))[corners]
    out.vertex_normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    out.visual = ColorVisuals(out, vertex_colors=with_crossings(vertex_colours(mesh))[corners].astype(np.uint8))
    for name, values in mesh.vertex_attributes.items():
        there = np.concatenate([values, values[np.where(value[first] > 0, first, second)]])
        out.vertex_attributes[name] = there[corners]
    return out


def _kept_parts(faces: np.ndarray, keeps: np.ndarray, crossings: np.ndarray) -> np.ndarray:
    """Return the triangles left of each face: itself, a corner of it, or the two that remain without a corner.

    Args:
        keeps: per vertex.
        crossings: per face and side (0-1, 1-2, 2-0) the vertex where the line crosses it, -1 where it does not.
    """
    count = keeps[faces].sum(1)
    parts = [faces[count == 3]]
    for corner in range(3):
        after, before = (corner + 1) % 3, (corner + 2) % 3
        alone = (count == 1) & keeps[faces[:, corner]]
        parts.append(np.stack([faces[alone, corner], crossings[alone, corner], crossings[alone, before]], 1))
        gone = (count == 2) & ~keeps[faces[:, corner]]
        p, q, r, s = faces[gone, after], faces[gone, before], crossings[gone, before], crossings[gone, corner]
        parts += [np.stack([p, q, r], 1), np.stack([p, r, s], 1)]
    return np.concatenate(parts)


@dataclass(frozen=True)
class EditedSurface:
    """A run's surface after its edits. World frame."""

    run: StoredRun
    mesh: trimesh.Trimesh  # closed; what is a guess is still there
    fields: SolvedScene  # with the same edits
    edit: Edit

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
    document, edit = read_stage_document(run.run_dir), Edit()
    if document is not None:
        low, high = (tuple(document["crop"][end]) for end in ("low", "high")) if document["crop"] else (None, None)
        edit = Edit(low, high, float(document["smooth"]), document["guess"] == "cut")
    if edit.low is None and not edit.smooth:
        return EditedSurface(run, run.mesh, run.fields, edit)
    fields = edited_fields(run.fields, edit)
    return EditedSurface(run, edited_mesh(fields, run.mesh, edit), fields, edit)
