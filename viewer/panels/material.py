"""The tab "Material": what the picture shows, and other materials for the object, the ground, a box or a brush."""

import threading
from collections.abc import Sequence

import numpy as np
import trimesh
import viser
from jaxtyping import Float

from calibration.light import Light
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.appearance.brdf import DIELECTRIC, MATERIALS, Material
from reconstruct.render.g_buffer import RenderView
from reconstruct.render.material_edit import (
    BoxRegion,
    BrushRegion,
    Edit,
    GroundRegion,
    ObjectRegion,
    Region,
    apply_edits,
    edited_vertex_colours,
)
from viewer.display.pictures import Picture, vertex_colours
from viewer.display.result import Result
from viewer.panels.channels import CHANNELS, Channel
from viewer.panels.colouring import round_step
from viewer.widgets.legend import QUIET, remark
from viewer.widgets.panel import PanelContext
from viewer.widgets.pointer import Ray, Tool

OWN = "Your colour"
REGIONS = ("Whole object", "Ground", "Box", "Brush")
HINTS = {
    "Box": "Drag the box in the 3D view around the part.",
    "Brush": "Click on the object or the ground in the 3D view. To paint no more, choose another place above.",
    "Ground": "The ground changes in the picture on the left.",
}
ROUGHEST, SMOOTHEST = 0.72, 0.1  # what nine lobes can show, see Material.roughness
WIDEST_BRUSH = 0.5  # of the object's longest edge
FIRST_BRUSH, FIRST_BOX = 0.12, 0.5  # of that edge; of each edge
VIEWS_KEPT = 4  # edited views kept: quick and full, from the camera and from where the visitor stands
BOX_COLOUR = (214, 137, 16)
STEPS = 100  # at least, of a slider over its range


def own_material(colour: tuple[int, int, int], shininess: float) -> Material:
    """Make a material of an sRGB colour. Shininess 0 is matt; above it is a dielectric, from satin to polished at 1."""
    albedo = tuple(float(v) for v in decode_srgb(np.array(colour, np.uint8)))
    mirrored = DIELECTRIC if shininess > 0 else 0.0
    roughness = ROUGHEST + (SMOOTHEST - ROUGHEST) * shininess
    return Material((albedo[0], albedo[1], albedo[2]), (mirrored, mirrored, mirrored), roughness)


def edited_mesh(mesh: trimesh.Trimesh, edits: Sequence[Edit]) -> trimesh.Trimesh:
    """Return the mesh in the colours of its edits."""
    recovered = decode_srgb(vertex_colours(mesh))
    colours = encode_srgb(edited_vertex_colours(edits, np.asarray(mesh.vertices), recovered))
    normals = np.asarray(mesh.vertex_normals)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, vertex_colors=colours, process=False)


class CachedEdits:
    """Applies edits to each view once, however often its picture is computed under another light."""

    def __init__(self, edits: Sequence[Edit]):
        """Take the edits to apply."""
        self._edits = tuple(edits)
        self._done: list[tuple[RenderView, RenderView]] = []

    def __call__(self, view: RenderView) -> RenderView:
        """Return the edited view."""
        for before, after in self._done:
            if before is view:
                return after
        after = apply_edits(view, self._edits)
        self._done = [*self._done, (view, after)][-VIEWS_KEPT:]
        return after


