"""The sentence about a file of a run folder that cannot be used."""

from pathlib import Path

from capture.errors import ReconstructionError
from capture.files.regular import why

MAKE = "Run again, or ask for the file again."


def refusal(path: Path, error: Exception | str) -> ReconstructionError:
    """Return the error for a file that is missing, or that no run writes."""
    if isinstance(error, FileNotFoundError):
        return ReconstructionError(f"{path.name} is missing in {path.parent}: give the folder of a finished run.")
    reason = error if isinstance(error, str) else why(error)
    return ReconstructionError(f"{path} is not what a run writes ({reason}). {MAKE}")
