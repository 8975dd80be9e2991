"""The commands that read a run folder, as functions of it: what fuzz_runs.py has damaged folders read by."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import sheet  # noqa: F401  where the packages are

# isort: split
import numpy as np

import shadowgraph
import shadowgraph.run_result
import viewer.page.page
import viewer.report.report
import viewer.stage.page
from capture.intake.parts import Parts
from reconstruct.export.export import ExportOptions, export
from reconstruct.run.queue import Queue
from viewer.page.guard import GuardedServer
from viewer.stage.page import page_of, stage_pack
from viewer.studio.checking import Checks
from viewer.studio.folder import StudioFolder
from viewer.studio.helper import Helper
from viewer.studio.library import Library

SMALL = ExportOptions(width=32, frames=2, texture=64, faces=2000)
ANY_PORT = 0


def told(words: list[str]) -> Callable[[Path], int]:
    """A command line; {run} and {out} stand for folders."""

    def run_it(run: Path) -> int:
        out = run.parent / "out"
        out.mkdir(exist_ok=True)
        named = {"run": run, "out": out, "reference": run.parent.parent / "reference"}
        return shadowgraph.main([word.format(**named) for word in words])

    return run_it


def exported(name: str) -> Callable[[Path], int]:
    """An export of a small size, as `export` and the page make it."""

    def run_it(run: Path) -> int:
        export(run, name, None, SMALL)
        return 0

    return run_it


def visited(run: Path) -> int:
    """The page, with every photo shown."""
    server = GuardedServer("127.0.0.1", ANY_PORT)
    page = viewer.page.page.Page(run, server)
    for _ in range(3):
        page.refresh()
    for index in range(min(8, len(page._lights))):
        page.choose_photo(index)
    shown = [page.controls._status.content, *(str(getattr(h, "content", "")) for h in _handles(server))]
    server.stop()
    if any("<script>alert" in text or "<img src=x" in text for text in shown):
        raise RuntimeError("text of the folder became markup of the page")
    print(page.problem, file=sys.stderr)
    return 0


def _handles(server: object) -> list[object]:
    return list(getattr(getattr(server, "gui", None), "_gui_input_handle_from_uuid", {}).values())


def looked_at(run: Path) -> int:
    """The run as an object of Python."""
    result = shadowgraph.run_result.RunResult(run)
    assert "<script>alert" not in result._repr_html_()
    for value in (result.depth, result.normals):
        assert np.isnan(value).sum() == 0
    return 0


def listed(run: Path) -> int:
    """The run among those of a studio's folder, as its page asks for them."""
    folder = StudioFolder(run.parent)
    queue = Queue(run.parent / "out.json")
    parts, helper = Parts(folder.kept / "parts", folder.root), Helper(folder.kept / "looks.txt")  # which is not started
    library = Library(folder, queue, parts, Checks(folder.kept / "checks", helper, ()))
    text = json.dumps(library.cards(), allow_nan=False)
    assert text.encode()
    return 0


def staged(run: Path) -> int:
    """The page that is lit by the pointer, with all its parts."""
    pack = stage_pack(run)
    assert all(isinstance(pack.read(name), bytes) for name in pack.names)
    page_of(run, stage_pack(run))
    return 0


FRESH = {
    "report": ["report", "{run}"],
    "report --bundle": ["report", "{run}", "--bundle", "{out}/b.zip", "--with-pictures"],
    "evaluate": ["evaluate", "{run}", "--reference", "{reference}"],
    "relight --light": ["relight", "{run}", "--light", "100,-200,400", "--out", "{out}/a.png", "--width", "32"],
    "relight --orbit": ["relight", "{run}", "--orbit", "2", "--out", "{out}/a.gif", "--width", "32"],
    "check --out": ["check", "{reference}", "--out", "{run}"],
    "run --out": ["run", "{reference}", "--out", "{run}", "--viewer", "off"],
    "export ply": ["export", "{run}", "{out}/a.ply"],
    "export still": ["export", "{run}", "{out}/a.png", "--format", "still", "--width", "32"],
}
COMMANDS: dict[str, Callable[[Path], int]] = {
    **{name: told(words) for name, words in FRESH.items() if not name.startswith("export")},
    "view": visited,
    "RunResult": looked_at,
    "studio": listed,
    "stage": staged,
    **{
        f"export {name}": exported(name)
        for name in ("glb", "3mf", "ply", "obj", "turntable", "still", "html", "normal-png", "depth-exr", "nerf", "rti")
    },
}
