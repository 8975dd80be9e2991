"""PicturePanel: the computed picture and a photo beside the scene, one above the other or with a wipe."""

import html
import threading
from collections.abc import Callable

import numpy as np
import viser

from viewer.display.pictures import Picture, enlarged, wiped

PICTURE_PANEL_PX = 430
MUTED = "opacity:.68;font-size:.82rem"
NOTHING = np.zeros((2, 3, 3), np.uint8)
BOTH, WIPE = "One above the other", "Wipe"


class PicturePanel:
    """Two pictures with their captions. The `show_*` methods may be called from any thread."""

    def __init__(self, gui: viser.GuiApi):
        """Lay the panel out, hidden until `show`."""
        self._gui = gui
        self._lock = threading.RLock()
        self._picture, self._nearest = NOTHING, NOTHING  # as given
        self._photo_words = ""
        self._slider: viser.GuiSliderHandle[int] | None = None
        self._panel = gui.add_panel(visible=False)
        self._tab = self._panel.add_tab("Pictures", viser.Icon.PHOTO)
        with self._tab:
            self._computed_caption = gui.add_html("", visible=False)
            self._computed = gui.add_image(NOTHING, format="jpeg", jpeg_quality=92, visible=False)
            self._divider = gui.add_slider("Photo | computed", 0, 100, 1, 50, visible=False)
            self._compare = gui.add_dropdown(
                "Compare", (BOTH, WIPE), visible=False, hint="Wipe: the photo on the left of a line that you move"
            )
            self._photo_caption = gui.add_html("")
            self._photo = gui.add_image(NOTHING, format="jpeg", visible=False)
        for control in (self._divider, self._compare):
            control.on_update(lambda _: self._draw())
        self._panel.dock_left()
        self._panel.set_width(PICTURE_PANEL_PX)

    def computed(self) -> Picture:
        """Return the last computed picture, without the photo; 2 x 3 black pixels before the first."""
        return self._picture

    def drawn(self) -> Picture:
        """Return the upper picture as the page shows it, with or without the photo wiped over it."""
        return self._computed.image

    # --- the photo ---------------------------------------------------------------------------------------------------

    def show(self, count: int, chosen: Callable[[int], None]) -> None:
        """Open the panel and let one of `count` photos be chosen.

        Args:
            chosen: called with its index, from 0, when a visitor moves the slider.
        """
        if self._slider is not None:
            self._slider.remove()
        with self._tab:
            self._slider = self._gui.add_slider(
                "Photo",
                1,
                max(count, 1),
                1,
                1,
                disabled=count < 2,
                hint="Each photo has its own light",
                order=(self._compare.order + self._photo_caption.order) / 2,
            )
        self._slider.on_update(lambda event: chosen(self.photo_index()) if event.client is not None else None)
        self._panel.visible = True

    def photo_index(self) -> int:
        """Return the index of the chosen photo, from 0."""
        return 0 if self._slider is None else int(self._slider.value) - 1

    def set_photo(self, index: int) -> None:
        """Move the slider to this photo without choosing it again."""
        if self._slider is not None and index != self.photo_index():
            self._slider.value = index + 1

    def show_photo(self, name: str, remark: str, picture: Picture | None) -> None:
        """Show the chosen photo.

        Args:
            remark: why its light is not used, or "".
            picture: sRGB, or None where there is none yet.
        """
        with self._lock:
            self._photo_words = f"{name}{' · ' + remark if remark else ''}"
            self._nearest = NOTHING if picture is None else picture
            self._draw()

    # --- the computed picture ----------------------------------------------------------------------------------------

    def show_computed(self, picture: Picture, is_final: bool, title: str = "Computed") -> None:
        """Show the computed picture. One that is not final will soon be replaced by a sharper one."""
        with self._lock:
            self._picture = picture
            self._computed_caption.content = caption(title, "from the surface found" if is_final else "refining ...")
            self._draw()

    def _draw(self) -> None:
        """Show both pictures according to the controls."""
        with self._lock:
            label = "Photo" if self._picture is NOTHING else "Nearest photo"
            self._photo_caption.content = caption(label, self._photo_words)
            has_both = self._picture is not NOTHING and self._nearest is not NOTHING
            is_wiped = has_both and self._compare.value == WIPE
            shown = wiped(self._nearest, self._picture, self._divider.value / 100) if is_wiped else self._picture
            if self._picture is not NOTHING:
                self._computed.image = enlarged(shown, PICTURE_PANEL_PX)
            self._computed.visible = self._computed_caption.visible = self._picture is not NOTHING
            self._divider.visible = is_wiped
            self._compare.visible = has_both
            self._photo.visible = self._nearest is not NOTHING and not is_wiped
            if self._photo.visible:
                self._photo.image = enlarged(self._nearest, PICTURE_PANEL_PX)


def caption(label: str, text: str) -> str:
    """Return a line over a picture. Its text is escaped: a photo's name must not become part of the page."""
    return (
        f'<div style="padding:.5rem .6rem .15rem;font-size:.9rem"><b>{html.escape(label)}</b>'
        f'<span style="{MUTED}">&ensp;{html.escape(text)}</span></div>'
    )
