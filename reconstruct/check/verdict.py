"""The verdict on a capture before the solve: is it worth reconstructing, and which photos to take next.

The limits are design values: beyond them results get worse, but a reconstruction need not fail.

Photos under known lights without a known ground are judged by spread of the lights, exposure, powers and gloss: no
shadow on a ground tells anything there, the object's own shading must carry the shape.

Weigh the views of a capture together: what each lacks, what all of them lack, and where the tripod goes next.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from capture.checks.mixture import STEADY, levels, usual_level
from capture.errors import CalibrationError, CaptureError
from capture.files.title import title_of
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack
from capture.session.session import FEWEST_LIT
from reconstruct.appearance.brdf import facing_reflectance
from reconstruct.check.light_coverage import (
    LEAST_APART,
    LONG_SIDE,
    ShadowCover,
    close_pairs,
    directions,
    from_the_camera,
    shadow_cover,
    widest_gap,
)
from reconstruct.check.readiness import (
    GRADES,
    MORE_LIGHTS,
    PLENTY,
    Judge,
    Readiness,
    capture_facts,
    judge,
    judge_gap,
    judge_photos,
    powers_mean_nothing,
    verdict_of,
)
from reconstruct.labels.ground_test import empty_ground_test
from reconstruct.labels.highlights import material_without_ground
from reconstruct.labels.photometric_stereo import label_object
from reconstruct.scene import Scene, build_scene, ground_points
from reconstruct.source.calibrate_source import calibrate_source
from reconstruct.source.photos import Photos, read_photos
from reconstruct.source.source import RunOptions, Source

FLAT = 0.15  # rms of the lights' directions off their plane: below, normals across it are guessed
DARK, MANY_DARK = 0.004, 0.25  # linear value that noise rules, and the share of the object's samples that may lie below
CLIPPED = 0.02  # of the object's samples that may be clipped
GLOSSY = 0.08  # reflectance at normal incidence: twice that of plastic; interreflections then count
POWER_CHANGED = 0.1  # log: lists of intensities are right within a few per cent
NAMED = 4  # photos in a sentence
ALL_LIT = 0.75  # of the photos with room light in their shadows: a changed exposure of some cannot cause it
REASONS_SHOWN = 3


def judge_without_ground(
    scene: Scene, calibration: Calibration, findings: tuple[Finding, ...]
) -> tuple[Readiness, ShadowCover]:
    """Weigh photos and lights by the object's shading; also return what the page shows: no shadows.

    Args:
        scene: the photos, of any size, with `ground_known` False.
    """
    assert scene.rgb is not None
    points = torch.nan_to_num(ground_points(scene), nan=0.0)
    mask = empty_ground_test(scene).mask
    cover = _nothing_but_the_object(scene, mask > 0.5, points)
    say = Judge([(GRADES.index("fair"), str(one), "") for one in calibration.residuals.get("warnings", [])])
    facts = capture_facts(calibration, findings, cover) | _shading_facts(scene, points, mask, calibration, cover)
    judge_photos(say, facts, findings)
    _judge_shading(say, facts)
    return verdict_of(say, facts), cover


def _nothing_but_the_object(scene: Scene, mask: torch.Tensor, points: torch.Tensor) -> ShadowCover:
    assert scene.rgb is not None
    none = np.zeros(len(scene.rgb), dtype=bool)
    centre = points[mask].median(0).values if mask.any() else points.reshape(-1, 3).median(0).values
    return ShadowCover(
        times=np.zeros(mask.shape, dtype=np.int64),
        mask=mask.numpy(),
        picture=scene.rgb.mean(0).numpy(),
        centre=centre.double().numpy(),
        object_share=float(mask.float().mean()),
        ground_share=0.0,
        ring_share=0.0,
        is_cut=False,
        with_shadow=none,
        cut=none,
    )


def _shading_facts(
    scene: Scene, points: torch.Tensor, mask: torch.Tensor, calibration: Calibration, cover: ShadowCover
) -> dict[str, Any]:
    """Return numbers of the shading: spread of the lights, exposure of the object, powers and gloss."""
    assert scene.rgb is not None
    ways = directions(calibration, cover.centre)[[light.used for light in calibration.lights]]
    spread = float(np.sqrt(max(np.linalg.eigvalsh(ways.T @ ways / max(len(ways), 1))[0], 0.0)))
    inside = mask > 0.5
    labels = label_object(scene, points, None, mask)
    material = material_without_ground(scene, points, labels)
    gains = torch.zeros(len(scene.lights)) if material is None else material.log_gains
    changed = {scene.photo_names[i]: float(gains[i].exp()) for i in range(len(gains)) if abs(gains[i]) > POWER_CHANGED}
    mirrored = 0.0 if material is None else float(facing_reflectance(material.lobes).mean())
    return {
        "light_spread": spread,
        "clipped_share": float((~scene.usable[:, inside]).float().mean()) if inside.any() else 0.0,
        "dark_share": float((scene.rgb[:, inside].mean(-1) < DARK).float().mean()) if inside.any() else 1.0,
        "photos_of_another_power": changed,
        "reflectance": mirrored,
    }


def _judge_shading(say: Judge, facts: dict[str, Any]) -> None:
    if facts["light_spread"] < FLAT:
        reason = f"the lights lie within {np.degrees(np.arcsin(facts['light_spread'])):.0f} degrees of one plane, "
        reason += f"{np.degrees(np.arcsin(FLAT)):.0f} are needed: slopes across it are guessed"
        say("poor", reason, MORE_LIGHTS)
    if facts["clipped_share"] > CLIPPED:
        reason = f"{facts['clipped_share']:.0%} of what shows the object is pure white, at most {CLIPPED:.0%} may be"
        say("fair", reason, "Expose less: what is pure white tells nothing.")
    if facts["dark_share"] > MANY_DARK:
        reason = f"{facts['dark_share']:.0%} of what shows the object is nearly black, at most {MANY_DARK:.0%} advised"
        say("fair", reason, "Expose longer, or hold the lights nearer to the camera's side.")
    changed = facts["photos_of_another_power"]
    if changed:
        shown = ", ".join(f"{name} ({gain:.2f} times)" for name, gain in list(changed.items())[:NAMED])
        more = "" if len(changed) <= NAMED else f" and {len(changed) - NAMED} more"
        reason = f"{len(changed)} photos are brighter or darker than their lights say: {shown}{more}; it is allowed for"
        say("fair", reason, "Correct the list of intensities, or take these photos again with the exposure locked.")
    if facts["reflectance"] > GLOSSY:
        reason = f"the object is glossy: it mirrors {facts['reflectance']:.0%} of light from the front"
        say("fair", reason, "Use more lights, or powder the glossy parts.")


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
    facts |= {"widest_gap_deg": float(np.degrees(gap))}
    _judge_places(say, views, centre)
    return verdict_of(say, facts)


def _judge_places(say: Judge, views: CalibratedViews, centre: np.ndarray) -> None:
    """Judge where the tripod stood."""
    for one, other, angle in close_pairs(views, centre):
        reason = f"{one} and {other} look from directions only {np.degrees(angle):.0f} degrees apart"
        apart = f"{np.degrees(LEAST_APART):.0f} degrees"
        say("fair", reason, f"Put the tripod at least {apart} farther around the object for another view.")


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


@dataclass(frozen=True)
class CaptureCheck:
    """All results of the check of one capture."""

    name: str
    readiness: Readiness
    calibration: Calibration
    findings: tuple[Finding, ...]
    cover: ShadowCover
    notes: tuple[str, ...] = ()
    phone_back: Path | None = None  # photo of the back of the flashlight's phone
    further: tuple["CaptureCheck", ...] = ()  # of the other views, of a capture of several; the readiness is of all

    def document(self) -> dict[str, Any]:
        """Return the verdict as check.json stores it, with the place of each light and what was found in the photos.

        Azimuths are degrees from the camera's side, positive to its right; elevations are above the ground.
        """
        lights, camera = [], self.calibration.posed_camera
        for light, way in zip(self.calibration.lights, directions(self.calibration, self.cover.centre), strict=True):
            azimuth = from_the_camera(float(np.arctan2(way[1], way[0])), camera, self.cover.centre)
            angles = {"azimuth": np.degrees(azimuth), "elevation": np.degrees(np.arcsin(np.clip(way[2], -1, 1)))}
            rounded = {name: round(float(angle), 1) for name, angle in angles.items()}
            lights.append({"photo": light.photo, "used": light.used, "reason": light.reason} | rounded)
        found = [{"photo": f.photo.name, "kind": f.kind, "text": f.text, "drop": f.drop} for f in self.findings]
        return self.readiness.document() | {"lights": lights, "findings": found}


def read_and_check(source: Source, options: RunOptions) -> CaptureCheck:
    """Read, calibrate and judge a capture, without reconstructing it.

    Raises:
        CaptureError, CalibrationError: no photos, or the board, the ground or the lights cannot be found.
    """
    photos = read_photos(source, options)
    if all(one.error is None and one.stack is None for one in photos):
        raise CaptureError(
            f"{source.folder} holds shadow pictures only, and `check` looks at photos. Run it as it is: "
            "shadow pictures need no check."
        )
    try:
        views = calibrate_source(source, photos, options)
    except CalibrationError as error:
        faults = "; ".join(f"{finding.photo.name}: {finding.kind}" for one in photos for finding in one.findings)
        raise CalibrationError(f"{error}" + (f" Besides: {faults}." if faults else "")) from error
    if not source.ground_is_known(options):
        return _check_without_ground(source, photos[0], views.first)
    return check_capture(source, photos, views)


def _check_without_ground(source: Source, photos: Photos, calibration: Calibration) -> CaptureCheck:
    """Judge photos under known lights by the object's shading."""
    assert photos.stack is not None, "others are refused before"
    scene = replace(build_scene(photos.stack, calibration, LONG_SIDE, mask=photos.mask), ground_known=False)
    readiness, cover = judge_without_ground(scene, calibration, photos.findings)
    notes = tuple(map(str, calibration.residuals.get("notes", [])))
    name = title_of(source.folder)
    return CaptureCheck(name, readiness, calibration, photos.findings, cover, notes)


