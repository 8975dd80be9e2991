"""A run folder: all results of a run, written so that a kill at any moment loses nothing that was finished."""

import hashlib
import json
import shutil
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from capture.errors import Remedy, UserError
from capture.files.atomic import TEMPORARY, atomic_file, write_json
from capture.files.names import stored_file
from capture.files.regular import read_regular
from reconstruct.run_folder.forecast import Cost, PeakMemory, cpu_seconds
from reconstruct.run_folder.lock import release_lock, take_lock
from reconstruct.run_folder.requests import withdraw_all
from reconstruct.stored_run.documents import MANIFEST, MANIFEST_FORMAT, log_lines, read_manifest

LOG = "log.jsonl"
LARGEST_LOG = 256 << 20  # bytes; a run of a day writes a hundredth of it
KEPT = "kept_photos"  # folder of reduced photos, while the run needs them
PLAN = "memory.json"  # photos and pixels that the run uses so that it fits into memory
MOST_PARTS = 5  # of a photo's path in a capture: its folder, object pose, view, role, name
HASH_BLOCK = 1 << 20  # bytes read at once while hashing: large enough that Python's loop does not show


@dataclass(frozen=True)
class Progress:
    """One line of log.jsonl: where the run is. Times cover all invocations of the same run, pauses excluded."""

    t: float  # s of work since the run began
    cpu_s: float  # CPU seconds (user + system, finished children included) since the run began
    stage: str
    done: int | float = 0
    total: int | float = 0  # 0 = unknown
    eta_s: float | None = None  # until the end of this stage
    message: str = ""
    numbers: dict[str, float] = field(default_factory=dict)


