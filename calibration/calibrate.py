"""A session becomes a calibration: the camera and the ground from the board, then a light for every photo."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from calibration.board.board import AnyBoard, parse_board
from calibration.board.board_photos import BoardFit, fit_board
from calibration.board.corners import find_board, grey_of
from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.flashlight.fit import MIN_PHOTOS
from calibration.flashlight.led_photo import BackView, read_phone_back
from calibration.flashlight.light_estimate import LightFit, locate_lights
from calibration.flashlight.phone import MIN_VIEWS, PhoneViews, locate_lights_from_phone
from calibration.flashlight.solids import fuse_shadow_lights, locate_sun
from calibration.light import Light
from calibration.lights.files import read_opinions
from calibration.lights.mixed_light import SECOND_LIGHT, MixedLight, mixture_of
from calibration.lights.power import on_albedo_scale
from calibration.lights_of_file import lights_of_file, refuse_below, with_opinions
from calibration.outlines.metric_cues import MetricCues
from calibration.posed_camera import PosedCamera
from calibration.reframed import reframed, with_doubt
from calibration.side_photos.side_views import metric_cues, side_notes
from capture.checks.ambient_light import find_shadows
from capture.errors import CalibrationError, Remedy
from capture.files.names import clip_of
from capture.photos.finding import Finding, grouped
from capture.photos.photo import PhotoStack, read_photo
from capture.session.session import Session

WAYS = ("auto", "shading", "phone")
Find = Callable[[Callable[[LightFit], bool], Bool[np.ndarray, " photos"]], tuple[LightFit, list[str]]]  # as _lights


def calibrate(
    session: Session,
    stack: PhotoStack,
    board_spec: str | None = None,
    lights: str | Path = "auto",
    findings: Sequence[Finding] = (),
    on_board: BoardFit | None = None,
) -> Calibration:
    """Calibrate camera, ground (world z = 0, mm) and one light per photo of the stack; unusable photos carry a reason.

    Args:
        stack: the session's lit photos, in their order.
        board_spec: as parse_board reads it; None: session.toml's board, or else the board is recognised.
        lights: "shading": from the ground alone; "phone": from the flashlight phone's photos; "auto": from those where
            they show the board, else from the ground; a path: from that file, which may give a photo several. A list
            whose entries all have a sigma is combined light by light with the estimates from the photos; photos that
            it lacks keep their own estimates.
        findings: of check_stack; photos with a finding that drops them get no light.
        on_board: camera and ground, where they are found already, for several views together.

    Raises:
        CalibrationError: the board, the ground or the lights cannot be found, or as lights_of_file.
    """
    if isinstance(lights, Path) and (opinions := read_opinions(lights)) is not None:
        refuse_below(opinions, 0.0, lights)
        return with_opinions(calibrate(session, stack, board_spec, "auto", findings, on_board), opinions, lights)
    if isinstance(lights, str) and lights not in WAYS:
        raise ValueError(f"lights is {lights!r}, one of {', '.join(WAYS)} is needed")
    posed_camera, lens, residuals = on_board or fit_board(session, board_spec)
    refuse_other_size(posed_camera.camera, stack)
    posed_camera, framing_notes, doubt = reframed(posed_camera, stack, findings)
    dropped, usable = left_out(stack, findings)
    board = parse_board(residuals["board"])
    cues, sides = metric_cues(session, stack, usable, posed_camera, board, lens.on_sheet)
    if isinstance(lights, Path):
        fit, notes, has_power = lights_of_file(lights, session, stack, posed_camera, dropped)
        every, mixtures = fit.lights, []
    else:
        find = partial(_lights, session, stack, posed_camera, board, lights, cues)
        fit, notes, spoilt, mixtures = _as_declared(find, session, stack, posed_camera, usable)
        dropped |= {path.name: SECOND_LIGHT for path, one in zip(stack.paths, spoilt, strict=True) if one}
        covariance, doubted = np.array(residuals["pose_covariance"]), with_doubt(fit.lights, posed_camera, doubt)
        by_name = {light.photo: light for light in with_camera_error(doubted, posed_camera, covariance)}
        names, has_power = [path.name for path in stack.paths], False
        every = tuple(by_name.get(name) or _unknown_light(name, dropped[name], fit) for name in names)
    notes = [*session.notes, *residuals.get("notes", []), *framing_notes, *notes, *side_notes(sides)]
    rows = {"side_photos": [side.row() for side in sides], "left_out_photos": [one.row() for one in session.left_out]}
    rows |= {"notes": notes, "warnings": [*residuals.get("warnings", []), *mixtures]}
    residuals = residuals | fit.residuals | doubt.of_ground(posed_camera, residuals) | rows
    shared = {"beam": fit.beam, "ambient": fit.ambient, "residuals": residuals, "side_views": cues.views}
    found = Calibration.of(posed_camera, every, **shared)
    return found if has_power else on_albedo_scale(found, stack)


def with_camera_error(
    lights: Sequence[Light], posed_camera: PosedCamera, covariance: Float[np.ndarray, "6 6"]
) -> tuple[Light, ...]:
    """Return lights whose sigmas hold the error of the camera's pose, too: what is solved is seen from that camera.

    Args:
        covariance: of the camera's turn (rad) about the world's axes, and of its place (world unit).
    """
    found = []
    for light in lights:
        if light.position is None:
            error = np.full(3, np.trace(covariance[:3, :3]) / 3)
        else:
            x, y, z = light.position - posed_camera.centre
            by_pose = np.hstack([[[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]], np.eye(3)])
            error = np.maximum(np.diag(by_pose @ covariance @ by_pose.T), 0)
        found.append(replace(light, sigma=np.sqrt(np.square(light.sigma) + error)))
    return tuple(found)


def left_out(stack: PhotoStack, findings: Sequence[Finding]) -> tuple[dict[str, str], Bool[np.ndarray, " photos"]]:
    """Return the reasons why photos get no light, by name, and which photos of the stack are usable.

    Raises:
        CalibrationError: fewer than 4 are left; lists the faults of the others.
    """
    dropped = {one.photo.name: one for one in reversed(findings) if one.drop and one.photo in stack.paths}
    usable = np.array([path.name not in dropped for path in stack.paths])
    if dropped and usable.sum() < MIN_PHOTOS:
        faults = [one for one in findings if one.drop and one.role == "lit"]
        raise CalibrationError(
            f"{usable.sum()} of {len({*stack.paths, *(one.photo for one in faults)})} photos under the flashlight can "
            f"be used, {MIN_PHOTOS} needed (25 or more are better). {grouped(faults)}. Take these photos again."
        )
    return {name: f"{one.kind}: {one.text}" for name, one in dropped.items()}, usable


def _as_declared(
    find: Find, session: Session, stack: PhotoStack, posed_camera: PosedCamera, usable: Bool[np.ndarray, " photos"]
) -> tuple[LightFit, list[str], Bool[np.ndarray, " photos"], list[str]]:
    """Return what _unmixed does, with the help of the objects and lights that session.toml declares."""
    declared = session.settings
    if declared.lights_at_once > 1:
        at_once = f"{session.folder}: session.toml declares {declared.lights_at_once} lights at once"
        wanted = "which the ground's shading cannot separate; their positions are needed, a line for each."
        raise CalibrationError(f"{at_once}, {wanted}", Remedy.LIGHTS_FILE)
    if declared.light == "sun":
        fit = locate_sun(stack, posed_camera, usable, declared.solids)
        return fit, ["lights: from the shadows of declared objects"], np.zeros_like(usable), []
    fit, notes, spoilt, said = _unmixed(find, stack, usable)
    if declared.solids:
        fit, more = fuse_shadow_lights(fit, stack, posed_camera, declared.solids)
        notes = [*notes, *more]
    return fit, notes, spoilt, said


def _unmixed(
    find: Find, stack: PhotoStack, usable: Bool[np.ndarray, " photos"]
) -> tuple[LightFit, list[str], Bool[np.ndarray, " photos"], list[str]]:
    """Return the lights, notes, which usable photos a second light spoilt, and what is said of light that is mixed.

    Without the spoilt photos lights are looked for once more, and never again: trouble at most doubles the work.

    Args:
        find: finds the lights of some photos, and notes, as _lights does.
    """

    def spoilt_by(mixed: MixedLight | None) -> Bool[np.ndarray, " photos"]:
        spoilt = np.zeros_like(usable)
        if mixed is not None:
            spoilt[usable] = mixed.spoilt()
        return spoilt if (usable & ~spoilt).sum() >= MIN_PHOTOS else np.zeros_like(usable)

    fit, notes = find(lambda found: bool(spoilt_by(_mixture(found, stack, usable)).any()), usable)
    mixed = _mixture(fit, stack, usable)
    said = [] if mixed is None else [mixed.sentence([light.photo for light in fit.lights])]
    spoilt = spoilt_by(mixed)
    if spoilt.any():
        fit, notes = find(lambda _: False, usable & ~spoilt)
    return fit, notes, spoilt, said


def _mixture(fit: LightFit, stack: PhotoStack, usable: Bool[np.ndarray, " photos"]) -> MixedLight | None:
    """Return the two groups of photos that the fit of the usable ones tells, if there are two."""
    misfit = fit.residuals.get("relative_misfit_by_photo", {})
    return mixture_of(fit.lights, misfit, find_shadows(stack, usable.tolist()).of(usable))


def _lights(
    session: Session,
    stack: PhotoStack,
    posed_camera: PosedCamera,
    board: AnyBoard,
    lights: str,
    cues: MetricCues,
    is_spoilt: Callable[[LightFit], bool],
    usable: Bool[np.ndarray, " photos"],
) -> tuple[LightFit, list[str]]:
    """Return the lights, found by the requested method, and notes for the user about the choice.

    Args:
        is_spoilt: as of locate_lights.
    """
    if lights == "phone" and not session.light:
        raise CalibrationError(
            f"no photos by the flashlight's phone in {session.folder}, {MIN_VIEWS} needed for --lights phone. "
            "Put them into its folder light/, or use --lights shading."
        )
    if lights == "shading" or not session.light:
        unused = (
            [f"{session.phone_back.name} was not used: it helps only photos in light/"] if session.phone_back else []
        )
        fit = locate_lights(stack, posed_camera, usable, cues, is_spoilt)
        return fit, [fit.residuals["cue"], *unused]
    back, unread = _read_back(session, board)
    views = replace(read_views(session, board), back=back)
    try:
        fit = locate_lights_from_phone(stack, posed_camera, usable, views)
    except CalibrationError as error:
        if lights == "phone":
            raise
        fit = locate_lights(stack, posed_camera, usable, cues, is_spoilt)
        return fit, [f"{fit.residuals['cue']}, because {error}"]
    n_views = len(fit.residuals["phone_photos"])
    back_notes = [fit.residuals["phone_back"]["why"]] if "phone_back" in fit.residuals else unread
    away, sigma = np.linalg.norm(fit.residuals["led_offset_mm"]), fit.residuals["led_offset_sigma_mm"]
    how = (
        f"lights: {n_views} of {len(fit.lights)} from the phone's photos of the board, the rest from shading; its LED "
        f"sits {away:.0f} +- {sigma:.0f} mm from its lens"
    )
    return fit, [how, *back_notes]


def _read_back(session: Session, board: AnyBoard) -> tuple[BackView | None, list[str]]:
    """Return the readings from the photo of the phone's back; a sentence if there is nothing of use."""
    if session.phone_back is None or session.settings.led_offset_mm is not None:
        return None, []
    try:
        return read_phone_back(session.phone_back, board, session.settings.phone_back), []
    except CalibrationError as error:
        return None, [f"the LED's offset from the lens was fitted to the ground's shading: {error}"]


