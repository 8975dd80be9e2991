"""Plots of the measurements as SVG: text stays text, and black becomes the page's own colour, light or dark.

Each takes all pages, finds its tables by their columns, and is None where they are missing.
"""

import re
from collections.abc import Callable
from io import StringIO
from pathlib import Path

import matplotlib
import paper
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from pages import Page, Row, number, with_columns
from sheet import slope

INK = "#010203"  # stands for the page's colour of text, and is replaced by it
STYLE = "<style>svg{color:#222}@media(prefers-color-scheme:dark){svg{color:#ddd}}</style>"
COLOURS = ("#1f88d8", "#e07b1a", "#2ca05a", "#b065d0", "#c9a400")  # told apart on white and on black
SETTINGS: dict = {
    "svg.fonttype": "none",
    "svg.hashsalt": "shadowgraph",  # the same figure has the same bytes
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    **{f"{part}.color": INK for part in ("text", "xtick", "ytick", "grid")},
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.prop_cycle": matplotlib.cycler(color=COLOURS),
    "grid.alpha": 0.15,
    "axes.grid": True,
    "legend.frameon": False,
    "legend.fontsize": 9,
}


def error_curves(pages: list[Page]) -> Figure | None:
    """Normal error against CPU seconds, by field, and what the paper's iterations would take here."""
    found = with_columns(pages, "field", "CPU s", "normals, deg")
    if not found:
        return None
    figure, (axes,) = panels(1)
    rows = found[0][1]
    for name in dict.fromkeys(row["field"] for row in rows):
        mine = [row for row in rows if row["field"] == name]
        line(axes, mine, "CPU s", "normals, deg", label=name)
    for _, table in with_columns(pages, "field", "CPU s of one iteration"):
        cost = next((number(row["CPU s of one iteration"]) for row in table if row["field"] == "neural"), None)
        if cost:
            marked(axes, cost, "one of the paper's\niterations")
            marked(axes, cost * paper.ITERATIONS, f"all {paper.ITERATIONS:,}\nof them".replace(",", " "))
    axes.set(xscale="log", xlabel="CPU seconds", ylabel="normal error, degrees", ylim=(0, None))
    axes.legend()
    return figure


def photos(pages: list[Page]) -> Figure | None:
    """Errors against the number of photos, beside the paper's."""
    found = with_columns(pages, "subject", "photos", "normals, deg", "CPU s")
    found = [(page, table) for page, table in found if "lights in each" not in table[0]]
    if not found:
        return None
    figure, (left, right) = panels(2)
    for page, table in found:
        for name in dict.fromkeys(row["subject"] for row in table):
            mine = [row for row in table if row["subject"] == name]
            kind = "shadows" if "shadow" in page.name else "photos"
            line(left, mine, "photos", "normals, deg", label=f"{name}, {kind}")
            line(right, mine, "photos", "depth", label=f"{name}, {kind}")
    counts = list(paper.PHOTOS)
    for axes, place in ((left, 1), (right, 0)):
        errors = [paper.PHOTOS[count][place] for count in counts]
        axes.plot(counts, errors, "--", color=INK, label="the paper's Chair")
        axes.set(xscale="log", xlabel="photos")
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.minorticks_off()
    left.set(ylabel="normal error, degrees", ylim=(0, None))
    right.set(ylabel="depth error, scene units", yscale="log")
    left.legend()
    return figure


def lights(pages: list[Page]) -> Figure | None:
    """Errors against how far every light was moved, with lights held and refined."""
    rows = [
        row for _, table in with_columns(pages, "folder", "moved by", "lights", "normals, deg", "F") for row in table
    ]
    if not rows:
        return None
    figure, (left, right) = panels(2)
    for colour, folder in zip(COLOURS, dict.fromkeys(row["folder"] for row in rows), strict=False):
        for kind, style in (("held", "o--"), ("refined", "o-")):
            mine = [row for row in rows if (row["folder"], row["lights"]) == (folder, kind)]
            for axes, column in ((left, "normals, deg"), (right, "F")):
                line(axes, mine, "moved by", column, f"{folder}, {kind}", style, colour)
    left.set(xlabel="error of every light, % of its distance", ylabel="normal error, degrees", ylim=(0, None))
    right.set(xlabel="error of every light, % of its distance", ylabel="F-score", ylim=(None, 1))
    right.legend(loc="lower left", fontsize=8)
    return figure


