"""Light that is mixed: two groups of photos that one flashlight in a room that stays as it is does not explain.

Each photo has four numbers that do not depend on where its light is: the flashlight's power, the light in its shadows,
how much of its shading one flashlight leaves unexplained, and whether its shadow has one depth. Two groups that one of
them shows are explained in four ways, and the likelihood of all four numbers tells which it is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from calibration.light import Light
from capture.checks.ambient_light import ALIKE, Shadows, excess
from capture.checks.mixture import STEADY, costs, price, which_photos

SECOND_LIGHT = "a second light is on, as the ground's brightness and the shadows tell"
MISFIT = 0.35  # log: by which one flashlight's misfit varies between photos, as its height and beam do


@dataclass(frozen=True)
class PhotoLight:
    """Numbers of each photo; NaN where unknown."""

    log_power: Float[np.ndarray, " photos"]
    in_shadow: Float[np.ndarray, " photos"]  # light in its cast shadows, of the usual light
    log_misfit: Float[np.ndarray, " photos"]
    one_depth: Bool[np.ndarray, " photos"]  # whether its cast shadow is of one level

    @staticmethod
    def of(shadows: Shadows, log_power: Float[np.ndarray, " photos"], misfit: Float[np.ndarray, " photos"]):
        """Return the numbers of photos whose shadows were found.

        Args:
            misfit: of the ground's shading in each photo, on any common scale.
        """
        clear = np.isfinite(shadows.levels)
        room = float(np.median(shadows.levels[clear])) if clear.any() else 0.0
        return PhotoLight(log_power, np.maximum(room + excess(shadows), ALIKE), np.log(np.maximum(misfit, 1e-6)), clear)


@dataclass(frozen=True)
class MixedLight:
    """Two groups of photos, and why they differ."""

    cause: str  # "power": of the flashlight, or of the exposure; "second light"
    groups: Bool[np.ndarray, " photos"]  # the smaller group; those with a second light
    ratio: float  # of its power over that of the others

    def sentence(self, names: Sequence[str]) -> str:
        """Say it to the user.

        Args:
            names: of all photos, in their order.
        """
        groups, ratio = self.groups, self.ratio
        if self.cause != "second light" and groups[0]:  # what changed is told of the photos that came later
            groups, ratio = ~groups, 1 / ratio
        which, times = which_photos(names, groups), f"{ratio:.2g} times as"
        if self.cause == "power":
            return f"{which} the light is {times} bright as in the other photos: each is used with its own power"
        return f"{which} {SECOND_LIGHT}: these photos are {times} bright as the others. Take them again with one light"

    def spoilt(self) -> Bool[np.ndarray, " photos"]:
        """Return the photos whose lights cannot be found."""
        return self.groups & (self.cause == "second light")


def mixture_of(lights: Sequence[Light], misfit: Mapping[str, float], shadows: Shadows) -> MixedLight | None:
    """Return the two groups of photos that a calibration finds; None if its photos are of one group.

    Args:
        lights: of the photos of `shadows`, in their order.
        misfit: of the ground's shading by the photo's name; {}: not known.
    """
    power = np.log([max(float(light.power.mean()), 1e-12) for light in lights])
    found = find_mixture(PhotoLight.of(shadows, power, np.array([misfit.get(x.photo, 1.0) for x in lights])))
    if found is None or found.spoilt().any():
        return found
    used = np.array([light.used for light in lights])
    return found if 2 * used[found.groups].sum() > found.groups.sum() else None  # unused lights' powers mean nothing


def find_mixture(light: PhotoLight) -> MixedLight | None:
    """Return the two groups of photos that explain their numbers best, and the cause; None if one group does.

    Groups start as every cut of the photos, in the order that they were taken in and in that of each number; then each
    photo goes where all its numbers fit better.
    """
    n = len(light.log_power)
    best, found = float(_costs(light, np.zeros(n, bool), "")[0].sum()), None
    ranks = [np.arange(n)]
    ranks += [np.argsort(np.argsort(x)) for x in (light.log_power, light.in_shadow, light.log_misfit, light.one_depth)]
    starts = [side for rank in ranks for cut in range(1, n) for side in (rank < cut, rank >= cut)]
    for start, cause in product(starts, FREE):
        groups, trial = _settled(light, start, cause)
        if trial < best:
            best, found = trial, MixedLight(cause, groups, float(np.exp(_apart(light.log_power, groups))))
    return found


# What each cause leaves free, with where the groups end: medians and shares that differ.
FREE = {"power": 3, "second light": 5}
ROUNDS = 4  # of assigning photos to groups: few change after the first


def _settled(
    light: PhotoLight, groups: Bool[np.ndarray, " photos"], cause: str
) -> tuple[Bool[np.ndarray, " photos"], float]:
    """Return the groups after each photo went where it costs less, and what all photos cost then."""
    found, best = groups, np.inf
    for _ in range(ROUNDS):
        table = _costs(light, groups, cause)
        total = float(table[groups.astype(int), np.arange(len(groups))].sum()) + price(groups, FREE[cause])
        if total >= best:
            break
        found, best = groups, total
        share = (groups.sum() + 0.5) / (len(groups) + 1)
        nearer = table[1] - np.log(share) < table[0] - np.log(1 - share)
        if nearer.all() or not nearer.any():
            break
        groups = nearer
    return found, best


def _costs(light: PhotoLight, groups: Bool[np.ndarray, " photos"], cause: str) -> Float[np.ndarray, "2 photos"]:
    """Return each photo's cost outside and inside the group, if the groups differ for that cause; "": they do not.

    A second light adds light everywhere: it makes photos brighter, shadows too, and no shadow clearer; photos that are
    not brighter than one flashlight's power varies have none. With the power goes some of the light in the shadows:
    what the flashlight's own light reaches, or all of it with the exposure.
    """
    second, power, in_shadow = cause == "second light", _apart(light.log_power, groups), light.in_shadow
    if second and power <= STEADY:
        return np.full((2, len(groups)), np.inf)
    if cause == "power":
        own_shadow = _apart(in_shadow, groups) * _apart(in_shadow * np.exp(-power * groups), groups) < 0
    else:
        own_shadow = second and _apart(in_shadow, groups) > 0
    table = costs(light.log_power, groups, STEADY, cause != "")
    table = table + costs(in_shadow, groups, ALIKE, own_shadow)
    table += costs(light.log_misfit, groups, MISFIT, second and _apart(light.log_misfit, groups) > 0)
    share, all_of = [_share(light.one_depth[some]) for some in (~groups, groups)], _share(light.one_depth)
    chances = np.array(share if second and share[1] < share[0] else [all_of, all_of])[:, None]
    return table - np.where(light.one_depth, np.log(chances), np.log(1 - chances))


def _share(yes: Bool[np.ndarray, " photos"]) -> float:
    return (float(yes.sum()) + 0.5) / (len(yes) + 1)


def _apart(values: Float[np.ndarray, " photos"], groups: Bool[np.ndarray, " photos"]) -> float:
    """Return how much larger the group's median is than that of the others; 0 where one of them is unknown."""
    own, other = (values[some][np.isfinite(values[some])] for some in (groups, ~groups))
    return float(np.median(own) - np.median(other)) if len(own) and len(other) else 0.0
