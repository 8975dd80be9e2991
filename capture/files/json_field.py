"""Read a JSON file that somebody may have edited: the error about a wrong value names it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.errors import CalibrationError
from capture.files.atomic import parse_json
from capture.files.regular import why
from capture.files.schema import (
    CORRECT,
    LARGEST_FILE,
    LARGEST_NUMBER,
    LONGEST_NAME,
    LONGEST_TEXT,
    MOST_ENTRIES,
    read_value,
)

Vector = Float[np.ndarray, "3"]
UNIT_ATOL = 1e-6  # directions are computed in float64 and written in full


@dataclass(frozen=True)
class JsonField:
    """A value of a JSON file, with its name there for messages. Methods raise CalibrationError for another type."""

    value: Any
    file: str
    name: str = ""
    advice: str = CORRECT  # what to do about a wrong value, in a sentence

    def refuse(self, needed: str) -> CalibrationError:
        """Return the error that states this value and what was needed instead."""
        shown = repr(self.value)
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        return CalibrationError(f"{self.file}: {self.name or 'the file'} is {shown}, {needed} needed. {self.advice}")

    def __getitem__(self, key: str) -> "JsonField":
        """Return the object's entry with this name."""
        if not isinstance(self.value, dict):
            raise self.refuse("an object was")
        name = f"{self.name}.{key}" if self.name else key
        if key not in self.value:
            raise CalibrationError(f"{self.file}: {name} is missing. {self.advice}")
        return JsonField(self.value[key], self.file, name, self.advice)

    def get(self, key: str, default: Any) -> "JsonField":
        """Return the object's entry with this name; one that holds `default` if there is none, or null in its place."""
        if isinstance(self.value, dict) and self.value.get(key) is None:
            name = f"{self.name}.{key}" if self.name else key
            return JsonField(default, self.file, name, self.advice)
        return self[key]

    def items(self) -> "dict[str, JsonField]":
        """Return the object's entries by their names."""
        if not isinstance(self.value, dict):
            raise self.refuse("an object was")
        if len(self.value) > MOST_ENTRIES or max(map(len, self.value), default=0) > LONGEST_TEXT:
            raise self.refuse(f"an object of at most {MOST_ENTRIES} entries with short names was")
        return {key: self[key] for key in self.value}

    def entries(self, most: int = MOST_ENTRIES) -> "list[JsonField]":
        """Return the list's entries, of which there may be `most`, each with its name."""
        if not isinstance(self.value, list):
            raise self.refuse("a list was")
        if len(self.value) > most:
            said = f"{self.name or 'the file'} has {len(self.value):,} entries, at most {most:,} were needed"
            raise CalibrationError(f"{self.file}: {said}. {self.advice}")
        return [JsonField(value, self.file, f"{self.name}[{i}]", self.advice) for i, value in enumerate(self.value)]

    def number(self, above: float = -np.inf, most: float = LARGEST_NUMBER) -> float:
        """Return the value as a finite number greater than `above`, and not beyond `most` on either side of 0."""
        if type(self.value) not in (int, float) or not _is_finite(self.value) or self.value <= above:
            raise self.refuse("a finite number was" if above == -np.inf else f"a finite number above {above:g} was")
        if abs(self.value) > most:
            raise self.refuse(f"a number from {max(above, -most):g} to {most:g} was")
        return float(self.value)

    def count(self, least: int = 1, most: int = 2**53) -> int:
        """Return the value as a whole number from `least` to `most`."""
        if type(self.value) is not int or not least <= self.value <= most:
            raise self.refuse(f"a whole number from {least} {f'to {most} ' if most < 2**53 else ''}was")
        return self.value

    def flag(self) -> bool:
        """Return the value as true or false."""
        if type(self.value) is not bool:
            raise self.refuse("true or false was")
        return self.value

    def text(self, *choices: str) -> str:
        """Return the value as text; it must be one of the choices, if there are any."""
        if not isinstance(self.value, str) or (choices and self.value not in choices):
            raise self.refuse(f"{' or '.join(choices)} was" if choices else "text was")
        if len(self.value) > LONGEST_TEXT:
            raise self.refuse(f"a text of at most {LONGEST_TEXT} letters was")
        return self.value

    def file_name(self) -> str:
        """Return the value as the name of a file in its folder: no path leads elsewhere."""
        name = self.text()
        if not name or len(name) > LONGEST_NAME or name in (".", "..") or any(c in name for c in "/\0"):
            raise self.refuse("the name of a file was")
        return name

    def numbers(self, n: int | None = None) -> list[float]:
        """Return the value as a list of finite numbers, of length n if given."""
        entries = self.entries()
        if n is not None and len(entries) != n:
            raise self.refuse(f"a list of {n} numbers was")
        return [entry.number() for entry in entries]

    def vector(self) -> Vector:
        """Return the value as three finite numbers."""
        return np.array(self.numbers(3))

    def not_negative(self) -> Vector:
        """Return the value as three finite numbers, none below 0."""
        vector = self.vector()
        if (vector < 0).any():
            raise self.refuse("three numbers from 0 were")
        return vector

    def unit_vector(self) -> Vector:
        """Return the value as a vector of length 1."""
        vector = self.vector()
        if abs(np.linalg.norm(vector) - 1) > UNIT_ATOL:
            raise self.refuse("a direction of length 1 was")
        return vector


def _is_finite(value: int | float) -> bool:
    """Return whether a float can hold the number; whole numbers in JSON can be of any length."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def read_text(path: Path) -> str:
    """Read a text file, without its byte-order mark; bytes that are not UTF-8 become replacement characters.

    Raises:
        CalibrationError: the file cannot be read, or is larger than LARGEST_FILE.
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
    """Read a JSON file of limited size and depth.

    Raises:
        CalibrationError: the file cannot be read, is larger than LARGEST_FILE, is not JSON, or is nested too deeply.
    """
    text = read_text(path)
    try:
        return parse_json(text)
    except ValueError as error:  # no JSON, or digits and brackets without end
        raise CalibrationError(f"{path} is not JSON ({why(error)}); export the scene again.") from error


def read_document(path: Path, advice: str = CORRECT) -> JsonField:
    """Read the JSON file of a run folder, which may be a stranger's.

    Raises:
        CalibrationError: it is no regular file, is too large, or is not JSON.
    """
    return JsonField(read_value(path, advice), str(path), "", advice)


def read_object(path: Path, member: str) -> dict[str, Any]:
    """Read a scene's file that holds a JSON object; `member` is an entry that the error message asks for.

    Raises:
        CalibrationError: the file is not JSON, or holds no object.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} holds a {type(content).__name__}, an object with '{member}' is needed.")
    return content
