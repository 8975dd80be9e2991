"""Render a capture folder with ground truth: any mesh, a printed board, a flashlight around it.

    pip install 'shadowgraph[generator]'
    python examples/make_capture.py vase --shape vase --gloss 0.5
    shadowgraph run vase --board charuco:5x7:30:22:DICT_4X4_50
    shadowgraph evaluate runs/vase --reference vase

As phones and living rooms give them: --hard. docs/generator.md says what that is, and what lies in gt/.
Exit code 2: a setting cannot be used; one sentence says why.
"""

import importlib.util
import sys
from pathlib import Path
from typing import Annotated

import tyro
from generator.options import Setup
from tyro.conf import OmitArgPrefixes, Positional, arg

from capture.errors import UserError

DEFAULTS = Setup()


def render(out: Annotated[Positional[Path], arg(metavar="OUT")], setup: OmitArgPrefixes[Setup] = DEFAULTS) -> None:
    """Render a capture folder with ground truth.

    Args:
        out: A new folder.
    """
    missing = [name for name in ("mitsuba", "embreex") if importlib.util.find_spec(name) is None]
    if missing:
        sys.exit(f"{' and '.join(missing)} not installed. Run: pip install 'shadowgraph[generator]'")
    from generator.capturing import make_capture

    try:
        make_capture(out, setup, lambda text: print(f"\r{text:<40}", end="", flush=True, file=sys.stderr))
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(f"\r{f'{out} written':<40}", file=sys.stderr)


if __name__ == "__main__":
    tyro.cli(render, description=__doc__)
