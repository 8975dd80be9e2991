"""Weigh what is known of a capture before the solve: reasons, each with its grade and advice.

The limits are design values: beyond them results get worse, but a reconstruction need not fail.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration
from calibration.lights.power import SHADING_MISFIT
from capture.checks.alignment import BOARD_OFF
from capture.checks.framing import KINDS, REFRAMED, SEEN_FROM
from capture.errors import ReconstructionError
from capture.photos.finding import Finding
from capture.session.session import ADVISED_LIT, FEWEST_LIT
from reconstruct.check.light_coverage import ShadowCover, directions, side_in_words, widest_gap

PLENTY = 25  # photos from which more add little
WIDE_GAP, HALF = np.radians(90.0), np.radians(180.0)  # of the horizon without light: shape is mostly guessed
LOW, HIGH = np.radians(20.0), np.radians(60.0)  # shadows longer than 2.7 heights leave the picture, short ones hide
FEW_BANDS = 0.15  # of the photos that should be lower than HIGH, and higher than the middle of both
LARGEST_SIGMA = 0.06  # of a light's distance: lights that are off by more do not count as found
MANY_DROPPED, MANY_CUT = 0.25, 0.4  # of the photos
LITTLE_GROUND, LITTLE_RING = 0.15, 0.5  # of the picture, of the ground near the object
SMALLEST_OBJECT, LARGEST_OBJECT = 0.002, 0.6  # of the picture
BOARD_AGAIN = "Photograph the board again as the tripod stands now, and use that photo in place of the other"
GRADES = ("good", "fair", "poor", "hopeless")


@dataclass(frozen=True)
class Readiness:
    """The verdict: one of GRADES, its reasons and advice, worst first. `facts` are named numbers."""

    grade: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]
    facts: dict[str, Any]

    def sentence(self) -> str:
        """The verdict in one sentence."""
        used, photos = self.facts["photos_used"], self.facts["photos"]
        if len(self.reasons) == 0:
            return f"Good: {used} of {photos} photos can be used, and light came from all sides."
        return in_one_sentence(self.grade, self.reasons)

    def document(self) -> dict[str, Any]:
        """Return the verdict as check.json stores it."""
        words = {"verdict": self.grade, "sentence": self.sentence(), "reasons": self.reasons, "advice": self.advice}
        return {"format": 1, **words, "numbers": self.facts}


def in_one_sentence(grade: str, reasons: Sequence[str]) -> str:
    """Return a verdict in one sentence: its grade, the first of its reasons, and how many more there are."""
    if not reasons:
        return f"{grade.capitalize()}: no check found fault with it."
    further = len(reasons) - 1
    more = f", and for {further} more reason{'s' * (further > 1)}" if further else ""
    return f"{grade.capitalize()}: {reasons[0].rstrip('.')}{more}."


def powers_mean_nothing(calibration: Calibration) -> bool:
    """Return whether given lights miss the ground's shading: a power then makes up for beam and tone curve."""
    return float(calibration.residuals.get("given_lights_misfit", 0.0)) >= SHADING_MISFIT


@dataclass
class Judge:
    """A collector of reasons, each with its grade and advice."""

    entries: list[tuple[int, str, str]]

    def __call__(self, grade: str, reason: str, advice: str) -> None:
        self.entries.append((GRADES.index(grade), reason, advice))


def judge(
    calibration: Calibration,
    findings: Sequence[Finding],
    cover: ShadowCover,
    doubts: Sequence[str] = (),
    is_part: bool = False,
) -> Readiness:
    """Weigh lights, shadows and photos.

    Args:
        findings: of the photos, as check_stack gives them.
        cover: of the photos whose light is used.
        doubts: further sentences, each of which makes a good capture a fair one.
        is_part: of one view of several: the number of photos and the sides of their lights count for all together.
    """
    say = Judge([])
    facts = capture_facts(calibration, findings, cover)
    _judge_lights(say, facts)  # first of its grade: shadows, normals and outlines rest on the lights
    judge_photos(say, facts, findings, is_part)
    if not is_part:
        judge_gap(say, facts["photos_used"], widest_gap(calibration, cover.centre), calibration, cover.centre)
    _judge_shadows(say, facts)
    for doubt in doubts:
        say("fair", doubt, "")
    return verdict_of(say, facts)


