"""Drafts that are quick, for runs whose shape is measured elsewhere."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from calibration.flashlight import fit
from reconstruct.run import presets
from reconstruct.shading import joint_normals
from reconstruct.source.source import LONG_SIDES

SIDE = 240  # px
NORMAL_STEPS = 20  # of 150, when few photos leave the normals of all pixels to be fitted together
TESTS = Path(__file__).parent
ENVIRONMENT = {"PYTHONPATH": f"{TESTS}{os.pathsep}{TESTS.parent}"}  # of a process with `brief_command`
_RUN = """import sys, shadowgraph
from brief_drafts import brief_drafts
with brief_drafts():
    sys.exit(shadowgraph.main(sys.argv[1:]))"""


def brief_command(*words: object) -> list[str]:
    """`shadowgraph WORDS` with brief drafts, for a process of its own."""
    return [sys.executable, "-c", _RUN, *map(str, words)]


@contextmanager
def brief_drafts() -> Iterator[None]:
    """The preset draft with smaller pictures, coarser grids, fewer iterations of every kind and one start of lights."""
    first, last = presets.DRAFT_LEVELS
    levels = replace(first, nodes=32, iterations=20), replace(last, nodes=48, iterations=20)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "DRAFT_LEVELS", levels)
        patch.setitem(LONG_SIDES, "draft", SIDE)
        patch.setattr(joint_normals, "STEPS", NORMAL_STEPS)
        patch.setattr(fit, "START_BEAMS", fit.START_BEAMS[:1])
        yield
