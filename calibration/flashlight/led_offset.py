"""Estimate the offset of the LED from the phone's lens, by a choice between readings of a photo."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