class MaterialPanel:
    """Channels of the picture, and a stack of edits that both the picture and the mesh show."""

    def __init__(self, context: PanelContext, tab: viser.GuiTabHandle):
        """Lay the controls out."""
        self._context = context
        self._lock = threading.RLock()
        self._result: Result | None = None
        self._edits: tuple[tuple[str, Edit], ...] = ()  # with their names, the oldest first
        self._tool = Tool(self._painted, self._brush_lost)
        self._gizmo: viser.TransformControlsHandle | None = None
        self._frame: viser.BoxHandle | None = None
        with tab:
            self._add_channel()
            self._add_material()
            self._add_region()
            self._add_stack()
        self._show_choices()

    def _add_channel(self) -> None:
        gui = self._context.server.gui
        self._channel = gui.add_dropdown("Picture", tuple(CHANNELS), hint="What the picture on the left shows")
        self._legend = gui.add_html("")
        self._channel.on_update(lambda _: self._show_channel())

    def _add_material(self) -> None:
        gui = self._context.server.gui
        names = (*(name.capitalize() for name in MATERIALS), OWN)
        self._material = gui.add_dropdown("New material", names, hint="What to make a part of the scene of")
        self._colour = gui.add_rgb("Colour", (176, 58, 46), visible=False)
        self._shine = gui.add_slider("Shininess", 0.0, 1.0, 0.01, 0.5, visible=False, hint="0: matt, 1: polished")
        self._material.on_update(lambda _: self._show_choices())

    def _add_region(self) -> None:
        gui = self._context.server.gui
        self._where = gui.add_dropdown("Where", REGIONS, hint="Which part gets the new material")
        self._sizes = [
            gui.add_slider(name, 0.0, 1.0, 0.01, 0.5, visible=False)
            for name in ("Box width", "Box depth", "Box height")
        ]
        self._turn = gui.add_slider("Box turn", -45, 45, 1, 0, visible=False, hint="Degrees about the vertical")
        self._radius = gui.add_slider("Brush radius", 0.0, 1.0, 0.01, 0.5, visible=False)
        self._hint = gui.add_html("")
        self._where.on_update(lambda _: self._show_choices())
        for slider in (*self._sizes, self._turn):
            slider.on_update(lambda _: self._draw_box())

    def _add_stack(self) -> None:
        gui = self._context.server.gui
        self._apply = gui.add_button("Apply")
        self._list = gui.add_html("")
        self._undo = gui.add_button("Undo the last", icon=viser.Icon.ARROW_BACK_UP, color=QUIET, visible=False)
        self._reset = gui.add_button("Remove all", icon=viser.Icon.TRASH, color=QUIET, visible=False)
        self._apply.on_click(lambda _: self._add_edit(self._region()))
        self._undo.on_click(lambda _: self._set_edits(self._edits[:-1]))
        self._reset.on_click(lambda _: self._set_edits(()))

    # --- for the page ------------------------------------------------------------------------------------------------

    def show(self, result: Result) -> None:
        """Edit this result from now on. Earlier edits are applied to it."""
        with self._lock:
            is_first, self._result = self._result is None, result
            if is_first and result.mesh is not None:
                self._fit_sliders(result.mesh, result.calibration.unit)
            self._set_edits(self._edits)
            self._show_channel()

    def close(self) -> None:
        """Listen to no more clicks."""
        self._context.pointer.release(self._tool)

    def edits(self) -> list[Edit]:
        """Return the edits, the oldest first."""
        return [edit for _, edit in self._edits]

    # --- what the picture shows --------------------------------------------------------------------------------------

    def _show_channel(self) -> None:
        with self._lock:
            name, result = str(self._channel.value), self._result
            channel = CHANNELS[name]
            if channel is None or result is None:
                self._legend.content = ""
                self._context.content.set_map("", None)
                return
            self._context.content.set_map(name, self._map(name, channel, result.calibration.unit))

    def _map(self, name: str, channel: Channel, unit: str):
        def drawn(view: RenderView, light: Light) -> Picture:
            shown = channel(view, light, unit)
            if self._channel.value == name and self._legend.content != shown.legend:
                self._legend.content = shown.legend
            return shown.picture

        return drawn

    # --- what is to be edited ----------------------------------------------------------------------------------------

    def _fit_sliders(self, mesh: trimesh.Trimesh, unit: str) -> None:
        """Let the sliders span this object, in its unit."""
        longest = float(mesh.extents.max())
        for slider, extent in zip(self._sizes, mesh.extents, strict=True):
            _span(slider, 1.2 * float(extent), FIRST_BOX * float(extent), unit)
        _span(self._radius, WIDEST_BRUSH * longest, FIRST_BRUSH * longest, unit)

    def _show_choices(self) -> None:
        """Show the controls of the chosen material and region, and no others."""
        where, is_own = str(self._where.value), self._material.value == OWN
        self._colour.visible = self._shine.visible = is_own
        for slider in (*self._sizes, self._turn):
            slider.visible = where == "Box"
        self._radius.visible = where == "Brush"
        self._apply.visible = where != "Brush"
        self._hint.content = remark(HINTS.get(where, ""))
        if where == "Brush":
            self._context.pointer.take(self._tool)
        else:
            self._context.pointer.release(self._tool)
        self._draw_box()

    def _draw_box(self) -> None:
        """Draw the box and its handle while a box is chosen."""
        with self._lock:
            result, is_box = self._result, self._where.value == "Box"
            if self._gizmo is not None and self._frame is not None:
                self._gizmo.visible = self._frame.visible = is_box
            if not is_box or result is None or result.mesh is None:
                return
            scene = self._context.server.scene
            if self._gizmo is None:
                upwards = np.array([0, 0, 0.5 * FIRST_BOX * result.mesh.extents[2]])
                place = result.scale.to_page(result.mesh.bounds.mean(0) + upwards)
                self._gizmo = scene.add_transform_controls(
                    "/material_box", 0.6, line_width=3.0, disable_rotations=True, disable_sliders=True, position=place
                )
            half = 0.5 * float(np.radians(self._turn.value))
            self._frame = scene.add_box(
                "/material_box/frame",
                BOX_COLOUR,
                result.scale.factor * np.array([slider.value for slider in self._sizes]),
                wireframe=True,
                cast_shadow=False,
                receive_shadow=False,
                wxyz=(np.cos(half), 0.0, 0.0, np.sin(half)),
            )

    def _chosen(self) -> tuple[str, Material]:
        """Return the name of the chosen material and the material."""
        name = str(self._material.value)
        if name != OWN:
            return name, MATERIALS[name.lower()]
        return name, own_material(self._colour.value, float(self._shine.value))

    def _region(self) -> Region:
        where = self._where.value
        if where == "Ground":
            return GroundRegion()
        if where == "Box" and self._gizmo is not None and self._result is not None:
            centre = self._result.scale.to_world(np.asarray(self._gizmo.position, dtype=np.float64))
            return BoxRegion(
                _point(centre),
                _point(0.5 * np.array([s.value for s in self._sizes])),
                float(np.radians(self._turn.value)),
            )
        return ObjectRegion()

    def _painted(self, ray: Ray) -> None:
        """Apply a click with the brush."""
        result = self._result
        if result is None:
            return
        picked = ray.pick(result)
        if picked is not None:
            self._add_edit(BrushRegion(_point(picked.place), float(self._radius.value), picked.on_object))

    def _brush_lost(self) -> None:
        """Handle that another tool now takes the clicks."""
        self._where.value = REGIONS[0]

    # --- the stack ---------------------------------------------------------------------------------------------------

    def _add_edit(self, region: Region) -> None:
        name, material = self._chosen()
        with self._lock:
            self._set_edits((*self._edits, (f"{name}: {str(self._where.value).lower()}", Edit(material, region))))

    def _set_edits(self, edits: tuple[tuple[str, Edit], ...]) -> None:
        """Show these edits in the picture, on the mesh and in the list."""
        with self._lock:
            self._edits = edits
            self._undo.visible = self._reset.visible = bool(edits)
            self._list.content = remark(" · ".join(_counted([name for name, _ in edits])))
            mesh = self._result.mesh if self._result is not None else None
            self._context.content.set_edit(CachedEdits(self.edits()) if edits else None)
            self._context.show_mesh(self, edited_mesh(mesh, self.edits()) if edits and mesh is not None else None)


def _span(slider: viser.GuiSliderHandle, most: float, value: float, unit: str) -> None:
    """Let a slider go from nearly 0 to about `most`, in round steps."""
    step = round_step(most / STEPS)
    slider.max, slider.min, slider.step = step * round(most / step), step, step
    slider.value = step * round(value / step)
    slider.label = f"{slider.label} ({unit})"


def _point(place: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in place)
    return x, y, z


def _counted(names: Sequence[str]) -> list[str]:
    """Return the names in order, repeated ones with their count, as strokes of a brush."""
    out: list[tuple[str, int]] = []
    for name in names:
        if out and out[-1][0] == name:
            out[-1] = (name, out[-1][1] + 1)
        else:
            out.append((name, 1))
    return [name if count == 1 else f"{name} ({count} times)" for name, count in out]