def read_views(session: Session, board: AnyBoard) -> PhoneViews:
    """Find the board's corners in every photo of the flashlight's phone; one full photo in memory at a time.

    Photos of another pixel size than most get no corners: they are from another lens, or cropped.

    Raises:
        CaptureError: a photo cannot be read.
    """
    found, sizes, focals = [], [], []
    for path in session.light:
        photo = read_photo(path)
        grey = grey_of(photo)
        found.append(find_board(grey, board))
        sizes.append((grey.shape[1], grey.shape[0]))
        focals.append(photo.focal_35mm)
    size = Counter(sizes).most_common(1)[0][0]
    detections = tuple(corners if s == size else None for corners, s in zip(found, sizes, strict=True))
    names = tuple(path.name for path in session.light)
    focal = next((f for f, s in zip(focals, sizes, strict=True) if s == size and f is not None), None)
    return PhoneViews(names, detections, size, focal, session.settings.led_offset_mm)


def refuse_other_size(camera: Camera, stack: PhotoStack) -> None:
    """Raise an error if the tripod's board photo differs in size from the photos: their cameras then differ.

    Raises:
        CalibrationError: the sizes differ.
    """
    if (camera.width, camera.height) != (stack.full_width, stack.full_height):
        is_filmed = clip_of(stack.paths[0]) is not None
        film = " Film the board, too: phones film with another part of the sensor." if is_filmed else ""
        raise CalibrationError(
            f"the tripod's photo of the board is {camera.width}x{camera.height} px, the photos under the flashlight "
            f"are {stack.full_width}x{stack.full_height}. Take both with the same camera, zoom and orientation.{film}"
        )


def _unknown_light(name: str, reason: str, fit: LightFit) -> Light:
    """Return the light of a photo that was left out: amid the others, with their spread as uncertainty."""
    places = np.array([light.homogeneous()[:3] for light in fit.lights])
    about = {"power": np.zeros(3), "sigma": places.std(axis=0), "used": False, "reason": reason}
    if fit.lights[0].position is None:
        return Light(name, "directional", direction=np.array([0.0, 0.0, 1.0]), **about)
    return Light(name, "point", position=np.median(places, axis=0), **about)
