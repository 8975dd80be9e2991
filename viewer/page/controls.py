"""Controls: the status, the tabs, the layers and the curves of the page. They handle no geometry and no files."""

import html
from collections.abc import Callable

import numpy as np
import viser
import viser.uplot
from jaxtyping import Float

from reconstruct.run_folder.forecast import duration_text, left_text
from viewer.display.run_follower import Status, residual_text
from viewer.widgets.picture_panel import MUTED, PicturePanel

BRAND = (214, 137, 16)
LAYERS = ("Surface", "Shadow hull", "Ground", "Camera", "Lights", "Uncertainty", "Your lamp")
OFF_AT_FIRST = ("Shadow hull",)
LAYER_HINTS = {
    "Surface": "The shape found so far, or the finished mesh",
    "Shadow hull": "The space that the shadows on the ground alone allow; the run begins with it",
    "Ground": "The plane the object stands on",
    "Camera": "Where the photos were taken from, with the chosen photo",
    "Lights": "Where the flashlight was held; grey ones could not be used",
    "Uncertainty": "The light lies in this ellipsoid, with about 95 % certainty along each axis",
    "Your lamp": "A light you can drag, once the surface is finished",
}
TO_STAGE = (
    '<div style="padding:0 .8rem .7rem"><a href="/stage/" target="_self" style="color:inherit;font-weight:600">'
    "Open the picture: lit by the pointer, to turn, to annotate</a></div>"
)
CURVE_COLOURS = ("#f5a524", "#5b9dff", "#4cc38a", "#e5709b", "#a78bfa", "#9aa3b2", "#22c1c3", "#e46c3b")


class Controls:
    """All panels of the page. The `show_*` methods may be called from any thread and send only what changed."""

    def __init__(self, server: viser.ViserServer, title: str, change_layers: Callable[[], None]):
        """Lay the panels out.

        Args:
            title: the run's name.
            change_layers: called in viser's thread pool when a layer is switched on or off.
        """
        self._gui = server.gui
        self._change_layers = change_layers
        self._curves: viser.GuiUplotHandle | None = None
        self._curve_names: tuple[str, ...] = ()
        self._gui.set_panel_label(f"Shadowgraph · {title}")
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(330)
        self._add_main_panel()
        self.pictures = PicturePanel(self._gui)

    def _add_main_panel(self) -> None:
        gui = self._gui
        self._status = gui.add_html("")
        self._tabs = gui.add_tab_group(visible=False)
        with gui.add_folder("Show", expand_by_default=False):
            self._layers = {n: gui.add_checkbox(n, n not in OFF_AT_FIRST, hint=LAYER_HINTS[n]) for n in LAYERS}
            self._dark = gui.add_checkbox("Dark page", True)
        self._dark.on_update(lambda _: self._set_theme())
        self._set_theme()
        for box in self._layers.values():
            box.on_update(lambda _: self._change_layers())
        self._curve_folder = gui.add_folder("How well it fits", expand_by_default=False, visible=False)

    def add_tab(self, title: str) -> viser.GuiTabHandle:
        """Add a tab behind the others. It has no icon, so that all tabs fit in one row."""
        self._tabs.visible = True
        return self._tabs.add_tab(title)

    # --- what is read from the controls ------------------------------------------------------------------------------

    def shows(self, layer: str) -> bool:
        """Return whether this one of LAYERS is switched on."""
        return bool(self._layers[layer].value)

    def status_html(self) -> str:
        """Return the status card as it was sent."""
        return self._status.content

    # --- what is shown -----------------------------------------------------------------------------------------------

    def show_status(self, now: Status, remark: str = "", has_picture: bool = False) -> None:
        """Show stage, n of m, time left and message, a remark about the mesh or a problem, and the way to the stage."""
        content = _status_card(now, remark) + (TO_STAGE if has_picture else "")
        if content != self._status.content:
            self._status.content = content

    def _set_theme(self) -> None:
        self._gui.configure_theme(
            dark_mode=bool(self._dark.value), show_logo=False, show_share_button=False, brand_color=BRAND
        )

    def show_losses(self, seconds: np.ndarray, losses: dict[str, np.ndarray]) -> None:
        """Plot each term of the loss over seconds."""
        names = tuple(losses)
        data = (seconds, *(continued(seconds, values) for values in losses.values()))
        if self._curves is not None and names == self._curve_names:
            self._curves.data = data
            return
        if self._curves is not None:
            self._curves.remove()
        self._curve_names = names
        self._curve_folder.visible = True
        with self._curve_folder:
            self._curves = self._gui.add_uplot(
                data,
                series=(
                    viser.uplot.Series(label="seconds"),
                    *(
                        viser.uplot.Series(label=residual_text(name)[0], stroke=colour, width=2, spanGaps=True)
                        for name, colour in zip(names, CURVE_COLOURS * len(names), strict=False)
                    ),
                ),
                scales={"x": viser.uplot.Scale(time=False, auto=True), "y": viser.uplot.Scale(distr=3, auto=True)},
                aspect=1.3,
            )


def continued(seconds: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return positive values at all seconds, drawn straight on a logarithmic scale between those that are known.

    A term that is measured now and then has nan in between, which the page's plot would draw as zero, a comb.
    """
    known = np.isfinite(values) & (values > 0)
    if not known.any():
        return np.full(len(values), np.nan)
    return np.exp(np.interp(seconds, seconds[known], np.log(values[known])))


def _status_card(now: Status, remark: str) -> str:
    """Return the status as HTML. Text from files is escaped: a photo's name must not become part of the page."""
    bar = ""
    if not now.is_over:
        width = 100 * (now.fraction if now.fraction is not None else 0.0)
        bar = (
            '<div style="height:6px;border-radius:3px;background:rgba(128,128,128,.25);margin:.5rem 0 .35rem">'
            f'<div style="height:6px;border-radius:3px;width:{width:.0f}%;background:rgb{BRAND}"></div></div>'
        )
    facts = [now.counts, "" if now.is_over else left_text(now.eta_s)]
    facts.append(
        f"{duration_text(now.elapsed_s)} so far" if not now.is_over else f"took {duration_text(now.elapsed_s)}"
    )
    lines = [" · ".join(f for f in facts if f), now.message, remark]
    body = "".join(f'<div style="{MUTED};margin-top:.15rem">{html.escape(line)}</div>' for line in lines if line)
    return (
        '<div style="padding:.55rem .8rem .7rem">'
        f'<div style="font-size:1.12rem;font-weight:600">{html.escape(now.title)}</div>{bar}{body}</div>'
    )
