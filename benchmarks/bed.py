"""Draw captures at random, render each once, run and score them: how many succeed, fail honestly, or are wrong unsaid.

    python benchmarks/bed.py --seed 1 --count 12 [--kind close far] [--meshes DIR] [--cache DIR] [--tree DIR]
    python benchmarks/bed.py --seed 1000 --count 40 --compare A B
    python benchmarks/bed.py --seed 1000 --count 40 --without NAME

The captures follow from kind and seed (benchmarks/bed_draws.py). Pictures and results stay in the cache: one JSON line
for each capture and commit, so that the bed can be run in pieces. A and B are commits; what one lacks is run in a
worktree of its own. NAME is a mechanism of benchmarks/switches.py: the runs that are kept are done again without it,
from their calibrations on, and compared. Seeds below 1000 are for looking into. Of those from 1000 on no single
capture is printed.

Needs the extra `generator`; with LLVM 16 or newer, named by DRJIT_LIBLLVM_PATH, it renders five times as fast.
"""

import argparse
import json
import multiprocessing
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import trimesh
from scipy import stats
from sheet import ROOT, Sheet, parser_of, table

# isort: split
from bed_draws import Draw, draw

FIRST_UNSEEN = 1000
FEWEST = 8  # captures in a cell of an unseen table: fewer would tell of single ones
MOST_CPU_S = 1800  # of one run, five times what the slowest takes: it does not end
LIMITS = {"lights_pct": 6.0, "iou": 0.95, "depth_pct": 3.0, "normals_deg": 15.0}  # what succeeds; iou: at least
CAUSES = {  # what is wrong in truth, and the words by which a verdict names it
    "lights": r"lights?' (places?|positions?)|where the (lights?|flashlight) (is|are)|usable light|wrong lights?",
    "outline": r"outline|what is (object|ground|table)|taken for (ground|table|object)|object's (shape|edge)",
    "shape": r"the surface('s slopes| does not explain)",
    "bad photo": r"\barm\b|hand in|shak|did not fire|flash.* off|photos? (was|were|is|are) (wrong|bad)",
    "moved camera": r"tripod|camera (moved|was moved)",
    "mixed light": r"room light|mixed light|another lamp",
}
OUTCOMES = ("success", "honest", "confident wrong")
REST_DEG = 40  # edges of a file's mesh that are sharper are shaded sharp
Row = dict


# --- one capture -----------------------------------------------------------------------------------------------------


def rendered(made: Draw, cache: Path) -> Path:
    """Return the folder of a capture, which is rendered unless it is in the cache."""
    place = cache / "captures" / made.key()
    if not place.exists():
        from examples.generator.capturing import make_capture

        part = cache / "parts" / f"{made.key()}-{os.getpid()}"
        shutil.rmtree(part, ignore_errors=True)
        thing = made.setup.thing
        if thing.mesh:
            thing = replace(thing, mesh=at_rest(thing.mesh, cache / "things", made.seed))
        exposure = replace(made.setup.exposure, llvm="DRJIT_LIBLLVM_PATH" in os.environ)
        make_capture(part, replace(made.setup, thing=thing, exposure=exposure), lambda said: None)
        (part / "session.toml").write_text(f'board = "{made.setup.table.board}"\n')
        place.parent.mkdir(parents=True, exist_ok=True)
        part.rename(place)
    return place


def at_rest(file: Path, folder: Path, seed: int) -> Path:
    """Return a mesh file turned to a side on which the thing rests, each as likely as it falls so."""
    mesh = trimesh.load_mesh(file)
    poses, shares = mesh.compute_stable_poses(n_samples=1)
    chosen = int(np.random.default_rng(seed).choice(len(poses), p=shares / shares.sum()))
    mesh.apply_transform(poses[chosen])
    out = folder / f"{file.stem}-{chosen}.ply"
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.graph.smooth_shade(mesh, angle=np.radians(REST_DEG)).export(out, vertex_normal=True)
    return out


