"""The scene's numbers as one packed block: what the page's scene.js unpacks."""

import gzip
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from reconstruct.export.stage_scene import StageScene

PACKING = 6  # of gzip: 9 takes three times as long for a hundredth
STEPS_16 = 65535  # of a coordinate: 3 micrometres on 200 mm
NORMAL_16 = 32767


@dataclass(frozen=True)
class Block:
    """A packed block and where its parts are."""

    content: bytes  # gzip
    parts: dict[str, dict[str, Any]]  # by name: "offset" and "count" in bytes and numbers, "kind"


def packed(scene: StageScene, centre: Float[np.ndarray, "3"], radius: float) -> Block:
    """Pack the mesh. Coordinates become (x - centre) / radius on 16 bits, bytes in planes, corners as differences."""
    places = (scene.vertices - centre) / radius
    low, high = places.min(0), places.max(0)
    steps = np.round((places - low) / np.maximum(high - low, 1e-9) * STEPS_16).astype(np.uint16)
    normals = np.round(NORMAL_16 * scene.normals).astype(np.int16)
    corners = scene.faces.reshape(-1).astype(np.int64)
    moves = np.diff(corners, prepend=0)
    soft = scene.soft
    bounce_scale = float(soft.bounce.abs().max()) if len(soft.bounce) else 0.0
    bounce_scale = bounce_scale or 1.0
    zigzag = np.where(moves < 0, -2 * moves - 1, 2 * moves).astype(np.uint32)
    arrays = {
        "places": (_planes(steps.T), len(steps)),
        "normals": (_planes(normals.T.view(np.uint16)), len(steps)),
        "colours": (scene.colours.T, len(steps)),
        "evidence": (scene.evidence, len(steps)),
        "gloss": (scene.gloss.T, len(steps)),
        "corners": (_planes(zigzag), len(corners)),
        "sky": (_share(soft.sky.numpy()), len(steps)),
        "below": (_share((soft.sky if soft.below is None else soft.below).numpy()), len(steps)),
        "bounce": (np.round(127 * soft.bounce.numpy().T / bounce_scale).astype(np.int8), len(steps)),
        "tint": (_share(soft.tint.numpy()).T, len(steps)),
        "groundSky": (_share(scene.ground_sky), len(scene.ground_sky)),
    }
    parts, content, offset = {}, [], 0
    for name, (array, count) in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        parts[name] = {"offset": offset, "count": count}
        content.append(data)
        offset += len(data)
    parts["places"] |= {"low": low.tolist(), "high": high.tolist()}
    parts["bounce"] |= {"scale": bounce_scale}
    return Block(gzip.compress(b"".join(content), PACKING, mtime=0), parts)


def _share(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)


def _planes(values: Shaped[np.ndarray, "..."]) -> UInt8[np.ndarray, "bytes ..."]:
    """Split whole numbers into planes of their bytes, the highest first, which gzip packs best."""
    bytes_each = values.dtype.itemsize
    return np.stack([(values >> (8 * (bytes_each - 1 - k)) & 255).astype(np.uint8) for k in range(bytes_each)])
