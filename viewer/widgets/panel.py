"""What a panel of the page is, and what the page shares with its panels.

To add a panel: write a class that is made from a `PanelContext` and its tab, in a module of its own, and add one line
to TABS in viewer/page/tabs.py. A panel for finished runs has `show`, one for running runs has `follow`; a panel for
both has both. A tab is made together with its panel, so no tab is empty.

    class SavePanel:
        def __init__(self, context: PanelContext, tab: viser.GuiTabHandle):
            with tab:  # controls made in this block belong to this panel's tab
                button = context.server.gui.add_button("Save the mesh")
            button.on_click(lambda event: ...)  # called in a pool of threads

        def show(self, result: Result) -> None: ...

        def close(self) -> None: ...
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import viser

from calibration.calibration import Calibration
from calibration.light import Light
from viewer.display.pictures import Picture
from viewer.display.run_follower import Status
from viewer.widgets.picture_panel import PicturePanel
from viewer.widgets.pointer import Pointer
from viewer.widgets.signal import Signal

if TYPE_CHECKING:  # a page beside a run has none of these, and need not import them
    import trimesh

    from reconstruct.evaluate.deviation import ReferenceMesh
    from reconstruct.render.g_buffer import RenderView
    from viewer.display.result import Result

ViewEdit = Callable[["RenderView"], "RenderView"]  # returns the view with other materials: material_edit.apply_edits
SurfaceMap = Callable[["RenderView", Light], Picture]  # draws albedo, depth, shadow ... in place of light


class PictureContent:
    """What the computed picture shows. The tab "Material" sets it, the tab "Light" computes the picture."""

    def __init__(self) -> None:
        """Start with the recovered materials under the light."""
        self.edit: ViewEdit | None = None  # None: the recovered materials
        self.map: SurfaceMap | None = None  # None: the picture is lit
        self.map_name = ""
        self.changed: Signal[None] = Signal()

    def set_edit(self, edit: ViewEdit | None) -> None:
        """Show other materials; None: the recovered ones."""
        self.edit = edit
        self.changed.emit(None)

    def set_map(self, name: str, surface_map: SurfaceMap | None) -> None:
        """Show a map of the surface, under this name, in the place of the lit picture; None: the lit picture."""
        self.map_name, self.map = name, surface_map
        self.changed.emit(None)


class ShowMesh(Protocol):
    """Draws a mesh in the place of the finished one; see PanelContext."""

    def __call__(self, owner: object, mesh: "trimesh.Trimesh | None", is_lit: bool = True) -> None:
        """Draw the mesh of this panel, world frame; None: the panel shows none any more.

        Args:
            owner: the panel; each has at most one mesh.
            is_lit: by the lamp or by daylight; else in exactly its vertex colours.
        """
        ...


@dataclass(frozen=True)
class PanelContext:
    """What the page shares with all its panels. Every function may be called from any thread and returns at once."""

    server: viser.ViserServer
    run_dir: Path
    pictures: PicturePanel  # the computed picture and the photo, beside the scene
    pointer: Pointer  # clicks into the scene
    show_mesh: ShowMesh  # in the place of the finished mesh; of several panels' meshes, the one shown last
    look_at_photo: Callable[[int], None]  # by its index in calibration.lights
    reference: "ReferenceMesh | None" = None  # to compare the result with, where the command named one
    content: PictureContent = field(default_factory=PictureContent)
    photo_shown: Signal[int] = field(default_factory=Signal)  # another photo is looked at: its index
    photo_chosen: Signal[int] = field(default_factory=Signal)  # a visitor chose a photo: the lamp goes to its light
    lamp_shown: Signal[bool] = field(default_factory=Signal)  # the layer "Your lamp" is switched on or off


class ResultPanel(Protocol):
    """A tab of a finished run's page. The thread that calls `show` makes the panel."""

    def show(self, result: "Result") -> None:
        """Show this result. Called right after the panel is made, and again for each new result.

        Raises:
            UserError: a file of the run is damaged; the page says so and goes on.
        """
        ...

    def close(self) -> None:
        """End all threads and wait for them: the page closes."""
        ...


class LivePanel(Protocol):
    """A tab of a running run's page. It is removed once the run has finished."""

    def follow(self, now: Status, log: Sequence[Mapping[str, Any]], calibration: Calibration | None) -> None:
        """Show the run as it is now. Called about twice a second.

        Args:
            log: every line so far.
            calibration: once camera and lights are known.
        """
        ...

    def close(self) -> None:
        """End all threads and wait for them: the tab is removed right afterwards."""
        ...
