"""Find how an object was turned between two object poses: the rigid motion that lays one solved surface on the other.

In: the solved surface of each pose, and the points of it that its cameras saw. Out: the motion and how well it fits, or
a refusal in a sentence.

1. Many rotations, each with the translation between the centres of volume, are scored by the distance of one pose's
   seen points from the other's surface, both ways: the surfaces are distance functions, so no pairs are searched.
2. The best are refined by iterated least squares on these distances [Fitzgibbon 2003, Robust Registration of 2D and 3D
   Point Sets], with weights that fall with the distance (Geman and McClure): undersides are cut off at the table, and
   what a pose did not see is a guess.
3. Two different motions that fit equally well, within the noise of their difference, are told apart by colour, else
   refused.

Rotations spread evenly over all of them, and small rigid motions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from calibration.pose import Pose
from capture.checks.robust import cauchy, geman_mcclure
from capture.errors import ReconstructionError
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import surface_maps
from reconstruct.sdf.grid import SdfGrid

PHI = 2**0.5  # the two irrational numbers of the spiral
PSI = 1.533751168755204288118041  # psi^4 = psi + 4
ROTATIONS = 4096  # about 15 degrees apart
FEWEST_POINTS = 50  # voxels that a pose's cameras see, at least
FEW_POINTS = 250  # of each pose, for the first score
SOME_POINTS = 1000  # of each pose, while many motions are refined
MOST_POINTS = 8000  # of each pose, at the end
REFINED = 32  # best rotations that are refined
AT_ONCE = 128  # of the rotations
APART = np.radians(12.0)  # nearer rotations end in the same motion
FACING = 0.3  # cosine to the view ray from which a pixel's place on the surface is trusted
OFF_TABLE = 3.0  # voxels above the ground: below, object and ground are hard to tell apart
COARSE, ROUGH, CLOSE = 0.08, 0.03, 0.5  # widths of the robust error: shares of the object's size; voxels
STEPS = 12  # of least squares at each width
DISTINCT = np.radians(6.0)  # and DISTINCT_SHIFT of the size: motions that differ by less are one
DISTINCT_SHIFT = 0.04
SIGMAS = 3.0  # of the difference between two motions: below, neither is better
BLOCKS = 8  # along the object: distances inside one are correlated
FITS = 1.5  # voxels: median distance of the seen points from the other's surface, at most
SAME_PLACE = 1.5  # voxels: points of both poses that show one place of the surface
DARKEST = 0.01  # albedo below which no ratio is known


def even_rotations(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Return rotations on the Super-Fibonacci spiral [Alexa 2022, Super-Fibonacci Spirals: Fast, Low-Discrepancy
    Sampling of SO(3)]: 4096 leave no rotation farther than some 15 degrees from one of them.
    """
    s = np.arange(count) + 0.5
    small, large = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / PHI, 2 * np.pi * s / PSI
    quaternions = np.stack(
        [small * np.sin(alpha), small * np.cos(alpha), large * np.sin(beta), large * np.cos(beta)], 1
    )
    return Rotation.from_quat(quaternions).as_matrix()


