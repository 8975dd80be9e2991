"""The command `batch`: many captures, one page of results."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from capture.errors import CaptureError
from shadowgraph.options import Flag, Given

if TYPE_CHECKING:
    from reconstruct.run.batch import Outcome


@dataclass(frozen=True)
class Batch:
    """Run many captures, each on its own, and write one page of results. The same command again continues it."""

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="FOLDER")]
    """Captures, or folders whose sub-folders are captures."""
    out: Path
    """Folder for the results: a run for each capture, index.html, batch.json."""
    jobs: int = 1
    """Captures at a time on this machine; each takes its share of the cores, and memory as `doctor` says."""
    ray: Given[str] = None
    """Run on a Ray cluster instead, whose machines see the same folders: auto, HOST:PORT, ray://HOST:PORT, or local."""
    threads: Given[int] = None
    """Cores for each capture; all of this machine over --jobs unless given."""
    preset: Literal["draft", "standard", "fine", "paper"] = "standard"
    """As for `run`."""
    board: Given[str] = None
    """The printed board of all captures, as for `run`, where they do not say it themselves."""
    seed: int = 0
    """As for `run`."""
    debug: Flag = False
    """Show the traceback of an error."""


def do_batch(command: Batch, say: Callable[[str], object]) -> bool:
    """Run every capture that is not done yet. Return whether none failed.

    Raises:
        CaptureError: no capture, one given twice, or settings that make no sense.
    """
    from reconstruct.run.batch import find_captures, locally, make_tasks, on_ray, run_batch
    from viewer.report.batch_page import write_batch_page, write_thumbnail

    if command.jobs < 1 or (command.threads or 1) < 1:
        raise CaptureError(f"--jobs {command.jobs}, --threads {command.threads}: at least 1 was needed.")
    board = ("--board", command.board) if command.board else ()
    options = ("--preset", command.preset, "--seed", str(command.seed), *board)
    tasks = make_tasks(find_captures(command.folders, command.out), command.out, options, command.jobs, command.threads)
    said: set[str] = set()

    def show_outcomes(outcomes: Mapping[str, "Outcome"]) -> None:
        for name in [name for name in outcomes if name not in said]:
            one = outcomes[name]
            if one.exit_code == 0:
                write_thumbnail(command.out / name)
            words = f"failed: {one.sentence}" if one.exit_code else f"done in {one.seconds:.0f} s"
            said.add(name)
            say(f"{len(said)} of {len(tasks)}, {name}: {words}")
        write_batch_page(command.out, tasks, outcomes)

    engine = partial(on_ray, address=command.ray) if command.ray else partial(locally, jobs=command.jobs)
    outcomes = run_batch(tasks, engine, show_outcomes)
    say(f"Results in {command.out / 'index.html'}")
    return all(one.exit_code == 0 for one in outcomes.values())
