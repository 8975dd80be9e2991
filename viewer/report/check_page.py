"""The result of `shadowgraph check` as a page (check.html) and as lines of text for the terminal."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from calibration.board.board_scale import scale_sentence
from calibration.light import Light
from capture.files.atomic import atomic_file
from capture.photos.photo import encode_srgb, read_photo
from reconstruct.check.light_coverage import ShadowCover, side_in_words
from reconstruct.check.verdict import CaptureCheck
from viewer.report import document as doc
from viewer.report.document import enlarged
from viewer.report.figures import coverage, lights_from_above

PAGE = "check.html"
PICTURE_WIDTH = 520  # px
SHADOW_COLOURS = np.array([[255, 214, 102], [240, 120, 60], [150, 40, 120]], float)  # few, some, many photos
MANY_TIMES = 0.5  # of the photos: as often in shadow as ground beside an object is
MARGIN_SHARE = 0.04  # of a photo's longer side: least half width of the part with LED and lenses
LED, CHOSEN, CANDIDATE = (255, 205, 40), (70, 210, 90), (240, 110, 90)
FONT = cv2.FONT_HERSHEY_SIMPLEX
KINDS = {"good": "", "fair": "warn", "poor": "bad", "hopeless": "bad"}


def write_check(checked: CaptureCheck, folder: Path) -> Path:
    """Write check.html into the folder, whole or not at all; returns its path."""
    path = folder / PAGE
    with atomic_file(path) as temporary:
        temporary.write_text(check_page(checked), encoding="utf-8")
    return path


def check_page(checked: CaptureCheck) -> str:
    """Return the whole document as HTML."""
    readiness, calibration, cover = checked.readiness, checked.calibration, checked.cover
    header = (
        f'<header><div class="tag">Shadowgraph check</div><h1>{doc.html.escape(checked.name)}</h1>'
        f'<p class="verdict {KINDS[readiness.grade]}">{doc.html.escape(readiness.sentence())}</p>'
        f"{doc.facts(_numbers(checked))}</header>"
    )
    notes = [*filter(None, [scale_sentence(calibration.residuals)]), *checked.notes]
    parts = [
        header,
        doc.section("What to shoot next", "Most useful first; then check again.", doc.bullets(readiness.advice)),
        doc.section("Why", "Everything that makes the result worse than it could be.", doc.bullets(readiness.reasons)),
        doc.section(
            "Light",
            "Each dot is the flashlight in one photo. Light from all sides, low and high, shows the whole shape.",
            doc.row(
                doc.figure(coverage(calibration, cover.centre), "From the object: overhead is in the middle"),
                doc.figure(lights_from_above(calibration, None), "Seen from above, with two-sigma ellipses"),
            ),
        ),
        *_shadows(checked),
        *_phone_back(checked),
        doc.section("Photos", "One line per photo. It is good if the last column is empty.", _photo_table(checked)),
        *(_further(one) for one in checked.further),
        doc.section("Please note", "What was assumed or chosen on the way.", doc.bullets(notes)),
    ]
    return doc.page(f"Shadowgraph check: {checked.name}", "".join(parts))


def _shadows(checked: CaptureCheck) -> list[str]:
    """Return the section of shadows on the ground; none where no ground is known."""
    if "light_spread" in checked.readiness.facts:
        return []
    about = "Shadows on the ground carry the shape of sides that the camera does not see."
    return [doc.section("Shadows", about, _shadow_figure(checked.cover))]


def _shading_numbers(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what is told of photos without a known ground."""
    spread = np.degrees(np.arcsin(min(facts["light_spread"], 1.0)))
    return [
        (f"{facts['photos_used']} of {facts['photos']}", "Photos that can be used."),
        (f"{spread:.0f}°", "Typical angle of the lights to the plane that they come closest to; above 9° is good."),
        (f"{facts['clipped_share']:.1%} / {facts['dark_share']:.0%}", "The object's samples clipped / nearly black."),
        (f"{len(facts['photos_of_another_power'])}", "Photos brighter or darker than their lights say."),
        (f"{facts['reflectance']:.0%}", "Light that the object mirrors from the front: its gloss."),
    ]


def _numbers(checked: CaptureCheck) -> list[tuple[str, str]]:
    facts = checked.readiness.facts
    if "light_spread" in facts:
        return _shading_numbers(facts)
    kinds = [finding.kind for finding in checked.findings]
    return [
        (f"{facts['photos_used']} of {facts['photos']}", "Photos that can be used."),
        (f"{facts['widest_gap_deg']:.0f}°", "Widest part of the horizon without light; below 60° is good."),
        (f"{facts['lowest_light_deg']:.0f}° to {facts['highest_light_deg']:.0f}°", "Heights of the flashlight."),
        (f"{facts['ring_share']:.0%}", "Share of the ground near the object that lay in shadow and in light."),
        (f"{facts['ground_share']:.0%}", "Share of the picture that is readable ground."),
        (f"{kinds.count('blurred')} / {kinds.count('camera moved')}", "Photos blurred / taken with a moved camera."),
        (f"{kinds.count('over-exposed')}", "Photos with over-exposed places."),
        (f"{facts['light_sigma_share']:.1%}", "Typical uncertainty of a light's place, as a share of its distance."),
    ]


