"""The context of one panel on a real viser server, without the rest of the page, that notes what the panel shows."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fake_run
import numpy as np
import torch
import trimesh
import viser
from synthetic import Truth

from calibration.light import Light
from reconstruct.evaluate.deviation import ReferenceMesh
from reconstruct.render.g_buffer import RenderView, look
from viewer.display.layers import page_scale
from viewer.display.pictures import Picture
from viewer.display.result import Result
from viewer.widgets.panel import PanelContext, PictureContent
from viewer.widgets.picture_panel import PicturePanel
from viewer.widgets.pointer import Pointer


@dataclass
class Shown:
    """What a panel asked the page to show, the newest."""

    mesh: trimesh.Trimesh | None = None
    is_lit: bool = True
    content: PictureContent = field(default_factory=PictureContent)

    def show_mesh(self, owner: object, mesh: trimesh.Trimesh | None, is_lit: bool = True) -> None:
        self.mesh, self.is_lit = mesh, is_lit

    def picture(self, view: RenderView, light: Light) -> Picture:
        assert self.content.map is not None
        return self.content.map(view, light)


def make_context(server: viser.ViserServer, reference: ReferenceMesh | None = None) -> tuple[PanelContext, Shown]:
    shown = Shown()
    context = PanelContext(
        server=server,
        run_dir=Path(),
        pictures=PicturePanel(server.gui),
        pointer=Pointer(server),
        show_mesh=shown.show_mesh,
        look_at_photo=lambda index: None,
        reference=reference,
        content=shown.content,
    )
    return context, shown


def make_tab(context: PanelContext) -> viser.GuiTabHandle:
    return context.server.gui.add_tab_group().add_tab("Panel")


def result_of(truth: Truth, with_evidence: bool = False) -> Result:
    """A finished run of these shapes; its rays are dense everywhere, where they are wanted."""
    fields = fake_run.fields_of(truth)
    if with_evidence:
        fields = replace(fields, evidence=torch.ones_like(fields.grid.values))
    calibration = fake_run.calibration_of(truth)
    return Result(Path(), calibration, fields, page_scale(calibration), fake_run.mesh_of(fields))


def view_of(result: Result) -> RenderView:
    return look(result.fields, 48)


def click(context: PanelContext, result: Result, target: np.ndarray, eye: np.ndarray) -> None:
    """As viser tells of a click by which a visitor at `eye` sees `target`; world."""
    origin, end = result.scale.to_page(eye), result.scale.to_page(target)
    camera = SimpleNamespace(fov=0.8, image_height=800)
    event: Any = SimpleNamespace(
        ray_origin=tuple(origin), ray_direction=tuple(end - origin), client=SimpleNamespace(camera=camera)
    )
    context.pointer._clicked(event)
