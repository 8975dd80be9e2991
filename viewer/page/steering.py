"""Steering: pause, go on, next level, stop and save, another resolution, as requests in the folder of the run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import viser

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
from viewer.display.run_follower import RunFollower, Status

QUIET = (74, 78, 88)  # sRGB of a button that is not the main one
AS_PLANNED = "as planned"
SOLVING = ("hull", "solve")  # stages that can be steered; before them a request waits
ASKED = {
    PAUSE: "a pause",
    NEXT_LEVEL: "to go on finer",
    STOP: "stop and save",
    "draft": "draft from the next round on",
    "standard": "standard from the next round on",
    "fine": "fine from the next round on",
}
HINTS = {
    PAUSE: "The run waits and uses no processor; Go on continues it",
    NEXT_LEVEL: "End this round now and go on with the next, finer one",
    STOP: "Make a mesh of the surface so far; the same command continues from here later",
    AS_PLANNED: "The resolution of the rest of the run, from the next round on",
}


class Steering:
    """Buttons that make requests, and the state of the requests. Nothing that a visitor sends becomes a file name."""

    def __init__(self, gui: viser.GuiApi, run_dir: Path):
        """Lay the buttons out, hidden until a run is there."""
        self._run_dir, self._follower = run_dir, RunFollower(run_dir)
        icons = viser.Icon
        self._pause = gui.add_button("Pause", icon=icons.PLAYER_PAUSE, hint=HINTS[PAUSE], visible=False)
        self._go_on = gui.add_button("Go on", icon=icons.PLAYER_PLAY, visible=False)
        self._next, self._stop = (
            gui.add_button(label, icon=icon, color=QUIET, hint=HINTS[name], visible=False)
            for label, icon, name in (
                ("Finer now", icons.PLAYER_TRACK_NEXT, NEXT_LEVEL),
                ("Stop and save", icons.DEVICE_FLOPPY, STOP),
            )
        )
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
        _set_visible(self._go_on, is_alive and PAUSE in asked)
        _set_visible(self._pause, is_alive and PAUSE not in asked)
        for control in (self._next, self._stop, self._resolution):
            _set_visible(control, is_alive)
        chosen = next((name for name in RESOLUTIONS if name in asked), AS_PLANNED)
        if self._resolution.value != chosen:
            self._resolution.value = chosen
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
        return "Paused. It waits until somebody goes on, here or by starting the same command again."
    open_ones = [words for name, words in ASKED.items() if name in asked]
    if not open_ones:
        return ""
    when = "in a moment" if str(last.get("stage", "")) in SOLVING else "once the surface is being fitted"
    return f"Asked for: {', '.join(open_ones)}. It follows {when}."


def _set_visible(control: Any, is_visible: bool) -> None:
    if control.visible != is_visible:
        control.visible = is_visible
