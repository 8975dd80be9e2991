"""Library: the cards of the studio's first page, and all that is known of one capture or run.

The example: photos of a figure that come with the program, and their result, for who has no photos yet.
"""

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import CaptureError, UserError
from capture.files.regular import is_regular
from capture.files.title import title_of
from capture.intake.parts import Parts
from capture.session.session import load_settings
from capture.session.sorting import clips_of, folder_role, photos_of
from reconstruct.run.queue import FAILED, FINISHED, RUNNING, STOPPED, WAITING, Job, Queue
from reconstruct.run_folder.folder import LOG
from reconstruct.stored_run.documents import CHECK, REPORT, read_check, read_manifest, read_report
from reconstruct.stored_run.stage_pack import FORMAT, opened_pack
from viewer.display.run_follower import RunFollower, Status, size_text, status
from viewer.stage.page import page_html
from viewer.studio.checking import Checks
from viewer.studio.folder import StudioFolder, mark_of, without_folder

OF_CAPTURE = re.compile(r"(-(draft|standard|fine|paper)(-\d+)?)?")  # what a run's name has behind its capture's
MOST_DOCUMENTS = 1000  # of runs, that stay in memory
ARRIVING_S = 4.0  # after the last photo, the capture still counts as arriving

ROLES = {
    "lit": "under the flashlight",
    "board": "of the board",
    "light": "by the flashlight's phone",
    "dark": "without light",
    "side": "from the side",
}
EXAMPLE = "Spot, an example"
EXAMPLE_RESULT = Path(__file__).with_name(f"example-{FORMAT}.zip")  # a stage; .ci/example_result.py makes it
EXAMPLE_PLACE = ("examples", "spot", "session.toml")  # in a checkout, and in share/shadowgraph of an installation


