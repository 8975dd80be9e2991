"""Cut a solved surface with a plane: outlines and area of the cut, and the part of a mesh on one side of the plane."""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import Delaunay, QhullError
from skimage.measure import find_contours
from trimesh.intersections import slice_faces_plane

from reconstruct.sdf.grid import SdfGrid

STEP = 0.5  # voxels between the samples of a plane: the SDF is trilinear between its nodes
MOST_SAMPLES = 4_000_000  # of one plane: larger planes have a wider spacing
FEWEST_POINTS = 3  # of an outline


@dataclass(frozen=True)
class Plane:
    """The plane normal . x = offset, world; its lower side has normal . x < offset."""

    normal: Float[np.ndarray, "3"]  # unit
    offset: float

    def axes(self) -> Float[np.ndarray, "2 3"]:
        """Return two unit directions in the plane; with the normal they form a right-handed frame."""
        across = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(self.normal, across)])

    def span(self, origin: Float[np.ndarray, "3"], along: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Return the interval of a ray on the plane's lower side, world length; (inf, inf) if it is empty.

        Args:
            origin: world.
            along: unit, world.
        """
        height, rise = float(origin @ self.normal) - self.offset, float(along @ self.normal)
        if height <= 0:
            return 0.0, -height / rise if rise > 0 else np.inf
        return (-height / rise, np.inf) if rise < 0 else (np.inf, np.inf)


@dataclass(frozen=True)
class Section:
    """The cut of the object with a plane. World."""

    outlines: tuple[Float[np.ndarray, "_ 3"], ...]  # closed: the first point is repeated; holes run the other way
    area: float  # without the holes, world length squared
    cap: tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]  # the cut as triangles, facing along the normal

    def segments(self) -> Float[np.ndarray, "n 2 3"]:
        """Return the outlines as separate straight segments, world."""
        parts = [np.stack([line[:-1], line[1:]], 1) for line in self.outlines]
        return np.concatenate([np.zeros((0, 2, 3)), *parts])


def section(grid: SdfGrid, ground_height: float, plane: Plane) -> Section:
    """Cut the object above the ground with a plane: find the zero line of its SDF by marching squares.

    Beyond the grid there is only air, so a surface that reaches the grid's walls is closed along them.

    Args:
        ground_height: world z.
        plane: world.
    """
    across = plane.axes()
    lower, step, shape = _raster(grid, across)
    u, v = (lower[i] + step * np.arange(shape[i]) for i in range(2))
    points = plane.offset * plane.normal + u[:, None, None] * across[0] + v[:, None] * across[1]
    solid = _solid(grid, ground_height, points.reshape(-1, 3)).reshape(shape)
    flat = [lower + step * line for line in find_contours(solid, 0.0, positive_orientation="low")]
    flat = [line for line in flat if len(line) > FEWEST_POINTS and (line[0] == line[-1]).all()]
    area = sum((0.5 * float((a[:-1, 0] * a[1:, 1] - a[1:, 0] * a[:-1, 1]).sum()) for a in flat), 0.0)
    outlines = tuple(plane.offset * plane.normal + line @ across for line in flat)
    return Section(outlines, abs(area), _cap(flat, outlines, grid, ground_height))


def _raster(grid: SdfGrid, across: Float[np.ndarray, "2 3"]) -> tuple[Float[np.ndarray, "2"], float, tuple[int, int]]:
    """Return lowest corner, spacing and shape of samples on the plane that cover the grid and a margin of air."""
    low, high = grid.origin.double().numpy(), grid.upper().double().numpy()
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    flat = corners @ across.T
    extent = np.ptp(flat, axis=0)
    step = max(STEP * grid.spacing, float(np.sqrt(extent.prod() / MOST_SAMPLES)))
    width, height = (np.ceil(extent / step).astype(int) + 5).tolist()
    return flat.min(0) - 2 * step, step, (width, height)


def _solid(grid: SdfGrid, ground_height: float, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the SDF of the object's part above the ground and inside the grid; positive (air) elsewhere."""
    values = grid.sdf(torch.from_numpy(points).float()).double().numpy()
    low, high = grid.origin.double().numpy(), grid.upper().double().numpy()
    outside = np.maximum(low - points, points - high).max(-1)
    return np.maximum.reduce([values, outside, ground_height - points[:, 2]])


def _cap(
    flat: list[Float[np.ndarray, "_ 2"]],
    outlines: tuple[Float[np.ndarray, "_ 3"], ...],
    grid: SdfGrid,
    ground_height: float,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Triangulate the inside of the outlines: the Delaunay triangles whose middle is inside the object.

    Neighbouring points of an outline are closer than its two sides, so its segments are edges of the triangulation.
    """
    empty = np.zeros((0, 3)), np.zeros((0, 3), int)
    if not outlines:
        return empty
    places = np.concatenate([line[:-1] for line in outlines])
    try:
        faces = Delaunay(np.concatenate([line[:-1] for line in flat])).simplices
    except QhullError:  # all points on one line: a cut without an inside
        return empty
    inside = _solid(grid, ground_height, places[faces].mean(1)) < 0
    return places, faces[inside].astype(int)


def below(
    mesh: trimesh.Trimesh, colours: Float[np.ndarray, "n 3"], plane: Plane
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "k 3"], Float[np.ndarray, "m 3"]]:
    """Return vertices (world), faces and vertex colours of the part of a mesh below a plane, open at the cut."""
    faces, place = np.asarray(mesh.faces), plane.offset * plane.normal
    vertices, faces, kept = slice_faces_plane(np.asarray(mesh.vertices), faces, -plane.normal, place, uv=colours)
    return vertices, faces.astype(int), np.asarray(kept).reshape(-1, 3)
