"""Files that arrive: whole, once, under safe names, in the right folder; archives within limits."""

import asyncio
import io
import stat
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture.errors import CaptureError
from capture.intake import archive, arrivals
from capture.intake.arrivals import place_in, refuse_size, safe_name, settle
from capture.intake.parts import OffsetError, Parts
from capture.session.session import load_settings
from capture.session.write_settings import set_entry, set_role


def jpeg(seed: int = 0) -> bytes:
    file = io.BytesIO()
    pixels = np.random.default_rng(seed).integers(0, 255, (40, 60, 3), np.uint8)
    Image.fromarray(pixels).save(file, "JPEG")
    return file.getvalue()


async def pieces(*contents: bytes) -> AsyncIterator[bytes]:
    for content in contents:
        yield content


@pytest.fixture
def studio(tmp_path: Path) -> Path:
    (tmp_path / "vase").mkdir()
    return tmp_path


def send(parts: Parts, name: str, content: bytes, role: str = ""):
    part = parts.begin("vase", name, len(content), role)
    asyncio.run(parts.append(part, 0, pieces(content)))
    return parts.finish(part)


@pytest.mark.parametrize(
    ("given", "safe"),
    [
        ("IMG_0001.JPG", "IMG_0001.JPG"),
        ("../../etc/passwd.jpg", "passwd.jpg"),
        ("C:\\Users\\me\\a b.heic", "a b.heic"),
        ("..jpg", "jpg"),
        ("<script>.jpg", "_script_.jpg"),
        ("con.jpg", "_con.jpg"),
        ("a\0b\n.png", "a_b_.png"),
        ("x" * 300 + ".jpg", "x" * 80 + ".jpg"),
    ],
)
def test_names_of_strangers_become_names_that_every_system_takes(given, safe):
    assert safe_name(given) == safe


def test_a_name_of_nothing_is_refused():
    with pytest.raises(CaptureError, match="no name of a file"):
        safe_name("///")


def test_role_folders_of_a_drop_are_kept_and_all_other_structure_is_not(studio):
    vase = studio / "vase"
    assert place_in(vase, "My shots/photos/sub/IMG_1.jpg") == vase / "photos" / "IMG_1.jpg"
    assert place_in(vase, "IMG_1.jpg") == vase / "IMG_1.jpg"
    (vase / "photos").mkdir()
    assert place_in(vase, "IMG_1.jpg") == vase / "photos" / "IMG_1.jpg"
    assert place_in(vase, "IMG_1.jpg", "board") == vase / "board" / "IMG_1.jpg"
    assert place_in(vase, "x/session.toml") == vase / "session.toml"
    loose = studio / "loose"
    loose.mkdir()
    (loose / "IMG_1.jpg").write_bytes(jpeg())
    assert place_in(loose, "photos/IMG_2.jpg") == loose / "IMG_2.jpg", "photos/ would hide the loose ones"


def test_a_copy_is_kept_once_and_another_photo_of_the_same_name_gets_a_number(studio):
    parts = Parts(studio / "parts", studio)
    names = [send(parts, "IMG_1.jpg", jpeg(seed)).arrived for seed in (1, 1, 2)]
    assert names == [("IMG_1.jpg",), ("IMG_1.jpg",), ("IMG_1-2.jpg",)]
    assert (studio / "vase" / "IMG_1-2.jpg").read_bytes() == jpeg(2)


