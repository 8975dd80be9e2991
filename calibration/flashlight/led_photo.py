"""Where the LED sits from the phone's lens: read in a photo of its back beside the board, chosen between readings."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from calibration.board.board import AnyBoard
from calibration.board.board_pose import board_views
from calibration.board.corners import find_board, grey_of
from calibration.board.intrinsics import fit_camera
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.photos.photo import Photo, encode_srgb, read_photo
from capture.session.declared_objects import PhoneBack

Circle = Float[np.ndarray, "3"]  # x, y, radius, in dots of the view from above

DOTS_PER_MM = 8.0  # of the view from above in which circles are sought: finer than any rim
REACH_MM = 50.0  # between LED and main lens, at most
LED_MM = (0.5, 25.0)  # diameter of a lit LED with what its glare saturates
LED_ROUND = 0.5  # its area over that of its bounding box, at least (a disc has 0.79)
LED_LONG = 2.5  # its longer over its shorter side, at most: two LEDs side by side
LED_CLEAR = 4.0  # times the area of the next saturated blob: highlights of lamps on glass are small
GAP_MM = 1.5  # saturated parts nearer than this are one: two LEDs under one glass
LENS_RADIUS_MM = (2.5, 11.0)  # from the inner glass of a small lens to the ring of a large one
ONE_LENS_MM = 2.0  # circles with middles nearer than this belong to one lens
ROUNDEST, LEAST_ROUND = 0.9, 0.75  # share of a circle that must be seen: clear ones first
CANNY_HIGH = 200.0  # Scharr gradient of an edge, in the picture with its contrast evened out
DARKER = 0.8  # brightness inside the glass over that around it, at most
MOST_LENSES = 8  # more circles are a pattern, not lenses
LED_SIGMA, LED_SHARE, LENS_SIGMA = 0.5, 0.05, 0.4  # mm; share of the saturated blob's diameter; mm
LAID_SIGMA = np.radians(3.0)  # how well a phone is laid along the board by eye
THICKNESS_SIGMA = 3.0  # mm: of the phone, unless measured; costs a per cent of the offset
QUARTER_TURNS = 4  # ways in which a sensor can be mounted, and a phone be laid along the board
TURN_COST = 9.0  # chi-square of any turn but the stated one: phones that store their photos otherwise are rare
FITTED_SIGMA = 4.0  # mm: of the offset that shading gives (1 to 6 mm in simulations, 8 with a tone curve 5 % off)
LEVEL_SIGMA = 1.2  # mm: depth of the lens's pupil against that of the LED behind the glass
CLEAR_WIN = 6.0  # difference of chi-square between two readings: odds of exp(3), 20 to 1
WORST_MISFIT = 16.0  # chi-square from which photo and shading contradict each other: four sigmas


@dataclass(frozen=True)
class LensReading:
    """One dark circle of the photo as a candidate lens."""

    lens_px: tuple[float, float]  # its middle, pixels of the photo as stored
    offset_mm: tuple[float, float]  # from the lens to the LED along the board's x and y, millimetres
    sigma_mm: float  # one sigma of it, both coordinates together


@dataclass(frozen=True)
class BackView:
    """The readings from a photo of the phone's back; the phone lies along the board, screen down."""

    name: str
    led_px: tuple[float, float]
    lenses: tuple[LensReading, ...]
    has_top: bool = True  # the board shows which of its ends is the top one, so the stated turn means something


@dataclass(frozen=True)
class Choice:
    """The reading that agrees with the shading; `why` explains the decision, also where offset is None.

    The offset is the mean of photo and shading weighted by their covariances, with one sigma for all three coordinates.
    """

    offset_mm: tuple[float, float, float] | None
    sigma_mm: float
    lens_px: tuple[float, float] | None
    why: str


def in_lens_frame(offset: tuple[float, float], turns: int) -> Float[np.ndarray, "3"]:
    """Convert an offset along the board's x and y to the camera frame of the lens, which looks up from the board.

    With stated turn 0, the phone's top points to the board's top. Phones store photos with x (right) towards their
    bottom and y (down) towards the side that is on the right in a view of the back; z leaves the lens. Each further
    turn is a phone laid, or a sensor mounted, a quarter turn further anticlockwise, seen from above. LED and lens are
    level, to LEVEL_SIGMA.
    """
    down, side = np.array([0.0, -1.0]), np.array([1.0, 0.0])  # the camera's x and y on the board, without a turn
    angle = turns * np.pi / 2
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.array([np.dot(turned @ down, offset), np.dot(turned @ side, offset), 0.0])


