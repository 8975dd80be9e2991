"""A value of a stranger's file that is of another type is named: file, place, what it is, and what is needed there."""

from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta, Struct

from capture.errors import CalibrationError, CaptureError
from capture.files.schema import Count, FileName, Number, Vector, as_type, check_numbers


class Lamp(Struct, forbid_unknown_fields=True):
    power: Number
    at: Annotated[Vector, Meta(description="x, y and z in mm")] = (0.0, 0.0, 0.0)
    kind: Literal["point", "sun"] = "point"
    photo: FileName = "a.jpg"

    def __post_init__(self) -> None:
        if self.kind == "sun" and self.at[2] < 0:
            raise ValueError("the sun is below the ground; needed: a sun above it")


class File(Struct):
    lights: Annotated[list[Lamp], Meta(max_length=2)]
    sizes: dict[str, Count] = {}


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ([], r"the file is \[\]; needed: a table of names and values"),
        ({}, "lights is missing"),
        ({"lights": 3}, "lights is 3; needed: a list"),
        ({"lights": [{"power": 1}] * 3}, "lights is .*; needed: a list of at most 2"),
        ({"lights": [{"power": 1}, {"power": "x"}]}, r"lights\[1\].power is 'x'; needed: a number"),
        ({"lights": [{"power": float("nan")}]}, r"lights\[0\].power is nan; needed: a finite number"),
        ({"lights": [{"power": 10**400}]}, r"lights\[0\].power is 1000*\.\.\.; needed: a finite number"),
        ({"lights": [{}]}, r"lights\[0\].power is missing"),
        ({"lights": [{"power": 1, "at": [1, 2]}]}, r"lights\[0\].at is \[1, 2\]; needed: x, y and z in mm"),
        ({"lights": [{"power": 1, "at": [1, 2, True]}]}, r"lights\[0\].at\[2\] is True; needed: x, y and z in mm"),
        ({"lights": [{"power": 1, "kind": "led"}]}, r"lights\[0\].kind is 'led'; needed: point or sun"),
        ({"lights": [{"power": 1, "photo": "../a"}]}, r"lights\[0\].photo is '../a'; needed: the name of a file"),
        ({"lights": [{"powr": 1, "power": 1}]}, r"lights\[0\] has the unknown entry 'powr'; power, .* are known"),
        ({"lights": [{"power": 1, "kind": "sun", "at": [0, 0, -1]}]}, r"lights\[0\]: the sun is below the ground; .*"),
        ({"lights": [], "sizes": {"a": -1}}, r"sizes is {'a': -1}; needed: a whole number of at least 0 in each entry"),
    ],
)
def test_a_wrong_value_is_named_with_what_is_needed_there(value: Any, sentence: str):
    with pytest.raises(CaptureError, match=rf"^x\.json: {sentence}\. Mend it\.$"):
        as_type(value, File, "x.json", "Mend it.", CaptureError)


def test_a_right_value_becomes_what_it_is():
    found = as_type({"lights": [{"power": 1, "at": [1, 2, 3]}], "more": "is not read"}, File, "x.json")
    assert found == File([Lamp(1.0, (1.0, 2.0, 3.0))])


@pytest.mark.parametrize(
    ("value", "place"),
    [(float("inf"), "the file"), ({"a": [1, {"b": float("nan")}]}, r"a\[1\].b"), ([[10**400]], r"\[0\]\[0\]")],
)
def test_a_number_that_no_float_holds_is_found_at_any_depth(value: Any, place: str):
    with pytest.raises(CalibrationError, match=f"^x: {place} is .*; needed: a finite number"):
        check_numbers(value, "x")