def measured(made: Draw, cache: Path, tree: Path, commit: str, preset: str, without: str = "") -> Row:
    """Render, run and score one capture; the row that is kept.

    Args:
        without: a switch; the run goes on from the calibration of the commit's own run.
    """
    capture, out = rendered(made, cache), cache / "runs" / place_of(commit, without) / made.key()
    program, force = [str(tree / "shadowgraph")], ["--force"]
    if without:
        copy_calibration(cache / "runs" / commit / made.key(), out)
        program, force = [str(ROOT / "benchmarks" / "switches.py"), without], []
    arguments = ["run", str(capture), "--out", str(out), "--viewer", "off", "--preset", preset, *force]
    out.parent.mkdir(parents=True, exist_ok=True)
    with (out.parent / f"{made.key()}.log").open("w") as log:
        started = subprocess.Popen(
            [sys.executable, *program, *arguments],
            env=os.environ | {"PYTHONPATH": str(tree)},
            stdout=subprocess.DEVNULL,
            stderr=log,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S)),
        )
        _, status, usage = os.wait4(started.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    row = {"seed": made.seed, "kind": made.kind, "key": made.key(), "commit": commit, "preset": preset, **made.factors}
    row |= {"exit": code, "cpu_s": usage.ru_utime + usage.ru_stime}
    return row | scored(out, capture, code, (out.parent / f"{made.key()}.log").read_text(), made.factors)


def place_of(commit: str, without: str) -> str:
    """Return the name under which the results of a commit are kept, with all mechanisms or without one."""
    return f"{commit}-without-{without}" if without else commit


def copy_calibration(run: Path, out: Path) -> None:
    """Make a run folder that stands where a finished one stood after its calibration and check."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for name in ("calibration.json", "check.json"):
        if (run / name).exists():
            shutil.copy(run / name, out)
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["finished"] = [stage for stage in manifest["finished"] if stage in ("calibrate", "check")]
    (out / "manifest.json").write_text(json.dumps(manifest))


def scored(out: Path, capture: Path, code: int, said: str, factors: dict[str, str]) -> Row:
    """Compare a run with the truth, and what it says of itself with what is wrong."""
    from reconstruct.evaluate.metrics import evaluate

    file = out / "report.json"
    verdict = json.loads(file.read_text()) if file.exists() else {}
    row: Row = {"grade": verdict.get("grade", "none"), "said": verdict.get("verdict", "")}
    if code != 0:
        row |= {"grade": "refused" if code == 2 else "crashed", "said": said.strip().splitlines()[-1:]}
        row["said"] = (row["said"] or [""])[0]
    else:
        numbers = evaluate(out, capture, samples=100)
        extent = max(trimesh.load_mesh(capture / "gt" / "object.ply", process=False).extents)
        row |= {"lights_pct": numbers.get("light_median_pct"), "iou": numbers["mask_iou"]}
        row |= {"depth_pct": float(100 * numbers["depth_mae"] / extent), "normals_deg": numbers["normal_mae_deg"]}
        row["bad_used"] = len(numbers["bad_photos_used"])
    return row | judged(row, factors)


def judged(row: Row, factors: dict[str, str]) -> Row:
    """Return the outcome of a scored row: success, honest, confident wrong, or doubted for another cause."""
    causes = what_is_wrong(row, factors)
    named = [cause for cause, words in CAUSES.items() if re.search(words, row["said"], re.IGNORECASE)]
    if not causes:
        outcome = "success"
    elif row["grade"] in ("good", "fair", "none", "crashed"):
        outcome = "confident wrong" if row["grade"] != "crashed" else "crashed"
    else:
        outcome = "honest" if set(causes) & set(named) else "another cause"
    return {"outcome": outcome, "causes": causes, "named": named}


def what_is_wrong(row: Row, factors: dict[str, str]) -> list[str]:
    """Return what is wrong with a result in truth; nothing: it succeeds. A refusal has no lights and no shape."""
    missing = {"lights_pct": np.inf, "iou": 0.0, "depth_pct": np.inf, "normals_deg": np.inf}
    value = {name: missing[name] if row.get(name) is None else row[name] for name in LIMITS}
    is_wrong = {k: bool(value[k] < limit if k == "iou" else value[k] > limit) for k, limit in LIMITS.items()}
    of_shape = is_wrong["depth_pct"] or is_wrong["normals_deg"]
    told = {"lights": is_wrong["lights_pct"], "outline": is_wrong["iou"], "shape": of_shape}
    causes = [cause for cause, is_so in (told | {"bad photo": row.get("bad_used", 0) > 0}).items() if is_so]
    if causes:
        there = {"moved camera": "tapped" in factors["bad photos"], "mixed light": factors["room light"] == "strong"}
        causes += [cause for cause, is_so in there.items() if is_so]
    return causes


# --- many captures ---------------------------------------------------------------------------------------------------


def results(options: argparse.Namespace, tree: Path | None, commit: str, without: str = "") -> list[Row]:
    """Return the rows of all wanted captures of a commit; those that are not kept yet are measured.

    Args:
        tree: a checkout of the commit; none: one is made when it is needed.
        without: a switch, see `measured`.
    """
    meshes = sorted(options.meshes.glob("*.ply")) if options.meshes else []
    seeds = range(options.seed, options.seed + options.count)
    wanted = {(d.kind, d.key()): d for seed in seeds for kind in options.kind for d in [draw(seed, kind, meshes)]}
    file = options.cache / "results" / f"{place_of(commit, without)}.jsonl"
    kept = {(r["kind"], r["key"]): r for r in read_rows(file) if r["preset"] == options.preset}
    left = [made for name, made in wanted.items() if name not in kept and not options.kept]
    if left:
        place = tree or checked_out(commit, options.cache)
        file.parent.mkdir(parents=True, exist_ok=True)
        jobs = ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn"), os.nice, (19,))
        with jobs as pool, file.open("a") as out:
            waiting = [pool.submit(measured, d, options.cache, place, commit, options.preset, without) for d in left]
            for done, one in enumerate(waiting, 1):
                row = one.result()
                out.write(json.dumps(row) + "\n")
                out.flush()
                kept[row["kind"], row["key"]] = row
                print(f"{done} of {len(left)} captures done", file=sys.stderr, flush=True)
    return [kept[name] | judged(kept[name], kept[name]) for name in wanted if name in kept]


def read_rows(file: Path) -> list[Row]:
    """Return the rows of a file of results, one JSON line each; none where there is no file."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def commit_of(tree: Path) -> str:
    """Return the commit that is checked out, with a hash of what differs from it."""
    head, changes = (git(tree, *words) for words in (("rev-parse", "HEAD"), ("diff", "HEAD")))
    return head.strip()[:12] + (f"-{sha256(changes.encode()).hexdigest()[:8]}" if changes else "")


def checked_out(commit: str, cache: Path) -> Path:
    """Return a worktree of a commit."""
    place = cache / "trees" / commit
    if not place.exists():
        git(ROOT, "worktree", "add", "--detach", str(place.resolve()), commit)
    return place


def git(tree: Path, *words: str) -> str:
    """Return what git answers."""
    return subprocess.run(["git", "-C", str(tree), *words], check=True, capture_output=True, text=True).stdout


# --- numbers ---------------------------------------------------------------------------------------------------------


def share(found: Sequence[bool]) -> str:
    """Return a share with its 95 % interval (Wilson)."""
    low, high = stats.binomtest(sum(found), len(found)).proportion_ci(method="wilson")
    return f"{np.mean(found):.2f} ({low:.2f} to {high:.2f})"


def interval(values: Sequence[float], of=np.median) -> str:
    """Return a median or mean with its 95 % interval (bootstrap of the captures, percentiles)."""
    if len(values) < 2:
        return f"{of(values):.3g}"
    found = stats.bootstrap((values,), of, method="percentile", n_resamples=2000, rng=0).confidence_interval
    return f"{of(values):.3g} ({found.low:.3g} to {found.high:.3g})"


def summary(rows: Sequence[Row], name: str) -> Row:
    """Return one line: name, captures, the three shares, the median of CPU seconds and the largest."""
    shares = {outcome: share([row["outcome"] == outcome for row in rows]) for outcome in OUTCOMES}
    cpu = [row["cpu_s"] for row in rows]
    return {"": name, "captures": len(rows)} | shares | {"CPU s, median": interval(cpu), "largest": round(max(cpu))}


def by_factor(rows: Sequence[Row], fewest: int) -> list[Row]:
    """Return the four numbers of each value of each factor that has enough captures."""
    lines = []
    for factor in ("kind", "object", "material", "size", "table", "pictures", "wall", "room light", "lights", "photos",
                   "bad photos"):  # fmt: skip
        for value in sorted({row[factor] for row in rows}):
            cell = [row for row in rows if row[factor] == value]
            if len(cell) >= fewest:
                lines.append(summary(cell, f"{factor}: {value}"))
    return lines


def singles(rows: Sequence[Row]) -> list[str]:
    """Return a table of single captures.

    Raises:
        SystemExit: one of them is not for looking into.
    """
    if any(row["seed"] >= FIRST_UNSEEN for row in rows):
        raise SystemExit(f"seeds from {FIRST_UNSEEN} on are not looked into one by one: only their numbers decide.")
    shown = ("outcome", *LIMITS, "bad_used", "grade", "causes", "said", "cpu_s", "object", "material", "table", "size",
             "pictures", "wall", "lights", "room light", "photos", "bad photos", "key")  # fmt: skip
    return table([{"capture": f"{r['kind']} {r['seed']}"} | {k: r.get(k) for k in shown} for r in rows])


def compared(a: Sequence[Row], b: Sequence[Row]) -> list[Row]:
    """Return the paired differences of the same captures: b less a for shares, log b / a for depth, normals, CPU s."""
    other = {(row["kind"], row["key"]): row for row in b}
    pairs = [(row, other[row["kind"], row["key"]]) for row in a if (row["kind"], row["key"]) in other]
    lines = []
    for name, some in [("all", pairs)] + [(k, [p for p in pairs if p[0]["kind"] == k]) for k in ("close", "far")]:
        if some:
            is_one = [[[row["outcome"] == one for row in pair] for pair in some] for one in OUTCOMES]
            shares = [interval([float(y) - float(x) for x, y in found], np.mean) for found in is_one]
            line = {"second less first": name, "captures": len(some)} | dict(zip(OUTCOMES, shares, strict=True))
            for told, key in (("depth", "depth_pct"), ("normals", "normals_deg"), ("CPU s", "cpu_s")):
                ratios = [np.log(y[key] / x[key]) for x, y in some if x.get(key) and y.get(key)]
                line |= {f"{told}, log second over first": interval(ratios, np.mean) if ratios else "none"}
            lines.append(line)
    return lines


def main() -> None:
    """Parse, measure what is not kept, print."""
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, required=True, help="of the first capture")
    parser.add_argument("--count", type=int, required=True, help="captures of each kind")
    parser.add_argument("--kind", nargs="+", default=["close", "far"], choices=["close", "far"])
    parser.add_argument("--preset", default="draft", choices=["draft", "standard", "fine"])
    parser.add_argument("--meshes", type=Path, help="a folder of .ply files; none: built-in solids only")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "shadowgraph-bed")
    parser.add_argument("--kept", action="store_true", help="measure nothing: only what is kept")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--tree", type=Path, default=ROOT, help="the checkout whose program runs")
    parser.add_argument("--compare", nargs=2, metavar=("A", "B"), help="two commits")
    parser.add_argument(
        "--without", default="", metavar="NAME", help="a switch; measured beside the runs that are kept"
    )
    options = parser.parse_args()
    last, options.cache = options.seed + options.count - 1, options.cache.resolve()
    if options.seed < FIRST_UNSEEN <= last:
        raise SystemExit(f"seeds below {FIRST_UNSEEN} and from there on are two beds: ask for one of them at a time.")
    seeds = f"captures {options.seed} to {last} of each kind: {', '.join(options.kind)}, {options.preset}"
    if options.compare:
        commits = [git(ROOT, "rev-parse", f"{name}^{{commit}}").strip()[:12] for name in options.compare]
        both = [results(options, None, commit) for commit in commits]
        own = [summary(rows, commit) for rows, commit in zip(both, commits, strict=True)]
        Sheet(None, seeds).write(own, table(compared(*both)))
        return
    commit = commit_of(options.tree)
    rows = results(options, options.tree.resolve(), commit)
    if not rows:
        raise SystemExit(f"none of these captures is kept for {commit}: run them without --kept.")
    if options.without:
        other = results(options, options.tree.resolve(), commit, options.without)
        both = (summary(rows, commit), summary(other, f"without {options.without}"))
        Sheet(None, seeds).write(both, table(compared(rows, other)))
        return
    kinds = [summary([row for row in rows if row["kind"] == kind], kind) for kind in sorted({r["kind"] for r in rows})]
    is_unseen = last >= FIRST_UNSEEN
    parts = [*kinds, summary(rows, "all"), *by_factor(rows, FEWEST if is_unseen else 1)]
    Sheet(options.table, f"{seeds}; program {commit}").write(parts, *([] if is_unseen else [singles(rows)]))


if __name__ == "__main__":
    main()