def verdict_of(say: Judge, facts: dict[str, Any]) -> Readiness:
    """Return the verdict that the collected reasons give, worst first."""
    say.entries.sort(key=lambda entry: -entry[0])
    grade = GRADES[max((entry[0] for entry in say.entries), default=0)]
    reasons = tuple(reason for _, reason, _ in say.entries)
    advice = tuple(dict.fromkeys(advice for _, _, advice in say.entries if advice))
    return Readiness(grade, reasons, advice, facts)


def refuse_hopeless(readiness: Readiness) -> None:
    """Raise an error before the solve if it cannot give a shape.

    Raises:
        ReconstructionError: the verdict is hopeless.
    """
    if readiness.grade == "hopeless":
        raise ReconstructionError(f"{readiness.reasons[0]}. {readiness.advice[0]}")


def capture_facts(calibration: Calibration, findings: Sequence[Finding], cover: ShadowCover) -> dict[str, Any]:
    """Return the named numbers of a verdict."""
    used = [light for light in calibration.lights if light.used]
    ways = directions(calibration, cover.centre)[[light.used for light in calibration.lights]]
    elevation = np.degrees(np.arcsin(np.clip(ways[:, 2], -1, 1))) if len(ways) else np.zeros(0)
    sigma = [float(np.linalg.norm(light.sigma)) / light.seen_from(cover.centre)[1] for light in used]
    kinds = Counter(finding.kind for finding in findings)
    left_out = {finding.photo.name for finding in findings if finding.drop and finding.role == "lit"}
    return {
        "photos": len({light.photo for light in calibration.lights} | left_out),
        "photos_used": len({light.photo for light in used}),
        "widest_gap_deg": float(np.degrees(widest_gap(calibration, cover.centre)[1])),
        "lowest_light_deg": float(elevation.min(initial=90.0)),
        "highest_light_deg": float(elevation.max(initial=0.0)),
        "share_below_60_deg": float((elevation < np.degrees(HIGH)).mean()) if len(ways) else 0.0,
        "share_above_40_deg": float((elevation > np.degrees(0.5 * (LOW + HIGH))).mean()) if len(ways) else 0.0,
        "light_sigma_share": float(np.median(sigma)) if sigma else 0.0,
        "object_share": cover.object_share,
        "object_cut": cover.is_cut,
        "ground_share": cover.ground_share,
        "ring_share": cover.ring_share,
        "photos_with_shadow": int(cover.with_shadow.sum()),
        "shadows_cut": int(cover.cut.sum()),
        "findings": dict(sorted(kinds.items())),
    }


MORE_LIGHTS = "Take more photos with the flashlight at other places, camera and focus untouched."


def judge_photos(say: Judge, facts: dict[str, Any], findings: Sequence[Finding], is_part: bool = False) -> None:
    """Judge the number of photos, and what was found in them."""
    used, photos = facts["photos_used"], facts["photos"]
    dropped = Counter(finding.kind for finding in findings if finding.drop and finding.role == "lit")
    why = ", ".join(f"{kind}: {count}" for kind, count in dropped.most_common())
    of_all = f"{used} of {photos} photos can be used" + (f" ({why})" if why else "")
    if used < FEWEST_LIT:
        say("hopeless", f"{of_all}, {FEWEST_LIT} are needed at least", MORE_LIGHTS)
    elif used < ADVISED_LIT:
        say("poor", f"{of_all}, {ADVISED_LIT} or more are advised", MORE_LIGHTS)
    elif used < (1 - MANY_DROPPED) * photos:
        say("fair", of_all, MORE_LIGHTS)
    elif used < PLENTY and not is_part:
        say("fair", f"{used} photos: {PLENTY} or more show more of the shape", MORE_LIGHTS)
    _judge_tripod(say, used, [finding for finding in findings if finding.kind == BOARD_OFF])
    _judge_framing(say, findings)
    warned = Counter(finding.kind for finding in findings if not finding.drop)
    for kind, count in warned.items():
        if kind == "over-exposed" and count > MANY_DROPPED * photos:
            say("fair", f"{count} photos are over-exposed in parts", "Expose less: what is pure white tells nothing.")
        if kind == "ambient light" and count > MANY_DROPPED * photos:
            reason = f"room light brightens the shadows in {count} of {photos} photos"
            say("fair", reason, "Darken the room, or photograph it without flashlight too (dark/).")


