"""Signed distance of each vertex of a mesh from a reference mesh: a scan, a model, or the mesh of another run."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from calibration.calibration import load_calibration
from capture.errors import ReconstructionError
from capture.files.regular import why
from capture.files.title import title_of
from reconstruct.evaluate.surface_distance import ICP_POINTS, Similarity, register, signed_distance_to_mesh
from reconstruct.mesh.mesh import MM_PER_METRE
from reconstruct.stored_run.ply import read_mesh

SAMPLES = 200_000  # of the reference: the closest triangle is among those of the nearest few samples
TURNS = 8  # rotations about the vertical from which the alignment starts, besides the reference's own pose
TRIAL_POINTS, TRIAL_TARGETS = 1000, 5000  # of reference and mesh, for choosing among the starts
CLOSE = 0.02  # of the mesh's diagonal: with a smaller mean distance, no other start is tried
PERCENTILES = (5, 50, 95)
IN_METRES = (".glb", ".gltf")  # by their specification, which also sets y up
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from y up
SEED = 0


@dataclass(frozen=True)
class ReferenceMesh:
    """A reference mesh with its unit."""

    name: str
    mesh: trimesh.Trimesh  # in its own frame, z up
    unit: str | None  # "mm" | "scene" of a run; None: the file does not state it
    has_metres: bool = False


def load_reference(path: Path) -> ReferenceMesh:
    """Load a mesh file, or the mesh of a finished run from its folder.

    Raises:
        ReconstructionError: the file does not exist, cannot be read, or holds no triangles.
    """
    file = path / "mesh.ply" if path.is_dir() else path
    if not file.is_file():
        needed = "the folder of a finished run holds a mesh.ply" if path.is_dir() else "a mesh file was needed"
        raise ReconstructionError(f"--reference {path}: {file.name} is not there; {needed}.")
    try:
        mesh = read_mesh(file) if path.is_dir() else trimesh.load_mesh(file, process=False)
    except (ValueError, IndexError, KeyError, NotImplementedError, OSError, ImportError, MemoryError) as error:
        raise ReconstructionError(
            f"--reference {path}: not a mesh that can be read ({why(error)}); .ply, .obj, .stl, .off and .glb can."
        ) from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise ReconstructionError(f"--reference {path}: it holds no triangles; a surface was needed, not points.")
    has_metres = file.suffix.lower() in IN_METRES
    if has_metres:
        mesh = trimesh.Trimesh(mesh.vertices @ Z_UP.T, mesh.faces, process=False)
    unit = load_calibration(path / "calibration.json").unit if (path / "calibration.json").is_file() else None
    return ReferenceMesh(title_of(path), mesh, unit, has_metres)


def in_unit(reference: ReferenceMesh, unit: str) -> trimesh.Trimesh:
    """Return the reference's mesh in a run's unit; a file without a unit is assumed to use the run's.

    Raises:
        ReconstructionError: one run is in millimetres and the other is not.
    """
    if reference.unit not in (None, unit):
        raise ReconstructionError(
            f"--reference {reference.name} is in {reference.unit} and this run is in {unit}; one unit was needed. "
            "Compare two runs of the same kind, or a mesh file."
        )
    if not reference.has_metres or unit != "mm":
        return reference.mesh
    return trimesh.Trimesh(MM_PER_METRE * reference.mesh.vertices, reference.mesh.faces, process=False)


@dataclass(frozen=True)
class Summary:
    """Summary statistics of signed distances, world length."""

    mean: float
    mean_absolute: float
    percentiles: tuple[float, ...]  # those of PERCENTILES, signed


def deviations(mesh: trimesh.Trimesh, reference: trimesh.Trimesh) -> Float[np.ndarray, " n"]:
    """Return the signed distance of each vertex of a mesh from the reference surface, positive outside it.

    Both are in one frame and unit, which is also that of the result.
    """
    points, faces = _sampled(reference, SAMPLES)
    return signed_distance_to_mesh(np.asarray(mesh.vertices), reference, points, faces)


def _sampled(mesh: trimesh.Trimesh, count: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Draw points uniformly on a surface, and return also their triangles."""
    drawn = trimesh.sample.sample_surface(mesh, count, seed=SEED)
    return np.asarray(drawn[0]), np.asarray(drawn[1])


def summary(mesh: trimesh.Trimesh, distances: Float[np.ndarray, " n"]) -> Summary:
    """Summarise distances, with every vertex weighted by its area, so that densely meshed parts do not dominate."""
    area = np.bincount(np.asarray(mesh.faces).ravel(), np.repeat(mesh.area_faces / 3, 3), len(distances))
    order = np.argsort(distances)
    at = (np.cumsum(area[order]) - 0.5 * area[order]) / area.sum()
    spread = tuple(float(v) for v in np.interp(np.array(PERCENTILES) / 100, at, distances[order]))
    mean, absolute = (float((area * d).sum() / area.sum()) for d in (distances, np.abs(distances)))
    return Summary(mean, absolute, spread)


def best_fit(reference: trimesh.Trimesh, mesh: trimesh.Trimesh) -> Similarity:
    """Align a reference to a mesh by rigid ICP.

    ICP starts from the reference's own pose. If the result is far off, it also starts from rotations about the vertical
    with the centres of the boxes aligned; the closest result is returned.
    """
    fixed, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    few, many = (_sampled(reference, count)[0] for count in (TRIAL_POINTS, ICP_POINTS))
    sparse = slice(None, None, len(fixed) // TRIAL_TARGETS + 1)
    tree = KDTree(fixed[sparse])
    best, least = Similarity(1.0, np.eye(3), np.zeros(3)), np.inf
    for start in _starts(reference.bounds.mean(0), mesh.bounds.mean(0)):
        motion = _after(register(start.apply(few), fixed[sparse], normals[sparse]), start)
        gap = float(np.mean(tree.query(motion.apply(few))[0]))
        if gap < least:
            best, least = motion, gap
        if least < CLOSE * mesh.scale:
            break
    return _after(register(best.apply(many), fixed, normals), best)


def _starts(middle: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> list[Similarity]:
    starts = [Similarity(1.0, np.eye(3), np.zeros(3))]
    for angle in 2 * np.pi * np.arange(TURNS) / TURNS:
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        starts.append(Similarity(1.0, turn, target - turn @ middle))
    return starts


def _after(second: Similarity, first: Similarity) -> Similarity:
    """Compose two rigid motions."""
    return Similarity(1.0, second.rotation @ first.rotation, second.rotation @ first.shift + second.shift)
