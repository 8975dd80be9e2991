"""Studio: everything that the pages can ask for, put together and kept going."""

import contextlib
import shutil
import threading
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calibration.board.board import parse_board
from capture.decode.formats import read_size
from capture.errors import CaptureError, UserError
from capture.files.regular import is_regular
from capture.files.title import keep_title, title_of
from capture.intake.arrivals import KEEP_FREE, refuse_full_disk
from capture.intake.parts import Parts
from capture.session.sorting import clips_of, photos_of
from capture.session.write_settings import set_entry, set_role
from reconstruct.run.batch import PROGRAM, Task
from reconstruct.run.queue import RUNNING, Job, Queue
from reconstruct.stored_run.stage_pack import StagePack
from viewer.stage.page import kept_pack
from viewer.studio.checking import Checks
from viewer.studio.folder import StudioFolder, Trash, mark_of
from viewer.studio.helper import Helper, LivePages, Newest
from viewer.studio.library import EXAMPLE, Library, example_photos
from viewer.studio.saving import Saving

TICK_S = 0.5
LEAVING_S = 5.0  # that a step may take to its end when the studio closes; files that are cut off go on the next time
PICTURE_PX = 320
USUAL = (36, 4032, 3024)  # photos, and their px, where none are there yet: a phone's
PRESETS = ("draft", "standard", "fine")
REPORT_PAGE = "report.html"
ACTIONS = ("stop", "first", "again")  # of the queue


