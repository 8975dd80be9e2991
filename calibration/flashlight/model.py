"""Flashlights: one handheld flashlight per photo over a ground of unknown albedo, and their robust least-squares fit.

Photo k, cell j at p on the ground, flashlight at s with beam axis a, height z, distance d, c = cosine off the axis:

    pixel_kj = albedo_j * (power_k * (g(c) * z / d^3 + wall_kj) * USUAL^2 + ambient), USUAL of calibration.lights.hand
    log g(c) = m log c + r2 u^2 + r3 u^3 + ..., u = 1 - c

wall_kj is what comes by way of a wall: see calibration.flashlight.wall. Splines of u may be added to log g: see
calibration.flashlight.beam_profile.

A beam that is not round adds (o_1 cos 2 phi + o_2 sin 2 phi) (theta / 40 degrees)^2 to log g, with theta = arccos c
and phi the angle about the axis. This is the first term of any beam that is symmetric under half a turn; its roll
differs from photo to photo. The one-sided first term is equivalent to a shift of the aim, which is fitted anyway.

The albedo of every cell is eliminated (variable projection). It also absorbs vignetting and any part of the
reflectance that depends on the fixed view alone. Only brightness ratios between photos count.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from calibration.flashlight.beam_profile import SMOOTH_TERMS, derivatives
from calibration.flashlight.beam_profile import log_gain as beam_log_gain
from calibration.flashlight.wall import BY, NO_WALL, WALL_TERMS, Wall, moved, wall_light
from calibration.lights import hand
from calibration.lights.ground_cells import GroundCells
from calibration.lights.response import STEEPEST, WIDTHS, bend, integrals, slopes
from calibration.outlines.terms import OutlineTerms

NOISE = 0.01  # relative error granted to a cell; the widths of all priors count in this unit
FLOOR = 0.001  # of full scale: what quantisation and stray light add
PER_FLASHLIGHT = 7  # position 3, a point on the beam axis 3, log power 1; two more where beams are oval
OVAL_ANGLE = np.radians(40.0)  # off the axis, where the two terms of an oval beam are stated
LOWEST_COSINE = 0.05  # beyond 87 degrees off the axis the beam means nothing
LAMP = 10.0  # mm above the ground, where a lamp would lie on the table
MAX_STEP = 0.25  # of the flashlight's distance, per iteration

Samples = Float[np.ndarray, "photos cells"]
Tangent = Callable[["Flashlights"], Float[np.ndarray, "full reduced"]]


class _Modelled(NamedTuple):
    """What a state says of every sample: a state's residuals, cost and derivatives ask for the same."""

    light: Samples  # log irradiance
    exposed: Samples | None  # log of light times exposure about its median over the series; None: linear pictures
    pictured: Samples  # log irradiance as the pictures' response shows it
    distance: Samples
    toward: Float[np.ndarray, "photos cells 3"]
    cosine: Samples
    share: Samples  # of the light that comes straight from the flashlight
    total: Samples
    more: Samples  # by way of the wall