def scale(pages: list[Page]) -> Figure | None:
    """CPU seconds and memory against grid, rays, photos and pixels, with their slopes."""
    figure, (left, right) = panels(2, height=4.2)
    for along, cost in (("nodes", "iteration"), ("rays", "iteration"), ("photos", "iteration"), ("pixels", "labels")):
        for table in varied(pages, along):
            heading = next(key for key in table[0] if key.startswith(cost) and key.endswith("CPU s"))
            for axes, column in ((left, heading), (right, "peak memory, GiB")):
                first = number(table[0][along]) or 1.0
                x = [(number(row[along]) or 0.0) / first for row in table]
                y = [number(row[column]) or 0.0 for row in table]
                what = f"{along} from {first:g}, {'labels and hull' if cost == 'labels' else 'iteration'}"
                axes.plot(x, y, "o-", ms=3, label=f"{what}: slope {slope(x, y):.2f}")
    if not left.lines:
        return None
    for axes, title in ((left, "CPU seconds"), (right, "peak memory, GiB")):
        axes.set(xscale="log", yscale="log", xlabel="times the smallest", ylabel=title)
        axes.set_xticks([1, 2, 4], ["1", "2", "4"])
        axes.minorticks_off()
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    return figure


def varied(pages: list[Page], along: str) -> list[list[Row]]:
    """The tables of benchmarks/run_scale.py in which this number varies."""
    tables = (table for _, table in with_columns(pages, along, "peak memory, GiB"))
    return [table for table in tables if len({row[along] for row in table}) > 1]


def line(axes: Axes, rows: list[Row], x: str, y: str, label: str, style: str = "o-", colour: str | None = None) -> None:
    """One line through the rows that have both numbers."""
    pairs = [(number(row[x]), number(row[y])) for row in rows]
    points = [(a, b) for a, b in pairs if a is not None and b is not None]
    if points:
        axes.plot(*zip(*points, strict=True), style, ms=3, color=colour, label=label)


def marked(axes: Axes, x: float, text: str) -> None:
    """A vertical line with its name."""
    axes.axvline(x, color=INK, lw=0.8, ls=":")
    axes.annotate(text, (x, 0.98), xycoords=("data", "axes fraction"), rotation=90, fontsize=8, ha="left", va="top")


def panels(count: int, height: float = 3.4) -> tuple[Figure, list[Axes]]:
    """A figure with panels side by side, inches high."""
    figure = Figure(figsize=(4.6 * count if count > 1 else 6.4, height), layout="constrained")
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


PLOTS: dict[str, tuple[Callable[[list[Page]], Figure | None], str]] = {
    "results_fields": (error_curves, "Normal error against CPU seconds."),
    "results_photos": (photos, "Error against the number of photos."),
    "results_light_series": (lights, "Error against the error of the lights, held (dashed) and refined."),
    "results_scale": (scale, "Cost against size, both axes logarithmic."),
}


def draw(pages: list[Page], folder: Path) -> dict[str, str]:
    """Write every plot that has its tables; a line of Markdown for each, by the page that it stands on."""
    out = {}
    folder.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(SETTINGS):
        for name, (plot, words) in PLOTS.items():
            figure = plot(pages)
            if figure is not None:
                file = folder / f"{plot.__name__}.svg"
                file.write_text(svg(figure), encoding="utf-8")
                out[name] = f"![{words}]({folder.name}/{file.name})"
    return out


def svg(figure: Figure) -> str:
    """The figure with the page's own colour of text, on nothing."""
    text = StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    plain = re.sub(r"[ \t]+\n", "\n", text.getvalue().replace(INK, "currentColor"))
    return plain.replace("<defs>", f"{STYLE}\n <defs>", 1)
