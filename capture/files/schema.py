"""Strangers' files as types: a value becomes what a file must hold, or one sentence says what is wrong where."""

import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, inspect

from capture.errors import CalibrationError, UserError
from capture.files.atomic import parse_json
from capture.files.regular import read_regular, why

LARGEST_FILE = 64 * 2**20  # bytes: the lights of a hundred thousand photos
LONGEST_NAME = 255  # letters of a file's name
LONGEST_TEXT = 10_000  # letters of a sentence
MOST_ENTRIES = 100_000  # of a list or an object
LARGEST_NUMBER = 1e15  # beyond, float64 holds no halves, and products of a few numbers soon overflow
LONGEST_SHOWN = 80  # letters of a wrong value in a sentence
CORRECT = "Calibrate again, or correct the file."
EXPORT = "Correct the file, or export the scene again."

Number = Annotated[float, Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]  # finite: comparisons refuse NaN
NotNegative = Annotated[float, Meta(ge=0, le=LARGEST_NUMBER)]
Positive = Annotated[float, Meta(gt=0, le=LARGEST_NUMBER)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Text = Annotated[str, Meta(max_length=LONGEST_TEXT)]
FileName = Annotated[
    str, Meta(pattern=r"\A(?!\.{1,2}\Z)[^/\0]+\Z", max_length=LONGEST_NAME, description="the name of a file")
]
Vector = tuple[Number, Number, Number]
Power = tuple[NotNegative, NotNegative, NotNegative]
Row = tuple[Number, Number, Number, Number]
Matrix = Annotated[tuple[Row, Row, Row, Row], Meta(description="4 rows of 4 numbers")]
Kind = TypeVar("Kind")

_WORDS = {"float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false", "null": "nothing"} | {
    "array": "a list",
    "object": "a table of names and values",
}
_BOUNDS = {">=": "of at least", "<=": "of at most", ">": "above", "<": "below"}


def as_type(
    value: Any, kind: type[Kind], file: str, advice: str = CORRECT, error: type[UserError] = CalibrationError
) -> Kind:
    """Return a value that a file holds, as JSON and TOML give it, as the type it must be of.

    Args:
        kind: of msgspec's types. A `description` in its Meta says what is needed there; a ValueError of a Struct's
            __post_init__ is a sentence without its dot.
        advice: what to do about a wrong value, a sentence.

    Raises:
        UserError: of the kind `error`: it is not; names the file, the place in it, what was found and what is needed.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as wrong:
        said, _, place = str(wrong).partition(" - at `")
        place = re.sub(r"^\$\.?", "", place.removeprefix("key` in `").removesuffix("`"))
        own = wrong.__cause__ is not None
        raise error(f"{file}: {_fault(said, own, place, value, kind)}. {advice}".rstrip()) from None


def refused(name: str, value: Any, needed: str) -> ValueError:
    """Return the error with which a Struct's __post_init__ refuses one of its fields."""
    return ValueError(f".{name} is {_shown(value)}; needed: {needed}")


def _shown(value: Any) -> str:
    shown = repr(value)
    return shown if len(shown) <= LONGEST_SHOWN else shown[: LONGEST_SHOWN - 3] + "..."


def check_numbers(value: Any, file: str, advice: str = CORRECT) -> None:
    """Check that every number in a value, at any depth, is one that a float can hold.

    Raises:
        CalibrationError: one is not; names its place.
    """
    left = [("", value)]
    while left:
        place, one = left.pop()
        if isinstance(one, dict):
            left += [(f"{place}.{name}".lstrip("."), inner) for name, inner in one.items()]
        elif isinstance(one, list):
            left += [(f"{place}[{k}]", inner) for k, inner in enumerate(one)]
        elif isinstance(one, int | float) and not abs(one) <= sys.float_info.max:
            raise CalibrationError(f"{file}: {place or 'the file'} is {one!s:.80}; needed: a finite number. {advice}")


def read_as(path: Path, kind: type[Kind], advice: str = CORRECT) -> tuple[Kind, Any]:
    """Return the JSON file of a run folder, which may be a stranger's, as a type, and as it stands.

    Raises:
        CalibrationError: it is no regular file, is too large, is not JSON, or a value is of another type; names it.
    """
    try:
        value = parse_json(read_regular(path, LARGEST_FILE).decode("utf-8-sig"))
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{path} cannot be read as JSON ({why(error)}). {advice}") from error
    check_numbers(value, str(path), advice)
    return as_type(value, kind, str(path), advice), value


def read_kept(path: Path, kind: type[Kind]) -> Kind | None:
    """Return a JSON file that the program keeps for itself as a type; None where it is missing or damaged."""
    try:
        return read_as(path, kind)[0]
    except UserError:
        return None


def read_text(path: Path) -> str:
    """Read a text file, without its byte-order mark; bytes that are not UTF-8 become replacement characters.

    Raises:
        CalibrationError: the file cannot be read, or is larger than LARGEST_FILE.
    """
    try:
        return read_regular(Path(os.path.realpath(path)), LARGEST_FILE).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read ({why(error)}). Check the file and its name.") from error


def read_json(path: Path) -> Any:
    """Return a JSON file of a capture or of another program's scene as it stands.

    Raises:
        CalibrationError: as `read_as`.
    """
    return read_scene(path, Any)


def read_scene(path: Path, kind: type[Kind]) -> Kind:
    """Return a JSON file of a capture or of another program's scene as a type; links to it are followed.

    Raises:
        CalibrationError: as `read_as`.
    """
    return read_as(Path(os.path.realpath(path)), kind, EXPORT)[0]


def _fault(said: str, own: bool, place: str, value: Any, kind: Any) -> str:
    """Return what is wrong in the words of a person."""
    if own:  # of a __post_init__
        return f"{place}{said}".lstrip(".") if said.startswith(".") else ": ".join(filter(None, (place, said)))
    steps = re.findall(r"[^.\[\]]+|\.\.\.", place)
    nodes, needed = _at(kind, steps)
    named = re.search(r"(missing required|unknown) field `(.*)`", said)
    if named and named[1] != "unknown":
        return f"{place}{'.' if place else ''}{named[2]} is missing"
    if named:
        known = ", ".join(field.encode_name for node in nodes for field in getattr(node, "fields", ()))
        return f"{place or 'the file'} has the unknown entry '{named[2]}'; {known} are known"
    for step in steps:
        if step == "...":  # one of an object's entries, whose name msgspec does not tell
            place, needed = place.partition("[...]")[0], needed or f"{_worded(said)} in each entry"
            break
        value = value[int(step)] if isinstance(value, list | tuple) else value[step]
    return f"{place or 'the file'} is {_shown(value)}; needed: {needed or _worded(said)}"


def _worded(said: str) -> str:
    """Return what msgspec expected."""
    if not said.startswith("Expected ") or str(LARGEST_NUMBER) in said:
        return "a finite number"
    needed = re.sub(r", got .*", "", said.removeprefix("Expected "))
    needed = re.sub(r"`(\w+)`", lambda name: _WORDS.get(name[1], name[1]), needed).replace(" | ", " or ")
    return re.sub(r"(?:of length )?([<>]=?) (\S+)", lambda found: f"{_BOUNDS[found[1]]} {found[2]}", needed)


def _at(kind: Any, steps: list[str]) -> tuple[list[inspect.Type], str | None]:
    """Return the types at a place of a type, and what is needed there: the nearest description, or its choices."""
    nodes, here = _unwrapped(inspect.type_info(kind))
    needed = here
    for step in steps:
        found = [inner for node in nodes for inner in _inner(node, step)]
        tags = [str(node.tag) for node in nodes if isinstance(node, inspect.StructType) and node.tag_field == step]
        if tags:
            return [], " or ".join(tags)
        nodes, here = _alternatives(found)
        needed = here or needed
    choices = [str(value) for node in nodes if isinstance(node, inspect.LiteralType) for value in node.values]
    return nodes, here or " or ".join(choices) or needed


def _unwrapped(node: inspect.Type) -> tuple[list[inspect.Type], str | None]:
    """Return the alternatives that a type allows, and its description."""
    if isinstance(node, inspect.Metadata):
        nodes, said = _unwrapped(node.type)
        return nodes, (node.extra_json_schema or {}).get("description", said)
    return _alternatives(node.types) if isinstance(node, inspect.UnionType) else ([node], None)


def _alternatives(types: Iterable[inspect.Type]) -> tuple[list[inspect.Type], str | None]:
    pairs = [_unwrapped(one) for one in types]
    return [node for nodes, _ in pairs for node in nodes], next((said for _, said in pairs if said), None)


def _inner(node: inspect.Type, step: str) -> list[inspect.Type]:
    """Return the type of what is inside at one step: a field's name, an index, or "..." in an object."""
    if isinstance(node, inspect.StructType | inspect.DataclassType):
        return [field.type for field in node.fields if field.encode_name == step]
    if isinstance(node, inspect.TupleType):
        return [node.item_types[int(step)]]
    if isinstance(node, inspect.ListType | inspect.VarTupleType):
        return [node.item_type]
    return [node.value_type] if isinstance(node, inspect.DictType) else []
