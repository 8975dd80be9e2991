"""The panel beside the scene: the computed picture and the photo it is compared with."""

import html

import numpy as np
import viser

from viewer.pictures import Picture, enlarged

PICTURE_PANEL_PX = 430
MUTED = "opacity:.68;font-size:.82rem"


class PicturePanel:
    """Two pictures with their captions. The `show_*` methods may be called from any thread."""

    def __init__(self, gui: viser.GuiApi):
        """Lay the panel out, hidden until `show`."""
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Pictures", viser.Icon.PHOTO):
            self._computed_caption = gui.add_html("", visible=False)
            self._computed = gui.add_image(np.zeros((2, 3, 3), np.uint8), visible=False)
            self._photo_caption = gui.add_html("")
            self._photo = gui.add_image(np.zeros((2, 3, 3), np.uint8), format="jpeg", visible=False)
        self._panel.dock_left()
        self._panel.set_width(PICTURE_PANEL_PX)

    def computed(self) -> Picture:
        """The computed picture as last shown; 2 x 3 black pixels before the first."""
        return self._computed.image

    def show(self) -> None:
        """Open the panel."""
        self._panel.visible = True

    def show_photo(self, name: str, remark: str, picture: Picture | None) -> None:
        """The chosen photo.

        Args:
            remark: why its light is not used, or "".
            picture: sRGB, or None where there is none yet.
        """
        label = "Photo" if not self._computed.visible else "Nearest photo"
        self._photo_caption.content = caption(label, f"{name}{' · ' + remark if remark else ''}")
        self._photo.visible = picture is not None
        if picture is not None:
            self._photo.image = enlarged(picture, PICTURE_PANEL_PX)

    def show_computed(self, picture: Picture, is_final: bool, title: str = "Computed") -> None:
        """The computed picture; one that is not final is about to be replaced by a sharper one."""
        self._computed.image = enlarged(picture, PICTURE_PANEL_PX)
        self._computed.visible = self._computed_caption.visible = True
        self._computed_caption.content = caption(title, "from the surface found" if is_final else "refining ...")


def caption(label: str, text: str) -> str:
    """A line over a picture; everything is escaped: a photo's name must not become part of the page."""
    return (
        f'<div style="padding:.5rem .6rem .15rem;font-size:.9rem"><b>{html.escape(label)}</b>'
        f'<span style="{MUTED}">&ensp;{html.escape(text)}</span></div>'
    )