class Studio:
    """One folder's studio. Its methods are what the routes call; any of them may raise a UserError."""

    def __init__(self, folder: StudioFolder, program: tuple[str, ...] = PROGRAM):
        """Read the queue and what was on its way; start nothing yet.

        Raises:
            CaptureError: the record of the queue is damaged.
        """
        self.folder = folder
        self.queue = Queue(folder.kept / "queue.json", program, self._refuse)
        self.parts = Parts(folder.kept / "uploads", folder.root)
        self.looks = Helper(folder.kept / "looks.txt")
        self.thumbnails = Helper(folder.kept / "thumbnails.txt")
        self.pictures = Helper(folder.kept / "pictures.txt")
        self.checks = Checks(folder.kept / "checks", self.looks, program)
        self.library = Library(folder, self.queue, self.parts, self.checks)
        self.trash = Trash(folder.root)
        self.pages = LivePages(folder)
        self.saving = Saving(folder)
        self._lock, self._ended = threading.RLock(), threading.Event()
        self._presets = Newest(self.pictures, "presets")
        self._faults: dict[str, str] = {}  # the newest of each step
        arriving = (contextlib.nullcontext(), self.parts.try_again)  # an archive takes minutes and holds nothing up
        working = (self._lock, self.queue.tick, self.checks.tick)
        self._threads = [
            threading.Thread(target=self._keep_going, args=steps, daemon=True) for steps in (arriving, working)
        ]

    def start(self) -> None:
        """Put files into their captures that were whole when the studio was killed; run the queue."""
        self.saving.clear()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the helpers and a check; runs go on."""
        self._ended.set()
        for thread in self._threads:
            thread.join(LEAVING_S)
        for part in (self.checks, self.pages, self.looks, self.thumbnails, self.pictures, self.saving):
            part.close()

    # --- what is there -----------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return what the first page shows."""
        with self._lock:
            cards = self.library.cards()
            rows = {row["key"]: row for card in cards for row in card["runs"]}
            jobs = [job for job in self.queue.jobs if job.is_open]
            deleted = [asdict(one) for one in self.trash.list()]
            return {
                "folder": str(self.folder.root),
                "free": shutil.disk_usage(self.folder.root).free,
                "keep_free": KEEP_FREE,
                "cards": cards,
                "queue": [self._queued(job, rows.get(self.folder.key(job.run))) for job in jobs],
                "trash": deleted,
            }

    def capture(self, key: str) -> dict[str, Any]:
        """Return what the page of one capture shows."""
        with self._lock:
            return self.library.capture_row(key)

    def presets(self, key: str) -> dict[str, Any]:
        """Return time and memory of each preset for a capture on this machine; empty until they are measured."""
        photos = photos_of(self.folder.capture(key))
        try:
            size = read_size(photos[-1]) if photos else USUAL[1:]
        except UserError:
            size = USUAL[1:]
        count = max(len(photos), 12) if photos else USUAL[0]
        asked = {"photos": count, "width": size[0], "height": size[1]}
        return {"presets": self._presets.about(tuple(asked.values()), "measured", **asked) or []}

    def _queued(self, job: Job, row: dict[str, Any] | None) -> dict[str, Any]:
        """Return what the queue on the first page shows of a job: its cost, and the seconds left."""
        found: list[dict[str, Any]] = []
        with contextlib.suppress(CaptureError):  # the capture may have gone
            found = self.presets(self.folder.key(Path(job.task.capture)))["presets"]
        cost = next((one for one in found if one["name"] == job.preset), {})
        key, left = self.folder.key(job.run), cost.get("seconds")
        if row is not None and job.state == RUNNING:
            now = row["progress"]
            left = now["left_s"] if now["left_s"] is not None else left and max(0.0, left - now["elapsed_s"])
        title = row["title"] if row is not None else title_of(job.run, Path(job.task.capture))
        known = {"id": job.id, "run": key, "title": title, "state": job.state, "preset": job.preset}
        return known | {"left_s": left, "bytes": cost.get("bytes")}

    def picture(self, key: str, photo: str) -> "Path | Future[Any]":
        """Return the small picture of a photo, or the task that makes it.

        Raises:
            CaptureError: the capture has no such photo.
        """
        capture = self.folder.capture(key)
        photos = photos_of(capture)
        path = photos[-1] if photo == "" and photos else _named(capture, photos, photo)
        out = self.folder.kept / "pictures" / f"{mark_of(path)}.jpg"
        if is_regular(out):
            return out
        return self.thumbnails.ask("thumbnail", photo=str(path), out=str(out), long_side=PICTURE_PX)

    def run_picture(self, key: str) -> "bytes | Future[Any]":
        """Return the small picture of a finished run, which its stage begins with, or the task that packs the stage."""
        pack = self.stage(key)
        return pack if isinstance(pack, Future) else pack.read(pack.facts["addresses"]["first"])

    def stage(self, key: str) -> "StagePack | Future[Any]":
        """Return the packed stage of a finished run, or the task that packs it where the run has not done so."""
        run = self.folder.run(key)
        return kept_pack(run) or self.pictures.ask("pack", run=str(run), is_urgent=True)

    def for_phone(self, key: str) -> dict[str, Any]:
        """Return what a phone that was let in may know of the capture that it sends to."""
        row = self.capture(key)
        bad = [{"name": one["name"], "remarks": one["remarks"]} for one in row["photos"] if one["drop"]]
        known = {name: row[name] for name in ("title", "count", "counts", "coming", "refused", "check", "coach")}
        return known | {"bad": bad}

    # --- what is done ------------------------------------------------------------------------------------------------

    def new_capture(self, title: str) -> str:
        """Make an empty capture and return its key."""
        with self._lock:
            return self.folder.key(self.folder.new_capture(title))

    def try_example(self) -> str:
        """Make a capture of the example's photos, put a first look at it into the queue, and return the run's key."""
        photos = example_photos()
        with self._lock:
            capture = self.folder.new_capture(EXAMPLE)
            shutil.copytree(photos, capture, dirs_exist_ok=True)
            return self.start_run(self.folder.key(capture), PRESETS[0])

    def rename(self, key: str, title: str) -> None:
        """Give a capture, and its runs that have the same title, or a run another one; folders keep their names."""
        with self._lock:
            path = self._find(key)
            before = title_of(path)
            mine = next((card["runs"] for card in self.library.cards() if card["key"] == key), [])
            runs = [self.folder.root / row["key"] for row in mine if row["title"] == before]
            for place in (path, *filter(Path.is_dir, runs)):
                keep_title(place, title)
                if is_regular(place / REPORT_PAGE):
                    self.pictures.ask("report", run=str(place))

    def delete(self, key: str) -> None:
        """Move a capture or run into the trash."""
        with self._lock:
            path = self._find(key)
            if any(job.is_open and path in (job.run, Path(job.task.capture)) for job in self.queue.jobs):
                raise CaptureError(f"{title_of(path)} runs or waits in the queue; stop that first.")
            if key in self.folder.runs() and self.library.run_row(key, path, None)["state"] == RUNNING:
                raise CaptureError(f"{title_of(path)} is running in another window or terminal; stop it there first.")
            self.checks.forget(path)
            for part in self.parts.under_way(key):
                self.parts.drop(part)
            self.trash.put(path, title_of(path))
            self.queue.forget(path)

    def empty_trash(self) -> int:
        """Delete what is in the trash, and files that were made for download; return the bytes that the trash freed."""
        self.saving.clear()
        return self.trash.empty()

    def go_on_without(self, key: str) -> None:
        """Forget the files of a capture that stopped in the middle; who comes back sends them from the beginning."""
        for part in self.parts.stalled(self.folder.key(self.folder.capture(key))):
            self.parts.drop(part)

    def dismiss(self, key: str, part: str) -> None:
        """Forget a file that was sent to a capture and not taken, or waits for room; what of it has arrived stays."""
        if all(one.id != part for one, _ in self.parts.complaints(key)):
            raise CaptureError("This file is not in the list any more.")
        self.parts.drop(self.parts.find(part))

    def delete_photo(self, key: str, photo: str) -> None:
        """Move one photo or clip of a capture into the trash."""
        capture = self.folder.capture(key)
        file = _named(capture, (*photos_of(capture), *clips_of(capture)), photo)
        self.trash.put(file, f"{photo} of {title_of(capture)}")

    def set_board(self, key: str, spec: str) -> None:
        """Say which board the photos show."""
        set_entry(self.folder.capture(key), "board", parse_board(spec).spec() if spec else None)

    def set_role(self, key: str, photo: str, role: str) -> None:
        """Say what a photo is."""
        capture = self.folder.capture(key)
        _named(capture, photos_of(capture), photo)
        set_role(capture, photo, role)

    def start_run(self, key: str, preset: str) -> str:
        """Put a run of a capture into the queue and return its key."""
        if preset not in PRESETS:
            raise CaptureError(f"{preset!r:.40} is no preset; {', '.join(PRESETS)} are known.")
        with self._lock:
            capture = self.folder.capture(key)
            if self.parts.under_way(key):
                raise CaptureError("Photos are still on their way; wait until they are here.")
            run = self.folder.new_run(capture, preset, {job.task.name for job in self.queue.jobs})
            task = Task(run.name, str(capture), str(run.parent), ("--preset", preset))
            self.queue.add(task)
            return self.folder.key(run)

    def change_queue(self, job: str, action: str) -> None:
        """Stop a job, move it to the front, or take it up again."""
        if action not in ACTIONS:
            raise CaptureError(f"{action!r:.40} is no action; {', '.join(ACTIONS)} are known.")
        getattr(self.queue, action)(job)

    # --- inside ------------------------------------------------------------------------------------------------------

    def _find(self, key: str) -> Path:
        return self.folder.run(key) if key in self.folder.runs() else self.folder.capture(key)

    def _refuse(self, task: Task) -> None:
        refuse_full_disk(0, Path(task.out) if Path(task.out).is_dir() else self.folder.root)

    def _keep_going(self, lock: AbstractContextManager[Any], *steps: Callable[[], None]) -> None:
        """Take steps again and again under a lock. What one raises, whichever file it is about, ends nothing else."""
        while not self._ended.wait(TICK_S):
            for step in steps:
                try:
                    with lock:
                        step()
                except Exception as error:  # noqa: BLE001  strangers' files: the next tick tries again
                    self._note_fault(step.__name__, error)

    def _note_fault(self, step: str, error: Exception) -> None:
        """Keep the newest fault of a step in a file, for a bug report."""
        text = "".join(traceback.format_exception(error))
        if self._faults.get(step) != text:
            self._faults[step] = text
            with contextlib.suppress(OSError):  # the disk may be full
                (self.folder.kept / f"fault_{step.strip('_')}.txt").write_text(text, "utf-8", "replace")


def _named(capture: Path, files: Iterable[Path], name: str) -> Path:
    """Return one of these files of a capture by its path relative to it.

    Raises:
        CaptureError: there is none of this name.
    """
    found = next((file for file in files if file.relative_to(capture).as_posix() == name), None)
    if found is None:
        raise CaptureError("This photo is gone.")
    return found