class Library:
    """What the folder holds, in the words of the page. Files that have not changed are not read again."""

    def __init__(self, folder: StudioFolder, queue: Queue, parts: Parts, checks: Checks):
        """Read nothing yet."""
        self.folder, self._queue, self._parts, self._checks = folder, queue, parts, checks
        self._followers: dict[Path, RunFollower] = {}

    def cards(self) -> list[dict[str, Any]]:
        """Return a card for each capture with its runs, and for each run whose capture is not here; newest first."""
        captures, runs = self.folder.captures(), self.folder.runs()
        asked = {job.run: job for job in self._queue.jobs}
        rows = {key: self.run_row(key, path, asked.get(path)) for key, path in runs.items()}
        for path, job in asked.items():  # jobs that have no folder yet, or never got one
            if path not in runs.values() and job.state != FINISHED:
                key = self.folder.key(path)
                rows[key] = self.run_row(key, path, job)
        cards = []
        for key, path in captures.items():
            mine = [name for name in rows if self._belongs(path, self.folder.root / name, asked)]
            own = sorted((rows.pop(name) for name in mine), key=lambda row: -row["date"])
            cards.append(self._card(key, path, own))
        for key, row in rows.items():
            cards.append({"kind": "run", "key": key, "title": row["title"], "date": row["date"], "runs": [row]})
        return sorted(cards, key=lambda card: -card["date"])

    def capture_row(self, key: str) -> dict[str, Any]:
        """Return all that is known of one capture.

        Raises:
            CaptureError: there is none with this key.
        """
        path = self.folder.capture(key)
        card = next(card for card in self.cards() if card["key"] == key)
        coach = self._checks.looks(path)
        looks = {look["name"]: look for look in coach["photos"]}
        photos = []
        for photo in photos_of(path):
            name = photo.relative_to(path).as_posix()
            look = looks.get(name, {})
            of_folder = folder_role(photo, path)
            row = {"name": name, "role": look.get("role") or of_folder, "remarks": look.get("remarks", [])}
            more = {"drop": look.get("drop", False), "looked": name in looks, "by_folder": bool(of_folder)}
            photos.append(row | more)
        refused = [
            {"id": part.id, "name": part.name, "why": without_folder(why, path, "this capture")}
            for part, why in self._parts.complaints(key)
        ]
        check = self._checks.state(path)
        return card | {
            "photos": photos,
            "counts": counts_of(photos, check),
            "clips": [clip.relative_to(path).as_posix() for clip in clips_of(path)],
            "board": _board_of(path),
            "refused": refused[-20:],
            "check": check,
            "coach": {"lights": coach["lights"], "advice": coach["advice"]},
        }

    def run_row(self, key: str, path: Path, job: Job | None) -> dict[str, Any]:
        """Return what a card shows of one run."""
        follower = self._followers.setdefault(path, RunFollower(path))
        changed = _time_of(path / LOG) or (job.asked if job else _time_of(path))
        began = job.began if job is not None and job.state == RUNNING else None  # it may not have taken the folder yet
        is_running, since = began is not None or follower.is_running(), time.time() - max(changed, began or 0.0)
        now = status(follower.log(), is_running, max(0.0, since))
        if began is not None:  # taken up again, its log counts from an earlier start
            now = replace(now, elapsed_s=max(now.elapsed_s, time.time() - began))
        report = _document(path / REPORT, read_report)
        manifest = _document(path / "manifest.json", read_manifest)
        check = _document(path / CHECK, read_check)
        preset = str((manifest.get("config") or {}).get("preset") or (job.preset if job else ""))
        mesh = report.get("mesh") or {}
        state, sentence = _state(job, is_running, now)
        extents = mesh.get("size") if state == FINISHED else None
        if job is not None:
            sentence = without_folder(sentence, Path(job.task.capture), "this capture")
        return {
            "key": key,
            "title": title_of(path, *([Path(job.task.capture)] if job else [])),
            "state": state,
            "sentence": sentence,
            "job": job.id if job else "",
            "progress": asdict(now),
            "preset": preset,
            "verdict": report.get("grade") or check.get("verdict", ""),
            "verdict_sentence": report.get("verdict") or check.get("sentence", ""),
            "size": size_text(np.array(extents, float), str(report.get("unit", "mm"))) if extents else "",
            "scale": str(report.get("scale", "")),
            "guessed": ((mesh.get("evidence") or {}).get("unconstrained") or {}).get("share"),
            "warnings": report.get("warnings", [])[:20],
            "date": changed,
            "has_report": is_regular(path / "report.html"),
            "has_mesh": is_regular(path / "mesh.ply"),
        }

    def _card(self, key: str, path: Path, runs: list[dict[str, Any]]) -> dict[str, Any]:
        photos = photos_of(path)
        newest = max((_time_of(photo) for photo in photos), default=_time_of(path))
        under_way = self._parts.under_way(key)
        check = self._checks.state(path)
        if under_way or (photos and time.time() - newest < ARRIVING_S):
            state = "arriving"
        elif check["is_running"]:
            state = "checking"
        else:
            state = "checked" if check["verdict"] or check["error"] else "new"
        return {
            "kind": "capture",
            "key": key,
            "title": title_of(path),
            "state": state,
            "count": len(photos) + len(clips_of(path)),
            "coming": len(under_way),
            "stalled": len(self._parts.stalled(key)),
            "coming_bytes": sum(part.size for part in under_way),
            "here_bytes": sum(self._parts.offset(part) for part in under_way),
            "verdict": check["verdict"],
            "verdict_sentence": check["sentence"] or check["error"],
            "date": max([newest, *(run["date"] for run in runs)]),
            "runs": runs,
        }

    def _belongs(self, capture: Path, run: Path, asked: dict[Path, Job]) -> bool:
        """Return whether a run is of a capture: as the queue knows, or by the names that studio and command give."""
        job = asked.get(run)
        if job is not None:
            return Path(job.task.capture) == capture
        return run.name.startswith(capture.name) and OF_CAPTURE.fullmatch(run.name[len(capture.name) :]) is not None


@lru_cache(MOST_DOCUMENTS)
def _read(path: Path, read: Callable[[Path], dict[str, Any]], _mark: str) -> dict[str, Any]:
    try:
        return read(path)
    except (OSError, UserError):
        return {}