def test_a_file_cut_off_anywhere_goes_on_after_the_server_was_started_anew(studio):
    content = jpeg()
    part = Parts(studio / "parts", studio).begin("vase", "a.jpg", len(content))
    for cut in (0, 1, len(content) // 2, len(content) - 1):
        parts = Parts(studio / "parts", studio)
        known = parts.find(part.id)
        have = parts.offset(known)
        asyncio.run(parts.append(known, have, pieces(content[have:cut])))
        assert parts.offset(known) == cut
    parts = Parts(studio / "parts", studio)
    asyncio.run(parts.append(parts.find(part.id), len(content) - 1, pieces(content[-1:])))
    again = Parts(studio / "parts", studio)  # killed before the file was put into its capture
    (whole,) = again.unfinished()
    assert again.finish(whole).arrived == ("a.jpg",)
    assert (studio / "vase" / "a.jpg").read_bytes() == content
    told = Parts(studio / "parts", studio).find(part.id)
    assert told.is_over and Parts(studio / "parts", studio).offset(told) == len(content)


def test_a_file_that_its_capture_had_no_room_for_waits_and_is_put_there_later(studio, monkeypatch):
    parts = Parts(studio / "parts", studio)
    with monkeypatch.context() as patch:
        patch.setattr("capture.intake.parts.settle", _refused)
        with pytest.raises(OSError, match="Read-only"):
            send(parts, "a.jpg", jpeg())
        parts.try_again()
        Parts(studio / "parts", studio).try_again()  # started anew meanwhile
        assert [part.name for part in parts.unfinished()] == ["a.jpg"] and not list((studio / "vase").iterdir())
    parts.try_again()
    assert not parts.unfinished() and (studio / "vase" / "a.jpg").read_bytes() == jpeg()


def test_a_file_whose_arrival_could_not_be_noted_is_there_once(studio, monkeypatch):
    parts = Parts(studio / "parts", studio)
    part = parts.begin("vase", "a.jpg", len(jpeg()))
    asyncio.run(parts.append(part, 0, pieces(jpeg())))
    with monkeypatch.context() as patch:
        patch.setattr("capture.intake.parts.write_json", _refused)
        with pytest.raises(OSError, match="Read-only"):
            parts.finish(part)
    parts.try_again()
    assert parts.find(part.id).arrived == ("a.jpg",) and not parts.unfinished()
    again = Parts(studio / "parts", studio)
    again.try_again()
    assert not again.unfinished() and [path.name for path in (studio / "vase").iterdir()] == ["a.jpg"]


def _refused(*_: object) -> None:
    raise OSError(30, "Read-only file system")


def test_a_piece_that_begins_elsewhere_is_told_where_and_one_that_is_too_long_is_refused(studio):
    parts = Parts(studio / "parts", studio)
    part = parts.begin("vase", "a.jpg", 10)
    with pytest.raises(OffsetError) as told:
        asyncio.run(parts.append(part, 3, pieces(b"x")))
    assert told.value.offset == 0
    with pytest.raises(CaptureError, match="goes on beyond"):
        asyncio.run(parts.append(part, 0, pieces(b"x" * 11)))


def test_a_newer_connection_takes_over_from_one_that_has_not_noticed_its_end(studio):
    parts = Parts(studio / "parts", studio)
    part = parts.begin("vase", "a.jpg", 8)

    async def both():
        reached = asyncio.Event()

        async def slow() -> AsyncIterator[bytes]:
            yield b"ab"
            reached.set()
            await asyncio.sleep(0.05)
            yield b"OLD"

        old = asyncio.create_task(parts.append(part, 0, slow()))
        await reached.wait()
        await parts.append(part, 2, pieces(b"cdefgh"))
        with pytest.raises(OffsetError):
            await old

    asyncio.run(both())
    assert (studio / "parts" / f"{part.id}.part").read_bytes() == b"abcdefgh"


def test_what_is_no_photo_is_refused_before_and_after_it_was_sent(studio):
    parts = Parts(studio / "parts", studio)
    with pytest.raises(CaptureError, match="no photo and no clip"):
        parts.begin("vase", "virus.exe", 10)
    with pytest.raises(CaptureError, match="at most"):
        parts.begin("vase", "a.jpg", arrivals.LARGEST_PHOTO + 1)
    refused = send(parts, "a.jpg", b"MZ this is a program")
    assert "holds no photo" in refused.refused and not list((studio / "vase").iterdir())


def test_a_full_disk_is_a_sentence(studio, monkeypatch):
    monkeypatch.setattr(arrivals, "KEEP_FREE", 1 << 60)
    with pytest.raises(CaptureError, match="GB free"):
        refuse_size("a.jpg", 1000, studio)


def test_settle_never_writes_through_a_link(studio):
    outside = studio / "outside.jpg"
    outside.write_bytes(b"mine")
    (studio / "vase" / "a.jpg").symlink_to(outside)
    part = studio / "x.part"
    part.write_bytes(jpeg())
    assert settle(part, studio / "vase" / "a.jpg").name == "a-2.jpg"
    assert outside.read_bytes() == b"mine"


def zipped(entries: dict[str, bytes], links: tuple[str, ...] = ()) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in entries.items():
            made.writestr(name, content)
        for name in links:
            entry = zipfile.ZipInfo(name)
            entry.external_attr = (stat.S_IFLNK | 0o777) << 16
            made.writestr(entry, "/etc/passwd")
    return file.getvalue()


def test_a_zip_is_unpacked_without_what_leads_elsewhere_and_says_what_was_left_out(studio):
    entries = {"v/photos/a.jpg": jpeg(1), "v/board/b.jpg": jpeg(2), "../../../c.jpg": jpeg(3), "v/gt/d.jpg": jpeg(4)}
    entries |= {"__MACOSX/v/a.jpg": b"fork", "v/.hidden.jpg": b"x", "v/readme.txt": b"words"}
    done = send(Parts(studio / "parts", studio), "v.zip", zipped(entries, links=("v/photos/link.jpg",)))
    assert done.arrived == ("photos/a.jpg", "board/b.jpg", "photos/c.jpg")
    assert len(done.remarks) == 2 and "readme.txt" in done.remarks[0] and "link" in done.remarks[1]
    assert sorted(p.name for p in studio.rglob("*.jpg")) == ["a.jpg", "b.jpg", "c.jpg"]


def test_a_zip_that_lies_about_its_sizes_or_is_none_is_refused(studio, monkeypatch):
    monkeypatch.setattr(arrivals, "LARGEST_PHOTO", 10_000)
    bomb = send(Parts(studio / "parts", studio), "v.zip", zipped({"a.jpg": b"\xff\xd8\xff" + bytes(10_000_000)}))
    assert "holds no photos" in bomb.refused and not list((studio / "vase").iterdir())
    assert "damaged" in send(Parts(studio / "parts", studio), "w.zip", b"PK nothing").refused
    monkeypatch.setattr(archive, "MOST_ENTRIES", 3)
    many = zipped({f"{k}.jpg": jpeg(k) for k in range(4)})
    assert "at most 3" in send(Parts(studio / "parts", studio), "m.zip", many).refused


def test_a_role_that_the_sender_says_is_kept_in_a_flat_capture(studio):
    parts = Parts(studio / "parts", studio)
    send(parts, "a.jpg", jpeg(1))
    send(parts, "b.jpg", jpeg(2), "board")
    assert load_settings(studio / "vase").roles == (("board", ("b.jpg",)),)


def test_settings_are_changed_one_by_one_and_a_wrong_one_leaves_the_file_as_it_was(studio):
    vase = studio / "vase"
    (vase / "session.toml").write_text('led_offset_mm = [1.5, 0, -2]\nscale = "120 mm"\n')
    set_entry(vase, "board", "card")
    settings = load_settings(vase)
    assert settings.board == "card" and settings.led_offset_mm == (1.5, 0, -2) and settings.scale == 120
    before = (vase / "session.toml").read_bytes()
    with pytest.raises(CaptureError, match="scale"):
        set_entry(vase, "scale", "long")
    assert (vase / "session.toml").read_bytes() == before
    set_entry(vase, "board", None)
    assert load_settings(vase).board is None


def test_a_photo_of_a_sorted_capture_moves_to_the_folder_of_its_role(studio):
    vase = studio / "vase"
    (vase / "photos").mkdir()
    (vase / "photos" / "a.jpg").write_bytes(jpeg())
    set_role(vase, "photos/a.jpg", "board")
    assert (vase / "board" / "a.jpg").is_file() and not (vase / "photos" / "a.jpg").exists()
    with pytest.raises(CaptureError, match="no role"):
        set_role(vase, "board/a.jpg", "../x")
