"""The stage as a page: in one file with all its parts, or as a page that asks for its parts beside it."""

import html
import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from capture.files.title import title_of
from reconstruct.export.export import UNIT_WORDS, Contents, ExportOptions, OnProgress
from reconstruct.export.formats import FORMATS
from reconstruct.stored_run.stage_document import EMPTY, read_stage_document
from reconstruct.stored_run.stage_pack import StagePack, addressed
from reconstruct.stored_run.stored_run import StoredRun
from viewer.display.embedded import as_address, hash_of
from viewer.stage.pack_file import kind_of, stage_pack

SCRIPTS = (
    "vectors",
    "scene",
    "state",
    "gpu",
    "coarse",
    "tiles",
    "passes",
    "renderer",
    "pick",
    "overlay",
    "notes",
    "hands",
    "panel",
    "main",
)
SHADERS = ("surface.vert", "surface.frag", "depth.frag", "full.vert", "light.frag", "blur.frag", "show.frag")
SHADERS += ("lines.vert", "lines.frag")
IMPORTED, EXPORTED = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL), re.compile(r"^export ", re.MULTILINE)


def stage_page(run_dir: Path) -> str:
    """Return the page of a finished run with everything in it; it works from a file, without a server or a network.

    Raises:
        UserError: the run is not finished, or a file of it cannot be used.
    """
    return page_html(title_of(run_dir), stage_pack(run_dir), read_stage_document(run_dir))


def page_html(
    name: str,
    pack: StagePack,
    document: dict[str, Any] | None = None,
    saves: str = "",
    home: str = "",
) -> str:
    """Return the page's HTML.

    Args:
        document: notes and views, None: none yet.
        saves: how its document can be kept with the run: "socket", its parts are then beside it, or "frame", the page
            around it keeps it; "": it cannot.
        home: address of the page that led here; "": none.
    """
    is_served = saves == "socket"
    addresses = {part: part if is_served else as_address(pack.read(part), kind_of(part)) for part in pack.names}
    facts = addressed(pack.facts, addresses)
    values = {
        "title": html.escape(name),
        "size": html.escape(str(facts["size"])),
        "policy": page_policy(is_served),
        "style": _asset("stage.css"),
        "first": html.escape(facts["addresses"]["first"]),
        "scene": _json({**facts, "name": name}),
        "document": _json(document or EMPTY),
        "served": _json({"saves": saves, "home": home, **({"formats": _file_kinds()} if is_served else {})}),
        "shaders": "\n".join(
            f'<script type="text/plain" id="{shader}">{_asset(f"{shader}.glsl")}</script>' for shader in SHADERS
        ).replace("//#photo", _asset("photo.glsl")),
        "script": script_text(),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: values[found.group(1)], _asset("stage.html"))


def _file_kinds() -> dict[str, tuple[str, str]]:
    """Return title and suffix of each format that a served page offers: videos take minutes and are the command's."""
    rows = FORMATS.items()
    return {name: (row.title, row.suffix) for name, row in rows if "frames" not in row.takes and name != "html"}


def page_policy(is_served: bool) -> str:
    """Return the page's content security policy: its own script and style, and nothing from elsewhere."""
    own, connects = ("'self' ", "'self'") if is_served else ("", "'none'")
    return (
        f"default-src 'none'; script-src {hash_of(script_text())}; style-src {hash_of(_asset('stage.css'))}; "
        f"img-src {own}data: blob:; connect-src {connects}; base-uri 'none'; form-action 'none'"
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
    path.write_text(page_html(run.name, pack, read_stage_document(run.run_dir)), encoding="utf-8")
    facts = pack.facts
    x, y, z = (float(e) for e in np.ptp(np.asarray(facts["bounds"]), axis=0))
    note = f"{len(facts['lights'])} lights, {UNIT_WORDS[run.unit]}; open it in any browser"
    return Contents(facts["parts"]["corners"]["count"] // 3, (x, y, z), run.unit, note=note)


def _json(value: Any) -> str:
    """Return JSON that ends no script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _asset(name: str) -> str:
    return (resources.files("viewer.stage") / "assets" / name).read_text(encoding="utf-8")
