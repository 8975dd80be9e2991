"""Read and write stage.json: notes, saved views and the way a finished run is shown; it may be a stranger's."""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from capture.errors import CalibrationError, ReconstructionError
from capture.files.atomic import parse_json, write_json
from capture.files.regular import why
from capture.files.schema import Number, as_type, read_as

STAGE = "stage.json"
FORMAT = 1
LARGEST = 1 << 20  # bytes
MOST_NOTES, MOST_VIEWS = 500, 200
LONGEST_NOTE = 500  # letters
LARGEST_LENGTH = 1e9  # world length
ADVICE = "Remove it, or ask for the folder again."
EMPTY: dict[str, Any] = {"format": FORMAT, "notes": [], "views": [], "crop": None, "guess": "shown", "smooth": 0.0}
Coordinate = Annotated[float, Meta(ge=-LARGEST_LENGTH, le=LARGEST_LENGTH)]
Place = Annotated[list[Coordinate], Meta(min_length=3, max_length=3, description="a list of 3 numbers")]
Words = Annotated[str, Meta(max_length=LONGEST_NOTE)]


class _Arrow(Struct, tag_field="kind", tag="arrow"):
    text: Words
    at: Place
    normal: Place


class _Length(_Arrow, tag_field="kind", tag="length"):
    to: Place


class _Seen(Struct):
    azimuth: Coordinate
    elevation: Coordinate
    distance: Coordinate
    focal: Coordinate
    shift: Annotated[list[Number], Meta(min_length=2, max_length=2, description="a list of 2 numbers")]


class _Lamp(Struct):
    azimuth: Coordinate
    elevation: Coordinate
    distance: Coordinate
    radius: Coordinate
    strength: Coordinate


class _View(Struct):
    name: Words
    view: _Seen
    lamp: _Lamp
    look: Words = "photo"


class _Crop(Struct):
    low: Place
    high: Place

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low is {self.low} and high {self.high}; needed: a box with low below high")


class _Stage(Struct):
    """stage.json."""

    format: Annotated[Literal[1], Meta(description="format 1, which this version reads")]
    notes: Annotated[list[_Arrow | _Length], Meta(max_length=MOST_NOTES)] = []
    views: Annotated[list[_View], Meta(max_length=MOST_VIEWS)] = []
    crop: _Crop | None = None
    guess: Literal["shown", "marked", "cut"] = "shown"
    smooth: Annotated[float, Meta(ge=0, le=LARGEST_LENGTH, description="a length from 0")] = 0.0


def read_stage_document(run_dir: Path) -> dict[str, Any] | None:
    """Return the content of stage.json, None where there is none.

    Raises:
        CalibrationError: it cannot be read, is of another format, or a value is of another kind; names it.
    """
    path = run_dir / STAGE
    if not path.exists() and not path.is_symlink():
        return None
    return msgspec.to_builtins(read_as(path, _Stage, ADVICE)[0])


def save_stage_document(run_dir: Path, content: bytes) -> None:
    """Write what a page sent as stage.json, whole or not at all.

    Raises:
        CalibrationError: it is none; names the value that is at fault.
        ReconstructionError: the run's folder cannot be written; says why.
    """
    document = parsed_stage(content)
    try:
        write_json(run_dir / STAGE, document)
    except OSError as error:
        raise ReconstructionError(f"{run_dir / STAGE} cannot be written ({error.strerror or error}).") from error


def parsed_stage(content: bytes) -> dict[str, Any]:
    """Return the document in some bytes, of which only what is known is kept.

    Raises:
        CalibrationError: it is none; names the value that is at fault.
    """
    if len(content) > LARGEST:
        raise CalibrationError(f"{STAGE}: {len(content):,} bytes were sent, at most {LARGEST:,} were needed.")
    try:
        value = parse_json(content.decode("utf-8"))
    except ValueError as error:
        raise CalibrationError(f"{STAGE} is not JSON ({why(error)}). Send the document again.") from error
    return msgspec.to_builtins(as_type(value, _Stage, STAGE, "Send the document again."))
