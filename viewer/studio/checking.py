"""Checks: first looks at photos as they arrive, and the verdict of `shadowgraph check` once they pause.

A first look is the helper's; a verdict is a process of its own, one at a time, made again when the photos have changed.
"""

import hashlib
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.errors import UserError
from capture.files.atomic import write_json
from capture.session.session import FEWEST_LIT
from capture.session.sorting import clips_of, photos_of
from reconstruct.run.batch import start_command, why_it_failed
from reconstruct.stored_run.documents import CHECK, read_check
from viewer.studio.folder import mark_of, without_folder
from viewer.studio.helper import Helper, Newest

PAUSE_S = 3.0  # without a new photo, after which a verdict is made
LOG = "said.txt"
REFUSED = "refused.json"


@dataclass
class _Watched:
    """One capture that somebody looks at."""

    mark: str = ""  # of its files
    changed: float = 0.0  # when, by our clock
    asked: float = 0.0  # when somebody last looked
    wants: bool = False  # a verdict as soon as possible


class Checks:
    """First looks and verdicts of the captures of a studio."""

    def __init__(self, folder: Path, helper: Helper, program: Sequence[str]):
        """Keep verdicts in `folder`; `program` is the command `shadowgraph`."""
        self._folder, self._program = folder, program
        self._looks = Newest(helper, "look")
        self._watched: dict[Path, _Watched] = {}
        self._process: tuple[Path, str, subprocess.Popen[bytes]] | None = None

    def looks(self, capture: Path) -> dict[str, Any]:
        """Return the newest first look, and ask for another where photos have changed. The caller asks again soon."""
        found = self._looks.about(capture, self._watch(capture).mark, folder=str(capture))
        return found or {"photos": [], "lights": [], "advice": ""}

    def state(self, capture: Path) -> dict[str, Any]:
        """Return the newest verdict, why none can be made, and whether one is being made."""
        found: dict[str, Any] = {"verdict": "", "sentence": "", "numbers": {}}
        found |= {name: [] for name in ("reasons", "advice", "lights")}
        found |= {key: value for key, value in self._kept(capture, CHECK).items() if key in found}
        said = str(self._kept(capture, REFUSED).get("sentence", ""))
        is_running = self._process is not None and self._process[0] == capture
        found |= {"error": without_folder(said, capture, "this capture"), "is_running": is_running}
        return found | {"is_old": self._made_of(capture) != self._mark(capture)}

    def ask(self, capture: Path) -> None:
        """Ask for a verdict now."""
        self._watch(capture).wants = True

    def tick(self) -> None:
        """Note a verdict that is ready; start one for a capture that is looked at and whose photos have paused."""
        if self._process is not None:
            self._note_end()
        if self._process is not None:
            return
        now = time.monotonic()
        for capture, watched in list(self._watched.items()):
            self._watch(capture, is_asked=False)
            is_ripe = watched.wants or (now - watched.changed > PAUSE_S and now - watched.asked < 4 * PAUSE_S)
            if is_ripe and capture.is_dir() and self._made_of(capture) != watched.mark:
                watched.wants = False
                if len(photos_of(capture)) > FEWEST_LIT or clips_of(capture):
                    self._start(capture, watched.mark)
                    return

    def forget(self, capture: Path) -> None:
        """End the check of a capture that is deleted."""
        self._watched.pop(capture, None)
        if self._process is not None and self._process[0] == capture:
            self.close()

    def close(self) -> None:
        """End the process of a verdict."""
        if self._process is not None:
            self._process[2].terminate()
            self._process[2].wait()
            self._process = None

    def page(self, capture: Path) -> Path:
        """Return the page of the newest verdict."""
        return self._place(capture) / "check.html"

    def _watch(self, capture: Path, is_asked: bool = True) -> _Watched:
        watched = self._watched.setdefault(capture, _Watched())
        mark = self._mark(capture)
        if mark != watched.mark:
            watched.mark, watched.changed = mark, time.monotonic()
        if is_asked:
            watched.asked = time.monotonic()
        return watched

    def _start(self, capture: Path, mark: str) -> None:
        place = self._place(capture)
        place.mkdir(parents=True, exist_ok=True)
        words = [*self._program, "check", str(capture), "--out", str(place)]
        self._process = (capture, mark, start_command(words, place / LOG, for_studio=True))

    def _note_end(self) -> None:
        assert self._process is not None
        capture, mark, process = self._process
        code = process.poll()
        if code is None:
            return
        self._process = None
        place = self._place(capture)
        document = {"sentence": "" if code == 0 else why_it_failed(code, place / LOG), "mark": mark}
        if code != 0 and not self._is_newer(place):
            (place / CHECK).unlink(missing_ok=True)
        write_json(place / REFUSED, document)

    def _is_newer(self, place: Path) -> bool:
        """Return whether check.json was written by the check that has just ended: it is hopeless, with its verdict."""
        try:
            return (place / CHECK).stat().st_mtime >= (place / LOG).stat().st_mtime - 60
        except OSError:
            return False

    def _made_of(self, capture: Path) -> str:
        return str(self._kept(capture, REFUSED).get("mark", ""))

    def _kept(self, capture: Path, name: str) -> dict[str, Any]:
        """Return a document of the newest verdict; empty where there is none that can be read."""
        try:
            return read_check(self._place(capture) / name)
        except UserError:
            return {}

    def _place(self, capture: Path) -> Path:
        return self._folder / hashlib.sha256(str(capture).encode()).hexdigest()[:16]

    def _mark(self, capture: Path) -> str:
        """Return a text that changes with the photos and settings of a capture."""
        return mark_of(*photos_of(capture), *capture.glob("*.toml"), *clips_of(capture))