@dataclass(frozen=True)
class Flashlights:
    """The state of the fit: world frame, powers relative to one another."""

    positions: Float[np.ndarray, "photos 3"]
    targets: Float[np.ndarray, "photos 3"]  # some point on each beam axis, about where it meets the scene
    log_power: Float[np.ndarray, " photos"]
    beam: Float[np.ndarray, " terms"]  # m, r2, r3, r4, then splines of u, if any
    ambient: float
    aim: Float[np.ndarray, "3"]  # where the person aims on average
    wall: Wall = field(default_factory=lambda: NO_WALL)
    # of the pictures; none: linear
    response: Float[np.ndarray, " responses"] = field(default_factory=lambda: np.zeros(0))
    oval: Float[np.ndarray, "photos 2"] | None = None  # log gain at OVAL_ANGLE by cos 2 phi, sin 2 phi; None: round
    _modelled: list[tuple["Evidence", _Modelled]] = field(default_factory=list, init=False, repr=False)

    def per_flashlight(self) -> int:
        """Return the number of full coordinates per flashlight."""
        return PER_FLASHLIGHT if self.oval is None else PER_FLASHLIGHT + 2

    def shared(self) -> int:
        """Return the number of coordinates that all flashlights share: beam, ambient, wall, response, mean aim."""
        return len(self.beam) + 1 + WALL_TERMS + len(self.response) + 3

    def axes(self) -> Float[np.ndarray, "photos 3"]:
        """Unit beam axes."""
        beam = self.targets - self.positions
        return beam / np.linalg.norm(beam, axis=-1, keepdims=True)

    def moved(self, step: Float[np.ndarray, " full"], height: float) -> "Flashlights":
        """Return the state after a step; flashlights stay above the ground (z = height) and steps are limited."""
        n, own = len(self.positions), self.per_flashlight()
        flashlight, rest = step[: own * n].reshape(n, own), step[own * n :]
        reach = MAX_STEP * np.linalg.norm(self.positions - self.aim, axis=1)
        size = np.linalg.norm(flashlight[:, :3], axis=1)
        flashlight = flashlight * np.minimum(1, reach / np.maximum(size, 1e-12))[:, None]
        positions = self.positions + flashlight[:, :3]
        positions[:, 2] = np.maximum(positions[:, 2], height + LAMP)
        terms = len(self.beam)
        return Flashlights(
            positions,
            self.targets + flashlight[:, 3:6],
            self.log_power + np.clip(flashlight[:, 6], -1, 1),
            self.beam + np.clip(rest[:terms], -1, 1),
            max(self.ambient + rest[terms], 0.0),
            self.aim + rest[-3:],
            moved(self.wall, rest[terms + 1 : terms + 1 + WALL_TERMS]),
            np.clip(self.response + rest[terms + 1 + WALL_TERMS : -3], -STEEPEST, STEEPEST),
            None if self.oval is None else self.oval + flashlight[:, PER_FLASHLIGHT:],
        )


@dataclass(frozen=True)
class Priors:
    """Prior sigmas in units of one cell's NOISE: an error of 1 % of power counts as much as one cell off by 1 %."""

    log_power: float = 0.01  # one flashlight on one battery: 1 % stays harmless under 3 % jitter and 8 % drift
    aim: float = hand.AIM  # mm by which single beams miss the common aim
    aim_mean: float = hand.AIM_MEAN  # mm by which the common aim misses the middle of the photo
    beam: float = 5.0  # m, r2, r3, r4
    ring: float = 0.3  # splines: rings of LEDs are dimmer or brighter by tens of per cent
    wall: tuple[float, ...] = (10.0, 1.0, 1.0)  # azimuth: none is likelier; log distance; albedo
    ambient: float = 0.2  # of a flashlight at a hand's usual distance
    power_outlier: float = 0.1  # a photo this far (log) from the common power is another exposure: Geman-McClure
    usual: Float[np.ndarray, " photos"] | float = 0.0  # log power that a photo shares with those of its group
    oval: float = 0.02  # a beam without any such misfit keeps its accuracy (0.05 to 0.06 % in simulations)


