"""Mixtures of groups of photos: does one number per photo come from one group of photos, or from several?

Each group's numbers lie about its median, with one width for all groups (Laplace's distribution, whose likelihood a few
odd photos hardly change). A further group has to pay for which photo belongs to it, and for what it leaves free:
classification likelihood with Schwarz's criterion [Biernacki, Celeux and Govaert, Assessing a mixture model for
clustering with the integrated completed likelihood, IEEE PAMI 22 (2000)].
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

FREE = 2  # what a further group leaves free: its middle, and where it ends
RARE = float(np.log(1000))  # nats: of ordinary numbers, normal to Student's t, one set in some hundreds looks like two
NAMED = 6  # photos in a sentence, at most
STEADY = 0.01  # log power of one flashlight: it jitters by a per cent, and a battery fades by some during a session


def costs(
    values: Float[np.ndarray, " photos"], groups: Bool[np.ndarray, " photos"], noise: float, differs: bool = True
) -> Float[np.ndarray, "2 photos"]:
    """Return each photo's negative log likelihood in the first and in the second group, up to a constant.

    Args:
        values: one per photo; NaN where unknown, which costs nothing.
        groups: which photos are in the second group; all False: there is one group.
        noise: least mean deviation, in the unit of the values: numbers are never known better than that.
        differs: whether the groups have medians of their own.
    """
    known, own = np.isfinite(values), groups.astype(int)
    members = [known & (~groups if differs else True), known & (groups if differs else True)]
    middle = [float(np.median(values[some])) if some.any() else np.nan for some in members]
    off = np.abs(values - np.array(middle)[:, None])
    mine = off[own, np.arange(len(values))][known]
    width = max(float(mine.mean()) if len(mine) else 0.0, noise)
    return np.where(known, np.nan_to_num(off / width + np.log(width / noise)), 0.0)


def price(groups: Bool[np.ndarray, " photos"], free: int = FREE) -> float:
    """Return what a second group costs: which photo is in which group, and numbers that it leaves free.

    A group that begins or ends with one of the photos, in their order, is told by that photo, any other photo by photo.
    """
    n, share = len(groups), groups.mean()
    shares = np.array([share, 1 - share])
    each = -n * float((shares * np.log(np.maximum(shares, 1 / n))).sum())
    changes = int((groups[1:] != groups[:-1]).sum())
    which = np.log(2) + min(each, np.log(2 * n) if changes == 1 else np.inf)  # log 2: in which of the ways it is told
    return float(RARE + which + 0.5 * free * np.log(n))


def levels(values: Float[np.ndarray, " photos"], noise: float) -> Float[np.ndarray, " photos"]:
    """Return for each photo the median of its group, of one, two or three as the numbers tell; NaN stays NaN."""
    known = np.flatnonzero(np.isfinite(values))
    order, n = known[np.argsort(values[known])], len(known)
    sums, found = np.append(0.0, np.cumsum(values[order])), np.full(len(values), np.nan)
    first, end = np.ogrid[: n + 1, : n + 1]
    # deviations from a group's median: its upper, less its lower half
    low, high = (first + end) // 2, (first + end + 1) // 2
    off = np.where(end >= first, sums[end] - sums[high] - sums[low] + sums[first], np.inf)
    three = np.where((first > 0) & (end < n), off[0][:, None] + off + off[:, n][None], np.inf)
    cuts = [(), (int(np.argmin(off[0] + off[:, n])),), np.unravel_index(int(np.argmin(three)), three.shape)]
    best = np.inf
    for one in cuts if n else []:
        parts = [part for part in np.split(order, np.array(one, int)) if len(part)]
        total = sum(float(np.abs(values[part] - np.median(values[part])).sum()) for part in parts)
        width, share = max(total / n, noise), np.array([len(part) / n for part in parts])
        own = total / width + n * np.log(width / noise) - n * float((share * np.log(share)).sum())
        own += (len(parts) - 1) * (RARE + 0.5 * FREE * np.log(n))
        if own < best:
            best = own
            for part in parts:
                found[part] = np.median(values[part])
    return found


def usual_level(found: Float[np.ndarray, " photos"]) -> float:
    """Return the level of the largest group, as `levels` gives them; of equal ones the lower."""
    middle, count = np.unique(found[np.isfinite(found)], return_counts=True)
    return float(middle[np.argmax(count)])


def which_photos(names: Sequence[str], groups: Bool[np.ndarray, " photos"]) -> str:
    """Say which photos a group holds: "from IMG_0108 on", "until IMG_0107", or their names."""
    inside = np.flatnonzero(groups)
    first, last = int(inside[0]), int(inside[-1])
    if len(inside) > 1 and len(inside) == last - first + 1 and last == len(groups) - 1:
        return f"from {names[first]} on"
    if len(inside) > 1 and len(inside) == last - first + 1 and first == 0:
        return f"until {names[last]}"
    shown = ", ".join(names[k] for k in inside[:NAMED])
    more = f" and {len(inside) - NAMED} more" if len(inside) > NAMED else ""
    return f"in {shown}{more}"
