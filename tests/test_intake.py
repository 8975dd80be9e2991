"""Files that arrive: whole, once, under safe names, in the right folder; archives within limits."""

import asyncio
import io
import stat
import struct
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture.errors import CaptureError
from capture.intake import arrivals
from capture.intake import parts as intake
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
        ("写" * 300 + ".jpg", "写" * 26 + ".jpg"),
        ("𠀀" * 300 + ".𠀀jpg", "𠀀" * 20 + ".𠀀jpg"),
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


def zipped(entries: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED, links: tuple[str, ...] = ()) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as made:
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


def packed(method: int) -> bytes:
    """A zip of three photos, the second of which is damaged in the middle by whoever calls this."""
    return zipped({f"{k}.jpg": jpeg(k) for k in range(3)}, method)


def with_bytes(content: bytes, at: int, new: bytes) -> bytes:
    return content[:at] + new + content[at + len(new) :]


def in_second(content: bytes, offset: int, new: bytes) -> bytes:
    """Change bytes of the second entry's header or content."""
    with zipfile.ZipFile(io.BytesIO(content)) as opened:
        return with_bytes(content, opened.infolist()[1].header_offset + offset, new)


def in_directory(content: bytes, offset: int, new: bytes) -> bytes:
    """Change bytes of what the archive's directory says of its second entry."""
    at = content.index(b"PK\1\2", content.index(b"PK\1\2") + 4)
    return with_bytes(content, at + offset, new)


DAMAGED_IN_ONE = {
    "deflate": in_second(packed(zipfile.ZIP_DEFLATED), 60, bytes(200)),
    "bzip2": in_second(packed(zipfile.ZIP_BZIP2), 60, bytes(200)),
    "lzma": in_second(packed(zipfile.ZIP_LZMA), 60, b"\xff" * 200),
    "the settings of lzma": in_second(packed(zipfile.ZIP_LZMA), 37, b"\xff" * 9),
    "a wrong sum": in_directory(packed(zipfile.ZIP_STORED), 16, b"1234"),
    "encrypted": in_directory(packed(zipfile.ZIP_DEFLATED), 8, b"\1"),
    "a method that nobody knows": in_directory(packed(zipfile.ZIP_DEFLATED), 10, b"\x5d"),
    "another name in its header": in_second(packed(zipfile.ZIP_STORED), 30, b"x"),
    "no header": in_second(packed(zipfile.ZIP_STORED), 0, b"none"),
    "a size that is none": in_directory(packed(zipfile.ZIP_DEFLATED), 24, b"\x10\0\0\0"),
}
DAMAGED_AS_A_WHOLE = {
    "cut short": packed(zipfile.ZIP_DEFLATED)[:3000],
    "without its end": packed(zipfile.ZIP_DEFLATED)[:-22],
    "only its beginning": b"PK nothing",
    "a directory elsewhere": with_bytes(packed(zipfile.ZIP_STORED), len(packed(0)) - 6, b"\xff\xff\xff\x7f"),
}


@pytest.mark.parametrize("content", DAMAGED_IN_ONE.values(), ids=list(DAMAGED_IN_ONE))
def test_a_photo_of_a_zip_that_cannot_be_unpacked_is_named_and_the_others_arrive(studio, content):
    done = send(Parts(studio / "parts", studio), "v.zip", content)
    assert done.arrived == ("0.jpg", "2.jpg") and len(done.remarks) == 1 and done.remarks[0].startswith("1.jpg: it ")


@pytest.mark.parametrize("content", DAMAGED_AS_A_WHOLE.values(), ids=list(DAMAGED_AS_A_WHOLE))
def test_a_damaged_zip_is_set_aside_with_a_sentence(studio, content):
    parts = Parts(studio / "parts", studio)
    assert "Pack it again" in send(parts, "v.zip", content).refused and not parts.unfinished()


@pytest.mark.parametrize(
    "fault", [LookupError("x"), OSError("Invalid data stream"), AssertionError(), struct.error("x"), MemoryError()]
)
def test_whatever_a_file_leads_to_it_is_set_aside_and_can_be_dismissed(studio, monkeypatch, fault):
    def fail(*_: object) -> None:
        raise fault

    monkeypatch.setattr("capture.intake.parts.settle", fail)
    parts = Parts(studio / "parts", studio)
    part = send(parts, "a.jpg", jpeg())
    assert type(fault).__name__ in part.refused and not parts.unfinished()
    ((told, sentence),) = parts.complaints("vase")
    assert told.id == part.id and sentence.startswith("it cannot be taken")
    parts.drop(part)
    assert not parts.complaints("vase") and not Parts(studio / "parts", studio).complaints("vase")


