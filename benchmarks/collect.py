"""Make the page of results, docs/results.md, from the rows in benchmarks/results/: python benchmarks/collect.py

Each command here leaves its rows in a file of that folder (--table); nothing is measured by this one.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

from sheet import ROOT, table


@dataclass(frozen=True)
class Section:
    """One table of the page: the file of its rows, its title, what a reader needs to know, and the columns it shows."""

    name: str
    title: str
    text: str
    columns: str = ""  # names, between semicolons; none: all


HEAD = """# Results

The present state, in {count} tables. `python benchmarks/collect.py` makes this page from `benchmarks/results/`; each
table names the command that measured it. Only scoring reads the truth. Captures are rendered unless a photograph is
named; names like `spot_charuco` are captures of this kind that do not ship. Most CPU seconds come from two cores that
did other work, too. "Depth" is the mean error along the camera's rays, "normals" the mean angle, "IoU" the overlap of
the outline with the true one, "F" the F-score of the surface at 2 % of the object's diagonal (scenes: 1 %), "hidden"
the share found of the surface that no camera sees."""
SECTIONS = (
    Section(
        "captures",
        "Whole runs",
        """From photos to the mesh. Of captures everything is estimated (depth in mm); of scenes camera and lights
        are known (depth in units of which the objects measure 2.3).""",
        "capture; preset; lights, %; depth; normals, deg; IoU; F; hidden; bad photos used",
    ),
    Section(
        "phone",
        "Photos as phones and rooms give them",
        """One rock (115 mm, 24 photos of 640 px), with one thing switched on at a time; below it other objects with
        all of them (`--hard`: a phone's picture pipeline, two LEDs, varnish, a wall, a wavy sheet, room
        light, bad photos).""",
    ),
    Section(
        "bed",
        "Captures drawn at random",
        """What kitchens and hands give, drawn by lot (`benchmarks/bed_draws.py`). Success: lights within 6 %,
        outline at least 0.95, depth within 3 % of the size, normals within 15 degrees. Honest: it failed,
        and said which of these is wrong. In brackets the 95 % interval.""",
    ),
    Section(
        "paper",
        "Beside ShadowNeuS",
        """The scenes of the first rows are the paper's own (shadow pictures alone, medians of three seeds). Photos:
        colour, known lights, well spread; the paper's column is its Chair, so it stands for the size of
        an effect.""",
    ),
    Section(
        "ablations",
        "What each part is worth",
        """Shadow pictures of `bunny_point`, draft. The paper's columns are means over its own scenes, `-only` its
        Lego.""",
    ),
    Section(
        "figures",
        "Photographed figures",
        """DiLiGenT's bear and cat under known distant lights, no ground. Eight photos are left out of a second run
        and relit.""",
    ),
    Section(
        "lights",
        "Where the flashlight was",
        """Errors in per cent of the light's distance. Simulated tables with one fault each, then captures. Inside:
        share of coordinates within 1.96 stated sigmas (wanted: 0.95 or more).""",
    ),
    Section(
        "sigma",
        "Do the stated uncertainties hold",
        """Shares of errors within 1, 2 and 3 stated sigmas, mean of seven rendered captures; a normal distribution
        has 0.68, 0.95, 0.997.""",
    ),
    Section(
        "captures",
        "Time and memory",
        """The same runs, on one core, kernels compiled, from reading to the report. The first run on a machine
        compiles for 17 CPU seconds more. `fine` takes about 2.5 times the time and twice the memory of `standard`.""",
        "capture; preset; capture, CPU s; calibrate, CPU s; solve, CPU s; mesh, CPU s; CPU s; GiB",
    ),
    Section(
        "faults",
        "Faults in captures, found and named",
        """Twenty photos drawn from `examples/spot`, one fault put in, eight cases of each. Accused: good photos that
        are said to have one.""",
    ),
    Section(
        "formats",
        "Photos read",
        """Files of cameras, phones and other programs, by content.""",
    ),
    Section(
        "gpu",
        "On a graphics card",
        """One iteration of the surface fit, compiled kernels on eight cores against torch on an NVIDIA H200. The
        surfaces agree; stopped and resumed, the bits do. `--device auto` stays on the CPU.""",
    ),
)


def page(folder: Path) -> str:
    """The whole page from the rows of a folder.

    Raises:
        ValueError: a file of rows stands in no section, or a section has none.
    """
    there = {path.stem for path in folder.glob("*.json")}
    if there != (known := {section.name for section in SECTIONS}):
        raise ValueError(f"{folder} and SECTIONS differ: {sorted(there ^ known)}")
    lines = [HEAD.format(count=len(SECTIONS))]
    for section in SECTIONS:
        kept = json.loads((folder / f"{section.name}.json").read_text(encoding="utf-8"))
        columns = section.columns.split("; ") if section.columns else list(kept["rows"][0])
        rows = [{key: row.get(key) for key in columns} for row in kept["rows"]]
        rows = [row for row in rows if any(row[key] is not None for key in columns[2:])]  # the rest was not scored
        text = " ".join(f"{section.text} {kept['note']}".split())
        made = f"Made by `{kept['command']}`: {kept['made']}."
        lines += ["", f"## {section.title}", "", text, "", *table(rows), "", made]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md")
    options = parser.parse_args()
    options.page.write_text(page(options.rows), encoding="utf-8")


if __name__ == "__main__":
    main()
