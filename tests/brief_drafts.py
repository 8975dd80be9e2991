"""Drafts that are quick, for runs whose shape is measured elsewhere."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from reconstruct.run import presets
from reconstruct.source.options import LONG_SIDES

SIDE = 240  # px


@contextmanager
def brief_drafts() -> Iterator[None]:
    """The preset draft with smaller pictures, on coarser grids and with nearly half the iterations."""
    first, last = presets.DRAFT_LEVELS
    levels = replace(first, nodes=32, iterations=20), replace(last, nodes=48, iterations=20)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "DRAFT_LEVELS", levels)
        patch.setitem(LONG_SIDES, "draft", SIDE)
        yield
