"""Small 8-bit sRGB pictures: of photos, of depth and normals, and of a mesh, drawn without a graphics card."""

import base64
import io
from collections.abc import Iterator
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from capture.photos.photo import decode_srgb, encode_srgb

if TYPE_CHECKING:  # beside a run a page shows photos only, and opens sooner without it
    import trimesh

Picture = UInt8[np.ndarray, "height width channels"]  # RGB, or RGBA where it has no background

JPEG_QUALITY = 86
MARGIN = 1.04  # of a picture's sides over a mesh that just fits in
OVERSAMPLING = 2  # a mesh is drawn this much larger, then averaged: smooth outlines
SAMPLES_PER_PIXEL = 1.6  # along a triangle's longest edge, so that no pixel of it is missed
LARGEST_BATCH = 2_000_000  # surface samples drawn at a time: about 200 MB
PLAIN = (190, 190, 196)  # of a mesh without colours
KEY, FILL, RIM = 0.6, 0.26, 0.12  # light from upper left, from all around, and from above
NEAR_TO_FAR = np.array(
    [[253, 231, 137], [94, 201, 98], [33, 145, 140], [59, 82, 139], [68, 20, 84]], float
)  # near to far
DARKER, SAME, BRIGHTER = (52, 119, 219), (236, 236, 236), (226, 74, 51)  # of a difference
STRONG_DIFFERENCE = 0.2  # of full sRGB scale: shown as full colour


def jpeg(picture: UInt8[np.ndarray, "height width 3"], quality: int, is_exact: bool = False) -> bytes:
    """Return a picture as JPEG; with `is_exact` its colours are kept at full resolution, as those of normals."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="JPEG", quality=quality, subsampling=0 if is_exact else 2)
    return file.getvalue()


def as_address(content: bytes, kind: str) -> str:
    """Return a file as a data address."""
    return f"data:{kind};base64," + base64.b64encode(content).decode()


def data_uri(picture: Picture) -> str:
    """Return the picture as a data: address for an <img>: JPEG, or PNG if it has no background."""
    if picture.shape[-1] == 3:
        return as_address(jpeg(picture, JPEG_QUALITY), "image/jpeg")
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG")
    return as_address(out.getvalue(), "image/png")


def reduced(picture: Picture, width: int) -> Picture:
    """Return the picture at most `width` px wide."""
    return picture if picture.shape[1] <= width else _resized(picture, width, Image.Resampling.BOX)


def enlarged(picture: Picture, width: int) -> Picture:
    """Return the picture at least `width` px wide."""
    return picture if picture.shape[1] >= width else _resized(picture, width, Image.Resampling.BICUBIC)


def _resized(picture: Picture, width: int, how: Image.Resampling) -> Picture:
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    return np.asarray(Image.fromarray(picture).resize((width, height), how))


def depth_picture(depth: Float[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]) -> Picture:
    """Draw the depth of the masked pixels, from yellow at the nearest to violet at the farthest."""
    seen = mask & np.isfinite(depth)
    out = np.zeros((*depth.shape, 4), np.uint8)
    if seen.any():
        near, far = depth[seen].min(), depth[seen].max()
        at = (depth[seen] - near) / max(far - near, 1e-9) * (len(NEAR_TO_FAR) - 1)
        stops = np.arange(len(NEAR_TO_FAR))
        out[seen, :3] = np.stack([np.interp(at, stops, NEAR_TO_FAR[:, c]) for c in range(3)], -1)
        out[seen, 3] = 255
    return out


def normal_picture(normals: Float[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]) -> Picture:
    """Draw the world normals of the masked pixels: red, green and blue are their x, y and z."""
    out = np.zeros((*mask.shape, 4), np.uint8)
    out[mask, :3] = np.round(127.5 * (np.clip(normals[mask], -1, 1) + 1))
    out[mask, 3] = 255
    return out


def difference_picture(one: Picture, other: Picture) -> Picture:
    """Draw the difference of two pictures of one size: red where the first is brighter, blue where it is darker."""
    gap = (one.astype(float).mean(-1) - other.astype(float).mean(-1)) / 255 / STRONG_DIFFERENCE
    amount = np.clip(np.abs(gap), 0, 1)[..., None]
    towards = np.where(gap[..., None] > 0, np.array(BRIGHTER, float), np.array(DARKER, float))
    return np.round((1 - amount) * np.array(SAME, float) + amount * towards).astype(np.uint8)


def vertex_colours(mesh: "trimesh.Trimesh") -> UInt8[np.ndarray, "n 3"]:
    """Return the sRGB colour of each vertex; PLAIN for a mesh without colours."""
    from trimesh.visual import ColorVisuals

    visual = mesh.visual
    if isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        return np.ascontiguousarray(visual.vertex_colors[:, :3])
    return np.tile(np.array(PLAIN, np.uint8), (len(mesh.vertices), 1))


def mesh_picture(mesh: "trimesh.Trimesh", back: Float[np.ndarray, "3"], size: tuple[int, int]) -> Picture:
    """Draw a mesh in its vertex colours by orthographic projection, RGBA with a transparent background; it fits in.

    Args:
        back: world direction from the mesh to the viewer, not straight up.
        size: width and height, px.
    """
    width, height = size[0] * OVERSAMPLING, size[1] * OVERSAMPLING
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(back, right), -back])  # picture right, picture down, away
    middle = mesh.bounds.mean(0)
    seen = (mesh.vertices - middle) @ axes.T
    scale = min(width / np.abs(seen[:, 0]).max(), height / np.abs(seen[:, 1]).max()) / (2 * MARGIN)
    pixels = seen * scale + [width / 2, height / 2, 0]
    colours = _vertex_light(mesh, axes)
    depth = np.full(width * height, np.inf, np.float32)
    picture = np.zeros((width * height, 4), np.float32)
    for points, light in _surface_samples(pixels, colours, mesh.faces):
        _draw_nearest(points, light, width, height, depth, picture)
    blocks = cv2.resize(picture.reshape(height, width, 4), size, interpolation=cv2.INTER_AREA)  # means of whole blocks
    cover = blocks[..., 3:]
    linear = np.divide(blocks[..., :3], cover, out=np.zeros_like(blocks[..., :3]), where=cover > 0)
    return np.concatenate([encode_srgb(linear), np.round(255 * cover).astype(np.uint8)], -1)


def _vertex_light(mesh: "trimesh.Trimesh", axes: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3"]:
    """Linear colour of each vertex under a light from the viewer's upper left, some from all around and from above."""
    normals = mesh.vertex_normals
    key = np.array([-0.45, -0.6, -0.66]) @ axes  # picture left, up and near
    lit = KEY * np.clip(normals @ key, 0, 1) + FILL + RIM * np.clip(normals[:, 2], 0, 1)
    return decode_srgb(vertex_colours(mesh)) * lit[:, None]


