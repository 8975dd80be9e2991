"""shadowgraph.run: photos to mesh by one call."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from rich.console import Console

from capture.errors import UserError
from shadowgraph.options import ReconstructResearch, Run, run_with
from shadowgraph.run_command import results_folder, run_stages

if TYPE_CHECKING:
    from shadowgraph.run_result import RunResult


def run(capture: str | Path, out: str | Path | None = None, *, quiet: bool = False, **settings: Any) -> "RunResult":
    """Make a mesh of photos, as the command `shadowgraph run` does. The same call continues one that was interrupted.

        result = shadowgraph.run("photos/", preset="draft")
        result.mesh.export("head.stl")

    Args:
        capture: folder of photos, or a clip's folder, or a scene.
        out: folder for the results; runs/NAME unless given.
        quiet: no progress on standard output.
        settings: options of the command, with underscores: preset, board, lights, seed, time_budget, force, ...

    Raises:
        UserError: the input cannot be used; says what was found, what was needed and what to do.
    """
    from shadowgraph.run_result import RunResult

    _check_choices(settings)
    command = run_with(Path(capture), None if out is None else Path(out), **settings)
    run_stages(command, Console(quiet=quiet))
    return RunResult(results_folder(command))


def _check_choices(settings: Mapping[str, Any]) -> None:
    """Refuse settings that the command line would refuse."""
    hints = get_type_hints(Run) | get_type_hints(ReconstructResearch)
    known = [name for name in hints if name not in ("capture", "out", "viewer", "research")]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise TypeError(f"shadowgraph.run has no setting {unknown[0]!r}; {', '.join(known)} are known.")
    for name, value in settings.items():
        kinds = (hints.get(name), *get_args(hints.get(name)))
        choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
        if choices and value is not None and value not in choices:
            raise UserError(f"{name}={value!r}: one of {', '.join(map(repr, choices))} was needed.")