def overlapping(first: bytes, count: int) -> bytes:
    """A zip whose directory names one content many times."""
    content = zipped({"0.jpg": first})
    at, end = content.index(b"PK\1\2"), content.index(b"PK\5\6")
    counts = struct.pack("<HHI", count, count, (end - at) * count)
    return content[:at] + content[at:end] * count + with_bytes(content[end:], 8, counts)


@pytest.mark.parametrize("first", [jpeg(), b"\xff\xd8\xff" + bytes(3_000_000), b""], ids=["photo", "zeros", "nothing"])
def test_a_zip_whose_files_share_bytes_is_refused_as_a_whole(studio, first):
    refused = send(Parts(studio / "parts", studio), "v.zip", overlapping(first, 50)).refused
    assert "overlap" in refused and not list((studio / "vase").iterdir())


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_what_grows_as_no_photo_does_is_not_unpacked(studio, method):
    entries = {f"{k}.jpg": b"\xff\xd8\xff" + bytes(5_000_000) for k in range(4)} | {"photo.jpg": jpeg()}
    done = send(Parts(studio / "parts", studio), "v.zip", zipped(entries, method))
    assert done.arrived == ("photo.jpg",) and len(done.remarks) == 4 and "times" in done.remarks[0]


def test_an_archive_is_held_to_the_number_and_the_bytes_of_its_files(studio, monkeypatch):
    monkeypatch.setattr(intake, "LARGEST_TOTAL", int(2.5 * len(jpeg())))
    done = send(Parts(studio / "parts", studio), "v.zip", packed(zipfile.ZIP_STORED))
    assert len(done.arrived) == 2 and "MB are taken" in done.remarks[0]
    monkeypatch.setattr(intake, "MOST_ENTRIES", 3)
    many = zipped({f"{k}.jpg": jpeg(k) for k in range(4)})
    assert "at most 3" in send(Parts(studio / "parts", studio), "m.zip", many).refused


WRITTEN = [
    "# my vase\n\nscale = '120 mm' # measured\n\n# end\n",
    "board = 'card' # lent\n\n[roles]\n# the first ones\nboard = ['a.jpg'] # blurred?\n",
    '\ufeff# from Windows\r\nscale = "120 mm"   # measured\r\n',
    "roles = { side = ['s.jpg'] } # walked round\n# led_offset_mm = [1, 2, 3]\n",
    "# nothing yet\n",
]


@pytest.mark.parametrize("text", WRITTEN)
def test_what_a_user_wrote_into_session_toml_stays_when_entries_change(studio, text):
    vase = studio / "vase"
    path = vase / "session.toml"
    path.write_bytes(text.encode())
    before = load_settings(vase)
    set_entry(vase, "board", "paper:A4")
    set_role(vase, "b.jpg", "board")
    settings = load_settings(vase)
    roles = dict(before.roles)
    assert settings.board == "paper:A4" and settings.scale == before.scale
    assert dict(settings.roles) == roles | {"board": (*roles.get("board", ()), "b.jpg")}
    now = path.read_bytes().decode()
    for line in text.splitlines():
        remark = line[line.index("#") :] if "#" in line else line
        assert remark in now and ("board" in line or "roles" in line or line in now)
    assert now.startswith("\ufeff") == text.startswith("\ufeff")
    with pytest.raises(CaptureError, match="scale"):
        set_entry(vase, "scale", "long")
    assert path.read_bytes().decode() == now
    set_role(vase, "b.jpg", "")
    set_entry(vase, "board", before.board)
    assert load_settings(vase) == before


def test_a_photo_of_a_sorted_capture_moves_to_the_folder_of_its_role(studio):
    vase = studio / "vase"
    (vase / "photos").mkdir()
    (vase / "photos" / "a.jpg").write_bytes(jpeg())
    set_role(vase, "photos/a.jpg", "board")
    assert (vase / "board" / "a.jpg").is_file() and not (vase / "photos" / "a.jpg").exists()
    with pytest.raises(CaptureError, match="no role"):
        set_role(vase, "board/a.jpg", "../x")