@dataclass(frozen=True)
class Evidence:
    """The data of the fit: log brightness of every cell in every photo, and its weight before robust reweighting."""

    cells: GroundCells
    height: float
    log_grey: Samples
    weight: Samples  # 1 / variance; 0 where unusable
    outlines: OutlineTerms | None = None  # of shadows and object, for the same photos
    exposure: Float[np.ndarray, " photos"] | None = None  # log of what each photo was divided by; None: linear pictures

    def at(self, some: Int[np.ndarray, " some"] | Bool[np.ndarray, " cells"]) -> "Evidence":
        """Return the evidence of some cells, without outlines."""
        cells = self.cells
        cells = replace(cells, points=cells.points[some], rgb=cells.rgb[:, some], usable=cells.usable[:, some])
        log_grey, weight = self.log_grey[:, some], self.weight[:, some]
        return Evidence(cells, self.height, log_grey, weight, exposure=self.exposure)

    @staticmethod
    def of(cells: GroundCells, gains: Float[np.ndarray, " photos"], height: float) -> "Evidence":
        """Build from cell means; the PhotoStack's `gains` raise the noise floor."""
        grey = np.maximum(cells.grey(), 1e-9)
        weight = cells.usable / (NOISE**2 + (FLOOR / gains[:, None] / grey) ** 2)
        return Evidence(cells, height, np.log(grey), weight)


def log_irradiance(flashlights: Flashlights, evidence: Evidence) -> Samples:
    """Return the log irradiance at every cell, relative to a flashlight of power 1 at a hand's usual distance."""
    return _model(flashlights, evidence).light


def log_pictured(flashlights: Flashlights, evidence: Evidence) -> Samples:
    """Return the log irradiance as the pictures' response shows it."""
    return _model(flashlights, evidence).pictured


def cosines(flashlights: Flashlights, evidence: Evidence) -> Samples:
    """Return the cosine of the angle off the beam's axis at which every cell is seen from every flashlight."""
    return _model(flashlights, evidence).cosine


def _model(flashlights: Flashlights, evidence: Evidence) -> _Modelled:
    """Compute what a state says, or return it: the last answer stays with the state."""
    for before, known in flashlights._modelled:
        if before.cells is evidence.cells and before.height == evidence.height and before.exposure is evidence.exposure:
            return known
    flashlights._modelled[:] = [(evidence, _compute(flashlights, evidence))]
    return flashlights._modelled[0][1]


def _compute(flashlights: Flashlights, evidence: Evidence) -> _Modelled:
    """Compute what a state says of every sample.

    The formula is that of calibration.light.irradiance on level ground, for all photos at once and in logarithms, with
    oval beams and ambient light added. Cosines are clamped at LOWEST_COSINE, where derivatives stay finite.
    """
    to_cell = evidence.cells.points[None] - flashlights.positions[:, None]
    distance = np.linalg.norm(to_cell, axis=-1)
    toward = to_cell / distance[..., None]
    axes = flashlights.axes()
    cosine = np.maximum(np.einsum("kjx,kx->kj", toward, axes), LOWEST_COSINE)
    log_gain = beam_log_gain(cosine, flashlights.beam)
    if flashlights.oval is not None:
        log_gain = log_gain + np.einsum("kjp,kp->kj", _oval_terms(toward, cosine, axes), flashlights.oval)
    z = flashlights.positions[:, 2] - evidence.height
    log_flash = flashlights.log_power[:, None] + log_gain + np.log(z * hand.USUAL**2)[:, None] - 3 * np.log(distance)
    flash = np.exp(log_flash)
    more = _by_wall(flashlights, evidence, flashlights.wall, float(cosine.min()))
    total = flash + flashlights.ambient + more
    light = pictured = np.log(total)
    exposed = None
    if len(flashlights.response):
        exposed = light if evidence.exposure is None else light + evidence.exposure[:, None]
        exposed = exposed - np.median(exposed)
        pictured = light + bend(exposed, flashlights.response)
    return _Modelled(light, exposed, pictured, distance, toward, cosine, flash / total, total, more)


def _by_wall(flashlights: Flashlights, evidence: Evidence, wall: Wall, narrowest: float) -> Samples:
    """Return the irradiance by way of a wall, relative to a flashlight of power 1 at a hand's usual distance."""
    points, middle = evidence.cells.points, evidence.cells.centre
    place = flashlights.positions, flashlights.axes(), flashlights.beam
    return np.exp(flashlights.log_power[:, None]) * hand.USUAL**2 * wall_light(wall, *place, narrowest, points, middle)


