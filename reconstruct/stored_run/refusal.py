"""The sentences about a folder that is no run, and about a file of a run folder that cannot be used."""

from pathlib import Path

from capture.decode.formats import is_photo_name
from capture.errors import ReconstructionError
from capture.files.names import refuse_no_folder
from capture.files.regular import why

MAKE = "Run again, or ask for the file again."
OF_A_RUN = ("manifest.json", "log.jsonl", "calibration.json", "fields.safetensors", "mesh.ply", "report.json")
RUNS = Path("runs")  # where `shadowgraph run` puts a run whose folder is not named


def refuse_no_run(folder: Path) -> None:
    """Refuse a folder that holds no file of a run, and say what it holds and which command makes a run.

    Raises:
        CaptureError: there is no such folder.
        ReconstructionError: it is not that of a run.
    """
    refuse_no_folder(folder, "the folder of a run")
    if _is_run(folder):
        return
    inside = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    runs = [path for path in (*inside, RUNS / folder.resolve().name) if _is_run(path)]
    if runs:
        raise ReconstructionError(f"{folder} is not the folder of a run; {runs[0]} is one.")
    names = [path for place in (folder, *inside) for path in place.iterdir()]
    made_from = folder if any(map(is_photo_name, names)) else "CAPTURE"
    raise ReconstructionError(f"{folder} is not the folder of a run. `shadowgraph run {made_from}` makes one.")


def _is_run(folder: Path) -> bool:
    return any((folder / name).is_file() for name in OF_A_RUN)


def refusal(path: Path, error: Exception | str) -> ReconstructionError:
    """Return the error for a file that is missing, or that no run writes."""
    if isinstance(error, FileNotFoundError):
        return ReconstructionError(f"{path.name} is missing in {path.parent}: give the folder of a finished run.")
    reason = error if isinstance(error, str) else why(error)
    return ReconstructionError(f"{path} is not what a run writes ({reason}). {MAKE}")
