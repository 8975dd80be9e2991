"""The stage of a finished run as a page: one file with all its parts, which works without a server or a network.

Its parts are packed in stage.zip, which `shadowgraph run` leaves; a run without one is packed when its page is made.
"""

import html
import json
import re
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import ReconstructionError, UserError
from capture.files.atomic import atomic_file
from capture.files.title import title_of
from reconstruct.export.export import FORMATS, UNIT_WORDS, Contents, ExportOptions, OnProgress
from reconstruct.stored_run.stage_document import EMPTY, read_stage_document
from reconstruct.stored_run.stage_pack import STAGE_PACK, StagePack, addressed, marks_of, read_stage_pack
from reconstruct.stored_run.stored_run import FIELDS, MESH, StoredRun
from viewer.report.document import as_address, hash_of

SCRIPTS = ("vectors", "scene", "state", "gpu", "passes", "renderer")
SCRIPTS += ("pick", "overlay", "notes", "hands", "panel", "main")
SHADERS = ("surface.vert", "surface.frag", "depth.frag", "full.vert", "light.frag", "blur.frag", "show.frag")
SHADERS += ("lines.vert", "lines.frag")
IMPORTED, EXPORTED = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL), re.compile(r"^export ", re.MULTILINE)
FORMATS["html"] = replace(FORMATS["html"], writer="viewer.stage.page:write_page")


def is_finished(run_dir: Path) -> bool:
    """Return whether the run has left what the stage shows."""
    return all((run_dir / name).is_file() for name in (MESH, FIELDS))


def kept_pack(run_dir: Path) -> StagePack | None:
    """Return the packed stage that is kept with the run; None where there is none of its results.

    Raises:
        ReconstructionError: the run is not finished, or cannot be read.
    """
    if not is_finished(run_dir):
        raise ReconstructionError(f"{run_dir} holds no finished run yet: its picture comes with the mesh.")
    try:
        return read_stage_pack(run_dir)
    except OSError as error:
        raise ReconstructionError(f"{run_dir} cannot be read ({error.strerror or error}).") from error


def stage_pack(run_dir: Path) -> StagePack:
    """Return the packed stage of a run, made in memory where the run keeps none.

    Raises:
        UserError: the run is not finished, or a file of it cannot be used.
    """
    return kept_pack(run_dir) or _packed(run_dir, str(marks_of(run_dir)))


@lru_cache(maxsize=1)
def _packed(run_dir: Path, _made_of: str) -> StagePack:
    from viewer.stage.parts import packed_stage  # torch takes seconds to import; a packed stage needs none of it

    return StagePack(packed_stage(StoredRun(run_dir)))


def write_stage(run_dir: Path) -> None:
    """Write the packed stage of a run into its folder, whole or not at all.

    Raises:
        UserError: a file of the run cannot be used.
        OSError: it cannot be written.
    """
    from viewer.stage.parts import packed_stage

    content = packed_stage(StoredRun(run_dir))
    with atomic_file(run_dir / STAGE_PACK) as temporary:
        temporary.write_bytes(content)


def page_of(run_dir: Path, pack: StagePack, saves: str = "", home: str = "") -> str:
    """Return the page of a run, whose packed stage this is, with its title and document; see `page_html`.

    Raises:
        UserError: the document cannot be used.
    """
    return page_html(title_of(run_dir), pack, read_stage_document(run_dir), saves, home, _fault(run_dir))


def _fault(run_dir: Path) -> str:
    """Return the verdict on the result as the report says it; "" where it is good or there is none."""
    try:
        report = StoredRun(run_dir).report
    except UserError:  # a run without a report can be looked at, too
        return ""
    return "" if report.get("grade") == "good" else str(report.get("verdict") or "")


def page_html(
    name: str, pack: StagePack, document: dict[str, Any] | None = None, saves: str = "", home: str = "", fault: str = ""
) -> str:
    """Return the page's HTML.

    Args:
        document: notes and views, None: none yet.
        saves: how its document can be kept with the run: "socket" (WebSocket stage.json of its server), "frame" (a
            message to the page around it, as this one has no origin); "": it cannot.
        home: address of the page that led here, for a link back; "": none.
        fault: the verdict on a result that is not good; in a "frame" the page around it says this, title and size.
    """
    kinds = {part: "image/jpeg" if part.endswith(".jpg") else "application/octet-stream" for part in pack.names}
    facts = addressed(pack.facts, {part: as_address(pack.read(part), kind) for part, kind in kinds.items()})
    values = {
        "title": html.escape(name),
        "size": html.escape(str(facts["size"])),
        "header": "hidden" if saves == "frame" else "",
        "fault": html.escape(fault),
        "policy": page_policy("'self'" if saves == "socket" else "'none'"),
        "style": _asset("stage.css"),
        "first": html.escape(facts["addresses"]["first"]),
        "scene": _json({**facts, "name": name}),
        "document": _json(document or EMPTY),
        "served": _json({"saves": saves, "home": home}),
        "shaders": "\n".join(
            f'<script type="text/plain" id="{shader}">{_asset(f"{shader}.glsl")}</script>' for shader in SHADERS
        ).replace("//#photo", _asset("photo.glsl")),
        "script": script_text(),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: values[found.group(1)], _asset("stage.html"))


def page_policy(connects: str = "'none'") -> str:
    """Return the page's content security policy: its own script and style, and nothing from elsewhere.

    Args:
        connects: whom the script may ask.
    """
    return (
        f"default-src 'none'; script-src {hash_of(script_text())}; style-src {hash_of(_asset('stage.css'))}; "
        f"img-src data: blob:; connect-src {connects}; base-uri 'none'; form-action 'none'"
    )


def script_text() -> str:
    """Return the page's modules as one: in their order, without `import` and `export`; their names are all different.

    They are ES modules of a folder, which a browser loads from no file: a page from the disk may import nothing.
    """
    parts = [EXPORTED.sub("", IMPORTED.sub("", _asset(f"{name}.js"))) for name in SCRIPTS]
    return "\n" + "\n".join(parts)


def write_page(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write the page of a run: one file of a few megabytes."""
    on_progress(0, 2, "packing the scene")
    pack = stage_pack(run.run_dir)
    on_progress(1, 2, "writing the page")
    path.write_text(page_of(run.run_dir, pack), encoding="utf-8")
    facts = pack.facts
    x, y, z = (float(e) for e in np.ptp(np.asarray(facts["bounds"]), axis=0))
    note = f"{len(facts['lights'])} lights, {UNIT_WORDS[run.unit]}; open it in any browser"
    return Contents(facts["parts"]["corners"]["count"] // 3, (x, y, z), run.unit, note=note)


def _json(value: Any) -> str:
    """Return JSON that ends no script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _asset(name: str) -> str:
    return (resources.files("viewer.stage") / "assets" / name).read_text(encoding="utf-8")