def _oval_terms(
    toward: Float[np.ndarray, "photos cells 3"], cosine: Samples, axes: Float[np.ndarray, "photos 3"]
) -> Float[np.ndarray, "photos cells 2"]:
    """Return cos 2 phi and sin 2 phi times (theta / OVAL_ANGLE)^2, phi in the frame of `across`."""
    first, second = across(axes)
    a, b = np.einsum("kjx,kx->kj", toward, first), np.einsum("kjx,kx->kj", toward, second)
    size = (np.arccos(cosine) / OVAL_ANGLE) ** 2 / np.maximum(a**2 + b**2, 1e-12)
    return np.stack([(a**2 - b**2) * size, 2 * a * b * size], -1)


def jacobian(flashlights: Flashlights, evidence: Evidence):
    """Derivatives of log_pictured: (photos, cells, own) by each photo's, (photos, cells, shared - 3) by the rest.

    Two turns are neglected: that of the oval's terms with flashlight and axis, and that of the wall's light with the
    flashlight's place, aim and beam. Both are a few per cent of the light.
    """
    _, exposed, _, distance, toward, cosine, share, total, more = _model(flashlights, evidence)
    axes = flashlights.axes()
    by_cosine, by_term = derivatives(cosine, flashlights.beam)
    reach = np.linalg.norm(flashlights.targets - flashlights.positions, axis=1)[:, None, None]
    off_axis = toward - cosine[..., None] * axes[:, None]  # cosine by the target, times reach
    off_cell = axes[:, None] - cosine[..., None] * toward  # cosine by the point lit, times distance
    flashlight = np.zeros((*cosine.shape, flashlights.per_flashlight()))
    flashlight[..., :3] = 3 * toward / distance[..., None]
    flashlight[..., :3] -= by_cosine[..., None] * (off_cell / distance[..., None] + off_axis / reach)
    flashlight[..., 2] += 1 / (flashlights.positions[:, 2] - evidence.height)[:, None]
    flashlight[..., 3:6] = by_cosine[..., None] * off_axis / reach
    flashlight[..., 6] = 1
    if flashlights.oval is not None:
        flashlight[..., PER_FLASHLIGHT:] = _oval_terms(toward, cosine, axes)
    flashlight *= share[..., None]
    flashlight[..., 6] += more / total
    wall, seen = flashlights.wall, float(cosine.min())
    by_wall = [(_by_wall(flashlights, evidence, wall + step, seen) - more) / BY for step in BY * np.eye(WALL_TERMS)[:2]]
    by_wall.append(_by_wall(flashlights, evidence, np.r_[wall[:2], 1.0], seen) if wall[2] <= 0 else more / wall[2])
    shared = [by_term * share[..., None], np.stack([np.ones_like(total), *by_wall], -1) / total[..., None]]
    if exposed is None:
        return flashlight, np.concatenate(shared, -1)
    slope = 1 + (slopes(exposed) @ flashlights.response)[..., None]
    return flashlight * slope, np.concatenate([*(slope * one for one in shared), integrals(exposed)], -1)


def log_albedo(flashlights: Flashlights, evidence: Evidence, weight: Samples) -> Float[np.ndarray, " cells"]:
    """Return the log albedo of each cell that fits its weighted samples best; of a cell without any their median."""
    raw = evidence.log_grey - log_pictured(flashlights, evidence)
    total = weight.sum(0)
    level = (weight * raw).sum(0) / np.maximum(total, 1e-12)
    silent = total <= 0  # no photo votes: the median lets such a cell come back
    level[silent] = _median(raw[:, silent], evidence.weight[:, silent] > 0)
    return level


def cell_residuals(flashlights: Flashlights, evidence: Evidence, weight: Samples) -> Samples:
    """Return log measured minus log modelled brightness, for the albedos that fit best.

    Variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973).
    """
    return evidence.log_grey - log_pictured(flashlights, evidence) - log_albedo(flashlights, evidence, weight)


