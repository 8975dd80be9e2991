"""Legends and remarks between controls, as HTML."""

import html
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from viewer.widgets.picture_panel import MUTED

Colour = tuple[int, int, int]  # sRGB
QUIET: Colour = (74, 78, 88)  # of a button that is not the main one


def swatches(rows: Sequence[tuple[Colour, str]]) -> str:
    """Return a legend of single colours."""
    return _framed(
        "".join(
            f'<div style="display:flex;align-items:center;gap:.5rem;margin:.15rem 0">'
            f'<span style="width:.95rem;height:.95rem;border-radius:3px;flex:none;background:rgb{colour}"></span>'
            f"<span>{html.escape(text)}</span></div>"
            for colour, text in rows
        )
    )


def bar(stops: Float[np.ndarray, "stops 3"], marks: Sequence[str], note: str = "") -> str:
    """Return a legend of a colour ramp with evenly spaced marks below it."""
    colours = ",".join(f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b in stops)
    below = "".join(f"<span>{html.escape(mark)}</span>" for mark in marks)
    return _framed(
        f'<div style="height:.8rem;border-radius:3px;background:linear-gradient(to right,{colours})"></div>'
        f'<div style="display:flex;justify-content:space-between;margin-top:.15rem">{below}</div>'
        f'<div style="{MUTED};margin-top:.25rem">{html.escape(note)}</div>'
    )


def remark(text: str) -> str:
    """Return a sentence in muted type, to stand between controls."""
    return _framed(f'<span style="{MUTED}">{html.escape(text)}</span>') if text else ""


def _framed(content: str) -> str:
    return f'<div style="padding:.15rem .75rem .45rem;font-size:.86rem;line-height:1.35">{content}</div>'
