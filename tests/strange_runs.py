"""What a stranger may put into a run folder that no damage by chance makes: each way changes a run, and says how."""

import io
import json
import os
import random
import shutil
import struct
import time
import unicodedata
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

DEEP, LONG = 100_000, 100_000  # brackets within each other; digits of a number, files of a folder by a tenth
DOCUMENTS = ("calibration.json", "report.json", "manifest.json", "check.json", "config.json")
DOCUMENTS += ("memory.json", "stage.json")
MARKUP = "<script>alert('shadowgraph')</script><img src=x onerror=alert(1)>&\"'"  # which must stay text
NAMES = ("../photos/IMG_1.jpg", "..\\IMG_1.jpg", "C:\\IMG_1.jpg", "/IMG_1.jpg", "CON", "", ".", "a/../b.jpg")
NAMES += ("IMG_1.jpg\0.png", "\u202egpj.1_GMI", "IMG_1.jpg\u200b", "\ud800.jpg", unicodedata.normalize("NFD", "Bü.jpg"))
NAMES += ("img_1.JPG", "IMG_1.jpg\r\nSet-Cookie: a", "\x1b]0;title\x07", "%2e%2e%2fsecret", "~/.ssh/id", "*")
NAMES += ("file:///etc/passwd", "x" * 5000, MARKUP)
CHANGING_S = 1.5  # for how long a file goes on changing


def by_text(draw: random.Random, run: Path) -> str:
    """JSON that other programs accept or write: names twice, deep, long numbers, numbers as text, other encodings."""
    path = run / draw.choice(DOCUMENTS)
    document = json.loads(path.read_text()) if path.exists() else {"format": 1}
    key = draw.choice(list(document) or ["format"])
    own = json.dumps(document)
    texts = {
        "twice": own[:-1]
        + f', {json.dumps(key)}: null, "FORMAT": 2, {json.dumps(key)}: {json.dumps(draw.choice(NAMES))}}}',
        "deep": own[:-1] + f', "{key}": ' + "[" * DEEP + "]" * DEEP + "}",
        "deep objects": '{"a":' * DEEP + "1" + "}" * DEEP,
        "long number": own.replace("1", "1" * LONG, 1),
        "exponent": own.replace("1", "1e999", 1),
        "numbers as text": json.dumps(json.loads(own, parse_float=str, parse_int=str)),
        "no numbers": own.replace("1", "NaN", 1).replace("2", "-Infinity", 1),
        "negative": own.replace(": 1", ": -1"),
        "list": "[" + own + "]",
        "scalar": draw.choice(["null", "1", '"text"', "true", "", " ", "[]", "{}"]),
        "surrogate": own.replace('"', '"\\ud800', 1),
        "more behind": own + "\n" + own,
    }
    encodings = {
        "utf-16": own.encode("utf-16"),
        "mark": b"\xef\xbb\xbf" + own.encode(),
        "latin": own.encode() + b"\xe9",
    }
    way = draw.choice([*texts, *encodings])
    path.write_bytes(encodings[way] if way in encodings else texts[way].encode())
    return f"{path.name}: {way}"


def by_names(draw: random.Random, run: Path) -> str:
    """Names of photos, views and stages that lead elsewhere, look alike, or mean something to a terminal."""
    path = run / draw.choice(["calibration.json", "report.json", "log.jsonl", "manifest.json", "stage.json"])
    if path.name == "log.jsonl":
        line = {"t": 9.0, "stage": draw.choice(NAMES), "done": 1, "total": 2, "message": draw.choice(NAMES)}
        path.write_text(path.read_text() + json.dumps(line) + "\n")
        return "log.jsonl: names"
    document = json.loads(path.read_text()) if path.exists() else {}
    name = draw.choice(NAMES)
    if path.name == "calibration.json" and draw.random() < 0.5:
        document |= {"view": name, "further_views": [dict(document) | {"view": draw.choice(NAMES)}]}
    for rows in ("lights", "photos", "refined_lights", "notes", "views"):
        for row in document.get(rows, []):
            if draw.random() < 0.5 and isinstance(row, dict):
                row["photo" if "photo" in row else "name"] = name
    document |= (
        {"command": name, "capture": name, "inputs": {name: "0" * 64}} if path.name != "calibration.json" else {}
    )
    path.write_text(json.dumps(document))
    return f"{path.name}: the name {name!r:.40}"