def check_capture(source: Source, photos: Sequence[Photos], calibrated: CalibratedViews) -> CaptureCheck:
    """Judge a capture before it is reconstructed: each of its views, and then several together.

    Args:
        photos: with a stack of colour photos, as read_photos reads them.
        calibrated: of these photos, with a known ground.

    Raises:
        CalibrationError: no photo has a usable light.
    """
    sources, by_name = {one.name: one for one in source.views()}, {one.view: one for one in photos}
    found = []
    for view in calibrated.views:
        one = _check_view(sources[view.name], by_name[view.name], view.calibration, len(sources) > 1)
        found.append(replace(one, name=view.name or one.name))
    if len(sources) == 1:
        return found[0]
    readiness = judge_together(calibrated, [one.readiness for one in found], [one.cover for one in found])
    return replace(found[0], name=title_of(source.folder), readiness=readiness, further=tuple(found[1:]))


def _check_view(source: Source, photos: Photos, calibration: Calibration, is_part: bool) -> CaptureCheck:
    """Judge one view."""
    stack = photos.stack
    assert stack is not None, "shadow pictures cannot be checked"
    if not any(light.used for light in calibration.lights):
        shown = "; ".join(f"{light.photo}: {light.reason}" for light in calibration.lights[:REASONS_SHOWN])
        raise CalibrationError(
            f"0 of {len(calibration.lights)} photos in {source.folder} have a usable light, {FEWEST_LIT} are needed "
            f"({shown}; ...). Photograph in a dark room, camera still, flashlight in other places."
        )
    cover = shadow_cover(build_scene(stack, calibration, LONG_SIDE, mask=photos.mask))
    doubts = tuple(map(str, calibration.residuals.get("warnings", [])))
    findings = with_power_changes(photos.findings, calibration, stack)
    readiness = judge(calibration, findings, cover, doubts, is_part)
    notes = tuple(map(str, calibration.residuals.get("notes", [])))
    back = None if source.session is None else source.session.phone_back
    return CaptureCheck(title_of(source.folder), readiness, calibration, findings, cover, notes, back)


