"""What a stranger may write into a run's files that no damage by chance makes: each way changes one, and says how."""

import io
import json
import random
import struct
import unicodedata
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

DEEP, LONG = 100_000, 100_000  # brackets within each other; digits of a number
DOCUMENTS = ("calibration.json", "report.json", "manifest.json", "check.json", "config.json")
DOCUMENTS += ("memory.json", "stage.json")
MARKUP = "<script>alert('shadowgraph')</script><img src=x onerror=alert(1)>&\"'"  # which must stay text
NAMES = ("../photos/IMG_1.jpg", "..\\IMG_1.jpg", "C:\\IMG_1.jpg", "/IMG_1.jpg", "CON", "", ".", "a/../b.jpg")
NAMES += ("IMG_1.jpg\0.png", "\u202egpj.1_GMI", "IMG_1.jpg\u200b", "\ud800.jpg", unicodedata.normalize("NFD", "Bü.jpg"))
NAMES += ("img_1.JPG", "IMG_1.jpg\r\nSet-Cookie: a", "\x1b]0;title\x07", "%2e%2e%2fsecret", "~/.ssh/id", "*")
NAMES += ("file:///etc/passwd", "x" * 5000, MARKUP)


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
    for rows in ("lights", "photos", "notes", "views"):
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


STRANGE: tuple[Callable[[random.Random, Path], str], ...] = (by_text, by_text, by_names, by_archive)
