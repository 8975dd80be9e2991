"""What is known of the object in millimetres: silhouettes of posed photos from the side, its height.

Shadows on the ground and one silhouette leave lights and object free up to common motions. A second camera whose place
is known, or a length, is not moved with them: space that it proves empty stays empty wherever the lights are.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from calibration.posed_camera import PosedCamera
from calibration.side_view import SideView

NODES = 80  # of the grid along the longest side of the box
MARGIN = 0.05  # of that side: around what is not proven empty
RAYS, SAMPLES = 64, 48  # along the outline of a silhouette; along a ray
TOP_SAMPLES = 24  # along each side of the level at the object's height
TOP_RAYS = 40  # as which the level counts: Cauchy's loss forgives a single one what a ruler does not
UNKNOWN = -1e3  # world length: nothing is proven


@dataclass(frozen=True)
class MetricCues:
    """What fixes scale: views of posed cameras, and the height of the object (mm, with one sigma)."""

    views: tuple[SideView, ...] = ()
    height: float | None = None
    height_sigma: float = 1.0

    def __bool__(self) -> bool:
        return bool(self.views) or self.height is not None

    def sentence(self) -> str:
        """Return what fixed the scale, for the user."""
        views = f"{len(self.views)} photo{'s' * (len(self.views) > 1)} from the side" if self.views else ""
        height = f"the object's height of {self.height:g} mm" if self.height is not None else ""
        return " and ".join(part for part in (views, height) if part)


NO_CUES = MetricCues()


@dataclass(frozen=True)
class ProvenSpace:
    """How far points are proven empty by what is not a light, heights above the ground, and rays that meet the object.

    Distances are scaled so that one sigma of a cue is `sigma`.
    """

    field: Float[np.ndarray, "x y z"]  # world length: positive where empty
    corner: Float[np.ndarray, "3"]  # of the first node
    cell: float
    points: Float[np.ndarray, "points 3"]  # of all rays, one after another
    ends: Int[np.ndarray, " rays_and_1"]  # ray k has the points ends[k] to ends[k + 1]
    by_views: bool  # not by the height alone

    def left(self) -> Float[np.ndarray, "n 3"]:
        """Return the nodes that are not proven empty."""
        return self.corner + self.cell * np.argwhere(self.field <= 0)

    def around_object(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return the lower and upper corner of a box around what is not proven empty, within this one."""
        upper, left = self.corner + self.cell * (np.array(self.field.shape) - 1), self.left()
        if len(left) == 0:
            return self.corner, upper
        pad = self.cell + MARGIN * float(np.ptp(left, axis=0).max())
        return np.maximum(left.min(0) - pad, self.corner), np.minimum(left.max(0) + pad, upper)

    def slope(self, at: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Return the field's derivatives along x and y."""
        step = 0.5 * self.cell
        return np.stack([(self(at + step * axis) - self(at - step * axis)) / (2 * step) for axis in np.eye(3)[:2]], -1)

    def __call__(self, at: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the field between its nodes, at the nearest point of the box."""
        place = np.clip((at - self.corner) / self.cell, 0, np.array(self.field.shape) - 1.001)
        low = place.astype(int)
        share = place - low
        total = np.zeros(len(at))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, share, 1 - share), axis=1)
            total += weight * self.field[tuple((low + corner).T)]
        return total


def proven_space(
    cues: MetricCues, outline: Float[np.ndarray, "n 2"], top: float, tripod: PosedCamera, sigma: float
) -> ProvenSpace:
    """Return the space that the cues prove empty in the box that the tripod's silhouette allows.

    Args:
        outline: ground points behind the silhouette; top: greatest height above the ground.
        sigma: world length that one sigma of each cue is scaled to.
    """
    eye, ground = tripod.centre, np.array([0.0, 0.0, tripod.ground_height])
    drawn = top / (eye[2] - tripod.ground_height)
    both = np.concatenate([outline, outline + (eye[:2] - outline) * drawn])
    lower, upper = np.append(both.min(0), 0.0), np.append(both.max(0), top)
    box = _emptiness(cues, lower, upper, ground, sigma)
    lower, upper = box.around_object()
    fine = _emptiness(cues, lower, upper, ground, sigma)
    rays: list[np.ndarray] = []
    for view in cues.views:
        rays += _rays(view.camera.centre - ground, view.outline_rays(RAYS), lower, upper)
    if cues.height is not None:
        x, y = (np.linspace(lower[axis], upper[axis], TOP_SAMPLES) for axis in (0, 1))
        level = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        rays += [np.column_stack([level, np.full(len(level), cues.height)])] * TOP_RAYS
    ends = np.cumsum([0, *map(len, rays)])
    points = np.concatenate([np.zeros((0, 3)), *rays])
    return replace(fine, points=points, ends=ends)


def _emptiness(
    cues: MetricCues,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    ground: Float[np.ndarray, "3"],
    sigma: float,
) -> ProvenSpace:
    """Return the space that the cues prove empty in a box, without rays."""
    cell = float((upper - lower).max() / (NODES - 1))
    counts = np.ceil((upper - lower) / cell).astype(int) + 1
    nodes = lower + cell * np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1).reshape(-1, 3)
    field = np.full(len(nodes), UNKNOWN)
    for view in cues.views:
        camera = view.camera
        depth = float(np.linalg.norm(camera.centre - ground - (lower + upper) / 2))
        scale = sigma / np.hypot(sigma, view.sigma() * depth / camera.camera.fx)
        field = np.maximum(field, np.maximum(scale * view.emptiness(nodes + ground), UNKNOWN))
    if cues.height is not None:
        field = np.maximum(field, (nodes[:, 2] - cues.height) * sigma / cues.height_sigma)
    return ProvenSpace(
        field.reshape(counts).astype(np.float32), lower, cell, np.zeros((0, 3)), np.zeros(1, np.int64), bool(cues.views)
    )


def _rays(eye: np.ndarray, directions: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
    """Return points on the part of each ray that lies in the box; rays that miss it are left out."""
    with np.errstate(divide="ignore"):
        first, last = (lower - eye) / directions, (upper - eye) / directions
    enter, leave = np.minimum(first, last).max(1), np.maximum(first, last).min(1)
    share = np.linspace(0, 1, SAMPLES)[:, None]
    hits = np.flatnonzero(leave > np.maximum(enter, 0))
    return [eye + (enter[k] + share * (leave[k] - enter[k])) * directions[k] for k in hits]
