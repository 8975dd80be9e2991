"""RunOptions: every setting of a run that changes its result."""

from dataclasses import dataclass

import numpy as np

from capture.errors import CalibrationError

AUTO, UNKNOWN = "auto", "unknown"  # of --ground, which may be a height instead
CALIBRATION_LONG_SIDE = 800  # px: checks and light fit average over patches of ground, finer photos add nothing
LONG_SIDES = {"draft": 320, "standard": 640, "fine": 1024, "paper": 800}  # px that the solver looks at, by preset


@dataclass(frozen=True)
class RunOptions:
    """Every setting of a run that changes its result."""

    board: str | None = None
    input: str = "auto"
    lights: str = "auto"
    light_error: float = 0.0
    preset: str = "standard"
    device: str = "auto"
    time_budget: float | None = None
    seed: int = 0
    split: str = "train"
    ground: str = "auto"
    mask: str = "auto"
    field: str = "auto"
    ablate: str | None = None
    detail: str = "auto"
    memory: float | None = None
    scale: str | None = None

    def is_trained(self) -> bool:
        """True if a field is trained in torch (reconstruct/shadowneus/) instead of fitted by the default solver."""
        return self.preset == "paper" or self.field in ("neural", "hash")

    def long_side(self) -> int:
        """The longer side (px) of photos as they are read, large enough for checks, calibration and solver."""
        return max(CALIBRATION_LONG_SIDE, LONG_SIDES[self.preset])


def ground_option(option: str) -> float | None:
    """Return the world z of the ground that --ground gives; None for "auto" and "unknown".

    Raises:
        CalibrationError: the option is neither of these nor a number.
    """
    if option in (AUTO, UNKNOWN):
        return None
    try:
        height = float(option)
    except ValueError:
        height = np.nan
    if not np.isfinite(height):
        raise CalibrationError(
            f"--ground {option} is no height; auto, unknown, or the world z of the ground was needed."
        )
    return height
