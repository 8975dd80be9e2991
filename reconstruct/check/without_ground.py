"""The verdict on photos under known lights without a known ground: spread of the lights, exposure, powers, gloss.

No shadow on a ground is judged there; the object's own shading must carry the shape.
"""

from typing import Any

import numpy as np
import torch

from calibration.calibration import Calibration
from capture.photos.finding import Finding
from reconstruct.appearance.brdf import facing_reflectance
from reconstruct.check.light_coverage import ShadowCover, directions
from reconstruct.check.readiness import (
    GRADES,
    MORE_LIGHTS,
    Judge,
    Readiness,
    capture_facts,
    judge_photos,
    verdict_of,
)
from reconstruct.labels.ground_test import empty_ground_test
from reconstruct.labels.highlights import material_without_ground
from reconstruct.labels.photometric_stereo import label_object
from reconstruct.scene import Scene, ground_points

FLAT = 0.15  # rms of the lights' directions off their plane: below, normals across it are guessed
DARK, MANY_DARK = 0.004, 0.25  # linear value that noise rules, and the share of the object's samples that may lie below
CLIPPED = 0.02  # of the object's samples that may be clipped
GLOSSY = 0.08  # reflectance at normal incidence: twice that of plastic; interreflections then count
POWER_CHANGED = 0.1  # log: lists of intensities are right within a few per cent
NAMED = 4  # photos in a sentence


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