def with_power_changes(findings: Sequence[Finding], calibration: Calibration, stack: PhotoStack) -> tuple[Finding, ...]:
    """Add a finding for each photo whose light is used, and has another power than those of the largest group.

    Such a photo had another exposure that its file does not state, or the flashlight faded. This also scales its
    shadows, so findings on its shadows are dropped, unless nearly all photos show room light. Where given lights miss
    the ground's shading, powers mean nothing.
    """
    known = {light.photo: float(light.power.mean()) for light in calibration.lights if light.used}
    known = {name: float(np.log(power)) for name, power in known.items() if power > 0}
    if powers_mean_nothing(calibration) or not known:
        return tuple(findings)
    own = levels(np.array(list(known.values())), STEADY)
    usual, level = usual_level(own), dict(zip(known, own, strict=True))
    changed = []
    for path in stack.paths:
        if level.get(path.name, usual) != usual:
            ratio = float(np.exp(known[path.name] - usual))
            text = f"{ratio:.2f} times as bright as the flashlight's place explains; used with a power of its own"
            changed.append(Finding(path, "exposure changed", text, ratio, 1.0, False))
    names = {finding.photo for finding in changed}
    is_room = sum(one.kind == "ambient light" for one in findings) > ALL_LIT * len(stack.paths)
    kept = [one for one in findings if is_room or one.drop or one.kind != "ambient light" or one.photo not in names]
    return (*kept, *changed)
