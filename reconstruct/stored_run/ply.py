"""Read a PLY of a run by trimesh, and check it: triangles with what is known of their vertices."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from capture.errors import ReconstructionError
from capture.files.regular import open_regular
from reconstruct.stored_run.documents import refusal

if TYPE_CHECKING:  # it takes half a second to import, and most commands read no mesh
    import trimesh

LARGEST_FILE = 1 << 30  # bytes
MOST_VERTICES, MOST_FACES = 1 << 22, 1 << 23  # several times those of the finest preset
LARGEST_PLACE = 1e12  # world length
PLACE, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue", "alpha")
EVIDENCE = ("evidence", "sigma")  # of mesh.ply, see CONVENTIONS.md
MOST_EVIDENCE = 2


@dataclass(frozen=True)
class Triangles:
    """Triangles, world frame."""

    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    normals: Float32[np.ndarray, "n 3"] | None = None
    colours: UInt8[np.ndarray, "n channels"] | None = None  # sRGB, 3 or 4 channels
    evidence: UInt8[np.ndarray, " n"] | None = None  # see reconstruct/mesh/evidence.py
    sigma: Float32[np.ndarray, " n"] | None = None  # world length


def read_triangles(path: Path) -> Triangles:
    """Read a PLY of a run.

    Raises:
        ReconstructionError: there is none, or it holds no triangles, or is none that a run writes.
    """
    from trimesh.exchange.ply import load_ply

    try:
        with open_regular(path, LARGEST_FILE) as file:
            found = load_ply(file, fix_texture=False, skip_materials=True)
        return _checked(found["metadata"]["_ply_raw"]["vertex"]["data"], np.asarray(found["faces"]))
    except Exception as error:  # of a file that no run wrote, trimesh raises many kinds
        raise refusal(path, error) from error


def read_preview(path: Path) -> Triangles | None:
    """Read a PLY of a run that goes on; None where there is none, or it is empty, cut off or of another kind."""
    try:
        return read_triangles(path)
    except ReconstructionError:
        return None


def read_mesh(path: Path) -> "trimesh.Trimesh":
    """Read a PLY of a run as a mesh, its vertices in their stored order; `evidence` and `sigma` are vertex_attributes.

    Normals are those of the triangles, as trimesh makes them.

    Raises:
        ReconstructionError: as `read_triangles`.
    """
    import trimesh

    found = read_triangles(path)
    mesh = trimesh.Trimesh(found.vertices, found.faces, vertex_colors=found.colours, process=False)
    known = {"evidence": found.evidence, "sigma": found.sigma}
    mesh.vertex_attributes |= {name: values for name, values in known.items() if values is not None}
    return mesh


def _checked(points: np.ndarray, faces: np.ndarray) -> Triangles:
    """Return the triangles after a check of their corners and of the numbers at their vertices.

    Args:
        points: its columns by their names in the file.

    Raises:
        ValueError, LookupError: no run wrote them.
    """
    names = points.dtype.names or ()
    if faces.ndim != 2 or faces.shape[1] != 3 or not 0 < len(faces) <= MOST_FACES or len(points) > MOST_VERTICES:
        raise ValueError(f"triangles were needed, at most {MOST_FACES:,} of {MOST_VERTICES:,} vertices")
    if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(points):
        raise ValueError("its triangles name vertices that are not there")

    def columns(wanted: tuple[str, ...], kind: type, most: float) -> np.ndarray | None:
        """Return these columns, those that there are of colours, as numbers up to `most` on either side of 0."""
        there = [name for name in wanted if name in names]
        if len(there) < min(3, len(wanted)):
            return None
        values = np.stack([points[name] for name in there], 1)
        if values.dtype.kind == "f" and not np.abs(values).max(initial=0) <= most:  # false of NaN, too
            raise ValueError(f"{there} hold numbers that are not finite, or beyond {most:g}")
        return values.astype(kind)

    evidence, sigma = (points[name] if name in names else None for name in EVIDENCE)
    if evidence is not None and (evidence.dtype != np.uint8 or evidence.max(initial=0) > MOST_EVIDENCE):
        raise ValueError(f"'evidence' holds something else than whole numbers from 0 to {MOST_EVIDENCE}")
    if sigma is not None and (sigma.dtype.kind != "f" or np.isnan(sigma).any() or (sigma < 0).any()):
        raise ValueError("'sigma' holds something else than lengths")
    places = columns(PLACE, np.float32, LARGEST_PLACE)
    if places is None:
        raise ValueError("its vertices have no x, y and z")
    return Triangles(
        places,
        np.ascontiguousarray(faces, np.int32),
        columns(NORMAL, np.float32, 2.0),
        columns(COLOUR, np.uint8, 255.0),
        None if evidence is None else evidence.copy(),
        None if sigma is None else sigma.astype(np.float32),
    )
