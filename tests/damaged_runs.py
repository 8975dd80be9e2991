"""Run folders as a stranger may send them: a whole one, and ways to damage it, drawn from a seed."""

import json
import os
import pickle
import random
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import fake_run
import numpy as np
import torch
from fuzz_images import DAMAGES
from laid_anew import turned_by
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from strange_runs import DOCUMENTS, MARKUP, STRANGE
from test_untrusted_files import Payload

from calibration.calibrated_views import CalibratedView, CalibratedViews, save_views
from calibration.calibration import Calibration, load_calibration, save_calibration
from calibration.side_view import SideView
from reconstruct.appearance.brdf import LOBES, Gloss
from reconstruct.detail.file import DETAIL, Detail, save_details
from reconstruct.detail.surface import Window
from reconstruct.fields import FurtherView, SolvedScene, load_fields, save_fields
from reconstruct.mesh.mesh import extract_mesh, save_mesh
from reconstruct.solve.checkpoint import write_checkpoint
from viewer.stage.page import write_stage

TENSORS = ("fields.safetensors", "detail.safetensors", "checkpoint.safetensors")
MAPS = ("depth.npy", "normal.npy")
MESHES = ("mesh.ply", "preview.ply", "hull.ply")
PICTURES = ("mask.png", "thumbs/*.jpg")
FILES = (*DOCUMENTS, *TENSORS, *MAPS, *MESHES, *PICTURES, "log.jsonl", "lock", "stage.zip")
VALUES = (None, True, -1, 0, 1, 1e308, -1e308, 1e-308, 1e13, float("nan"), float("inf"), 2**70, [], {}, [[1]], [0] * 4)
VALUES += ("", "x" * 300, "x" * 100_000, "../../etc/passwd", "/etc/passwd", "a\0b", "a\nb\x1b[2J", MARKUP)
NUMBERS = (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 0.0, 1e-30, 6e4)
LARGE = 100_000  # entries of a list that was made long
SPARSE = 8 << 30  # bytes that a file says it has


def make(folder: Path, has_stage: bool = True) -> Path:
    """A finished run with every file that one may hold."""
    truth = fake_run.make_truth(64, 6)
    run = folder / "heap"
    fake_run.start_run(run, truth)
    fake_run.finish_run(run, truth)
    fields = _all_known(fake_run.fields_of(truth))
    save_fields(fields, run / "fields.safetensors")
    save_mesh(extract_mesh(fields), run / "mesh.ply", run / "mesh.glb", "mm")
    (run / "hull.ply").write_bytes((run / "preview.ply").read_bytes())
    save_details([_detail(fields)], fields, run / DETAIL)
    cost = {"seconds": 4.0, "cpu_seconds": 7.1, "peak_memory_bytes": 412_000_000}
    manifest = {"format": 1, "inputs": {"photos/IMG_1.jpg": "0" * 64}, "config": {"preset": "draft", "seed": 0}}
    _write(run / "manifest.json", manifest | {"costs": {"solve": cost}, "finished": ["solve"], "made_with": {}})
    check = {"format": 1, "verdict": "good", "sentence": "Good.", "reasons": ["a reason"], "advice": [], "numbers": {}}
    _write(run / "check.json", check)
    _write(run / "config.json", {"seed": 0, "levels": [{"nodes": 40, "iterations": 40, "rate": [0.5, 0.4]}]})
    _write(run / "memory.json", {"photos": 6, "long_side": 320, "predicted": 10**9, "sentence": "about 1 GB"})
    state = json.dumps({"iteration": 0, "spacing": fields.grid.spacing})
    tensors = {"start": fields.grid.values.contiguous(), "origin": fields.grid.origin}
    write_checkpoint(tensors, {"format": "6", "fingerprint": "x", "state": state}, run / "checkpoint.safetensors")
    calibration = fake_run.calibration_of(truth)
    told = {"notes": ["a note"], "shading_rms_by_photo": {light.photo: 0.01 for light in calibration.lights}}
    save_calibration(replace(calibration, residuals=calibration.residuals | told), run / "calibration.json")
    view = {"azimuth": 0.1, "elevation": 0.5, "distance": 500.0, "focal": 1.0, "shift": [0.0, 0.0]}
    lamp = {"azimuth": 0.1, "elevation": 0.5, "distance": 500.0, "radius": 1.0, "strength": 1.0}
    note = {"kind": "arrow", "text": "here", "at": [0.0, 0.0, 20.0], "normal": [0.0, 0.0, 1.0]}
    saved = {"name": "a view", "view": view, "lamp": lamp, "look": "photo"}
    _write(run / "stage.json", {"format": 1, "notes": [note], "views": [saved], "crop": None, "guess": "shown"})
    if has_stage:
        write_stage(run)
    return run


