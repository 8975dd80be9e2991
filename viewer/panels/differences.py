"""The tab "Differences": compares the chosen photo with its computed picture, during a run and after it."""

import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from calibration.calibration import Calibration
from viewer.display.pictures import BRIGHTER, DARKER, SAME, STRONG_DIFFERENCE, enlarged
from viewer.display.run_follower import CHECKPOINT, RunFollower, Status
from viewer.widgets.legend import bar, remark
from viewer.widgets.panel import PanelContext
from viewer.widgets.picture_panel import caption

if TYPE_CHECKING:  # imported when somebody compares: beside a run it would cost more than all of the page
    from viewer.display.result import Result
    from viewer.relighting.comparison import Comparison

SNAPSHOT_WIDTH = 240  # px: about one CPU second for a dozen lights
SNAPSHOT_EVERY_S = 10.0  # the solver needs the cores
LATER = 10  # nice value of the thread beside a run
SHOWN_WIDTH = 430  # px: at least as wide as the tab, which makes them smaller
HINT = "Shows where the surface found so far does not explain the chosen photo"


class DifferencesPanel:
    """A switch, two pictures and a colour bar. Nothing is computed before a visitor switches it on and looks."""

    def __init__(self, context: PanelContext, tab: viser.GuiTabHandle):
        """Lay the tab out and wait."""
        self._context, self._follower = context, RunFollower(context.run_dir)
        self._index, self._next = 0, 0.0
        self._compare: Callable[[int], Comparison | None] | None = None  # by the index of a photo
        self._is_beside_run = False
        self._news, self._has_news, self._is_closed = threading.Condition(), False, False
        gui = context.server.gui
        with tab:
            self._switch = gui.add_checkbox("Compare", False, hint=HINT)
            self._said = gui.add_html(remark("Computes the chosen photo from the surface and shows where they differ."))
            self._computed_caption = gui.add_html("", visible=False)
            self._computed = gui.add_image(np.zeros((2, 3, 3), np.uint8), format="jpeg", visible=False)
            self._difference_caption = gui.add_html("", visible=False)
            self._difference = gui.add_image(np.zeros((2, 3, 3), np.uint8), format="png", visible=False)
            self._bar = gui.add_html("", visible=False)
        self._switch.on_update(lambda _: self._ask())
        context.photo_shown.connect(self._look_at)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def show(self, result: "Result") -> None:
        """Compare with this result from now on."""

        def compared(index: int) -> "Comparison | None":
            from viewer.relighting.comparison import compare_result

            name = result.calibration.lights[index].photo
            photo = self._follower.thumbnail(name)
            if photo is None:
                return None
            return compare_result(result.fields, result.calibration, name, photo, result.details)

        self._compare, self._is_beside_run = compared, False
        self._ask()

    def follow(self, now: Status, log: Sequence[Mapping[str, Any]], calibration: Calibration | None) -> None:
        """Compare with the newest snapshot of the run. A browser must have the page open."""
        self._is_beside_run = True
        if calibration is None:
            return
        if self._compare is None:
            self._compare = lambda index: self._of_snapshot(calibration, index)
        if self._follower.changed(CHECKPOINT) or self._next == 0.0:
            self._ask()

    def close(self) -> None:
        """End the thread."""
        self._context.photo_shown.disconnect(self._look_at)
        with self._news:
            self._is_closed = True
            self._news.notify()
        self._thread.join()

    # --- asking ------------------------------------------------------------------------------------------------------

    def _look_at(self, index: int) -> None:
        if index != self._index:
            self._index, self._next = index, 0.0
            self._ask()

    def _ask(self) -> None:
        with self._news:
            self._has_news = True
            self._news.notify()

    # --- in the thread -----------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while self._waited():
            if self._is_beside_run and sys.platform == "linux":  # elsewhere a nice value is the whole process's
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LATER)
            if not self._switch.value or self._compare is None or not self._context.server.get_clients():
                self._show(None, "" if self._switch.value else "off")
                continue
            found = self._compare(self._index)
            self._next = time.monotonic() + (SNAPSHOT_EVERY_S if self._is_beside_run else 0.0)
            self._show(found, "There is no surface or no photo yet.")

    def _waited(self) -> bool:
        """Wait for the next request, and, beside a run, for its time; False: it is over."""
        with self._news:
            self._news.wait_for(lambda: self._has_news or self._is_closed)
            while not self._is_closed and (left := self._next - time.monotonic()) > 0:
                self._news.wait(left)
            self._has_news = False
            return not self._is_closed

    def _of_snapshot(self, calibration: Calibration, index: int) -> "Comparison | None":
        from reconstruct.solve.checkpoint import newest_surface
        from reconstruct.stored_run.maps import read_thumbnails
        from viewer.relighting.comparison import compare_snapshot

        surface = newest_surface(self._context.run_dir / CHECKPOINT)
        thumbs = read_thumbnails(self._context.run_dir, [light.photo for light in calibration.lights])
        name = calibration.lights[index].photo
        if surface is None or name not in thumbs:
            return None
        return compare_snapshot(surface, calibration, name, thumbs, SNAPSHOT_WIDTH)

    def _show(self, found: "Comparison | None", otherwise: str) -> None:
        parts = (self._computed_caption, self._computed, self._difference_caption, self._difference, self._bar)
        with self._context.server.atomic():
            if found is None:
                self._said.content = remark(otherwise if otherwise != "off" else HINT + ".")
                for part in parts:
                    part.visible = False
                return
            name = "the surface so far" if self._is_beside_run else "the surface found"
            self._said.content = ""
            self._computed_caption.content = caption("Computed", f"from {name}")
            self._computed.image = enlarged(found.computed, SHOWN_WIDTH)
            self._difference_caption.content = caption("Difference", "photo minus computed")
            self._difference.image = enlarged(found.difference, SHOWN_WIDTH)
            self._bar.content = _legend(found)
            for part in parts:
                part.visible = True


def _legend(found: "Comparison") -> str:
    """Return the legend of the difference's colours, in per cent of white, and the size of the difference."""
    from viewer.relighting.comparison import MOST

    most, (typical, nearly_all) = f"{100 * STRONG_DIFFERENCE:.0f} % of white", found.gaps()
    marks = [f"\N{MINUS SIGN}{most}", "0", f"+{most}"]
    note = (
        f"Blue: the photo is darker than computed, red: brighter. Half of the pixels differ by less than "
        f"{100 * typical:.1f} % of white, {MOST} % by less than {100 * nearly_all:.1f} %."
    )
    return bar(np.array([DARKER, SAME, BRIGHTER], float), marks, note)
