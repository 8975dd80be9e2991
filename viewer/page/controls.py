"""Controls: the status, the steering, the photos and the layers of the page. They handle no geometry.

Steering: pause, go on, next level, stop and save, another resolution, as requests in the folder of the run.
"""

import html
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import viser
from jaxtyping import UInt8

from capture.files.title import title_of
from reconstruct.run_folder.forecast import duration_text, left_text
from reconstruct.run_folder.requests import (
    NEXT_LEVEL,
    PAUSE,
    PAUSED,
    RESOLUTIONS,
    STOP,
    make_request,
    open_requests,
    withdraw,
)
from viewer.display.layers import Host
from viewer.display.run_follower import RunFollower, Status

QUIET = (74, 78, 88)  # sRGB of a button that is not the main one
AS_PLANNED = "as planned"
SOLVING = ("hull", "solve")  # stages that can be steered; before them a request waits
ASKED = {
    PAUSE: "a pause",
    NEXT_LEVEL: "to go on finer",
    STOP: "stop and save",
    **{name: f"{name} from the next round on" for name in RESOLUTIONS},
}
HINTS = {
    PAUSE: "The run waits and uses no processor; Go on continues it",
    NEXT_LEVEL: "End this round now and go on with the next, finer one",
    STOP: "Make a mesh of the surface so far; the same command continues from here later",
    AS_PLANNED: "The resolution of the rest of the run, from the next round on",
}
MUTED = "opacity:.68;font-size:.82rem"
BRAND = (214, 137, 16)
OFF_AT_FIRST = ("Shadow hull",)
LAYERS = {
    "Surface": "The shape found so far",
    "Shadow hull": "The space that the shadows on the ground alone allow; the run begins with it",
    "Ground": "The plane the object stands on",
    "Camera": "Where the photos were taken from, with the chosen photo",
    "Lights": "Where the flashlight was held; grey ones could not be used",
    "Uncertainty": "The light lies in this ellipsoid, with about 95 % certainty along each axis",
    "Your lamp": "A light to drag: the surface shows its light and shadow",
}
TO_STAGE = (
    '<div style="padding:0 .8rem .7rem"><a href="/stage/" target="_self" style="color:inherit;font-weight:600">'
    "Open the result: to light, turn, measure and note</a></div>"
)


class Steering:
    """Buttons that make requests, and the state of the requests. Nothing that a visitor sends becomes a file name."""

    def __init__(self, gui: viser.GuiApi, run_dir: Path):
        """Lay the buttons out, hidden until a run is there."""
        self._run_dir, self._follower = run_dir, RunFollower(run_dir)
        icons = viser.Icon
        self._pause = gui.add_button("Pause", icon=icons.PLAYER_PAUSE, hint=HINTS[PAUSE], visible=False)
        self._go_on = gui.add_button("Go on", icon=icons.PLAYER_PLAY, visible=False)
        quiet: dict[str, Any] = {"color": QUIET, "visible": False}
        self._next = gui.add_button("Finer now", icon=icons.PLAYER_TRACK_NEXT, hint=HINTS[NEXT_LEVEL], **quiet)
        self._stop = gui.add_button("Stop and save", icon=icons.DEVICE_FLOPPY, hint=HINTS[STOP], **quiet)
        self._resolution = gui.add_dropdown(
            "Resolution", (AS_PLANNED, *RESOLUTIONS), initial_value=AS_PLANNED, hint=HINTS[AS_PLANNED], visible=False
        )
        self._pause.on_click(lambda _: self._request(PAUSE))
        self._go_on.on_click(lambda _: withdraw(run_dir, PAUSE))
        self._next.on_click(lambda _: self._request(NEXT_LEVEL))
        self._stop.on_click(lambda _: self._request(STOP))
        self._resolution.on_update(self._choose_resolution)

    def follow(self, now: Status, log: Sequence[Mapping[str, Any]]) -> str:
        """Show the buttons that apply now, and return what the run does about the open requests, in words."""
        asked = open_requests(self._run_dir)
        is_alive = not now.is_over
        self._go_on.visible, self._pause.visible = is_alive and PAUSE in asked, is_alive and PAUSE not in asked
        self._next.visible = self._stop.visible = self._resolution.visible = is_alive
        self._resolution.value = next((name for name in RESOLUTIONS if name in asked), AS_PLANNED)
        return _answer(now, log, asked)

    def _request(self, name: str) -> None:
        """Ask a run that is there. A client can press buttons that its page does not show."""
        if self._follower.is_running():
            make_request(self._run_dir, name)

    def _choose_resolution(self, event: viser.GuiEvent) -> None:
        if event.client is None:  # set by `follow`
            return
        withdraw(self._run_dir, *RESOLUTIONS)
        if self._resolution.value in RESOLUTIONS:
            self._request(self._resolution.value)


