"""Reading a JSON file that somebody may have edited: every wrong value is refused by its name."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.errors import CalibrationError
from capture.files.atomic import parse_json

Vector = Float[np.ndarray, "3"]
LARGEST_FILE = 64 * 2**20  # bytes: the lights of a hundred thousand photos
UNIT_ATOL = 1e-6  # directions are computed in float64 and written in full


@dataclass(frozen=True)
class JsonField:
    """A value of the file and its name there, for messages."""

    value: Any
    file: str
    name: str = ""

    def refuse(self, needed: str) -> CalibrationError:
        """The error that says what stands here and what was needed."""
        shown = repr(self.value)
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        return CalibrationError(
            f"{self.file}: {self.name or 'the file'} is {shown}, {needed} needed. Calibrate again, or correct the file."
        )

    def __getitem__(self, key: str) -> "JsonField":
        """The object's entry of this name."""
        if not isinstance(self.value, dict):
            raise self.refuse("an object was")
        name = f"{self.name}.{key}" if self.name else key
        if key not in self.value:
            raise CalibrationError(f"{self.file}: {name} is missing. Calibrate again, or correct the file.")
        return JsonField(self.value[key], self.file, name)

    def entries(self) -> "list[JsonField]":
        """The list's entries, each with its name."""
        if not isinstance(self.value, list):
            raise self.refuse("a list was")
        return [JsonField(value, self.file, f"{self.name}[{i}]") for i, value in enumerate(self.value)]

    def number(self, above: float = -np.inf) -> float:
        """A finite number above the limit."""
        if type(self.value) not in (int, float) or not _is_finite(self.value) or self.value <= above:
            raise self.refuse("a finite number was" if above == -np.inf else f"a finite number above {above:g} was")
        return float(self.value)

    def count(self) -> int:
        """A whole number from 1."""
        if type(self.value) is not int or self.value < 1:
            raise self.refuse("a whole number from 1 was")
        return self.value

    def flag(self) -> bool:
        """true or false."""
        if type(self.value) is not bool:
            raise self.refuse("true or false was")
        return self.value

    def text(self, *choices: str) -> str:
        """Text, one of the choices if there are any."""
        if not isinstance(self.value, str) or (choices and self.value not in choices):
            raise self.refuse(f"{' or '.join(choices)} was" if choices else "text was")
        return self.value

    def numbers(self, n: int | None = None) -> list[float]:
        """A list of finite numbers, n of them if given."""
        entries = self.entries()
        if n is not None and len(entries) != n:
            raise self.refuse(f"a list of {n} numbers was")
        return [entry.number() for entry in entries]

    def vector(self) -> Vector:
        """Three finite numbers."""
        return np.array(self.numbers(3))

    def not_negative(self) -> Vector:
        """Three finite numbers from 0."""
        vector = self.vector()
        if (vector < 0).any():
            raise self.refuse("three numbers from 0 were")
        return vector

    def unit_vector(self) -> Vector:
        """Three numbers of length 1."""
        vector = self.vector()
        if abs(np.linalg.norm(vector) - 1) > UNIT_ATOL:
            raise self.refuse("a direction of length 1 was")
        return vector

    def any_numbers(self) -> dict[str, Any]:
        """The object, in which every number at any depth is finite."""
        if not isinstance(self.value, dict):
            raise self.refuse("an object was")
        self._refuse_nan()
        return self.value

    def _refuse_nan(self) -> None:
        if isinstance(self.value, dict):
            for key in self.value:
                self[key]._refuse_nan()
        elif isinstance(self.value, list):
            for entry in self.entries():
                entry._refuse_nan()
        elif isinstance(self.value, float) and not np.isfinite(self.value):
            raise self.refuse("a finite number was")


def _is_finite(value: int | float) -> bool:
    """Whether it is a float's number: JSON's whole numbers have no end."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def read_text(path: Path) -> str:
    """The text of a file of at most LARGEST_FILE, without a byte-order mark; what is no UTF-8 becomes question marks.

    Raises:
        CalibrationError: no such file, or too large.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise CalibrationError(
                f"{path} is larger than {LARGEST_FILE >> 20} MB; a description of a scene is smaller."
            )
        return path.read_text("utf-8-sig", errors="replace")
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read ({error.strerror}). Check the file and its name.") from error


def read_json(path: Path) -> Any:
    """What a JSON file holds; no larger than LARGEST_FILE and not nested without end.

    Raises:
        CalibrationError: no such file, too large, or not JSON.
    """
    text = read_text(path)
    try:
        return parse_json(text)
    except ValueError as error:  # no JSON, or digits and brackets without end
        raise CalibrationError(f"{path} is not JSON ({error}); export the scene again.") from error


def read_object(path: Path, member: str) -> dict[str, Any]:
    """The JSON object of a scene's file; `member` is what the message says it should have.

    Raises:
        CalibrationError: not JSON, or no object.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} holds a {type(content).__name__}, an object with '{member}' is needed.")
    return content