def shadow_picture(cover: ShadowCover) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the mean of the photos: the ground coloured by how often it lay in shadow, the object as it is."""
    grey = encode_srgb(cover.picture / max(float(np.percentile(cover.picture, 99)), 1e-6)).astype(float)
    level = np.clip(cover.times / max(MANY_TIMES * len(cover.cut), 1.0), 0, 1)
    stops = np.linspace(0, 1, len(SHADOW_COLOURS))
    colour = np.stack([np.interp(level, stops, SHADOW_COLOURS[:, c]) for c in range(3)], -1)
    flat = np.repeat(grey.mean(-1, keepdims=True), 3, -1)
    shown = np.where((cover.times > 0)[..., None], 0.45 * flat + 0.55 * colour, flat)
    return np.round(np.where(cover.mask[..., None], grey, shown)).astype(np.uint8)


def _shadow_figure(cover: ShadowCover) -> str:
    caption = (
        "How often each place on the ground lay in shadow: yellow once, violet in half of the photos. "
        f"The shadow leaves the picture in {int(cover.cut.sum())} of {len(cover.cut)} photos."
    )
    return doc.figure(enlarged(shadow_picture(cover), PICTURE_WIDTH), caption)


def _phone_back(checked: CaptureCheck) -> list[str]:
    """What was seen on the back of the flashlight's phone, where there is a photo of it that could be used."""
    read = checked.calibration.residuals.get("phone_back")
    if checked.phone_back is None or not isinstance(read, dict):
        return []
    picture = back_picture(encode_srgb(read_photo(checked.phone_back).rgb), read)
    head = (
        "Yellow is the LED; circles are numbered as they were found, the one that was taken for the main lens is green."
    )
    return [doc.section("The flashlight's phone", head, doc.figure(enlarged(picture, PICTURE_WIDTH), read["why"]))]


def back_picture(photo: UInt8[np.ndarray, "height width 3"], read: dict[str, Any]) -> UInt8[np.ndarray, "rows cols 3"]:
    """Return the part of the photo around LED and lenses, with marks on them."""
    places = np.array([read["led_px"], *read["lenses_px"]], float)
    reach = max(MARGIN_SHARE * max(photo.shape), 1.5 * float(np.linalg.norm(places - places[0], axis=1).max()))
    low = np.maximum(np.floor(places[0] - reach), 0).astype(int)
    high = np.minimum(np.ceil(places[0] + reach), [photo.shape[1], photo.shape[0]]).astype(int)
    part = np.ascontiguousarray(photo[low[1] : high[1], low[0] : high[0]])
    thick = max(1, round(0.01 * reach))
    for k, place in enumerate(places):
        is_chosen = k > 0 and read["lens_px"] is not None and np.allclose(place, read["lens_px"])
        colour = CHOSEN if is_chosen else LED if k == 0 else CANDIDATE
        x, y = map(int, np.round(place - low))
        cv2.circle(part, (x, y), round(0.08 * reach), colour, thick, cv2.LINE_AA)
        words, beside = "LED" if k == 0 else str(k), (x + round(0.1 * reach), y)
        cv2.putText(part, words, beside, FONT, 0.005 * reach, colour, thick, cv2.LINE_AA)
    return part


def _further(checked: CaptureCheck) -> str:
    """Return lights, shadows and photos of a further view."""
    pictures = doc.row(
        doc.figure(coverage(checked.calibration, checked.cover.centre), "From the object: overhead is in the middle"),
        _shadow_figure(checked.cover),
    )
    return doc.section(checked.name, "Another place of the tripod.", pictures + _photo_table(checked))


def _photo_table(checked: CaptureCheck) -> str:
    rows = []
    for light in checked.calibration.lights:
        said = [f"{f.kind}: {f.text}" for f in checked.findings if f.photo.name == light.photo and f.role == "lit"]
        said += [light.reason] if light.reason and light.reason not in said else []
        rows.append([light.photo, *_place(light, checked), "; ".join(said)])
    known = {light.photo for light in checked.calibration.lights}
    lacking = [one for one in checked.findings if one.drop and (one.role != "lit" or one.photo.name not in known)]
    rows += [[one.called, "left out", "", "", "", f"{one.kind}: {one.text}"] for one in lacking]
    return doc.table(["Photo", "Flashlight", "Height", "Distance", "±", "Remarks"], rows, numbers=(2, 3, 4))


def _place(light: Light, checked: CaptureCheck) -> list[str]:
    """Side, elevation, distance and two sigma of a light, in words."""
    if not light.used:
        return ["not used", "", "", ""]
    centre, unit = checked.cover.centre, "mm" if checked.calibration.unit == "mm" else ""
    way, length = light.seen_from(centre)
    side = side_in_words(float(np.arctan2(way[1], way[0])), checked.calibration, centre)
    elevation = f"{np.degrees(np.arcsin(np.clip(way[2], -1, 1))):.0f}°"
    if light.position is None:
        return [side, elevation, "far", ""]
    return [side, elevation, f"{length:.3g} {unit}".strip(), f"{2 * np.linalg.norm(light.sigma):.2g} {unit}".strip()]


def check_lines(checked: CaptureCheck) -> list[str]:
    """Return the verdict as lines for the terminal: reasons, remarks on photos, what to shoot next."""
    readiness = checked.readiness
    lines = [readiness.sentence(), *(f"  - {reason}" for reason in readiness.reasons[1:])]
    lines += filter(None, [scale_sentence(checked.calibration.residuals)])
    lines += [f"{f.called}: {f.kind}, {f.text}" for f in checked.findings]
    lines += [f"{one.name}, {f.photo.name}: {f.kind}, {f.text}" for one in checked.further for f in one.findings]
    lines += [f"Shoot next: {advice}" for advice in readiness.advice]
    return lines