def make_several(folder: Path) -> Path:
    """The same run with a second view, the object laid anew, a view that was left out, and a photo from the side."""
    run = make(folder, has_stage=False)
    own = load_calibration(run / "calibration.json")
    own = replace(own, side_views=(_side_view(own),))
    motion, object_pose = turned_by(own)
    views = (CalibratedView("view_1", own), CalibratedView("view_2", own))
    save_views(CalibratedViews(views, (("view_3", "no board was found"),), (object_pose,)), run / "calibration.json")
    fields = load_fields(run / "fields.safetensors")
    poses = {"view_2": (own.world_from_camera, None), "turned_1": (object_pose.first.world_from_camera, motion)}
    further = tuple(
        FurtherView(name, fields.albedo, fields.camera, pose, object_from_world=moved)
        for name, (pose, moved) in poses.items()
    )
    fields = replace(fields, view="view_1", further=further, gloss=None, light_share=0.01)
    save_fields(fields, run / "fields.safetensors")
    save_details([_detail(fields), replace(_detail(fields), view=2)], fields, run / DETAIL)
    for name in ("view_2", "turned_1"):
        (run / name).mkdir()
        for file in ("depth.npy", "normal.npy", "mask.png"):
            (run / name / file).write_bytes((run / file).read_bytes())
        for small in sorted((run / "thumbs").glob("photo_*.jpg")):
            small.with_name(f"{name}-{small.name}").write_bytes(small.read_bytes())
    write_stage(run)
    return run


def _side_view(own: Calibration) -> SideView:
    mask = np.zeros((6, 8), bool)
    mask[2:5, 2:6] = True
    return SideView("side.jpg", own.posed_camera, (4, 4, 32, 24), mask, np.ones_like(mask), 1.0)


def _all_known(fields: SolvedScene) -> SolvedScene:
    height, width = fields.albedo.shape[:2]
    weights = torch.full((height, width, 1), 0.1)
    return replace(
        fields,
        gloss=Gloss(torch.full((1, LOBES, 3), 0.01), weights),
        evidence=torch.full(fields.grid.values.shape, 3.0),
    )


def _detail(fields: SolvedScene) -> Detail:
    height, width = fields.camera.height, fields.camera.width
    normals = np.zeros((height, width, 3), np.int16)
    normals[..., 2] = 32767
    confidence = np.full((height, width), 200, np.uint8)
    albedo = np.full((height, width, 3), 0.5, np.float16)
    return Detail(normals, albedo, confidence, fields.posed_camera, Window(0, 0, width, height))


def _write(path: Path, document: Any) -> None:
    path.write_text(json.dumps(document))


# --- damages: each changes one file, and returns its name and what was done ------------------------------------------


def _chosen(draw: random.Random, run: Path, names: tuple[str, ...]) -> Path:
    """One file of the run; of a pattern one of those that fit."""
    found = sorted(run.glob(draw.choice(names)))
    return draw.choice(found) if found else run / "log.jsonl"


def by_bytes(draw: random.Random, run: Path) -> str:
    """Cut, flipped, swollen, padded or empty."""
    path = _chosen(draw, run, FILES)
    damage = draw.choice(DAMAGES)
    path.write_bytes(damage(draw, path.read_bytes() if path.exists() else b"{}"))
    return f"{path.name}: {damage.__name__}"