def content_hash(paths: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256 of each file, by "folder/name", so that a moved capture keeps its hashes.

    Where two have one name, by "folder/folder/name", and so on.

    Frames of a clip have the clip's hash.
    """
    digests: dict[Path, str] = {}
    for path in {stored_file(path): None for path in paths}:
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while block := file.read(HASH_BLOCK):
                digest.update(block)
        digests[path] = digest.hexdigest()
    names = {path: "/".join(path.parts[-2:]) for path in paths}
    for parts in range(3, MOST_PARTS + 1):  # photos of several views may have one name
        counts = Counter(names.values())
        names = {path: "/".join(path.parts[-parts:]) if counts[name] > 1 else name for path, name in names.items()}
    return {name: digests[stored_file(path)] for path, name in names.items()}


def read_log(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a log.jsonl, also if it is being written or was cut by a kill; [] if there is none.

    Raises:
        OSError: as `open_regular`.
    """
    return log_lines(read_regular(path, LARGEST_LOG)) if path.exists() else []


class RunFolder:
    """One run's folder, held by one process at a time.

    Use as a context manager: it takes the lock, reads which stages an earlier invocation finished, and releases the
    lock at the end. If the block raises before any stage has finished, everything that this process wrote is removed.

    A step done is a line of the log, and goes to `listener`. What is being done between two steps goes to
    `on_activity` alone: whoever reads or resumes a run never sees it.
    """

    def __init__(
        self,
        path: Path,
        listener: Callable[[Progress], None] | None = None,
        on_activity: Callable[[str], None] | None = None,
    ):
        self.path = Path(path)
        self.costs: dict[str, Cost] = {}
        self.forgotten: frozenset[str] = frozenset()
        self._listener, self._on_activity = listener, on_activity
        self._manifest: dict[str, Any] = {}
        self._made_with: dict[str, Any] = {}
        self._before: set[str] | None = None  # names that existed already; None: the folder did not exist
        self._stage = ""
        self.is_left_open = False  # True: the next invocation continues the current stage, whose files are not final
        self._stage_start, self._stage_first = 0.0, 0.0  # when it began (or was resumed), and at which step
        self._t0, self._cpu0 = time.monotonic(), cpu_seconds()
        self.idle_s = 0.0  # seconds that passed in pauses; they are not counted as the run's time
        self._counts = 0, 0  # of the last line: done, total

    def __enter__(self) -> "RunFolder":
        if self.path.exists() and not self.path.is_dir():
            raise UserError(f"{self.path} is a file, a folder was needed for the results.", Remedy.OTHER_FOLDER)
        try:
            self._before = {p.name for p in self.path.iterdir()} if self.path.exists() else None
            self.path.mkdir(parents=True, exist_ok=True)
            take_lock(self.path)
        except OSError as error:
            raise UserError(
                f"the folder for the results, {self.path}, cannot be made or written to ({error.strerror}).",
                "check permissions and free space",
                Remedy.OTHER_FOLDER,
            ) from error
        try:
            self._read_what_is_there()
        except BaseException:
            release_lock(self.path)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if value is not None and self._stage:  # a run refused before its first stage leaves an existing log unchanged
            self._log_end(value)
        release_lock(self.path)
        if kind is not None and not self._manifest.get("finished"):
            self._remove_what_was_added()

    # --- writing -----------------------------------------------------------------------------------------------------

    def file(self, name: str) -> Path:
        """Return the path of a result in this folder."""
        return self.path / name

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON result atomically."""
        write_json(self.path / name, value)

    def discard(self, *names: str) -> None:
        """Remove files and folders that are no longer needed; a * stands for any letters."""
        for path in list(self.path.iterdir()):
            if any(path.match(name) for name in names):
                _remove(path)

    # --- resuming ----------------------------------------------------------------------------------------------------

    def claim(
        self,
        inputs: Mapping[str, str],
        config: Mapping[str, Any],
        force: bool = False,
        made_with: Mapping[str, Any] | None = None,
    ) -> None:
        """Record the inputs and config of this run; an unfinished or finished run with the same ones is continued.

        Args:
            inputs: content hash by file name.
            config: settings that change the result, JSON values only; settings not stated before are added.
            force: start again, whatever this folder holds.
            made_with: versions and similar facts for a reader; stages that finish from here on are recorded with them.

        Raises:
            UserError: the folder holds a run of other inputs or settings, and force is off. The difference is named.
        """
        now = {"inputs": dict(inputs), "config": json.loads(json.dumps(dict(config)))}
        if self._manifest:
            differences = _differences(self._manifest, now)
            if differences and not force:
                raise UserError(
                    f"{self.path} holds a run with other settings ({'; '.join(differences)}), the same were needed to "
                    "continue it.",
                    Remedy.START_AGAIN,
                    Remedy.OTHER_FOLDER,
                )
            if differences or force:
                self._start_again()
        now["config"] = self._manifest.get("config", {}) | now["config"]
        before = {"costs": {}, "finished": [], "made_with": {}} | self._manifest
        kept = {name: before[name] for name in ("costs", "finished", "made_with")}
        self._manifest, self._made_with = {"format": MANIFEST_FORMAT, **now, **kept}, dict(made_with or {})
        self.write_json(MANIFEST, self._manifest)

    def forget(self, *stages: str) -> None:
        """Mark these stages to run again from the beginning."""
        for stage in stages:
            self.costs.pop(stage, None)
            if self.is_finished(stage):
                self._manifest["finished"].remove(stage)
        self.discard("config.json", PLAN, "checkpoint*")

    def reopen(self, *stages: str) -> None:
        """Mark these stages to run again: their files are valid results, but not final."""
        for stage in stages:
            if self.is_finished(stage):
                self._manifest["finished"].remove(stage)
        self.write_json(MANIFEST, self._manifest)

    def is_finished(self, stage: str) -> bool:
        """Return True if an earlier invocation of the same run completed this stage."""
        return stage in self._manifest.get("finished", [])

    # --- stages ------------------------------------------------------------------------------------------------------

    @contextmanager
    def stage(self, name: str, message: str = "", leaves_files: bool = True) -> Iterator[None]:
        """Measure a stage's seconds, CPU seconds and peak memory; mark it finished when the block ends well.

        Args:
            leaves_files: off for a stage that has to be done again by every invocation: it is never finished.
        """
        earlier = self._logged_cost(name)
        start, cpu_start = self._now(), cpu_seconds()
        self._stage, self._stage_start, self._stage_first, self.is_left_open = name, start, 0.0, False
        with PeakMemory() as memory:
            self.progress(message=message or name)
            yield
        self.costs[name] = Cost(
            round(earlier.seconds + self._now() - start, 3),
            round(earlier.cpu_seconds + cpu_seconds() - cpu_start, 3),
            max(earlier.peak_memory_bytes, memory.peak),
        )
        self.progress(name, done=1, total=1, message="done")
        if self._manifest:
            self._manifest["costs"] = {k: asdict(v) for k, v in self.costs.items()}
            if leaves_files and not self.is_left_open and not self.is_finished(name):
                self._manifest["finished"].append(name)
                self._manifest["made_with"][name] = self._made_with
            self.write_json(MANIFEST, self._manifest)

    def progress(
        self,
        stage: str | None = None,
        done: int | float = 0,
        total: int | float = 0,
        message: str = "",
        numbers: Mapping[str, int | float] | None = None,
        preview_mesh: Any = None,
    ) -> None:
        """Append one line to log.jsonl and notify the listener.

        Args:
            stage: a part of the current stage from here on, with its own steps; None = as before.
            done: steps of `total` (0 = unknown) finished in this stage; the ETA assumes equal steps.
            numbers: losses and the like, plotted by the viewer.
            preview_mesh: a trimesh.Trimesh, written to preview.ply.
        """
        now, self._counts = self._now(), (done, total)
        if stage and stage != self._stage:
            self._stage, self._stage_start, self._stage_first = stage, now, done
        steps = done - self._stage_first
        eta = (now - self._stage_start) * (total - done) / steps if steps > 0 and done <= total else None
        line = Progress(
            round(now - self._t0, 3),
            round(cpu_seconds() - self._cpu0, 3),
            self._stage,
            done,
            total,
            None if eta is None else round(eta, 1),
            message,
            {k: float(v) for k, v in (numbers or {}).items()},
        )
        if preview_mesh is not None:
            with atomic_file(self.file("preview.ply")) as path:
                preview_mesh.export(path)
        with (self.path / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(line)) + "\n")
        if self._listener:
            self._listener(line)

    def remark(self, message: str) -> None:
        """Append a log line with this message, at the progress of the last line."""
        self.progress(None, *self._counts, message=message)

    def activity(self, sentence: str) -> None:
        """Say what the run does until its next step; an empty sentence: it waits."""
        if self._on_activity:
            self._on_activity(sentence)

    # --- inside ------------------------------------------------------------------------------------------------------

    def _now(self) -> float:
        """Return the time (s) of a clock that stops during pauses."""
        return time.monotonic() - self.idle_s

    def _log_end(self, error: BaseException) -> None:
        """Log the last line of a run that ends by an error: kind and message, and for a program fault its location."""
        text = f"stopped: {type(error).__name__}: {error}".removesuffix(": ")
        if isinstance(error, Exception) and not isinstance(error, UserError | OSError):
            text += "\n" + "".join(traceback.format_tb(error.__traceback__))
        with suppress(OSError):  # a full disk may be what ended it
            self.progress(message=text)

    def _read_what_is_there(self) -> None:
        for left_over in self.path.glob(f".*{TEMPORARY}*"):  # by a killed run
            left_over.unlink()
        self.forgotten = withdraw_all(self.path)  # requests of an earlier invocation: a pause must not stop this one
        manifest = self.path / MANIFEST
        self._manifest = read_manifest(manifest) if manifest.exists() else {}
        self.costs = {name: Cost(**cost) for name, cost in self._manifest.get("costs", {}).items()}
        self._continue_log()

    def _continue_log(self) -> None:
        """Continue the counts of an earlier invocation's last log line; remove a half-written last line."""
        path = self.path / LOG
        if not path.exists():
            return
        data = read_regular(path, LARGEST_LOG)
        if data and not data.endswith(b"\n"):
            path.write_bytes(data[: data.rfind(b"\n") + 1])
        lines = read_log(path)
        if lines:
            self._t0 -= float(lines[-1].get("t", 0.0))
            self._cpu0 -= float(lines[-1].get("cpu_s", 0.0))

    def _logged_cost(self, stage: str) -> Cost:
        """Return the cost of this stage in earlier invocations: its finished cost, else the span of its log lines."""
        if stage in self.costs:
            return self.costs[stage]
        lines = [line for line in read_log(self.path / LOG) if line.get("stage", "").split("/")[0] == stage]
        if not lines:
            return Cost()
        return Cost(lines[-1]["t"] - lines[0]["t"], lines[-1]["cpu_s"] - lines[0]["cpu_s"])

    def _start_again(self) -> None:
        """Forget the earlier run: its log, checkpoints and finished stages. Its results are overwritten later."""
        self.discard(LOG, "preview.ply", "config.json", KEPT, PLAN, "checkpoint*")
        self._manifest, self.costs = {}, {}
        self._t0, self._cpu0 = self._now(), cpu_seconds()

    def _remove_what_was_added(self) -> None:
        for path in list(self.path.iterdir()):
            if self._before is None or path.name not in self._before:
                _remove(path)
        if self._before is None:
            self.path.rmdir()


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Describe in words the changes between two manifests."""
    config = [
        f"{key} was {before['config'][key]!r}, now {now['config'][key]!r}"
        for key in sorted(before["config"].keys() & now["config"].keys())
        if before["config"][key] != now["config"][key]
    ]
    files = sorted(k for k in {*before["inputs"], *now["inputs"]} if before["inputs"].get(k) != now["inputs"].get(k))
    shown = ", ".join(files[:3]) + (f" and {len(files) - 3} more" if len(files) > 3 else "")
    return config + ([f"changed, added or removed: {shown}"] if files else [])


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