def angle_between(a: Float[np.ndarray, "3 3"], b: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle of the rotation that brings one orientation to the other, rad."""
    return float(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1.0, 1.0)))


def stepped(pose: Pose, step: Float[np.ndarray, "6"], about: Float[np.ndarray, "3"]) -> Pose:
    """Return a motion followed by a small one: a turn (rotation vector, rad) about a point, then a shift."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return Pose(turn @ pose.rotation, turn @ (pose.translation - about) + about + step[3:])


@dataclass(frozen=True)
class SeenSurface:
    """A pose's surface above its ground, and points of it that its cameras saw, one for each voxel. Its own world."""

    name: str
    grid: SdfGrid
    points: Float[np.ndarray, "n 3"]
    albedo: Float[np.ndarray, "n 3"]
    ground_height: float

    @property
    def size(self) -> float:
        """Diagonal of the seen points' box, world length."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def centre(self) -> Float[np.ndarray, "3"]:
        """Return the centre of the volume above the ground."""
        inside = torch.nonzero(self.grid.values < 0).double().numpy()
        places = self.grid.origin.double().numpy() + self.grid.spacing * inside
        return places[places[:, 2] > self.ground_height].mean(0)


@dataclass(frozen=True)
class Alignment:
    """The motion between two poses, and how well it is known."""

    motion: Pose  # first_from_turned
    distance: float  # median distance of seen points from the other pose's surface, world length
    colour: float  # median difference of log albedo where both poses saw a place; nan where none was compared
    by_colour: bool  # colour decided between motions that fit equally well


def seen_surface(name: str, fields: SolvedScene) -> SeenSurface:
    """Return what the cameras of a pose saw of its surface.

    Raises:
        ReconstructionError: they saw too little.
    """
    parts = []
    for view in fields.views():
        maps = surface_maps(view.grid, view.posed_camera)
        eye = torch.from_numpy(view.posed_camera.centre).float()
        facing = (torch.nn.functional.normalize(eye - maps.points, dim=-1) * maps.normals).sum(-1)
        low = fields.ground_height + OFF_TABLE * fields.grid.spacing
        kept = maps.mask & (facing > FACING) & (maps.points[..., 2] > low)
        parts.append([one[kept].double().numpy() for one in (maps.points, view.albedo)])
    points, albedo = (np.concatenate(column) for column in zip(*parts, strict=True))
    _, chosen = np.unique(np.floor(points / fields.grid.spacing).astype(np.int64), axis=0, return_index=True)
    if len(chosen) < FEWEST_POINTS:
        raise ReconstructionError(
            f"{name or 'the first object pose'}: {len(chosen)} voxels of the object are seen by its cameras, at least "
            f"{FEWEST_POINTS} were needed to find how it was turned. Photograph it from nearer."
        )
    surface = _above_ground(fields.grid, fields.ground_height)
    return SeenSurface(name, surface, points[chosen], albedo[chosen], fields.ground_height)


def _above_ground(grid: SdfGrid, height: float) -> SdfGrid:
    """Return a surface without the matter below the ground, which nothing that is solved in one pose denies.

    So it has an underside where the object stands, and another pose may show it.
    """
    z = grid.origin[2].double() + grid.spacing * torch.arange(grid.values.shape[2], dtype=torch.float64)
    return SdfGrid(torch.maximum(grid.values, (height - z).float()), grid.origin, grid.spacing)


def align(first: SeenSurface, turned: SeenSurface, seed: int = 0) -> Alignment:
    """Return the motion that carries a turned pose's world to that of the first pose.

    Raises:
        ReconstructionError: the surfaces fit in no motion, or in two different ones equally well.
    """
    found = _refined(first, turned, _coarse(first, turned, seed), seed)
    pairs = _Pairs(first, turned, MOST_POINTS, seed)
    alike = _best_by_shape(pairs, found)
    best, distance = _closely(pairs, alike[0])  # before colour: what fits badly may fit badly in many ways
    if len(alike) > 1:
        best, distance = _closely(pairs, _best_by_colour(pairs, alike))
    colour = pairs.colour_errors(best)
    seen = float(np.nanmedian(colour)) if np.isfinite(colour).any() else np.nan
    return Alignment(best, distance, seen, len(alike) > 1)


class _Pairs:
    """Seen points of both poses, and their distances from the other's surface under a motion first_from_turned."""

    def __init__(self, first: SeenSurface, turned: SeenSurface, count: int, seed: int):
        self.first, self.turned = first, turned
        self.voxel = max(first.grid.spacing, turned.grid.spacing)
        self.size = min(first.size, turned.size)
        rng = np.random.default_rng(seed)
        self.chosen = [np.sort(rng.permutation(len(one.points))[:count]) for one in (first, turned)]
        self.of_first, self.of_turned = first.points[self.chosen[0]], turned.points[self.chosen[1]]
        self.centre = first.centre()
        self.field_first, self.field_turned = _Field(first.grid), _Field(turned.grid)
        self._trees = KDTree(first.points), KDTree(turned.points)

    def signed(self, motion: Pose) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 6"]]:
        """Return signed distances, and their derivatives by a turn about the first's centre and a shift.

        Points of the turned pose come first, on the first's surface.
        """
        there = motion.apply(self.of_turned)
        phi, slope = self.field_first.at(there)
        phi_back, slope_back = self.field_turned.at(motion.inverse().apply(self.of_first))
        slope_back = -motion.rotate(slope_back)  # a step of the motion moves the first's point the other way
        at, slopes = np.concatenate([there, self.of_first]), np.concatenate([slope, slope_back])
        return np.concatenate([phi, phi_back]), np.concatenate([np.cross(at - self.centre, slopes), slopes], 1)

    def distances(self, motion: Pose) -> Float[np.ndarray, " n"]:
        """Return the distances of all points from the other pose's surface."""
        return self.distances_of([motion])[0]

    def distances_of(self, motions: Sequence[Pose]) -> Float[np.ndarray, "motions n"]:
        """Return the distances of all points from the other pose's surface, for each of several motions."""
        there = np.concatenate([motion.apply(self.of_turned) for motion in motions])
        back = np.concatenate([motion.inverse().apply(self.of_first) for motion in motions])
        parts = (self.field_first.at(there)[0], self.field_turned.at(back)[0])
        return np.abs(np.concatenate([part.reshape(len(motions), -1) for part in parts], 1))

    def losses(self, motion: Pose, width: float) -> Float[np.ndarray, " n"]:
        """Return each point's robust error in [0, 1]."""
        return 1 - cauchy((self.distances(motion) / width) ** 2)

    def fitted(self, motion: Pose, width: float) -> Pose:
        """Return the motion after STEPS of reweighted least squares on the distances."""
        for _ in range(STEPS):
            phi, rows = self.signed(motion)
            weight = geman_mcclure((phi / width) ** 2)
            normal = (rows * weight[:, None]).T @ rows
            normal += 1e-6 * np.diag(np.diag(normal).clip(min=1e-12))
            step = -np.linalg.solve(normal, (rows * weight[:, None]).T @ phi)
            motion = stepped(motion, step, self.centre)
            if np.abs(step[:3]).max() < 1e-5 and np.abs(step[3:]).max() < 1e-4 * self.voxel:
                break
        return motion

    def colour_errors(self, motion: Pose) -> Float[np.ndarray, " n"]:
        """Return the difference of log albedo, beside one factor for each channel, where both poses saw a place.

        Points of the turned pose come first; nan where the other pose did not see the place.
        """
        there, back = motion.apply(self.of_turned), motion.inverse().apply(self.of_first)
        parts = []
        for at, tree, own, other in (
            (there, self._trees[0], self.turned.albedo[self.chosen[1]], self.first.albedo),
            (back, self._trees[1], self.first.albedo[self.chosen[0]], self.turned.albedo),
        ):
            distance, index = tree.query(at)
            ratio = np.log(np.maximum(own, DARKEST) / np.maximum(other[index], DARKEST))
            ratio[distance > SAME_PLACE * self.voxel] = np.nan
            if np.isfinite(ratio).any():
                ratio = ratio - np.nanmedian(ratio, axis=0)
            parts.append(np.abs(ratio).mean(1))
        return np.concatenate(parts)

    def blocks(self) -> np.ndarray:
        """Return the block of space of each point, those of either pose apart: errors inside one are correlated."""
        labels = []
        for own in (self.of_turned, self.of_first):
            _, label = np.unique(np.floor(own / (self.size / BLOCKS)).astype(int), axis=0, return_inverse=True)
            labels.append(label.reshape(-1))
        return np.concatenate([labels[0], labels[1] + labels[0].max() + 1])


def _coarse(first: SeenSurface, turned: SeenSurface, seed: int) -> list[Pose]:
    """Return the best of many rotations about the centres of volume, no two of them close."""
    pairs = _Pairs(first, turned, FEW_POINTS, seed)
    centre, own = pairs.centre, turned.centre()
    rotations = even_rotations(ROTATIONS)
    poses = [Pose(rotation, centre - rotation @ own) for rotation in rotations]
    width = COARSE * pairs.size
    score = np.concatenate(
        [np.minimum(pairs.distances_of(poses[k : k + AT_ONCE]), width).mean(1) for k in range(0, ROTATIONS, AT_ONCE)]
    )
    chosen: list[Pose] = []
    for k in np.argsort(score, kind="stable"):
        if all(angle_between(poses[k].rotation, other.rotation) > APART for other in chosen):
            chosen.append(poses[k])
        if len(chosen) == REFINED:
            break
    return chosen


def _refined(first: SeenSurface, turned: SeenSurface, starts: list[Pose], seed: int) -> list[Pose]:
    """Return the distinct motions that the starts end in, the best first."""
    few, some = _Pairs(first, turned, FEW_POINTS, seed), _Pairs(first, turned, SOME_POINTS, seed)
    ends = [few.fitted(pose, COARSE * few.size) for pose in starts]
    ends = [some.fitted(pose, ROUGH * some.size) for pose in ends]
    ends = [some.fitted(pose, 2 * CLOSE * some.voxel) for pose in ends]
    width, centre = 2 * CLOSE * some.voxel, turned.centre()
    scores = [float(some.losses(pose, width).mean()) for pose in ends]
    distinct: list[Pose] = []
    for k in np.argsort(scores, kind="stable"):
        if not any(_is_same(ends[k], other, centre, some.size) for other in distinct):
            distinct.append(ends[k])
    return distinct


def _is_same(a: Pose, b: Pose, centre: Float[np.ndarray, "3"], size: float) -> bool:
    shift = float(np.linalg.norm(a.apply(centre) - b.apply(centre)))
    return bool(angle_between(a.rotation, b.rotation) < DISTINCT and shift < DISTINCT_SHIFT * size)


def _best_by_shape(pairs: _Pairs, found: list[Pose]) -> list[Pose]:
    """Return the motion that fits best, then all others that fit equally well within the noise."""
    width, blocks = 2 * CLOSE * pairs.voxel, pairs.blocks()
    losses = [pairs.losses(pose, width) for pose in found]
    first = int(np.argmin([loss.mean() for loss in losses]))
    alike = [found[first]]
    for k, loss in enumerate(losses):
        difference, noise = mean_difference(loss, losses[first], blocks)
        if k != first and difference <= SIGMAS * noise:
            alike.append(found[k])
    return alike


def _closely(pairs: _Pairs, motion: Pose) -> tuple[Pose, float]:
    """Return a motion fitted to all points, and their median distance from the other surface.

    Raises:
        ReconstructionError: the surfaces are too far apart to be the same object's.
    """
    motion = pairs.fitted(motion, CLOSE * pairs.voxel)
    distance, most = float(np.median(pairs.distances(motion))), FITS * pairs.voxel
    if distance > most:
        raise ReconstructionError(
            f"{pairs.turned.name}: laid on {pairs.first.name or 'the other object pose'} in the best of {ROTATIONS} "
            f"rotations, the surfaces are {distance:.2g} mm apart (median); at most {most:.2g} mm were needed. Is it "
            "the same object, and did it keep its shape?"
        )
    return motion, distance


def _best_by_colour(pairs: _Pairs, alike: list[Pose]) -> Pose:
    """Return the motion under which colours agree best, of those that fit equally well in shape.

    Raises:
        ReconstructionError: another fits equally well in colour, too.
    """
    blocks, colours = pairs.blocks(), [pairs.colour_errors(pose) for pose in alike]
    means = [float(np.nanmean(error)) if np.isfinite(error).any() else np.inf for error in colours]
    chosen = int(np.argmin(means))
    for k, error in enumerate(colours):
        difference, noise = mean_difference(error, colours[chosen], blocks)
        if k != chosen and difference <= SIGMAS * noise:
            raise ReconstructionError(_ambiguous(pairs, alike[chosen], alike[k]))
    return alike[chosen]


def _ambiguous(pairs: _Pairs, a: Pose, b: Pose) -> str:
    apart = np.degrees(angle_between(a.rotation, b.rotation))
    width = 2 * CLOSE * pairs.voxel
    losses = [float(pairs.losses(pose, width).mean()) for pose in (a, b)]
    _, noise = mean_difference(pairs.losses(a, width), pairs.losses(b, width), pairs.blocks())
    return (
        f"{pairs.turned.name}: two ways to lay it on {pairs.first.name or 'the other object pose'}, {apart:.0f} "
        f"degrees apart, fit equally well (shape off by {100 * losses[0]:.3g} % and {100 * losses[1]:.3g} %, noise "
        f"{100 * noise:.2g} %, and colours do not decide). Shape or colour that tells them apart was needed: put a "
        "sticker on the object, or photograph it so that both object poses show more of the same sides."
    )


def mean_difference(
    a: Float[np.ndarray, " n"],
    b: Float[np.ndarray, " n"],
    group: Int[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"] | float = 1.0,
) -> tuple[float, float]:
    """Return the mean of a - b where both are known, and one sigma of it, from how it varies between groups.

    The ratio estimator of cluster sampling [Cochran 1977, 6.4]: errors inside a group may be correlated. 0 and 0 with
    fewer than two groups.

    Args:
        a, b: errors of the same rays or points in two cases; nan where unknown.
        group: of each error, counted from 0.
        weight: of each error in the mean.
    """
    known = np.isfinite(a) & np.isfinite(b)
    counts = np.broadcast_to(weight, known.shape)[known]
    change, own = counts * (a - b)[known], group[known]
    total, count = np.bincount(own, change), np.bincount(own, counts)
    used = int((count > 0).sum())
    if used < 2:
        return 0.0, 0.0
    mean = float(change.sum() / counts.sum())
    return mean, float(np.sqrt(used / (used - 1) * ((total - mean * count) ** 2).sum()) / counts.sum())


class _Field:
    """A signed distance grid with its gradient at the nodes, so that one look-up returns both."""

    def __init__(self, grid: SdfGrid):
        slopes = torch.stack(torch.gradient(grid.values, spacing=grid.spacing))
        self._volume = torch.cat([grid.values[None], slopes])[None].float()
        self._last = torch.tensor(grid.values.shape, dtype=torch.float64) - 1
        self._origin, self._spacing = grid.origin.double(), grid.spacing

    def at(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Return the distance and its gradient at points; outside the box as SdfGrid.sdf."""
        x = (torch.from_numpy(points) - self._origin) / self._spacing
        inside = torch.minimum(x.clamp(min=0), self._last)
        scaled = (2 * inside / self._last - 1).float()
        found = torch.nn.functional.grid_sample(
            self._volume, scaled.flip(-1)[None, None, None], mode="bilinear", align_corners=True
        )[0, :, 0, 0].double()
        beyond = x - inside
        length = beyond.norm(dim=1)
        slope = torch.where(length[:, None] > 0, beyond / length.clamp(min=1e-9)[:, None], found[1:].T)
        return (found[0] + self._spacing * length).numpy(), slope.numpy()