def choose(view: BackView, fitted: Float[np.ndarray, "3"], range_sigma_mm: float) -> Choice:
    """Choose the lens and turn that agree best with the offset fitted to the shading; refuse if two agree.

    Args:
        fitted: the LED's offset in the lens's camera frame as fitted to the shading, mm.
        range_sigma_mm: sigma of the lens's distance from the ground; the offset's depth absorbs its error.
    """
    options = []
    for lens in view.lenses:
        for turns in range(QUARTER_TURNS):
            offset = in_lens_frame(lens.offset_mm, turns)
            off = float(np.linalg.norm((offset - fitted)[:2]))
            misfit = off**2 / (FITTED_SIGMA**2 + lens.sigma_mm**2 / 2)
            options.append((misfit + (TURN_COST if turns and view.has_top else 0.0), misfit, off, offset, turns, lens))
    options.sort(key=lambda option: option[0])
    cost, misfit, off, offset, turns, lens = options[0]
    x, y = fitted[:2]
    said = f"{view.name}: the ground's shading puts the LED at {x:.0f}, {y:.0f} mm from the lens"
    if misfit > WORST_MISFIT:
        return _refused(
            view, f"{said}, the nearest reading of the photo is {off:.0f} mm from there. Name led_px and lens_px."
        )
    if len(options) > 1 and options[1][0] - cost < CLEAR_WIN - 1e-9:
        return _refused(view, f"{said}, which two readings of the photo fit alike. {_advice(lens, options[1][5])}")
    turned = "" if turns == 0 else f", photos stored or phone laid with {90 * turns} degrees of turn"
    why = (
        f"{view.name}: the LED is {np.hypot(*lens.offset_mm):.1f} mm from the lens at "
        f"{lens.lens_px[0]:.0f}, {lens.lens_px[1]:.0f} px{turned}; {off:.1f} mm from where the shading puts it"
    )
    across, depth = lens.sigma_mm / np.sqrt(2), np.hypot(LEVEL_SIGMA, range_sigma_mm)
    trust = FITTED_SIGMA**2 / (FITTED_SIGMA**2 + np.array([across, across, depth]) ** 2)
    x, y, z = map(float, trust * offset + (1 - trust) * fitted)
    sigma = float(np.linalg.norm(np.sqrt(trust) * [across, across, LEVEL_SIGMA]))
    return Choice((x, y, z), sigma, lens.lens_px, why)


def _advice(lens: LensReading, other: LensReading) -> str:
    """Advise the user how to distinguish two readings of a photo: two turns of one lens, or two lenses."""
    if other is lens:
        return "Lay the phone with its top to the board's top."
    first, second = (f"[{x:.0f}, {y:.0f}]" for x, y in (lens.lens_px, other.lens_px))
    return f"Say which circle is the main lens: lens_px = {first} or {second}."


def _refused(view: BackView, why: str) -> Choice:
    seen = ", ".join(f"[{x:.0f}, {y:.0f}]" for x, y in (lens.lens_px for lens in view.lenses))
    return Choice(None, 0.0, None, f"{why} (Circles seen: {seen}.) The LED's place was fitted to the shading.")


def read_phone_back(path: Path, board: AnyBoard, given: PhoneBack) -> BackView:
    """Find the LED and every candidate circle of the lens, as offsets along the board.

    The phone lies on the board's sheet or beside it on the same table, screen down, its long side along the board's
    up-down direction and its top to the board's top. The board gives scale, tilt and directions; the back is a plane
    at the phone's thickness above it.

    Args:
        given: LED, lens and thickness as session.toml gives them; given ones are not searched.

    Raises:
        CaptureError: the file cannot be read.
        CalibrationError: board, LED or lens cannot be found, or several things may be the LED.
    """
    photo = read_photo(path)
    size = (photo.rgb.shape[1], photo.rgb.shape[0])
    above = _above(photo, size, board, given, path.name)
    (led, led_mm) = (given.led_px, 0.0) if given.led_px else _find_led(photo.clipped, above, path.name)
    _refuse_outside({"led_px": given.led_px, "lens_px": given.lens_px}, size, path.name)
    lenses = [given.lens_px] if given.lens_px else _find_lenses(photo, above, led, led_mm, path.name)
    readings = tuple(_reading(lens, led, led_mm, above) for lens in lenses)
    return BackView(path.name, led, readings, has_top=board.turns_alike() == QUARTER_TURNS)


