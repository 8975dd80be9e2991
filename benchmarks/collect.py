"""Collect every page of measurements on one page of the manual, beside the paper's figures, and draw its plots.

    python benchmarks/collect.py [--measurements benchmarks] [--page docs/results.md] [--pictures docs/pictures]

Reads results*.md, which the other commands here write; measures nothing. Pages come in the order of ORDER, others
after them. The comparison on top takes its figures from their tables, and leaves out what is not there. Needs the
extra `docs`.
"""

import argparse
import re
from pathlib import Path

import paper
from pages import Page, number, read_page, with_columns
from plots import draw
from sheet import ROOT, table

INDEX = "results"  # its sections are newer than the pages, and come first
ORDER = (
    INDEX,
    "results_bed",
    "results_deepshadow",
    "results_scenes",
    "results_photos",
    "results_photos_shadow",
    "results_figures",
    "results_ablations",
    "results_grounds",
    "results_two_lights",
    "results_both",
    "results_light_series",
    "results_lights",
    "results_desk_lamp",
    "results_captures",
    "results_phone_captures",
    "results_heldout",
    "results_time",
    "results_scale",
    "results_costs",
    "results_fields",
    "results_step",
    "results_torch",
    "results_boards",
    "results_faults",
    "results_fuzz_runs",
    "results_mistakes",
    "results_uncertainty",
    "results_sigma",
    "results_viewer",
    "results_before",
)
HEAD = """# Results

Every table of `benchmarks/`, each with the command that made it, its machine, versions, commit, seeds and cost, and
beside the paper's figures [ShadowNeuS, CVPR 2023] where the paper has them. This page is made by

    python benchmarks/collect.py

and everything below is copied from `benchmarks/results*.md`. SCENES and CAPTURES are folders with a `gt/` that only
scores; without folders the commands use what ships. Most was measured on a machine that did other work, too:
accuracies do not depend on that, CPU seconds are too high by up to three times where "quiet" is not said. On a graphics
card nothing has been measured."""
APART = """The scenes are the same only for DeepShadow. Everywhere else theirs stand for the size of an effect: their
objects, their renderings and their number of lights are others. Number of photos and parts left out: one solve each,
with the preset that the sections below name."""


def ordered(pages: list[Page]) -> list[Page]:
    """The pages in the order in which they are read."""
    places = {name: place for place, name in enumerate(ORDER)}
    return sorted(pages, key=lambda page: (places.get(page.name, len(ORDER)), page.name))


def beside_the_paper(pages: list[Page]) -> list[str]:
    """Our figures and the paper's in one table."""
    rows = [*deepshadow_rows(pages), *scene_rows(pages), *photo_rows(pages), *ablation_rows(pages), *cost_rows(pages)]
    return table(["", "here", "the paper", "DeepShadow, by the paper"], rows)


def deepshadow_rows(pages: list[Page]) -> list[list[object]]:
    """Means over the scenes that were run."""
    rows: list[list[object]] = []
    for _, found in with_columns(pages, "", "cactus", "mean"):
        by_name = {row[""]: row["mean"] for row in found}
        for name in ("nMZE", "normals, deg"):
            if f"{name}, paper" in by_name:
                theirs = [by_name.get(f"{name}, {whose}") for whose in ("paper", "DeepShadow in the paper")]
                rows.append([f"DeepShadow's scenes, mean {name}", by_name[name], *theirs])
    return rows


def scene_rows(pages: list[Page]) -> list[list[object]]:
    """Depth and normals of scenes with the paper's kinds of pictures and lights, beside the means over its own.

    A case that stands on several pages is taken from the first one.
    """
    rows: list[list[object]] = []
    left = dict(paper.OWN_SCENES)
    for _, found in with_columns(ordered(pages), "", "depth", "normals, deg", "F at 1 %"):
        for case in found:
            for name, figure in zip(("depth", "normals, deg"), left.pop(case[""], ()), strict=False):
                what = f"{case['']}, {name} (the paper: its own scenes)"
                rows.append([what, number(case[name]), figure, None])
    return rows


