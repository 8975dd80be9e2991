"""The tabs of the page. Their panels are imported when their tabs are first made.

Importing the panels of a finished run takes longer than opening a page, and a page beside a run needs none of them.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import viser

from calibration.calibration import Calibration
from viewer.display.run_follower import Status
from viewer.widgets.panel import LivePanel, PanelContext, ResultPanel

if TYPE_CHECKING:
    from viewer.display.result import Result


class Tab(NamedTuple):
    """One tab of the page."""

    title: str
    panel: str  # "module:class"
    is_live: bool = False  # while a run goes on; the class is a LivePanel
    is_result: bool = False  # of a finished run; the class is a ResultPanel

    def make(self, context: PanelContext, tab: viser.GuiTabHandle) -> Any:
        """Import the panel's class and make the panel."""
        return self.load()(context, tab)

    def load(self) -> Any:
        """Import the panel's class and return it."""
        module, name = self.panel.split(":")
        return getattr(importlib.import_module(module), name)


TABS = (  # in their order on the page; to add one, see viewer/widgets/panel.py
    Tab("Run", "viewer.panels.run:RunPanel", is_live=True),
    Tab("Light", "viewer.panels.light:LightPanel", is_result=True),
    Tab("Material", "viewer.panels.material:MaterialPanel", is_result=True),
    Tab("Inspect", "viewer.panels.inspect:InspectPanel", is_result=True),
    Tab("Differences", "viewer.panels.differences:DifferencesPanel", is_live=True, is_result=True),
    Tab("Save", "viewer.panels.save:SavePanel", is_result=True),
)


class Tabs:
    """The panels of one page. Each is made when there is something to show in it."""

    def __init__(self, context: PanelContext, add_tab: Callable[[str], viser.GuiTabHandle]):
        """Start without tabs; `show` and `follow` make them.

        Args:
            context: shared by all panels.
            add_tab: makes an empty tab with this title after the others.
        """
        self._context, self._add_tab = context, add_tab
        self.result_panels: dict[str, ResultPanel] = {}  # by title
        self.live_panels: dict[str, LivePanel] = {}
        self._live_tabs: list[viser.GuiTabHandle] = []

    def show(self, result: "Result") -> None:
        """Show a finished run in the panels for results, which are made with the first one."""
        if not self.result_panels:
            for tab in TABS:
                if tab.is_result:
                    self.result_panels[tab.title] = tab.make(self._context, self._add_tab(tab.title))
        for panel in self.result_panels.values():
            panel.show(result)

    def follow(self, now: Status, lines: Sequence[Mapping[str, Any]], calibration: Calibration | None) -> None:
        """Show the state of the run in its panels, which are made with the run and removed when it has finished."""
        if now.is_finished:
            self._end_run()
            return
        if not self.live_panels:
            for tab in TABS:
                if tab.is_live:
                    self._live_tabs.append(self._add_tab(tab.title))
                    self.live_panels[tab.title] = tab.make(self._context, self._live_tabs[-1])
        for panel in self.live_panels.values():
            panel.follow(now, lines, calibration)

    def close(self) -> None:
        """End the threads of all panels."""
        for panel in self.result_panels.values():
            panel.close()
        self._end_run()

    def _end_run(self) -> None:
        for panel in self.live_panels.values():
            panel.close()
        for tab in self._live_tabs:
            tab.remove()
        self.live_panels, self._live_tabs = {}, []
