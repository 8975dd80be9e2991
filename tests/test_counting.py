"""One count of photos for every sentence of the studio: by role, left out, and used by a run."""

import shutil
from pathlib import Path

import pytest
from studio_client import served
from test_left_out import LIT, save_capture, truncated
from waiting import wait_until

from viewer.studio.library import counts_of


def photo(role: str, drop: bool = False, looked: bool = True) -> dict[str, object]:
    return {"role": role, "drop": drop, "looked": looked}


LIT_36, BOARD_9 = [photo("lit")] * 36, [photo("board")] * 9
NO_CHECK = {"is_old": True, "numbers": {"photos": 9, "photos_used": 9}}


@pytest.mark.parametrize(
    ("photos", "check", "words", "start", "uses"),
    [
        (LIT_36 + BOARD_9, NO_CHECK, "45 photos: 36 under the flashlight, 9 of the board", "Start", "36 of 36 photos"),
        (
            [*LIT_36, photo("lit", drop=True), photo("board", drop=True)],
            NO_CHECK,
            "38 photos: 36 under the flashlight, 2 left out",
            "Leave 2 out and go on",
            "36 of 37 photos",
        ),
        (
            [*LIT_36, *BOARD_9],
            {"is_old": False, "numbers": {"photos": 36, "photos_used": 35}},
            "45 photos: 35 under the flashlight, 9 of the board, 1 left out",
            "Leave it out and go on",
            "35 of 36 photos",
        ),
        (
            [photo("lit")] * 20 + [photo("", looked=False)] * 16,
            NO_CHECK,
            "36 photos: 20 under the flashlight, 16 not looked at yet",
            "Start",
            "",
        ),
        ([photo("lit")], NO_CHECK, "1 photo: 1 under the flashlight", "Start", "1 of 1 photo "),
        ([], NO_CHECK, "0 photos", "Start", ""),
    ],
)
def test_all_sentences_have_one_count(photos, check, words, start, uses):
    found = counts_of(photos, check)
    assert found["words"] == words and found["start"] == start and found["uses"].startswith(uses)


def test_the_studio_counts_what_the_coach_saw_and_names_a_copy_on_arrival(tmp_path):
    folder = save_capture(tmp_path / "captures" / "vase", True)
    photos = folder / "photos"
    truncated(photos / LIT[0])
    shutil.copy(photos / LIT[1], photos / f"{Path(LIT[1]).stem} (1).jpg")
    with served(tmp_path) as (_, _, client):

        def row():
            return client.get("/api/capture?key=captures%2Fvase")[1]

        assert {one["role"] for one in row()["photos"]} == {"board", "lit"}, "before anything is looked at"
        wait_until(lambda: all(one["looked"] for one in row()["photos"]))
        found = row()
    bad = {one["name"].split("/")[-1]: one["remarks"][0][0] for one in found["photos"] if one["drop"]}
    assert bad == {LIT[0]: "unreadable", f"{Path(LIT[1]).stem} (1).jpg": "copy"}
    assert found["counts"]["words"] == "8 photos: 5 under the flashlight, 1 of the board, 2 left out"
    assert found["counts"]["start"] == "Leave 2 out and go on"
    assert found["counts"]["uses"] == "5 of 7 photos under the flashlight will be used."
