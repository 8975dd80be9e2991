"""What a panel of the page is, and what the page lends to it.

To add a panel for finished runs: write a class that is a `Panel`, made from a `Desk`, in a module of its own, and add
one line to RESULT_PANELS in viewer/page/result_tabs.py. For what belongs to a run that goes on: a `RunPanel`, and
RUN_PANELS in viewer/page/tabs.py. A tab is made together with its panel, so a panel that is not there leaves no empty
tab.

    class SavePanel:
        def __init__(self, desk: Desk):
            with desk.tab:  # controls made in here lie in this panel's tab
                button = desk.server.gui.add_button("Save the mesh")
            button.on_click(lambda event: ...)  # called in a pool of threads

        def show(self, result: Result) -> None: ...

        def close(self) -> None: ...
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import viser

from calibration.calibration import Calibration
from calibration.light import Light
from viewer.display.follow import Status
from viewer.display.pictures import Picture
from viewer.widgets.picture_panel import PicturePanel
from viewer.widgets.pointer import Pointer

if TYPE_CHECKING:  # a page beside a run has none of these, and need not import them
    import trimesh

    from reconstruct.evaluate.deviation import ReferenceMesh
    from reconstruct.render.g_buffer import RenderView
    from viewer.display.result import Result

Edit = Callable[["RenderView"], "RenderView"]  # other materials, as material_edit.apply_edits
Map = Callable[["RenderView", Light], Picture]  # what a picture shows instead of light: albedo, depth, ...


class ShowMesh(Protocol):
    """Draws a mesh in the finished one's place; see Desk."""

    def __call__(self, mesh: "trimesh.Trimesh | None", is_lit: bool = True) -> None:
        """World frame; None: what other panels show, or the finished mesh, again.

        Args:
            is_lit: by the lamp or by daylight; else in exactly its vertex colours.
        """
        ...


@dataclass(frozen=True)
class Desk:
    """What the page lends to one panel. Every function may be called from any thread and returns at once."""

    server: viser.ViserServer
    tab: viser.GuiTabHandle  # `with desk.tab:` puts controls into it
    run_dir: Path
    pictures: PicturePanel  # the computed picture and the photo, beside the scene
    look_at_photo: Callable[[int], None]  # by its index in calibration.lights
    on_photo: Callable[[Callable[[int], None]], None]  # called with the index whenever another photo is looked at
    show_mesh: ShowMesh  # instead of the finished mesh; of several panels' meshes, the one shown last
    set_edit: Callable[[Edit | None], None]  # of the computed picture, which is computed again; None: as recovered
    set_map: Callable[[str, Map | None], None]  # by name, instead of the lit picture; None: lit again
    pointer: Pointer  # clicks into the scene
    reference: "ReferenceMesh | None"  # to compare the result with, where the command named one


class Panel(Protocol):
    """A tab of the page of a finished run; made as Panel(desk), by the thread that calls `show`."""

    def show(self, result: "Result") -> None:
        """Show this result; called for the first one right after the panel is made, and for each one after it.

        Raises:
            UserError: a file of the run is damaged; the page says so and goes on.
        """
        ...

    def close(self) -> None:
        """The page closes: end threads, wait for them."""
        ...


class RunPanel(Protocol):
    """A tab of the page of a run that goes on; made as RunPanel(desk). It is taken away once the run has finished."""

    def follow(self, now: Status, log: Sequence[Mapping[str, Any]], calibration: Calibration | None) -> None:
        """The run as it is now, about twice a second.

        Args:
            log: every line so far.
            calibration: once camera and lights are known.
        """
        ...

    def close(self) -> None:
        """As Panel.close; its tab is removed right afterwards."""
        ...