def _judge_tripod(say: Judge, used: int, findings: Sequence[Finding]) -> None:
    """Judge photos that show another view than the photo of the board.

    Args:
        findings: of the kind BOARD_OFF. Their photos are left out if others show the board's view.
    """
    if not findings:
        return
    first, last = (finding.photo.name for finding in (findings[0], findings[-1]))
    which = f"{len(findings)} photos, {first} to {last}," if len(findings) > 1 else f"1 photo, {first},"
    by, limit = max(finding.value for finding in findings), min(finding.limit for finding in findings)
    reason = (
        f"the tripod moved: {which} lie up to {by:.0f} px off the photo of the board (at most {limit:.1f} px is fine)"
    )
    if findings[0].drop:
        reason += f" and are left out, {used} photos with the board's view are used"
        say("poor", reason, f"{BOARD_AGAIN}; they are then the ones that count.")
    else:
        reason += ", so camera and ground are somewhat off"
        say("poor", reason, f"{BOARD_AGAIN}. If it has moved again since, photograph everything again.")


def _judge_framing(say: Judge, findings: Sequence[Finding]) -> None:
    """Judge photos whose picture is not that of the board's photo: one sentence, as all of them say the same."""
    told = next((finding for finding in findings if finding.kind in KINDS), None)
    if told is None:
        return
    is_mended = told.kind in (REFRAMED, SEEN_FROM)
    say("fair" if is_mended else "poor", told.text, "" if is_mended else f"{BOARD_AGAIN}.")


def judge_gap(
    say: Judge, used: int, gap_of: tuple[float, float], calibration: Calibration, centre: Float[np.ndarray, "3"]
) -> None:
    """Judge the widest range of azimuths without light: its start and width, rad."""
    start, gap = gap_of
    side = side_in_words(start + 0.5 * gap, calibration, centre)
    if used and gap > WIDE_GAP:
        reason = f"no light from {np.degrees(gap):.0f} degrees of the horizon ({side})"
        extra = max(2, round(gap / np.radians(25)))
        say("poor" if gap > HALF else "fair", reason, f"Shoot {extra} photos with the flashlight {side}.")


def _judge_lights(say: Judge, facts: dict[str, Any]) -> None:
    if facts["share_below_60_deg"] < FEW_BANDS:
        say("fair", "nearly all lights are high above the object", "Hold the flashlight lower, for longer shadows.")
    if facts["share_above_40_deg"] < FEW_BANDS:
        say("fair", "nearly all lights are low", "Shoot some photos with the flashlight high above the object.")
    sigma = facts["light_sigma_share"]
    if 2 * sigma > LARGEST_SIGMA:  # an error of two sigma is too large, or one of a single sigma
        say(
            "poor" if sigma > LARGEST_SIGMA else "fair",
            f"the lights' places are uncertain by {sigma:.1%} of their distance (at most {LARGEST_SIGMA:.0%} is fine)",
            "Show more bare, matt table, or photograph the board with the flashlight's phone for each photo.",
        )


def _judge_shadows(say: Judge, facts: dict[str, Any]) -> None:
    used = facts["photos_used"]
    share = facts["object_share"]
    if share < SMALLEST_OBJECT and not facts["photos_with_shadow"]:
        say(
            "hopeless",
            f"no object and no shadow stand out: {share:.2%} of the picture is no ground, {SMALLEST_OBJECT:.1%} needed",
            "Put the object into the middle of the picture, and darken the room.",
        )
    elif share < SMALLEST_OBJECT:
        say("poor", f"the object fills {share:.2%} of the picture", "Move the camera nearer to the object.")
    elif share > LARGEST_OBJECT:
        say("poor", f"what is not ground fills {share:.0%} of the picture", "Move the camera back; clear the table.")
    if facts["object_cut"]:
        reason = "the object goes on beyond the picture's border: what lies outside is not found"
        say("fair", reason, "Show all of the object, with some table on every side.")
    if facts["ground_share"] < LITTLE_GROUND:
        reason = f"bare ground is {facts['ground_share']:.0%} of the picture, {LITTLE_GROUND:.0%} advised"
        say("poor", reason, "Show more of the table around the object.")
    if used and facts["photos_with_shadow"] < 0.5 * used:
        reason = f"a shadow on the ground is seen in {facts['photos_with_shadow']} of {used} photos"
        say("poor", reason, "Hold the flashlight lower and to the sides, and show the table where shadows fall.")
    if used and facts["shadows_cut"] > MANY_CUT * used:
        reason = f"shadows leave the picture in {facts['shadows_cut']} of {used} photos"
        say("fair", reason, "Hold the flashlight higher, or move the camera back.")
    if facts["ring_share"] < LITTLE_RING:
        reason = f"shadows reach {facts['ring_share']:.0%} of the ground near the object, {LITTLE_RING:.0%} advised"
        say("fair", reason, "Move the flashlight all around the object, at several heights.")
