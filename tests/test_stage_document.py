"""stage.json, which a page of a stranger may have sent: only what is known is kept, and what is wrong is named."""

import json

import pytest

from capture.errors import CalibrationError
from reconstruct.stored_run.stage_document import EMPTY, LARGEST, parsed_stage, read_stage_document, save_stage_document

NOTE = {"kind": "arrow", "text": "a crack", "at": [1.0, 2, 3], "normal": [0, 0, 1]}
VIEW = {
    "name": "from the left",
    "view": {"azimuth": 0.5, "elevation": 0.4, "distance": 300, "focal": 2, "shift": [0.1, 0]},
    "lamp": {"azimuth": 0, "elevation": 1, "distance": 900, "radius": 50, "strength": 0.9},
    "look": "unsharp",
}
FULL = EMPTY | {"notes": [NOTE], "views": [VIEW], "crop": {"low": [0, 0, 0], "high": [9, 9, 9]}, "guess": "cut"}


def test_what_was_saved_is_read_again(tmp_path):
    assert read_stage_document(tmp_path) is None
    save_stage_document(tmp_path, json.dumps(FULL).encode())
    found = read_stage_document(tmp_path)
    assert found is not None
    assert found["notes"] == [NOTE] and found["views"] == [VIEW] and found["crop"] == FULL["crop"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["stage.json"]


@pytest.mark.parametrize(
    "change, named",
    [
        ({"format": 7}, "format"),
        ({"notes": [NOTE | {"at": [1, 2]}]}, r"notes\[0\]\.at"),
        ({"notes": [NOTE | {"at": [1, 2, 1e300]}]}, r"notes\[0\]\.at"),
        ({"notes": [NOTE | {"kind": "script"}]}, r"notes\[0\]\.kind"),
        ({"notes": [NOTE | {"text": "a" * 501}]}, r"notes\[0\]\.text"),
        ({"notes": [NOTE] * 501}, "notes"),
        ({"views": [VIEW | {"lamp": {}}]}, r"views\[0\]\.lamp"),
        ({"crop": {"low": [0, 0, 0], "high": [1, 0, 1]}}, "crop"),
        ({"guess": "hidden"}, "guess"),
        ({"smooth": -1}, "smooth"),
    ],
)
def test_a_document_that_is_none_is_refused_by_name_and_changes_nothing(tmp_path, change, named):
    save_stage_document(tmp_path, json.dumps(FULL).encode())
    before = (tmp_path / "stage.json").read_bytes()
    with pytest.raises(CalibrationError, match=named):
        save_stage_document(tmp_path, json.dumps(FULL | change).encode())
    assert (tmp_path / "stage.json").read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"1" * (LARGEST + 1), b"NaN"])
def test_bytes_that_are_no_document_are_refused(content):
    with pytest.raises(CalibrationError):
        parsed_stage(content)