def _lying(draw: random.Random, way: str, data: bytearray) -> bytes:
    """An archive whose directory says what is not so."""
    end = data.rfind(b"PK\x05\x06")
    first = data.find(b"PK\x01\x02")
    if way == "cut":
        del data[draw.randrange(len(data)) :]
    elif way == "count":
        data[end + 8 : end + 12] = b"\xff\xff\xff\xff"
    elif way == "comment":
        data[end + 20 : end + 22] = b"\xff\xff"
    elif way == "sizes":
        data[first + 20 : first + 28] = struct.pack("<II", *draw.choice([(0xFFFFFFFF,) * 2, (0, 0xFFFFFFF0), (7, 7)]))
    elif way == "encrypted":
        data[first + 8] |= 1
    return bytes(data)


def by_archive(draw: random.Random, run: Path) -> str:
    """The packed stage as a bomb, with names that lead elsewhere, names twice, links, or lies about its sizes."""
    path = run / "stage.zip"
    whole = path.read_bytes()
    way = draw.choice(["bomb", "names", "twice", "link", "cut", "comment", "count", "sizes", "facts", "encrypted"])
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # names that are there twice
        for name, content in parts.items():
            if way == "facts" and name.endswith(".json"):
                made_of = json.loads(content).get("madeOf")
                content = json.dumps(
                    {"madeOf": made_of, "addresses": draw.choice([None, [], {"a": "../secret"}, 1])}
                ).encode()
            archive.writestr(name, content)
            if way == "twice":
                archive.writestr(name, b"{}")
        if way == "bomb":
            archive.writestr(draw.choice(["corners.bin", "facts.json", *parts]), bytes(64 << 20))
        elif way == "names":
            for name in NAMES:
                with suppress(ValueError, IndexError):
                    archive.writestr(name, b"{}")
        elif way == "link":
            link = zipfile.ZipInfo("link.jpg")
            link.external_attr = 0o120777 << 16
            archive.writestr(link, "../secret")
    lies = ("cut", "count", "sizes", "comment", "encrypted")
    path.write_bytes(_lying(draw, way, bytearray(whole)) if way in lies else file.getvalue())
    return f"stage.zip: {way}"


def by_company(draw: random.Random, run: Path) -> str:
    """Things beside the files of a run: thousands of them, folders that lead elsewhere or into themselves, pipes."""
    links = {"exports": run.parent / "elsewhere", "heap": run, "photos": run, "view_2": Path("/proc/self")}
    links |= {"view_3": Path("/"), "kept_photos": Path("/dev"), "wishes": Path("/dev/zero")}
    way = draw.choice(["thousands", "pipes", "case", "closed", "glb", *links])
    if way == "thousands":
        for i in range(LONG // 20):
            (run / f"thumbs/{i}.jpg").write_bytes(b"")
    elif way == "pipes":
        (run / "wishes").mkdir(exist_ok=True)
        for wish in ("stop", "pause", "draft"):
            os.mkfifo(run / "wishes" / wish)
    elif way == "case":
        for name in ("REPORT.JSON", "Mesh.PLY", "Fields.safetensors", unicodedata.normalize("NFD", "é.json")):
            (run / name).write_bytes(b"{}")
    elif way == "closed":
        (run / draw.choice(["report.json", "thumbs", "mesh.ply"])).chmod(0)
    elif way == "glb":
        header = struct.pack("<4sIIII", b"glTF", 2, 2**32 - 1, 2**32 - 1, 0x4E4F534A)
        (run / "mesh.glb").write_bytes(header + b'{"buffers":[{"uri":"../secret","byteLength":1e18}]}')
    else:
        shutil.rmtree(run / way, ignore_errors=True)  # a run of several views has such folders
        (run / way).symlink_to(links[way])
    return f"beside: {way}"


def by_change(draw: random.Random, run: Path) -> str:
    """A file that somebody else cuts, grows and exchanges while it is read."""
    names = ("fields.safetensors", "mesh.ply", "log.jsonl", "report.json", "calibration.json", "depth.npy", "stage.zip")
    path = run / draw.choice(names)
    whole = path.read_bytes()
    pid = os.fork()
    if not pid:
        os.setpgid(0, 0)
        end = time.monotonic() + CHANGING_S
        try:
            while time.monotonic() < end and run.exists():
                with path.open("r+b") as file:
                    file.truncate(draw.randrange(len(whole)))
                time.sleep(0.002)
                fresh = path.with_name("fresh")
                fresh.write_bytes(whole[: draw.randrange(len(whole))] + bytes(draw.randrange(100)))
                fresh.replace(path)
                time.sleep(0.002)
                path.write_bytes(whole)
                time.sleep(0.004)
        finally:
            os._exit(0)
    return f"{path.name}: changing"


STRANGE: tuple[Callable[[random.Random, Path], str], ...] = (
    *(by_text, by_text, by_names, by_archive, by_company, by_change),
)
