"""Weigh the views of a capture together: what each lacks, what all of them lack, and where the tripod goes next."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calibration.calibrated_views import CalibratedViews
from reconstruct.check.light_coverage import ShadowCover, side_in_words, widest_gap
from reconstruct.check.readiness import MORE_LIGHTS, PLENTY, Judge, Readiness, judge_gap, verdict_of
from reconstruct.check.surface_seen import LEAST_APART, surface_seen

MUCH_SEEN = 0.9  # of the surface that silhouettes leave: no further place is advised
WORTH_A_VIEW = 0.05  # of that surface, that one more view would add


def judge_together(views: CalibratedViews, parts: Sequence[Readiness], covers: Sequence[ShadowCover]) -> Readiness:
    """Weigh the views of a capture.

    Args:
        parts, covers: of each of views.views, judged as part of several.
    """
    say = Judge([])
    for view, part in zip(views.views, parts, strict=True):
        for k, reason in enumerate(part.reasons):
            grade = "poor" if part.grade == "hopeless" else part.grade  # the other views are used
            advice = part.advice[k] if k < len(part.advice) else ""
            say(grade if k == 0 else "fair", f"{view.name}: {reason}", f"{view.name}: {advice}" if advice else "")
    for name, reason in views.left_out:
        say("poor", f"{name} is left out: {reason.rstrip('.')}", "")
    centre = np.mean([cover.centre for cover in covers], axis=0)
    lights = tuple(light for view in views.views for light in view.calibration.lights)
    all_round, facts = replace(views.first, lights=lights), _facts_together(views, parts)
    start, gap = widest_gap(all_round, centre)
    judge_gap(say, facts["photos_used"], (start, gap), all_round, centre)
    if facts["photos_used"] < PLENTY:
        say("fair", f"{facts['photos_used']} photos: {PLENTY} or more show more of the shape", MORE_LIGHTS)
    facts |= {"widest_gap_deg": float(np.degrees(gap))} | _judge_places(say, views, covers, centre)
    return verdict_of(say, facts)


def _judge_places(
    say: Judge, views: CalibratedViews, covers: Sequence[ShadowCover], centre: np.ndarray
) -> dict[str, float]:
    """Judge where the tripod stood; return the share of the surface that is seen, and what one more view adds."""
    seen = surface_seen(views, [cover.mask for cover in covers], centre)
    for one, other, angle in seen.close_pairs:
        reason = f"{one} and {other} look from directions only {np.degrees(angle):.0f} degrees apart"
        apart = f"{np.degrees(LEAST_APART):.0f} degrees"
        say("fair", reason, f"Put the tripod at least {apart} farther around the object for another view.")
    if len(views.views) < 2:  # the cone behind one silhouette is no object
        return {}
    if seen.share < MUCH_SEEN and seen.gain >= WORTH_A_VIEW:
        side = side_in_words(seen.next_azimuth, views.first, centre)
        reason = f"{seen.share:.0%} of the object's surface is seen by a view, as far as silhouettes tell"
        more = f"with a view {side} (as seen in {views.views[0].name}) {seen.share + seen.gain:.0%} would be"
        say("fair", reason, f"Put the tripod at one more place: {more}.")
    return {"surface_seen": seen.share, "next_view_gain": seen.gain}


def _facts_together(views: CalibratedViews, parts: Sequence[Readiness]) -> dict[str, Any]:
    """Return the facts of all views: counts added up, shares of the worst view, and those of each view by its name."""
    facts = dict(parts[0].facts)
    for name in ("photos", "photos_used", "photos_with_shadow", "shadows_cut"):
        facts[name] = sum(part.facts[name] for part in parts)
    for name in ("ground_share", "ring_share", "object_share", "lowest_light_deg"):
        facts[name] = min(part.facts[name] for part in parts)
    for name in ("highest_light_deg", "light_sigma_share", "object_cut"):
        facts[name] = max(part.facts[name] for part in parts)
    kinds: Counter[str] = Counter()
    for part in parts:
        kinds.update(part.facts["findings"])
    by_view = {view.name: part.document() for view, part in zip(views.views, parts, strict=True)}
    return facts | {"findings": dict(sorted(kinds.items())), "views": by_view}