def _document(path: Path, read: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
    """Return a JSON document of a run, read when it has changed; empty where it is missing or damaged."""
    return _read(path, read, mark_of(path))


def _time_of(path: Path) -> float:
    """Return when a file was changed; 0 where it has just gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _board_of(capture: Path) -> str:
    try:
        return load_settings(capture).board or ""
    except UserError:
        return ""


def _state(job: Job | None, is_running: bool, now: Status) -> tuple[str, str]:
    """Return a run's state and its sentence; what the folder shows counts more than what the queue remembers."""
    if job is not None and job.state == WAITING:
        return WAITING, "Waits for the run before it."
    if (is_running and not now.is_finished) or (job is not None and job.state == RUNNING):
        return RUNNING, ""
    if now.is_finished:
        return FINISHED, ""
    if job is not None and job.state in (FAILED, STOPPED):
        return job.state, job.sentence or "Stopped. It goes on where it stood."
    return STOPPED, f"{now.title}. It was started in a terminal. Started again there, it goes on where it stood."


def counts_of(photos: Sequence[Mapping[str, Any]], check: Mapping[str, Any]) -> dict[str, Any]:
    """Return the counts of a capture, as sentences and numbers.

    Args:
        photos: `role`, `drop` and `looked` of each.
        check: the newest verdict; its numbers count unless photos have changed since.

    Returns:
        `words`, whose numbers add up; `lit`, photos under the flashlight, and `used`, how many of them a run will use;
        `start`, what the button says that starts one; `uses`, the sentence beside it.
    """
    numbers = {} if check.get("is_old") else check.get("numbers", {})
    lit = [photo for photo in photos if photo["role"] == "lit"]
    total = int(numbers.get("photos", len(lit)))
    used = int(numbers.get("photos_used", sum(not photo["drop"] for photo in lit)))
    left_out = total - used + sum(bool(photo["drop"]) for photo in photos if photo["role"] != "lit")
    kept = [photo["role"] for photo in photos if not photo["drop"]]
    counts = {role: kept.count(role) for role in ROLES} | {"lit": used}
    told = [f"{counts[role]} {words}" for role, words in ROLES.items() if counts[role]]
    unseen = sum(not photo["role"] and not photo["looked"] for photo in photos)
    told += [f"{unseen} not looked at yet"] if unseen else []
    told += [f"{left_out} left out"] if left_out else []
    start = "Start" if not left_out else f"Leave {'it' if left_out == 1 else left_out} out and go on"
    uses = f"{used} of {total} {_photos(total)} under the flashlight will be used." if total and not unseen else ""
    words = f"{len(photos)} {_photos(len(photos))}" + (f": {', '.join(told)}" if told else "")
    return {"words": words, "lit": total, "used": used, "start": start, "uses": uses}


def _photos(count: int) -> str:
    return "photo" if count == 1 else "photos"


@cache
def example_photos() -> Path:
    """Return the folder of the example's photos.

    Raises:
        CaptureError: it did not come with this installation.
    """
    checkout = Path(__file__).parents[2].joinpath(*EXAMPLE_PLACE)
    try:
        files = distribution("shadowgraph").files or ()
        installed = [Path(str(file.locate())) for file in files if file.parts[-len(EXAMPLE_PLACE) :] == EXAMPLE_PLACE]
    except PackageNotFoundError:
        installed = []
    for settings in (checkout, *installed):
        if settings.is_file():
            return settings.resolve().parent
    raise CaptureError("The example's photos did not come with this installation: install it with pip once more.")


@cache
def example_page() -> bytes:
    """Return the page of the example's result.

    Raises:
        CaptureError: it is damaged, or of another version of the stage.
    """
    pack = opened_pack(EXAMPLE_RESULT)
    if pack is None:
        raise CaptureError('The result that came with this installation is damaged. "Try the example" makes another.')
    return page_html("Spot", pack).encode()