def _above(photo: Photo, size: tuple[int, int], board: AnyBoard, given: PhoneBack, name: str) -> PosedCamera:
    """The camera above the board; its ground is the plane of the phone's back, mm."""
    corners = find_board(grey_of(photo), board)
    if corners is None:
        raise CalibrationError(
            f"the board was not found in {name}; half of its corners are needed to measure the phone's back by. "
            "Lay the phone beside the board, not over it"
        )
    fit = fit_camera([corners], size, photo.focal_35mm)
    views = board_views(fit.on_sheet(corners), fit.camera)
    if not views:
        raise CalibrationError(f"the board in {name} is seen mirrored. Use the photo as the camera took it")
    return PosedCamera(fit.camera, views[0].camera_from_world.inverse(), given.thickness_mm)


def _refuse_outside(named: dict[str, tuple[float, float] | None], size: tuple[int, int], name: str) -> None:
    for key, pixel in named.items():
        if pixel and not (0 <= pixel[0] < size[0] and 0 <= pixel[1] < size[1]):
            raise CalibrationError(
                f"{key} of phone_back in session.toml is {pixel[0]:g}, {pixel[1]:g}; {name} is {size[0]} x {size[1]} px"
            )


def _find_led(
    clipped: Bool[np.ndarray, "height width"], above: PosedCamera, name: str
) -> tuple[tuple[float, float], float]:
    """Return the middle (px) and diameter (mm) of the one compact saturated blob."""
    middle = np.array([[clipped.shape[1] / 2, clipped.shape[0] / 2]])
    per_mm = _pixels_per_mm(above, middle)
    side = max(3, round(GAP_MM * per_mm))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    joined = cv2.morphologyEx(clipped.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    _, _, stats, centres = cv2.connectedComponentsWithStats(joined, connectivity=8)
    blobs = []
    for (_, _, width, height, area), centre in zip(stats[1:], centres[1:], strict=True):
        diameter = 2 * float(np.sqrt(area / np.pi)) / _pixels_per_mm(above, centre[None])
        is_compact = area > LED_ROUND * width * height and max(width, height) < LED_LONG * min(width, height)
        if is_compact and LED_MM[0] <= diameter <= LED_MM[1]:
            blobs.append((diameter, (float(centre[0]), float(centre[1]))))
    blobs.sort(reverse=True)
    if not blobs:
        raise CalibrationError(
            f"no lit LED was found in {name}: one round saturated spot of {LED_MM[0]:g} to {LED_MM[1]:g} mm is needed. "
            "Switch the flashlight on and expose so that the phone's back is seen, or name led_px under phone_back"
        )
    if len(blobs) > 1 and blobs[0][0] ** 2 < LED_CLEAR * blobs[1][0] ** 2:
        spots = " or ".join(f"[{x:.0f}, {y:.0f}]" for _, (x, y) in blobs[:3])
        raise CalibrationError(
            f"{len(blobs)} saturated spots in {name} may be the LED. Avoid reflections of lamps, or name it in "
            f"session.toml: phone_back = {{ led_px = {spots} }}"
        )
    return blobs[0][1], blobs[0][0]


def _pixels_per_mm(above: PosedCamera, pixel: Float[np.ndarray, "1 2"]) -> float:
    """Scale of the photo on the phone's back: the mean of both directions by areas."""
    at = above.on_ground(pixel)
    shifted = above.project(at + np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    return float(np.sqrt(abs(np.linalg.det(shifted[1:] - shifted[:1]))))


def _find_lenses(
    photo: Photo, above: PosedCamera, led: tuple[float, float], led_mm: float, name: str
) -> list[tuple[float, float]]:
    """The middles, px, of all circles near the LED that are darker inside than around: clear ones, else faint ones."""
    middle = above.on_ground(np.array([led]))[0]
    view = _from_above(photo, above, middle)
    for roundness in (ROUNDEST, LEAST_ROUND):
        circles = [c for c in _circles(view, roundness) if _is_lens(view, c, led_mm)]
        places = _merged(circles)
        if places:
            break
    else:
        raise CalibrationError(
            f"no lens was found within {REACH_MM:g} mm of the LED in {name}: a dark circle is needed. Photograph the "
            "back from straight above in even light, or name the main lens: phone_back = { lens_px = [x, y] }"
        )
    if len(places) > MOST_LENSES:
        raise CalibrationError(
            f"{len(places)} circles near the LED in {name} may be the lens, {MOST_LENSES} at most are told apart. "
            "Name the main lens: phone_back = { lens_px = [x, y] }"
        )
    points = middle + np.array([[x / DOTS_PER_MM - REACH_MM, REACH_MM - y / DOTS_PER_MM, 0.0] for x, y in places])
    return [(float(x), float(y)) for x, y in above.project(points)]


def _from_above(photo: Photo, above: PosedCamera, middle: Float[np.ndarray, "3"]) -> UInt8[np.ndarray, "side side"]:
    """The back around the LED as seen from straight above, the board's x to the right and its y up; 8-bit, smoothed."""
    steps = np.arange(round(2 * REACH_MM * DOTS_PER_MM)) / DOTS_PER_MM - REACH_MM
    x, y = np.meshgrid(steps, -steps)
    pixels = above.project(middle + np.stack([x, y, np.zeros_like(x)], -1)).astype(np.float32)
    low, high = np.floor(pixels.min((0, 1))).astype(int) - 2, np.ceil(pixels.max((0, 1))).astype(int) + 3
    low, high = np.maximum(low, 0), np.minimum(high, [photo.rgb.shape[1], photo.rgb.shape[0]])
    part = encode_srgb(photo.rgb[low[1] : high[1], low[0] : high[0]])
    scale = _pixels_per_mm(above, above.project(middle[None])) / DOTS_PER_MM
    if scale > 1:  # fine photos are smoothed before they are thinned out
        part = cv2.GaussianBlur(part, (0, 0), 0.5 * scale)
    at = pixels - low.astype(np.float32)
    view = cv2.remap(part, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.GaussianBlur(cv2.cvtColor(view, cv2.COLOR_RGB2GRAY), (0, 0), 1.5))


def _circles(view: UInt8[np.ndarray, "side side"], roundness: float) -> Float[np.ndarray, "circles 3"]:
    """Circles (x, y, radius in dots) of lens size, by Hough's transform; the roundest first."""
    even = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(4, 4)).apply(view)
    found = cv2.HoughCircles(
        even,
        cv2.HOUGH_GRADIENT_ALT,
        dp=1.5,
        minDist=2.0,
        param1=CANNY_HIGH,
        param2=roundness,
        minRadius=round(LENS_RADIUS_MM[0] * DOTS_PER_MM),
        maxRadius=round(LENS_RADIUS_MM[1] * DOTS_PER_MM),
    )
    return np.zeros((0, 3)) if found is None else found.reshape(-1, found.shape[-1])[:, :3].astype(np.float64)


def _is_lens(view: UInt8[np.ndarray, "side side"], circle: Circle, led_mm: float) -> bool:
    """Return whether a circle is near the LED, in the middle of the view, and dark, and neither window nor glare."""
    apart = float(np.linalg.norm(circle[:2] / DOTS_PER_MM - REACH_MM))
    if not max(led_mm / 2, float(circle[2]) / DOTS_PER_MM) <= apart <= REACH_MM:
        return False
    y, x = np.ogrid[: view.shape[0], : view.shape[1]]
    radius = np.hypot(x - circle[0], y - circle[1]) / circle[2]
    inside, around = view[radius < 0.5], view[(radius > 0.9) & (radius < 1.4)]
    return bool(np.median(inside) < DARKER * np.percentile(around, 75))


def _merged(circles: list[Circle]) -> list[tuple[float, float]]:
    """Return one place per lens: the mean of concentric circles; all circles within the largest belong to it."""
    places: list[list[Circle]] = []
    for circle in sorted(circles, key=lambda c: -c[2]):
        for group in places:
            apart = float(np.linalg.norm(group[0][:2] - circle[:2]))
            if apart < max(ONE_LENS_MM * DOTS_PER_MM, group[0][2]):
                group.append(circle)
                break
        else:
            places.append([circle])
    middles = []
    for group in places:
        apart = np.linalg.norm(np.array(group)[:, :2] - group[0][:2], axis=1)
        middles.append(np.array(group)[apart < ONE_LENS_MM * DOTS_PER_MM, :2].mean(0))
    return [(float(x), float(y)) for x, y in middles]


def _reading(lens: tuple[float, float], led: tuple[float, float], led_mm: float, above: PosedCamera) -> LensReading:
    """Return the offset with one sigma, from errors of both middles, their unknown depth, and the phone's placement."""
    at_lens, at_led = above.on_ground(np.array([lens, led]))
    offset = at_led - at_lens
    length = float(np.linalg.norm(offset))
    ray = at_led - above.centre
    aside = float(np.hypot(ray[0], ray[1]) / abs(ray[2]))  # tangent of the angle from straight above
    scale = THICKNESS_SIGMA / abs(float(ray[2]))
    parts = (LED_SIGMA, LED_SHARE * led_mm, LENS_SIGMA, LEVEL_SIGMA * aside, length * LAID_SIGMA)
    sigma = float(np.linalg.norm([*parts, length * scale]))
    return LensReading((float(lens[0]), float(lens[1])), (float(offset[0]), float(offset[1])), sigma)
