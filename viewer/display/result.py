"""Result: what a finished run holds, for the panels of the page."""

from dataclasses import dataclass
from pathlib import Path

import trimesh

from calibration.calibration import Calibration
from reconstruct.detail.file import Detail
from reconstruct.fields import Fields
from viewer.display.layers import PageScale


@dataclass(frozen=True)
class Result:
    """A finished run. World frame, except what goes through `scale`."""

    run_dir: Path
    calibration: Calibration
    fields: Fields
    scale: PageScale  # page units per world length
    mesh: trimesh.Trimesh | None  # mesh.ply; None where it is missing or empty
    details: tuple[Detail, ...] = ()  # of the photos' own pixels, of each view; none where the run has none
