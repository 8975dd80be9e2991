"""Read a PLY as runs write it: triangles with what is known of their vertices.

Without trimesh, which takes half a CPU second to import: a page beside a run needs only this.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from capture.errors import ReconstructionError
from capture.files.regular import open_regular
from reconstruct.stored_run.refusal import refusal

if TYPE_CHECKING:
    import trimesh

KINDS = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
KINDS |= {"float": "<f4", "double": "<f8"}
LONGEST_HEADER = 4096  # bytes; ours have 500
BEGIN, FORMAT, END = "ply", "format binary_little_endian 1.0", "end_header"
CORNERS = "list uchar int"  # of a face
LARGEST_FILE = 1 << 30  # bytes
MOST_VERTICES, MOST_FACES = 1 << 22, 1 << 23  # several times those of the finest preset
LARGEST_PLACE = 1e12  # world length
PLACE, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue", "alpha")
EVIDENCE = ("evidence", "sigma")  # of mesh.ply, see CONVENTIONS.md
MOST_EVIDENCE = 2
DAMAGED = (OSError, ValueError, LookupError, OverflowError)


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
    try:
        with open_regular(path, LARGEST_FILE) as file:
            return _triangles(file)
    except DAMAGED as error:
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
    mesh = trimesh.Trimesh(
        found.vertices,
        found.faces,
        vertex_colors=found.colours,
        process=False,
    )
    known = {"evidence": found.evidence, "sigma": found.sigma}
    mesh.vertex_attributes |= {name: values for name, values in known.items() if values is not None}
    return mesh


def _triangles(file: BinaryIO) -> Triangles:
    """Decode a PLY.

    Raises:
        ValueError, LookupError, OverflowError: no run wrote it.
    """
    head, mark, _ = file.read(LONGEST_HEADER).partition(f"{END}\n".encode())
    if not mark:
        raise ValueError("no header of a PLY was found")
    vertex, counts = _header(head.decode("ascii"))
    corners = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    start = len(head) + len(mark)
    needed = start + counts["vertex"] * vertex.itemsize + counts["face"] * corners.itemsize
    size = file.seek(0, 2)
    if size != needed:
        raise ValueError(f"its header states {needed} bytes, {size} were found")
    file.seek(start)
    points = np.frombuffer(file.read(counts["vertex"] * vertex.itemsize), vertex)
    faces = np.frombuffer(file.read(counts["face"] * corners.itemsize), corners)
    if (faces["count"] != 3).any() or not len(faces):
        raise ValueError("it holds no triangles, or other faces too")
    if faces["corners"].min() < 0 or faces["corners"].max() >= len(points):
        raise ValueError("its triangles name vertices that are not there")
    return _checked(points, np.ascontiguousarray(faces["corners"]))


def _header(text: str) -> tuple[np.dtype, dict[str, int]]:
    """Return the type of a vertex, and the number of vertices and faces."""
    lines = [line for line in text.splitlines() if not line.startswith("comment")]
    if lines[:2] != [BEGIN, FORMAT]:
        raise ValueError("it is no binary PLY")
    counts: dict[str, int] = {}
    vertex: list[tuple[str, str]] = []
    for line in lines[2:]:
        word, *rest = line.split()
        if word == "element":
            counts[rest[0]] = int(rest[1])
        elif word == "property" and list(counts) == ["vertex"]:
            vertex.append((rest[1], KINDS[rest[0]]))
        elif " ".join(rest[:3]) != CORNERS:
            raise ValueError(f"its header has the line {line[:40]!r}")
    if list(counts) != ["vertex", "face"] or not set(PLACE) <= {name for name, _ in vertex}:
        raise ValueError("it has other elements than vertices with x, y and z, and faces")
    if not (0 <= counts["vertex"] <= MOST_VERTICES and 0 <= counts["face"] <= MOST_FACES):
        most = f"{MOST_VERTICES:,} vertices and {MOST_FACES:,} faces"
        raise ValueError(f"{counts} were found, at most {most} were needed")
    return np.dtype(vertex), counts


def _checked(points: np.ndarray, faces: Int32[np.ndarray, "m 3"]) -> Triangles:
    """Return the triangles after a check of the numbers at their vertices."""
    names = points.dtype.names or ()

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
    assert places is not None
    return Triangles(
        places,
        faces,
        columns(NORMAL, np.float32, 2.0),
        columns(COLOUR, np.uint8, 255.0),
        None if evidence is None else evidence.copy(),
        None if sigma is None else sigma.astype(np.float32),
    )
