"""The tabs of the page while a run goes on and after it, and what the page lends to them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import viser

from calibration.calibration import Calibration
from viewer.display.follow import Status
from viewer.page.controls import Controls
from viewer.panels.differences import ComparePanel
from viewer.panels.run import RunControls
from viewer.widgets.panel import Desk, Panel, RunPanel
from viewer.widgets.pointer import Pointer

if TYPE_CHECKING:
    from reconstruct.evaluate.deviation import ReferenceMesh
    from viewer.display.result import Result
    from viewer.panels.light import LightPanel


class RunTab(NamedTuple):
    """A tab while a run goes on."""

    title: str
    panel: Callable[[Desk], RunPanel]


RUN_PANELS: tuple[RunTab, ...] = (
    RunTab("Run", RunControls),
    RunTab("Differences", ComparePanel),
)


@dataclass(frozen=True)
class Lent:
    """What the page lends to all tabs."""

    server: viser.ViserServer
    controls: Controls
    run_dir: Path
    look_at_photo: Callable[[int], None]
    show_mesh: Callable[..., None]  # after the tab's title, as panel.ShowMesh
    reference: "ReferenceMesh | None"


class Tabs:
    """The panels of one page, made when there is something to show in them."""

    def __init__(self, lent: Lent):
        """No tab is there before `show` or `follow`."""
        self._lent = lent
        self._pointer = Pointer(lent.server)
        self.light: LightPanel | None = None
        self.panels: list[Panel] = []
        self.run_panels: list[tuple[RunPanel, viser.GuiTabHandle]] = []
        self._watchers: list[Callable[[int], None]] = []
        self._run_watchers: list[Callable[[int], None]] = []

    @property
    def photo_watchers(self) -> list[Callable[[int], None]]:
        """Who is told of the chosen photo."""
        return [*self._watchers, *self._run_watchers]

    def show(self, result: "Result") -> None:
        """Give a finished run to the panels, which are made, and imported, with the first one."""
        from viewer.page.result_tabs import RESULT_PANELS
        from viewer.panels.light import LightPanel

        if is_first := not self.panels:
            for title, make in RESULT_PANELS:
                panel = make(self._desk(title, self._watchers))
                if isinstance(panel, LightPanel):
                    self.light = panel
                self.panels.append(panel)
        for panel in self.panels:
            panel.show(result)
        if is_first and self.light is not None:
            self.light.hang_at(self._lent.controls.pictures.photo_index())

    def follow(self, now: Status, lines: Sequence[Mapping[str, Any]], calibration: Calibration | None) -> None:
        """Tell the run's panels how it stands; they come with the run and go when it has finished."""
        if now.is_finished:
            self._end_run()
            return
        if not self.run_panels:
            for title, make in RUN_PANELS:
                desk = self._desk(title, self._run_watchers)
                self.run_panels.append((make(desk), desk.tab))
        for panel, _ in self.run_panels:
            panel.follow(now, lines, calibration)

    def close(self) -> None:
        """End the panels' threads."""
        for panel in self.panels:
            panel.close()
        self._end_run()

    def _end_run(self) -> None:
        for panel, tab in self.run_panels:
            panel.close()
            tab.remove()
        self.run_panels = []
        self._run_watchers.clear()  # or each run of a folder would leave its panels behind

    def _desk(self, title: str, watchers: list[Callable[[int], None]]) -> Desk:
        lent = self._lent
        return Desk(
            server=lent.server,
            tab=lent.controls.add_tab(title),
            run_dir=lent.run_dir,
            pictures=lent.controls.pictures,
            look_at_photo=lent.look_at_photo,
            on_photo=watchers.append,
            show_mesh=partial(lent.show_mesh, title),
            set_edit=lambda edit: self.light.set_edit(edit) if self.light else None,
            set_map=lambda name, a_map: self.light.set_map(name, a_map) if self.light else None,
            pointer=self._pointer,
            reference=lent.reference,
        )
