"""Small 8-bit sRGB pictures: of photos, of depth and normals, and of a mesh, drawn without a graphics card."""

import base64
import io
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
FROM_AFAR = 1000.0  # heights of the picture between viewer and mesh: rays are parallel to a tenth of a pixel
PLAIN = (190, 190, 196)  # of a mesh without colours
KEY, FILL, RIM = 0.6, 0.26, 0.12  # light from upper left, from all around, and from above
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
        level = np.round(255 * (far - depth[seen]) / max(far - near, 1e-9)).astype(np.uint8)
        out[seen, :3] = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)[:, ::-1]
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
    seen = (mesh.vertices - mesh.bounds.mean(0)) @ axes.T
    scale = min(width / np.abs(seen[:, 0]).max(), height / np.abs(seen[:, 1]).max()) / (2 * MARGIN)
    away = FROM_AFAR * height
    places = (seen * scale * [1, -1, -1] - [0, 0, away]).astype(np.float32)  # OpenGL's: up, towards the viewer
    faces, light = np.asarray(mesh.faces, np.int32), _vertex_light(mesh, axes).astype(np.float32)
    picture, depth = np.zeros((height, width, 3), np.float32), np.full((height, width), 2 * away, np.float32)
    field = 2 * np.arctan(0.5 * height / away)
    how = cv2.TriangleRasterizeSettings().setShadingType(cv2.RASTERIZE_SHADING_SHADED)
    how = how.setCullingMode(cv2.RASTERIZE_CULLING_CW)
    cv2.triangleRasterize(places, faces, light, picture, depth, np.eye(4), field, 0.5 * away, 2 * away, how)
    drawn = np.dstack([picture, (depth < 2 * away).astype(np.float32)])
    blocks = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)  # means of whole blocks
    cover = blocks[..., 3:]
    linear = np.divide(blocks[..., :3], cover, out=np.zeros_like(blocks[..., :3]), where=cover > 0)
    return np.concatenate([encode_srgb(linear), np.round(255 * cover).astype(np.uint8)], -1)


def _vertex_light(mesh: "trimesh.Trimesh", axes: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3"]:
    """Linear colour of each vertex under a light from the viewer's upper left, some from all around and from above."""
    normals = mesh.vertex_normals
    key = np.array([-0.45, -0.6, -0.66]) @ axes  # picture left, up and near
    lit = KEY * np.clip(normals @ key, 0, 1) + FILL + RIM * np.clip(normals[:, 2], 0, 1)
    return decode_srgb(vertex_colours(mesh)) * lit[:, None]