def _median(values: Float[np.ndarray, "rows n"], known: Bool[np.ndarray, "rows n"]) -> Float[np.ndarray, " n"]:
    """Return the median of each column's known values; 0 where there are none."""
    ordered, count = np.sort(np.where(known, values, np.inf), axis=0), known.sum(0)
    column, some = np.arange(values.shape[1]), count > 0
    low, high = ordered[(count - 1) // 2 * some, column], ordered[count // 2 * some, column]
    return np.where(some, 0.5 * (np.where(some, low, 0.0) + np.where(some, high, 0.0)), 0.0)


def _prior_widths(flashlights: Flashlights, priors: Priors) -> Float[np.ndarray, " shared"]:
    """Return the sigmas of what all flashlights share."""
    smooth = min(len(flashlights.beam), SMOOTH_TERMS)
    beam = np.repeat([priors.beam, priors.ring], [smooth, len(flashlights.beam) - smooth])
    response = WIDTHS[: len(flashlights.response)]
    return np.r_[beam, priors.ambient, priors.wall, response, np.full(3, priors.aim_mean)]


def _prior_terms(flashlights: Flashlights, evidence: Evidence, priors: Priors) -> Float[np.ndarray, " rows"]:
    """Return the residuals of the priors, divided by their sigmas."""
    miss = (flashlights.targets - flashlights.aim) / priors.aim
    first, second = across(flashlights.axes())
    own_power = flashlights.log_power - priors.usual
    bent = 1 + (own_power / priors.power_outlier) ** 2
    missed = flashlights.aim - evidence.cells.centre
    shared = np.r_[flashlights.beam, flashlights.ambient, flashlights.wall - NO_WALL, flashlights.response, missed]
    shared /= _prior_widths(flashlights, priors)
    oval = np.zeros(0) if flashlights.oval is None else flashlights.oval.T.ravel() / priors.oval
    return np.r_[(miss * first).sum(1), (miss * second).sum(1), own_power / bent**0.5 / priors.log_power, shared, oval]


def _prior_slopes(flashlights: Flashlights, priors: Priors) -> Float[np.ndarray, "rows full"]:
    """Return the derivatives of _prior_terms."""
    n, shared, own = len(flashlights.positions), flashlights.shared(), flashlights.per_flashlight()
    jac = np.zeros((3 * n + shared + (own - PER_FLASHLIGHT) * n, own * n + shared))
    rows = np.arange(n)
    for offset, basis in zip((0, n), across(flashlights.axes()), strict=True):
        jac[offset + rows[:, None], own * rows[:, None] + [3, 4, 5]] = basis / priors.aim
        jac[offset + rows, -3:] = -basis / priors.aim
    bent = 1 + ((flashlights.log_power - priors.usual) / priors.power_outlier) ** 2
    jac[2 * n + rows, own * rows + 6] = bent**-1.5 / priors.log_power
    jac[3 * n : 3 * n + shared, own * n :] = np.diag(1 / _prior_widths(flashlights, priors))
    for term in range(own - PER_FLASHLIGHT):
        jac[3 * n + shared + n * term + rows, own * rows + PER_FLASHLIGHT + term] = 1 / priors.oval
    return jac


def across(axes: Float[np.ndarray, "photos 3"]):
    """Return two unit vectors orthogonal to each axis and to one another, world."""
    helper = np.where(np.abs(axes[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(axes, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axes, first)


def free_tangent(flashlights: Flashlights) -> Float[np.ndarray, "full reduced"]:
    """Return a basis per free photo: position 3, aim 2 (across the beam), power 1, [oval 2]; and the shared parameters.

    The shared parameters are beam, ambient, wall, response and mean aim.
    """
    n, own, shared = len(flashlights.positions), flashlights.per_flashlight(), flashlights.shared()
    basis = np.zeros((own * n + shared, (own - 1) * n + shared))
    blocks = basis[: own * n, : (own - 1) * n].reshape(n, own, n, own - 1)
    photo = range(n)
    blocks[photo, :3, photo, :3] = np.eye(3)
    blocks[photo, 3:6, photo, 3:5] = np.stack(across(flashlights.axes()), -1)
    blocks[photo, 6:, photo, 5:] = np.eye(own - 6)
    basis[own * n :, (own - 1) * n :] = np.eye(shared)
    return basis


def pulled(jacobian: tuple[np.ndarray, np.ndarray], weighted: Samples) -> Float[np.ndarray, " full"]:
    """Return J' times weighted residuals of the cells, in the full coordinates."""
    flashlight, shared = jacobian
    by_photo = np.einsum("kjp,kj->kp", flashlight, weighted).ravel()
    return np.concatenate([by_photo, np.einsum("kj,kjg->g", weighted, shared), np.zeros(3)])


def normal_equations(
    flashlights: Flashlights,
    evidence: Evidence,
    weight: Samples,
    priors: Priors,
    slopes: tuple[np.ndarray, np.ndarray] | None = None,
):
    """Return J' W J and J' W r in the full coordinates with priors; albedo is eliminated by its Schur complement.

    Triggs et al., Bundle Adjustment - A Modern Synthesis (2000), section 6. Full coordinates: per photo position (world
    length), a point on the beam axis (world length), log power, [oval 2]; then beam, ambient, wall, response, mean aim.

    Args:
        slopes: of `jacobian`, where the caller has them.
    """
    n, own = len(flashlights.positions), flashlights.per_flashlight()
    residual = cell_residuals(flashlights, evidence, weight)
    flashlight, shared = jacobian(flashlights, evidence) if slopes is None else slopes
    cut = own * n
    full = cut + shared.shape[-1] + 3
    weighted = weight[..., None] * flashlight
    by_cell = np.zeros((weight.shape[1], full))
    by_cell[:, :cut] = weighted.transpose(1, 0, 2).reshape(weight.shape[1], cut)
    by_cell[:, cut:-3] = np.einsum("kj,kjg->jg", weight, shared)
    matrix = -by_cell.T @ (by_cell / np.maximum(weight.sum(0), 1e-12)[:, None])
    alone = weighted.transpose(0, 2, 1) @ flashlight
    mixed = weighted.transpose(0, 2, 1) @ shared
    for k in range(n):
        block = slice(own * k, own * (k + 1))
        matrix[block, block] += alone[k]
        matrix[block, cut:-3] += mixed[k]
        matrix[cut:-3, block] += mixed[k].T
    matrix[cut:-3, cut:-3] += np.einsum("kj,kjg,kjh->gh", weight, shared, shared, optimize=True)
    downhill = pulled((flashlight, shared), weight * residual)
    value, jac = _prior_terms(flashlights, evidence, priors), _prior_slopes(flashlights, priors)
    if evidence.outlines is not None:
        more, by_place = evidence.outlines.rows(flashlights.positions)
        wide = np.zeros((len(more), full))
        wide[:, :cut].reshape(len(more), n, own)[:, :, :3] = by_place
        value, jac = np.concatenate([value, more]), np.concatenate([jac, wide])
    jac = csr_array(jac)
    return matrix + (jac.T @ jac).toarray(), downhill - jac.T @ value


def cost(flashlights: Flashlights, evidence: Evidence, weight: Samples, priors: Priors) -> float:
    """Return half the weighted sum of squared log residuals with priors: the objective of `descend`."""
    value = _prior_terms(flashlights, evidence, priors)
    outlines = 0.0 if evidence.outlines is None else evidence.outlines.cost(flashlights.positions)
    return outlines + 0.5 * float((weight * cell_residuals(flashlights, evidence, weight) ** 2).sum() + value @ value)