def photo_rows(pages: list[Page]) -> list[list[object]]:
    """Normal error of every number of photos that the paper has, too."""
    rows: list[list[object]] = []
    for page, found in with_columns(pages, "subject", "photos", "normals, deg", "paper's Chair: normals, deg"):
        for row in found:
            count = number(row["photos"])
            if count in paper.PHOTOS and row["normals, deg"]:
                kind = page.title.partition(", ")[2] or "photos"
                what = f"{row['photos']} {kind}, normal error, degrees ({row['subject']}; the paper's Chair)"
                rows.append([what, row["normals, deg"], paper.PHOTOS[int(count)][1], None])
    return rows


def ablation_rows(pages: list[Page]) -> list[list[object]]:
    """How many times the default solver's normal error grows where a part is left out."""
    rows: list[list[object]] = []
    for _, found in with_columns(pages, "", "subject", "normals, deg", "paper: normals, deg"):
        errors = {row[""]: number(row["normals, deg"]) for row in found}
        full = errors.get("full")
        for theirs in (paper.ABLATIONS, paper.SUPERVISED):
            for part, (_, degrees) in theirs.items():
                ours = errors.get(part)
                if part != "full" and ours and full:
                    words = f"normal error over that of all, {part if part.endswith('-only') else f'without {part}'}"
                    rows.append([words, f"{ours / full:.2f}", f"{degrees / theirs['full'][1]:.2f}", None])
    return rows


def cost_rows(pages: list[Page]) -> list[list[object]]:
    """Hours of a scene."""
    rows: list[list[object]] = []
    for _, found in with_columns(pages, "field", "CPU s", "normals, deg"):
        ends = [number(row["CPU s"]) for row in found if row["field"] == "default solver"]
        if ends and ends[-1]:
            theirs = f"{paper.HOURS:g} hours of an RTX 2080Ti"
            rows.append(["one scene", f"{ends[-1]:.0f} CPU seconds, no graphics card", theirs, None])
    return rows


def section(page: Page, plot: str | None, anchors: dict[str, str]) -> list[str]:
    """A page as a section: headings one level down, links from where the manual lies, to other pages as anchors."""
    lines = [re.sub(r"^(#+ )", r"#\1", line).replace("](../docs/", "](") for line in page.lines]
    for name, anchor in anchors.items():
        lines = [line.replace(f"]({name}.md)", f"](#{anchor})") for line in lines]
    picture = ["", plot] if plot else []
    return [f"## {page.title}", *picture, *lines, ""]


def anchor(title: str) -> str:
    """What a heading is called in the manual's addresses."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower())


def collected(pages: list[Page], pictures: dict[str, str]) -> str:
    """The page of the manual."""
    sections = [page for page in ordered(pages) if page.name != INDEX]
    newest = [line for page in pages if page.name == INDEX for line in added(page)]
    lines = [HEAD, "", "## Beside the paper", "", *beside_the_paper(pages), "", APART, "", *newest]
    anchors = {page.name: anchor(page.title) for page in sections}
    for page in sections:
        lines += section(page, pictures.get(page.name), anchors)
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).rstrip() + "\n"


def added(index: Page) -> list[str]:
    """The sections of the index page; what stands before them is for readers of the folder."""
    text = "\n".join(index.lines)
    start = re.search(r"(?m)^## ", text)
    return [] if start is None else text[start.start() :].splitlines()


def main() -> None:
    """Read, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measurements", type=Path, default=ROOT / "benchmarks")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md")
    parser.add_argument("--pictures", type=Path, default=ROOT / "docs" / "pictures")
    options = parser.parse_args()
    pages = [read_page(path) for path in sorted(options.measurements.glob("results*.md"))]
    options.page.parent.mkdir(parents=True, exist_ok=True)
    options.page.write_text(collected(pages, draw(pages, options.pictures)), encoding="utf-8")


if __name__ == "__main__":
    main()