def _answer(now: Status, log: Sequence[Mapping[str, Any]], asked: frozenset[str]) -> str:
    """Say what the run does about the open requests."""
    if now.is_finished:
        return ""
    if now.is_over:
        left = " A pause that was asked for is forgotten then." if PAUSE in asked else ""
        return f"Nothing runs in this folder. The same command goes on where it stopped.{left}"
    last = log[-1] if log else {}
    if str(last.get("message", "")).startswith(PAUSED):
        return "Paused. Press Go on, or start the same command again."
    open_ones = [words for name, words in ASKED.items() if name in asked]
    if not open_ones:
        return ""
    when = "in a moment" if str(last.get("stage", "")) in SOLVING else "once the surface is being fitted"
    return f"Asked for: {', '.join(open_ones)}. It takes effect {when}."


class Controls:
    """All controls of the page. The `show_*` methods may be called from any thread; viser sends only what changed."""

    def __init__(
        self, host: Host, run_dir: Path, change_layers: Callable[[], None], choose_photo: Callable[[int], None]
    ):
        """Lay the controls out.

        Args:
            change_layers: called in viser's thread pool when a layer is switched on or off.
            choose_photo: called there with the index of a photo, from 0, when a visitor moves the slider.
        """
        self._gui = gui = host.gui
        self._change_layers = change_layers
        gui.set_panel_label(f"Shadowgraph · {title_of(run_dir)}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self._status = gui.add_html("")
        self._bar = gui.add_progress_bar(0, color=BRAND)
        self.steering = Steering(gui, run_dir)
        self._photo_folder = gui.add_folder("Photos", visible=False)
        with self._photo_folder:
            self._slider = gui.add_slider("Photo", 1, 2, 1, 1, hint="Each photo has its own light: the lamp goes there")
            self._caption = gui.add_html("")
        self._photo: viser.GuiImageHandle | None = None
        self._slider.on_update(lambda event: choose_photo(self.photo_index()) if event.client is not None else None)
        with gui.add_folder("Show", expand_by_default=False):
            self._layers = {n: gui.add_checkbox(n, n not in OFF_AT_FIRST, hint=hint) for n, hint in LAYERS.items()}
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=BRAND)
        for box in self._layers.values():
            box.on_update(lambda _: self._change_layers())

    # --- what is read from the controls ------------------------------------------------------------------------------

    def shows(self, layer: str) -> bool:
        """Return whether this one of LAYERS is switched on."""
        return bool(self._layers[layer].value)

    def photo_index(self) -> int:
        """Return the index of the chosen photo, from 0."""
        return int(self._slider.value) - 1

    # --- what is shown -----------------------------------------------------------------------------------------------

    def follow(self, now: Status, lines: Sequence[Mapping[str, Any]], remark: str, has_picture: bool) -> None:
        """Show stage, n of m, time left and message, the steering, a remark or problem, and the way to the stage."""
        self._status.content = _status_card(now, remark, self.steering.follow(now, lines)) + TO_STAGE * has_picture
        self._bar.visible, self._bar.value = not now.is_over, 100 * (now.share or 0.0)

    def show_photo(self, index: int, count: int, words: str, picture: UInt8[np.ndarray, "h w 3"] | None) -> None:
        """Show one of `count` photos, with a line about it; None: there is no picture of it yet."""
        self._slider.max, self._slider.disabled = max(count, 2), count < 2
        self._slider.value = index + 1
        self._photo_folder.visible = True
        if self._photo is not None:
            self._photo.visible = picture is not None
        if picture is not None and self._photo is None:
            with self._photo_folder:
                self._photo = self._gui.add_image(picture, format="jpeg")
        elif picture is not None and self._photo is not None:
            self._photo.image = picture
        self._caption.content = f'<div style="padding:0 .8rem .5rem;{MUTED}">{html.escape(words)}</div>'


def _status_card(now: Status, *remarks: str) -> str:
    """Return the status as HTML. Text from files is escaped: a photo's name must not become part of the page."""
    took = duration_text(now.elapsed_s)
    facts = [now.counts, f"took {took}"] if now.is_over else [now.counts, left_text(now.left_s), f"{took} so far"]
    lines = [" · ".join(f for f in facts if f), now.message, *remarks]
    body = "".join(f'<div style="{MUTED};margin-top:.15rem">{html.escape(line)}</div>' for line in lines if line)
    return (
        '<div style="padding:.55rem .8rem .7rem">'
        f'<div style="font-size:1.12rem;font-weight:600">{html.escape(now.title)}</div>{body}</div>'
    )