def _surface_samples(
    pixels: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n 3"], faces: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points on the triangles that face the viewer, dense enough to cover every pixel, with their colours."""
    a, b, c = (pixels[faces[:, i]] for i in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    edge = np.max([np.abs(q - p)[:, :2].max(-1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    steps = np.ceil(np.maximum(SAMPLES_PER_PIXEL * edge, 1)).astype(int)
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        inside = (i + j) <= n
        weights = np.stack([n - i - j, i, j], -1)[inside] / n
        chosen = faces[(steps == n) & (turn < 0)]
        batch = max(1, LARGEST_BATCH // len(weights))
        for first in range(0, len(chosen), batch):
            corners = chosen[first : first + batch]
            yield (weights @ pixels[corners]).reshape(-1, 3), (weights @ colours[corners]).reshape(-1, 3)


def _draw_nearest(
    points: np.ndarray, light: np.ndarray, width: int, height: int, depth: np.ndarray, picture: np.ndarray
) -> None:
    """Keep, at each pixel, the sample nearest to the viewer. Changes depth and picture."""
    u, v = np.floor(points[:, 0]).astype(int), np.floor(points[:, 1]).astype(int)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index, away = (v * width + u)[inside], points[inside, 2].astype(np.float32)
    np.minimum.at(depth, index, away)
    nearest = depth[index] == away
    picture[index[nearest], :3] = light[inside][nearest]
    picture[index[nearest], 3] = 1.0
