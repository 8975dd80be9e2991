"""index.html of a batch: one row per capture, with a picture, its state and remarks. A click on a heading sorts."""

import contextlib
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from capture.files.atomic import atomic_file
from capture.files.regular import is_regular
from reconstruct.run.batch import LOGS, Outcome, Task
from reconstruct.run_folder.forecast import duration_text
from reconstruct.stored_run.stage_pack import read_stage_pack
from viewer.display.run_follower import size_text
from viewer.report import document as doc
from viewer.report.pictures import guessed_share

INDEX, THUMBNAIL = "index.html", "thumbnail.jpg"
SORT = """
document.querySelectorAll('th').forEach((head,column)=>{head.tabIndex=0;head.onclick=head.onkeydown=event=>{
if(event.type==='keydown'&&event.key!=='Enter')return;
const down=head.getAttribute('aria-sort')==='ascending',body=head.closest('table').tBodies[0];
document.querySelectorAll('th').forEach(other=>other.removeAttribute('aria-sort'));
head.setAttribute('aria-sort',down?'descending':'ascending');
const key=row=>row.cells[column].dataset.key,number=row=>parseFloat(key(row));
[...body.rows].sort((a,b)=>(isNaN(number(a))||isNaN(number(b))?key(a).localeCompare(key(b)):number(a)-number(b))*(down?-1:1))
.forEach(row=>body.append(row))}});
"""
STYLE = """
main{max-width:1280px}th{cursor:pointer;white-space:nowrap}th[aria-sort=ascending]::after{content:" \\2191"}
th[aria-sort=descending]::after{content:" \\2193"}td img{width:96px;border-radius:6px;background:#8884}
td:nth-child(2){min-width:8rem}td:nth-child(3){min-width:5rem}td:nth-child(4){min-width:13rem}
td:nth-child(n+5){white-space:nowrap}td img{min-width:96px}
td.done b{color:var(--good)}td.noted b{color:var(--accent)}td.failed b{color:var(--bad)}td a{color:inherit}
"""
HEAD = ("", "Capture", "State", "What to know", "Size", "Photos", "Only a guess", "Time")


def write_batch_page(folder: Path, tasks: Sequence[Task], outcomes: Mapping[str, Outcome]) -> Path:
    """Write index.html, whole or not at all, with pictures and reports by relative addresses; returns its path."""
    failed = sum(o.exit_code != 0 for o in outcomes.values())
    waiting = len(tasks) - len(outcomes)
    lead = f"{len(outcomes) - failed} of {len(tasks)} captures are done, {failed} failed, {waiting} waiting."
    rows = "".join(_row(folder, task, outcomes.get(task.name)) for task in tasks)
    heads = "".join(f"<th>{html.escape(words)}</th>" for words in HEAD)
    body = (
        f'<header><div class="tag">Shadowgraph batch</div><h1>{html.escape(folder.resolve().name)}</h1>'
        f'<p class="verdict {"bad" if failed else ""}">{lead}</p></header><section>'
        '<p class="lead">A click on a heading sorts; a name opens the report of its run, or what a failed one said.</p>'
        f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div></section>'
    )
    path = folder / INDEX
    with atomic_file(path) as temporary:
        temporary.write_text(doc.page(f"Shadowgraph: {folder.resolve().name}", body, STYLE, SORT), encoding="utf-8")
    return path


def write_thumbnail(run_dir: Path) -> None:
    """Write thumbnail.jpg of a finished run: the picture that its stage begins with; none where it has no stage."""
    with contextlib.suppress(OSError):
        pack = read_stage_pack(run_dir)
        if pack is not None:
            with atomic_file(run_dir / THUMBNAIL) as temporary:
                temporary.write_bytes(pack.read(pack.facts["addresses"]["first"]))


def _row(folder: Path, task: Task, outcome: Outcome | None) -> str:
    """One capture: its cells, each with the key that it is sorted by."""
    report, notes = (outcome.report, _notes(outcome)) if outcome else ({}, [])
    state, kind, order = _state(outcome, notes)
    told = notes[0] + (f" (and {len(notes) - 1} more)" if len(notes) > 1 else "") if notes else ""
    extents = report.get("mesh", {}).get("size")
    size = size_text(np.array(extents, float), str(report.get("unit", "scene"))) if extents else ""
    photos = [photo for photo in report.get("photos", []) if photo.get("role") == "lit"]
    used, guess = sum(bool(photo.get("used")) for photo in photos), guessed_share(report)
    picture = ""
    if is_regular(folder / task.name / THUMBNAIL):
        picture = f'<img src="{html.escape(task.name)}/{THUMBNAIL}" alt="">'
    target = f"{task.name}/report.html" if outcome and not outcome.exit_code else f"{LOGS}/{task.name}.txt"
    name = html.escape(task.name)
    link = f'<a href="{html.escape(target)}">{name}</a>' if outcome else name
    seconds = outcome.seconds if outcome else -1.0
    cells = [
        (picture, 0, ""),
        (f"<b>{link}</b>", task.name, ""),
        (f"<b>{state}</b>", order, kind),
        (html.escape(told), len(notes), ""),
        (size, max(extents) if extents else 0.0, ""),
        (f"{used} of {len(photos)}" if photos else "", used, ""),
        (f"{100 * guess:.0f} %" if guess is not None else "", -1 if guess is None else guess, ""),
        (duration_text(seconds) if seconds >= 0 else "", seconds, ""),
    ]
    return "<tr>" + "".join(f'<td class="{c}" data-key="{html.escape(str(k))}">{t}</td>' for t, k, c in cells) + "</tr>"


def _state(outcome: Outcome | None, notes: Sequence[str]) -> tuple[str, str, int]:
    """In a word, its colour, and its place when sorted: what needs a person comes first."""
    if outcome is None:
        return "waiting", "", 2
    if outcome.exit_code:
        return "failed", "failed", 0
    return ("done, with remarks", "noted", 1) if notes else ("done", "done", 3)


def _notes(outcome: Outcome) -> list[str]:
    """What is to be said of a capture."""
    return [outcome.sentence] if outcome.exit_code else [str(line) for line in outcome.report.get("warnings", [])]
