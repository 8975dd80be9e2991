"""The HTML elements of the report. They escape all text that is given to them."""

import base64
import hashlib
import html
from collections.abc import Sequence

from viewer.report.drawing import Picture, data_uri

STYLE = """
:root{--bg:#fbfaf8;--card:#fff;--text:#1d2026;--muted:#667080;--line:#dfe1e6;--accent:#d9820f;--good:#1f8a53;--bad:#c8402f}
@media (prefers-color-scheme:dark){:root{--bg:#15171b;--card:#1d2026;--text:#e8eaee;--muted:#98a1b0;--line:#353a44;
--accent:#f0a53a;--good:#4cc38a;--bad:#f2705e}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--text);font:16px/1.55 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1060px;margin:0 auto;padding:28px 20px 80px}
h1,figcaption,li{overflow-wrap:anywhere}td{overflow-wrap:break-word}header>:last-child{margin-bottom:0}
h1{font-size:1.9rem;line-height:1.2;margin:.1rem 0 .3rem}
h2{font-size:1.25rem;margin:0 0 .2rem}
.lead{color:var(--muted);margin:0 0 1rem;max-width:46rem}
section,header{background:var(--card);border:1px solid var(--line);border-radius:14px;padding:22px 24px;margin:0 0 18px}
header .tag{font-size:.8rem;letter-spacing:.06em;text-transform:uppercase;color:var(--muted)}
.verdict{font-size:1.1rem;margin:.2rem 0 1rem;border-left:4px solid var(--good);padding-left:.7rem}
.verdict.warn{border-color:var(--accent)}.verdict.bad{border-color:var(--bad)}
.facts{display:flex;flex-wrap:wrap;gap:14px 34px;margin:0 0 1rem}.facts>div{min-width:150px}
.facts b{display:block;font-size:1.35rem;line-height:1.2}
.facts span{color:var(--muted);font-size:.86rem;max-width:15rem;display:block}
.row{display:flex;flex-wrap:wrap;gap:18px}.row>*{flex:1 1 280px;min-width:0}
.row.wide-first>*:first-child{flex:2 1 420px}
.row.wide-first{align-items:center}
figure{margin:0}figcaption{color:var(--muted);font-size:.86rem;margin-top:.35rem}
img,svg{display:block;width:100%;height:auto}img{border-radius:8px}
svg{margin:0 auto}
svg text{fill:var(--muted);font-family:inherit;paint-order:stroke;stroke:var(--card);stroke-width:3px}
.scroll{overflow-x:auto}table{border-collapse:collapse;width:100%;font-size:.92rem;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:6px 12px 6px 0;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--muted);font-weight:600}th::first-letter{text-transform:uppercase}
td.n,th.n{text-align:right;white-space:nowrap}.legend{margin:.5rem 0 1rem}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(128px,1fr));gap:12px}
.grid figcaption{font-size:.76rem;line-height:1.3;overflow-wrap:anywhere}
.dropped img{filter:grayscale(1);opacity:.55}.dropped figcaption b{color:var(--bad)}
.key{display:inline-flex;align-items:center;gap:6px;margin-right:16px;font-size:.86rem;color:var(--muted)}
.key i{width:18px;height:3px;border-radius:2px;display:inline-block}
ul{margin:.2rem 0;padding-left:1.2rem}code{font-size:.88em;overflow-wrap:anywhere}
summary{cursor:pointer;color:var(--muted)}
@media (max-width:560px){table.words tr{display:block;padding:8px 0;border-bottom:1px solid var(--line)}
table.words th{display:none}table.words td{display:block;padding:0;border:0}table.words td:first-child{font-weight:600}}
@media print{body{background:#fff}section,header{break-inside:avoid}}
"""


def page(title: str, body: str, style: str = "", script: str = "") -> str:
    """Return a whole document. It loads nothing, and its policy forbids the browser to load anything.

    Args:
        style: more rules, after those of every page.
        script: the only one that it may run; such a page may also show pictures that lie beside it.
    """
    policy, code = "default-src 'none'; style-src 'unsafe-inline'; img-src data:", ""
    if script:
        policy, code = f"{policy} 'self'; script-src {hash_of(script)}", f"<script>{script}</script>"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{html.escape(title)}</title><style>{STYLE}{style}</style></head><body><main>{body}</main>{code}</body>"
        "</html>\n"
    )


def hash_of(text: str) -> str:
    """Return the source of a script or style by its hash, for a content security policy."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def section(title: str, explanation: str, body: str) -> str:
    """Return a titled part with one sentence that explains it; "" if the body is empty."""
    if not body:
        return ""
    return f'<section><h2>{html.escape(title)}</h2><p class="lead">{html.escape(explanation)}</p>{body}</section>'


def figure(picture: Picture | str, caption: str, kind: str = "") -> str:
    """Return a picture, or an SVG drawing, with its caption."""
    shown = picture if isinstance(picture, str) else f'<img src="{data_uri(picture)}" alt="{html.escape(caption)}">'
    return f'<figure class="{kind}">{shown}<figcaption>{html.escape(caption)}</figcaption></figure>'


def row(*cells: str, kind: str = "") -> str:
    """Return parts side by side where the page is wide enough. Empty ones are left out."""
    shown = [cell for cell in cells if cell]
    return f'<div class="row {kind}">{"".join(shown)}</div>' if shown else ""


def facts(values: Sequence[tuple[str, str]]) -> str:
    """Return numbers in large type, each over one short sentence that explains it."""
    if not values:
        return ""
    cells = (f"<div><b>{html.escape(v)}</b><span>{html.escape(what)}</span></div>" for v, what in values)
    return f'<div class="facts">{"".join(cells)}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return a table of text. The columns `numbers` are set flush right; without any, narrow pages stack its cells."""
    if not rows:
        return ""

    def cell(tag: str, column: int, words: str) -> str:
        return f"<{tag}{' class=n' if column in numbers else ''}>{html.escape(words)}</{tag}>"

    lines = ["".join(cell("th", i, words) for i, words in enumerate(head))]
    lines += ["".join(cell("td", i, words) for i, words in enumerate(r)) for r in rows]
    kind = "" if numbers else ' class="words"'
    return f'<div class="scroll"><table{kind}>{"".join(f"<tr>{line}</tr>" for line in lines)}</table></div>'


def length_unit(unit: str) -> str:
    """Return how lengths of a world are named: `mm`, or `units` where no length is known."""
    return "mm" if unit == "mm" else "units"


def bullets(lines: Sequence[str]) -> str:
    """Return a list of sentences."""
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def folded(title: str, body: str) -> str:
    """Return a part that a click opens."""
    return f"<details><summary>{html.escape(title)}</summary>{body}</details>" if body else ""
