"""Files from strangers run no code, reach nothing outside their folder and take no more memory than they are worth."""

import io
import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from confined import limited
from PIL import Image

import reconstruct.run.pipeline
import shadowgraph
from capture.decode import sandbox as confined
from capture.errors import UserError
from capture.photos.photo import read_grey, read_photo, read_thumbnail
from capture.session.session import load_session

ROOT = Path(__file__).parent.parent
SPOT = ROOT / "examples" / "spot"
assert reconstruct.run.pipeline  # imported before files are watched


# --- hostile files ---------------------------------------------------------------------------------------------------


class Payload:
    """Unpickling it makes a folder, which nobody else does."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def png(width: int, height: int, data: bytes = b"") -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def tiff(width: int, height: int) -> bytes:
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1)]
    tags += [(273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, 100)]
    body = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + b"\0" * 4
    return b"II*\0" + struct.pack("<I", 8) + body


def exr(path: Path, edge: int) -> None:
    """A small picture whose header says that it is `edge` px wide and high."""
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": np.zeros((4, 4), np.float32)}).write(str(path))
    data, small = path.read_bytes(), struct.pack("<4i", 0, 0, 3, 3)
    assert data.count(small) == 2
    path.write_bytes(data.replace(small, struct.pack("<4i", 0, 0, edge - 1, edge - 1)))


def heic(path: Path, edge: int) -> None:
    Image.new("RGB", (64, 64)).save(path, format="HEIF")
    data, small = path.read_bytes(), b"ispe" + struct.pack(">III", 0, 64, 64)
    assert small in data
    path.write_bytes(data.replace(small, b"ispe" + struct.pack(">III", 0, edge, edge)))


def pickled(path: Path, kind: str) -> None:
    """A payload as Python, numpy and torch store objects."""
    payload = Payload(path.parent / "RAN")
    if kind == "npy":
        np.save(path, np.array([payload], dtype=object), allow_pickle=True)
    elif kind == "pth":
        torch.save(payload, path)
    else:
        path.write_bytes(pickle.dumps(payload))


def zip_slip(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        for name in ("../../outside.npy", "/tmp/outside.npy", "light_pose.npy"):
            data = io.BytesIO()
            np.save(data, np.zeros(3))
            file.writestr(name, data.getvalue())


PHOTOS: dict[str, Callable[[Path], object]] = {
    "bomb.png": lambda p: p.write_bytes(png(30_000, 30_000)),
    "flat.png": lambda p: p.write_bytes(png(2**31 - 1, 1)),
    "none.png": lambda p: p.write_bytes(png(0, 5)),
    "bomb.tif": lambda p: p.write_bytes(tiff(30_000, 30_000)),
    "huge.tif": lambda p: p.write_bytes(tiff(2**32 - 1, 2**32 - 1)),
    "bomb.exr": lambda p: exr(p, 30_000),
    "bomb.heic": lambda p: heic(p, 30_000),
    "pickle.png": lambda p: pickled(p, "pickle"),
    "torch.jpg": lambda p: pickled(p, "pth"),
    "numpy.tif": lambda p: pickled(p, "npy"),
    "zip.png": zip_slip,
    "script.eps": lambda p: p.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(x) run\n"),
    "script.png": lambda p: p.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(x) run\n"),
    "vector.png": lambda p: p.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg"><image href="file:///etc/passwd"/></svg>'
    ),
    "device.jpg": lambda p: p.symlink_to("/dev/zero"),
    "secret.png": lambda p: p.symlink_to("/etc/passwd"),
    "loop.png": lambda p: p.symlink_to(p),
}


@pytest.mark.parametrize("name", PHOTOS)
def test_a_hostile_photo_is_refused_by_name_before_it_costs_anything(name, tmp_path):
    import pillow_heif

    pillow_heif.register_heif_opener()
    path = tmp_path / name
    PHOTOS[name](path)
    for read in (read_photo, read_thumbnail, read_grey):
        more = (64,) if read is read_thumbnail else ()
        with limited(tmp_path, room=600 << 20) as watch, pytest.raises(UserError, match=name):
            read(path, *more)
        assert not watch.ran and not watch.written
        assert not watch.read or name == "secret.png"  # what a link names is looked into, and refused
    assert not (tmp_path / "RAN").exists()


# --- a hostile capture -----------------------------------------------------------------------------------------------


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    for role, count in (("board", 1), ("photos", 5)):
        (folder / role).mkdir(parents=True)
        for path in sorted((SPOT / role).iterdir())[:count]:
            shutil.copy(path, folder / role)
    return folder


@pytest.mark.parametrize(
    "name",
    ["../secret.jpg", "/etc/passwd", "photos/../../secret.jpg", "gt/a.png", "..\\secret.jpg", "a\0.jpg", "no.jpg"],
)
def test_session_toml_names_nothing_outside_its_folder(name, capture, tmp_path):
    shutil.copy(next((SPOT / "photos").iterdir()), tmp_path / "secret.jpg")
    (capture / "session.toml").write_text(f"[roles]\nlit = [{json.dumps(name)}]\n")
    with limited(capture) as watch, pytest.raises(UserError, match=r"session\.toml"):
        load_session(capture)
    assert not watch.ran and not watch.read and not watch.written


@pytest.mark.skipif(not confined.IS_CONFINED, reason="limits for decoders need Linux")
def test_a_photo_that_costs_too_much_is_left_out_by_name(capture, monkeypatch, capsys):
    plain = sorted((capture / "photos").iterdir())[2]
    with Image.open(plain) as picture:
        picture.save(plain.with_name("costly.tif"))
    monkeypatch.setattr(confined, "FIXED_ROOM", 1 << 20)
    monkeypatch.setattr(confined, "ROOM_PER_CORE", 0)
    monkeypatch.setattr(confined, "ROOM_PER_PIXEL", 1)
    for path in sorted((capture / "photos").glob("*.jpg"))[3:]:
        path.unlink()
    assert shadowgraph.main(["check", str(capture)]) == 2
    error = capsys.readouterr().err.strip()
    assert "3 photos lit by the flashlight" in error and "costly.tif: unreadable" in error and "Traceback" not in error
