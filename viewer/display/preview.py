"""Preview: the growing mesh of a run, read without the libraries that a finished mesh needs.

trimesh and what it imports take half a CPU second, a fiftieth of a whole draft run, and nothing else beside it needs
them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

KINDS = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
KINDS |= {"float": "<f4", "double": "<f8"}
LONGEST_HEADER = 4096  # bytes; ours have 300
BEGIN, FORMAT, END = "ply", "format binary_little_endian 1.0", "end_header"
CORNERS = "list uchar int"  # of a face


@dataclass(frozen=True)
class Preview:
    """Triangles, world frame."""

    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]


def read_preview(path: Path) -> Preview | None:
    """Read a PLY as runs write it; None where there is none, or it is empty, cut off or of another kind."""
    try:
        content = path.read_bytes()
        return _preview(content)
    except (OSError, ValueError, LookupError, OverflowError):
        return None


def _preview(content: bytes) -> Preview | None:
    """Decode a PLY. Raise ValueError, LookupError or OverflowError if no run wrote it."""
    head, mark, _ = content[:LONGEST_HEADER].partition(f"{END}\n".encode())
    lines = [line for line in head.decode("ascii").splitlines() if not line.startswith("comment")]
    if not mark or lines[:2] != [BEGIN, FORMAT]:
        return None
    counts: dict[str, int] = {}
    vertex: list[tuple[str, str]] = []
    for line in lines[2:]:
        word, *rest = line.split()
        if word == "element":
            counts[rest[0]] = int(rest[1])
        elif list(counts) == ["vertex"]:
            vertex.append((rest[1], KINDS[rest[0]]))
        elif " ".join(rest[:3]) != CORNERS:
            return None
    if list(counts) != ["vertex", "face"]:
        return None
    start = len(head) + len(mark)
    points = np.frombuffer(content, np.dtype(vertex), counts["vertex"], start)
    corners = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    faces = np.frombuffer(content, corners, counts["face"], start + points.nbytes)
    vertices = np.stack([points[axis] for axis in "xyz"], 1).astype(np.float32)
    inside = (faces["count"] == 3).all() and (faces["corners"] < len(vertices)).all() and (faces["corners"] >= 0).all()
    return Preview(vertices, faces["corners"].copy()) if len(faces) and inside else None
