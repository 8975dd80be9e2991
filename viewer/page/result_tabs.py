"""The tabs of a finished run, in their order. Imported with the first result: they take longer to import than a page to
open, and a page beside a run needs none of them.
"""

from collections.abc import Callable
from typing import NamedTuple

from viewer.panels.differences import ComparePanel
from viewer.panels.inspect import InspectPanel
from viewer.panels.light import LightPanel
from viewer.panels.material import MaterialPanel
from viewer.panels.save import SavePanel
from viewer.widgets.panel import Desk, Panel


class ResultTab(NamedTuple):
    """A tab for finished runs."""

    title: str
    panel: Callable[[Desk], Panel]


# In the order of the tabs; one line adds a panel: see widgets/panel.py. The light comes first: others use its picture.
RESULT_PANELS: tuple[ResultTab, ...] = (
    ResultTab("Light", LightPanel),
    ResultTab("Material", MaterialPanel),
    ResultTab("Inspect", InspectPanel),
    ResultTab("Differences", ComparePanel),
    ResultTab("Save", SavePanel),
)
