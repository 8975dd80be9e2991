"""LightControls: the kind of light, its place and its brightness. They handle no geometry."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import viser
from jaxtyping import Float

from capture.photos.photo import decode_srgb
from viewer.widgets.legend import remark

LAMP: Final = "Lamp"
SUN: Final = "Far lamp"
SKY: Final = "Surroundings"
CAMERA, HERE = "The camera's place", "Where I stand"
LEAST_HEIGHT = 3  # degrees above the ground: shadows of lower lamps have no end
HINTS = {
    LAMP: "Drag the arrows of the lamp in the scene.",
    SUN: "Drag the lamp in the scene around the object, or set its direction here.",
    SKY: "Light from all around. Choose a map, or add a panorama of your own.",
}
WHITE = (255, 255, 255)


@dataclass(frozen=True)
class LightChoice:
    """The values of the controls."""

    kind: str  # LAMP | SUN | SKY
    brightness: float
    colour: Float[np.ndarray, "3"]  # linear factors, the largest 1
    size: float  # of the lamp, in [0, 1]
    azimuth: float  # degrees
    elevation: float
    sky: str
    turn: float  # degrees
    from_here: bool  # the picture is computed for where the visitor stands, too


class LightControls:
    """The controls, and which of them are visible."""

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiTabHandle,
        skies: Iterable[str],
        changed: Callable[[], None],
        uploaded: Callable[[str, bytes], None],
    ):
        """Lay the controls out in the tab.

        Args:
            changed: a visitor moved something; called in viser's threads.
            uploaded: a visitor sent a file of this name.
        """
        self._gui, self._tab, self._changed, self._uploaded = gui, tab, changed, uploaded
        with tab:
            self._add(gui, skies)
        for control in (self._kind, self._azimuth, self._elevation, self._sky, self._turn, self._brightness):
            control.on_update(self._moved)
        for control in (self._size, self._colour, self._from):
            control.on_update(self._moved)
        self._show_choices()

    def _add(self, gui: viser.GuiApi, skies: Iterable[str]) -> None:
        self._kind = gui.add_dropdown("Light", (LAMP, SUN, SKY), hint="What lights the computed picture")
        self._hint = gui.add_html("")
        self._azimuth = gui.add_slider("Direction", 0, 360, 1, 0, hint="Degrees around the object", visible=False)
        self._elevation = gui.add_slider(
            "Height", LEAST_HEIGHT, 90, 1, 45, hint="Degrees above the ground", visible=False
        )
        self._sky = gui.add_dropdown("Map", tuple(skies), hint="What surrounds the object", visible=False)
        self._turn = gui.add_slider("Turn", 0, 360, 1, 0, hint="Degrees; turns the surroundings", visible=False)
        self._brightness = gui.add_slider("Brightness", 0.1, 3.0, 0.05, 1.0, hint="1: as in the photos")
        self._size = gui.add_slider("Lamp size", 0, 100, 1, 0, hint="0: hard shadows; larger lamps, softer shadows")
        self._colour = gui.add_rgb("Colour", WHITE, hint="Of the lamp; white: that of the photos")
        self._upload: viser.GuiUploadButtonHandle | None = None
        self._message = gui.add_html("", visible=False)
        self._from = gui.add_dropdown(
            "Seen from", (CAMERA, HERE), hint="Where I stand: the scene itself shows the computed picture, too"
        )

    def choice(self) -> LightChoice:
        """Return the values of the controls now."""
        linear = decode_srgb(np.array(self._colour.value, np.uint8)).astype(np.float64)
        return LightChoice(
            kind=str(self._kind.value),
            brightness=float(self._brightness.value),
            colour=linear / linear.max() if linear.max() > 0 else np.zeros(3),
            size=float(self._size.value) / 100,
            azimuth=float(self._azimuth.value),
            elevation=float(self._elevation.value),
            sky=str(self._sky.value),
            turn=float(self._turn.value),
            from_here=self._from.value == HERE,
        )

    def set_kind(self, kind: Literal["Lamp", "Far lamp", "Surroundings"]) -> None:
        """Choose a kind of light as a visitor would, without a call of `changed`."""
        self._kind.value = kind
        self._show_choices()

    def set_angles(self, azimuth: float, elevation: float) -> None:
        """Show the far lamp's direction, degrees."""
        self._azimuth.value = round(azimuth) % 360
        self._elevation.value = int(np.clip(round(elevation), LEAST_HEIGHT, 90))

    def add_sky(self, name: str) -> None:
        """Offer another map, and choose it."""
        self._sky.options = (*(o for o in self._sky.options if o != name), name)
        self._sky.value = name
        self.say("")

    def say(self, html: str) -> None:
        """Show a remark under the controls. It is HTML: what it quotes must be escaped."""
        self._message.content, self._message.visible = html, bool(html)

    def _moved(self, event: viser.GuiEvent) -> None:
        if event.client is None:  # moved by `set_...`
            return
        if event.target is self._kind:
            self._show_choices()
        self._changed()

    def _show_choices(self) -> None:
        kind = self._kind.value
        self._hint.content = remark(HINTS[str(kind)])
        for control in (self._azimuth, self._elevation):
            control.visible = kind == SUN
        self._offer_upload(kind == SKY)
        for control in (self._sky, self._turn):
            control.visible = kind == SKY
        for control in (self._size, self._colour):
            control.visible = kind != SKY
        self._message.visible = kind == SKY and bool(self._message.content)

    def _offer_upload(self, is_offered: bool) -> None:
        """Make the button, or take it away: viser draws one that is not visible all the same."""
        if self._upload is not None and not is_offered:
            self._upload.remove()
            self._upload = None
        if self._upload is None and is_offered:
            with self._tab:
                self._upload = self._gui.add_upload_button(
                    "Add a panorama (.hdr, .exr)",
                    icon=viser.Icon.UPLOAD,
                    color="gray",
                    mime_type=".hdr,.exr",
                    order=self._message.order - 0.5,
                )
            self._upload.on_upload(lambda event: self._uploaded(event.target.value.name, event.target.value.content))