def by_value(draw: random.Random, run: Path) -> str:
    """One value of a JSON file exchanged, removed, or repeated."""
    path = _chosen(draw, run, DOCUMENTS)
    document, said = exchanged(draw, json.loads(path.read_text()))
    _write(path, document)
    return f"{path.name}: {said}"


def exchanged(draw: random.Random, document: Any) -> tuple[Any, str]:
    """A document with one value exchanged, removed, or repeated."""
    here, way = document, ""
    while True:
        keys = list(here) if isinstance(here, dict) else list(range(len(here)))
        if not keys:
            return document, f"{way} as it was"
        key = draw.choice(keys)
        way = f"{way}.{key}"
        if isinstance(here[key], dict | list) and here[key] and draw.random() < 0.75:
            here = here[key]
            continue
        if draw.random() < 0.15:
            del here[key]
            return document, f"{way} removed"
        if isinstance(here[key], list) and here[key] and draw.random() < 0.5:
            here[key] = (here[key] * (LARGE // len(here[key]) + 1))[:LARGE]
            return document, f"{way} repeated"
        value = draw.choice(VALUES)
        here[key] = value
        return document, f"{way} = {value!r:.30}"


def by_tensor(draw: random.Random, run: Path) -> str:
    """A tensor of numbers that no scene has, of another shape or type, missing, or under another name."""
    path = _chosen(draw, run, TENSORS)
    tensors, header = _stored(path)
    name = draw.choice(sorted(tensors))
    tensor = tensors.pop(name)
    value = draw.choice(NUMBERS if tensor.is_floating_point() else [0, 1, -1, 255])
    spoilt = tensor.clone()
    spoilt.view(-1)[draw.randrange(tensor.numel())] = value
    ways = {"missing": None, "renamed": tensor, "one": spoilt, "all": torch.full_like(tensor, value)}
    ways |= {"noise": torch.randn(tensor.shape) * draw.choice([0.1, 1, 100])}
    ways |= {"scaled": tensor.double() * draw.choice([-1, 1e-12, 1e12, 1e3]), "double": tensor.double()}
    ways |= {"flat": tensor.reshape(-1), "cut": tensor[: len(tensor) // 2], "empty": tensor[:0]}
    way = draw.choice([*ways, "transposed"])
    made = tensor.transpose(0, -1) if way == "transposed" else ways[way]
    if made is not None:
        made = made.to(tensor.dtype) if way in ("noise", "scaled") else made
        tensors["x" * 50 if way == "renamed" else name] = made.contiguous()
    _save(tensors, header, path)
    return f"{path.name}: {name} {way}"


def by_header(draw: random.Random, run: Path) -> str:
    """Numbers of the JSON in the header of a tensor file, or of the header itself."""
    path = _chosen(draw, run, TENSORS)
    if draw.random() < 0.7:
        tensors, header = _stored(path)
        key = next(key for key in ("fields", "detail", "state") if key in header)
        document, said = exchanged(draw, json.loads(header[key]))
        _save(tensors, header | {key: json.dumps(document)}, path)
        return f"{path.name}: header {said}"
    data = path.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    document, said = exchanged(draw, json.loads(data[8 : 8 + length]))
    text = json.dumps(document).encode()
    path.write_bytes(struct.pack("<Q", draw.choice([len(text)] * 4 + [2**62, 0, 99])) + text + data[8 + length :])
    return f"{path.name}: layout {said}"


def by_mesh(draw: random.Random, run: Path) -> str:
    """Counts in the header of a PLY, corners that are not there, places that are no numbers."""
    path = _chosen(draw, run, MESHES)
    data = path.read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    way = draw.choice(["count", "body", "kind", "faces"])
    if way == "count":
        lines = head.decode().splitlines()
        at = draw.choice([i for i, line in enumerate(lines) if line.startswith("element")])
        lines[at] = f"{lines[at].rpartition(' ')[0]} {draw.choice([0, -1, 1, 10**12, 2**31, 2**64])}"
        head = ("\n".join(lines) + "\n").encode()
    elif way == "kind":
        old, new = draw.choice(
            [(b"float x", b"uchar x"), (b"binary_little", b"binary_big"), (b" 1.0", b" 2.0"), (b"int ", b"double ")]
        )
        head = head.replace(old, new)
    else:
        out = bytearray(body)
        for _ in range(20):
            at = draw.randrange(max(len(out) - 4, 1)) if way == "body" else len(out) - 4 * draw.randrange(1, 50)
            out[at : at + 4] = struct.pack("<I", draw.choice([0x7FC00000, 0x7F800000, 0xFFFFFFFF, 0x7FFFFFFF, 10**9]))
        body = bytes(out)
    path.write_bytes(head + mark + body)
    return f"{path.name}: {way}"


def by_map(draw: random.Random, run: Path) -> str:
    """A pickle in the place of numbers, another shape or type, numbers that are none."""
    path = run / draw.choice(MAPS)
    values = np.load(path)
    way = draw.choice(["pickle", "object", "shape", "kind", "number", "header"])
    if way == "pickle":
        path.write_bytes(pickle.dumps(Payload(run / "RAN")))
    elif way == "object":
        np.save(path, np.array([Payload(run / "RAN")], dtype=object), allow_pickle=True)
    elif way == "shape":
        np.save(path, draw.choice([values[:-1], values.ravel(), values[None], values[:0], np.asfortranarray(values)]))
    elif way == "kind":
        with np.errstate(invalid="ignore"):
            values = values.astype(draw.choice(["f2", "f8", ">f4", "c8", "i4", "S3", "?"]))
        np.save(path, values)
    elif way == "number":
        values.ravel()[draw.randrange(values.size)] = draw.choice(NUMBERS)
        np.save(path, values)
    else:
        data = path.read_bytes()
        old = str(values.shape).encode()
        path.write_bytes(data.replace(old, draw.choice([b"(99999, 99999)", b"(-1, -1)", b"(1,) * 9**9", b"()"]), 1))
    return f"{path.name}: {way}"


def by_log(draw: random.Random, run: Path) -> str:
    """Lines of other kinds, many lines, a run that seems to go on."""
    way = draw.choice(["values", "many", "lock", "deep"])
    with (run / "log.jsonl").open("a") as log:
        if way == "values":
            line, _ = exchanged(draw, {"t": 1.0, "cpu_s": 1.0, "stage": "solve", "numbers": {"loss_a": 1.0, "b": 2}})
            log.write(json.dumps(line) + "\n")
        elif way == "many":
            log.write('{"t": 1, "stage": "solve", "numbers": {"loss_a": 1}}\n' * LARGE)
        elif way == "deep":
            log.write("[" * LARGE + "\n" + '{"a":' * LARGE + "\n")
    if way == "lock":
        _write(run / "lock", {"pid": draw.choice([1, -1, 2**70, os.getpid(), "x"]), "started": draw.choice(VALUES[:9])})
    return f"log.jsonl: {way}"


WAYS: tuple[Callable[[random.Random, Path], str], ...] = (
    *(by_bytes, by_bytes, by_value, by_value, by_value, by_tensor, by_tensor, by_tensor, by_header),
    *(by_header, by_mesh, by_map, by_log),
    *STRANGE,
)


def damaged(draw: random.Random, run: Path) -> str:
    """Damage a run in one way, sometimes in two, and say how."""
    said = draw.choice(WAYS)(draw, run)
    if draw.random() < 0.25:
        with suppress(OSError, ValueError, LookupError, SafetensorError, BadZipFile):  # damaged already
            said += "; " + draw.choice(WAYS)(draw, run)
    return said


def _stored(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    with safe_open(path, "pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118


def _save(tensors: dict[str, torch.Tensor], header: dict[str, str], path: Path) -> None:
    header.pop("checksum", None)  # a stranger can write a right one as well
    save_file(tensors, path, header)
