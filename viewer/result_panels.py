"""The tabs of a finished run, in their order. Imported with the first result: they take longer to import than a page to
open, and a page beside a run needs none of them.
"""

from collections.abc import Callable
from typing import NamedTuple

from viewer.compare_panel import ComparePanel
from viewer.inspect_panel import InspectPanel
from viewer.light_panel import LightPanel
from viewer.material_panel import MaterialPanel
from viewer.panel import Desk, Panel
from viewer.save_panel import SavePanel


class ResultTab(NamedTuple):
    """A tab for finished runs."""

    title: str
    panel: Callable[[Desk], Panel]


# In the order of the tabs; one line adds a panel: see viewer/panel.py. The light comes first: others use its picture.
RESULT_PANELS: tuple[ResultTab, ...] = (
    ResultTab("Light", LightPanel),
    ResultTab("Material", MaterialPanel),
    ResultTab("Inspect", InspectPanel),
    ResultTab("Differences", ComparePanel),
    ResultTab("Save", SavePanel),
)
