"""Unwrap a simplified mesh, and bake colour and normals of the full surface into textures.

Colours of a surface that is still being solved: those of the mean of the photos, before any albedo is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import trimesh
import xatlas
from jaxtyping import Bool, Float, Integer, UInt8
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize
from trimesh.visual import ColorVisuals, TextureVisuals

from calibration.posed_camera import PosedCamera
from capture.photos.photo import encode_srgb
from reconstruct.appearance.brdf import MetalRough
from reconstruct.detail.file import Detail
from reconstruct.detail.fit import DetailSample, detail_at
from reconstruct.fields import SolvedScene
from reconstruct.mesh.glb import Y_UP, material, packed
from reconstruct.mesh.mesh import mesh_material
from reconstruct.render.g_buffer import NEIGHBOURS, SAME_POINT, SeenMaterial, material_at, seen_material

WHITE_SHARE = 0.99  # of the pixels on the object are darker than what is drawn as BRIGHT
BRIGHT = 0.8  # linear
FACING = 0.2  # cosine between normal and line of sight from which a vertex takes the colour of its own pixel
PADDING_TEXELS = 4  # between charts: a seam stays hidden down to a quarter of the size
SUBTEXEL_BITS = 4  # charts are drawn to a sixteenth of a texel
NEWTON_STEPS = 3  # from the reduced mesh onto the surface, which is a fraction of a voxel away
CUT_VOXELS = 0.5  # above the ground: the base of a reduced mesh is not exactly level
LEVEL = 0.98  # cosine (11 degrees), for the same reason
TEXELS_AT_ONCE = 2**18  # about 100 MB of points, corners and weights
PACKED = 0.6  # share of a picture that charts cover, about
DARKEST = 1e-3  # albedo: the colour of darker points is too uncertain to scale
MIN_FACING = 0.2  # least cosine between gradient and face normal; lower at filled cavities and box walls


class PhotoColours:
    """The mean of one camera's photos, and the colours that it gives to meshes."""

    def __init__(self, camera: PosedCamera, photos: Float[Tensor, "photos height width 3"] | None):
        """Average the photos, linear, on the camera's grid; shadow pictures alone (None) have no colours."""
        self._camera = camera
        self._mean = None if photos is None else photos.mean(0).numpy()

    def coloured(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """Give a mesh its colours per vertex, sRGB, and return it; without photos it stays as it is.

        Vertices that face the camera take the colour of their pixel; what hides them is not looked for. All others take
        that of the nearest vertex that does. The brightest one per cent is drawn as BRIGHT.

        Args:
            mesh: world frame, with normals.
        """
        if self._mean is None or not len(mesh.vertices):
            return mesh
        vertices = np.asarray(mesh.vertices, np.float64)
        towards = self._camera.centre - vertices
        cosine = (np.asarray(mesh.vertex_normals) * towards).sum(1) / np.linalg.norm(towards, axis=1)
        height, width = self._mean.shape[:2]
        column, row = np.round(self._camera.project_with_depth(vertices)[0]).T
        faces = np.flatnonzero((cosine > FACING) & (column >= 0) & (column < width) & (row >= 0) & (row < height))
        if len(faces):
            mesh.visual = ColorVisuals(mesh, vertex_colors=self._nearest(vertices, faces, row, column))
        return mesh

    def _nearest(
        self, vertices: np.ndarray, faces: np.ndarray, row: np.ndarray, column: np.ndarray
    ) -> UInt8[np.ndarray, "n 3"]:
        """Return the colour of each vertex: of its pixel, or that of the nearest of those which face the camera."""
        assert self._mean is not None
        seen = self._mean[row[faces].astype(np.int64), column[faces].astype(np.int64)]
        seen = encode_srgb(np.clip(seen * BRIGHT / max(float(np.quantile(seen, WHITE_SHARE)), 1e-6), 0, 1))
        return np.asarray(seen)[KDTree(vertices[faces]).query(vertices)[1]]


# An atlas stays until the next one is made: one that is destroyed while its worker falls asleep waits for it forever
# (xatlas 0.0.11, TaskScheduler::~TaskScheduler wakes its worker without holding the worker's lock).
_last_atlas: list[xatlas.Atlas] = []


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh with texture coordinates and its pictures; world frame."""

    vertices: Float[np.ndarray, "n 3"]  # split along the seams
    normals: Float[np.ndarray, "n 3"]  # unit
    tangents: Float[np.ndarray, "n 4"]  # unit, along +u; w = 1 where normal x tangent points up in the picture, else -1
    uv: Float[np.ndarray, "n 2"]  # as in glTF: u right, v down, (0, 0) is the picture's top-left corner
    faces: Integer[np.ndarray, "m 3"]
    base: UInt8[np.ndarray, "size size 3"]  # sRGB base colour
    normal_map: UInt8[np.ndarray, "size size 3"]  # tangent space, glTF: x right, y up, z out, (value + 1) / 2
    metallic: float
    roughness: float

    def standing(self, scale: float) -> "TexturedMesh":
        """Return the mesh y up, `scale` times as large, its base on the origin, where AR viewers put it."""
        low, high = self.vertices.min(0), self.vertices.max(0)
        vertices = scale * (self.vertices - np.append(0.5 * (low + high)[:2], low[2])) @ Y_UP.T
        tangents = np.column_stack([self.tangents[:, :3] @ Y_UP.T, self.tangents[:, 3]])
        return replace(self, vertices=vertices, normals=self.normals @ Y_UP.T, tangents=tangents)


def write_textured_glb(mesh: TexturedMesh) -> bytes:
    """Return the bytes of a textured GLB of a mesh that stands as glTF wants it: metres, y up."""
    base, normal_map = Image.fromarray(mesh.base), Image.fromarray(mesh.normal_map)
    look = material(mesh.metallic, mesh.roughness, baseColorTexture=base, normalTexture=normal_map)
    visual = TextureVisuals(np.column_stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]]), look)  # trimesh's v is up
    return packed(mesh.vertices, mesh.normals, mesh.faces, {"TANGENT": mesh.tangents}, visual)


def unwrap(
    mesh: trimesh.Trimesh, size: int
) -> tuple[Integer[np.ndarray, " n"], Integer[np.ndarray, "m 3"], Float[np.ndarray, "n 2"]]:
    """Unwrap a mesh into charts of a square picture with xatlas.

    Args:
        size: px of the picture that the charts are padded for.

    Returns:
        The mesh vertex of each new vertex, the faces, and uv (v down).
    """
    chart, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    chart.fix_winding = True  # no chart is mirrored
    pack.resolution, pack.padding, pack.bilinear, pack.blockAlign = size, PADDING_TEXELS, True, True
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32))
    atlas.generate(chart, pack)
    origin, faces, uv = atlas[0]
    _last_atlas[:] = [atlas]
    # A packed atlas may be slightly larger than requested, and not square; xatlas returns uv relative to its size.
    texels = uv * [atlas.width, atlas.height]
    return origin.astype(np.int64), faces.astype(np.int64), texels / max(atlas.width, atlas.height)


def texel_width(mesh: trimesh.Trimesh, size: int) -> float:
    """Estimate the width of a texel on the mesh, world length, for a picture of `size` px."""
    return float(np.sqrt(mesh.area / PACKED)) / size


def size_for(details: Sequence[Detail], mesh: trimesh.Trimesh) -> int:
    """Return the picture size, px, whose texels are as fine on the mesh as the finest detail's pixels."""
    return int(np.ceil(texel_width(mesh, 1) / min(pixel_width(detail, mesh) for detail in details)))


def pixel_width(detail: Detail, mesh: trimesh.Trimesh) -> float:
    """Return the width of a detail's pixel on a mesh that faces the camera, world length."""
    away = np.linalg.norm(np.asarray(mesh.vertices) - detail.posed_camera.centre, axis=1)
    return float(np.median(away)) / detail.posed_camera.camera.fx


def bake(
    fields: SolvedScene, mesh: trimesh.Trimesh, full: trimesh.Trimesh, size: int, details: Sequence[Detail] = ()
) -> TexturedMesh:
    """Bake colour and normals of the full surface into the textures of a mesh.

    Args:
        mesh: closed, world frame, close to the surface; its vertex normals are not used.
        full: the mesh that it was reduced from.
        size: px, both sides of both pictures.
        details: finer normals and albedo, where the photos of some view show them.
    """
    origin, faces, uv = unwrap(mesh, size)
    vertices = np.asarray(mesh.vertices, np.float64)[origin]
    is_base = _on_the_cut(fields, vertices, faces)
    kept, faces = _parted(faces, is_base)
    vertices, uv = vertices[kept], uv[kept]
    normals = _vertex_normals(fields, vertices, faces, is_base)
    tangents = vertex_tangents(vertices, normals, uv, faces)
    face_of = _drawn(uv, faces, size)
    details = [detail.reduced(texel_width(mesh, size) / pixel_width(detail, mesh)) for detail in details]
    sampler = _SurfaceSampler(fields, full, details)
    rows, columns = np.nonzero(face_of >= 0)
    base, normal_map = np.empty((len(rows), 3), np.uint8), np.empty((len(rows), 3), np.uint8)
    for first in range(0, len(rows), TEXELS_AT_ONCE):
        some = slice(first, first + TEXELS_AT_ONCE)
        face = face_of[rows[some], columns[some]]
        corners = faces[face]
        weights = _barycentric(uv[corners], (np.stack([columns[some], rows[some]], 1) + 0.5) / size)
        flat = _flat_normals(vertices, faces)[face]
        points = np.einsum("nk,nkd->nd", weights, vertices[corners])
        colour, facing = sampler.at(points, flat, is_base[face])
        between = np.einsum("nk,nkd->nd", weights, normals[corners])
        in_tangent_space = _in_frame(facing, between, tangents[corners], weights)
        base[some], normal_map[some] = encode_srgb(colour), np.round(127.5 * (in_tangent_space + 1))
    pictures = _padded(face_of, base), _padded(face_of, normal_map)
    return TexturedMesh(vertices, normals, tangents, uv, faces, *pictures, *sampler.gloss())


def vertex_tangents(
    vertices: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    uv: Float[np.ndarray, "n 2"],
    faces: Integer[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n 4"]:
    """Return unit tangents along +u, perpendicular to the normals, weighted by area.

    w is the sign of the bitangent, the picture's up (-v): bitangent = w * normal x tangent [glTF 2.0, 3.7.2.1].
    """
    p, t = vertices[faces], uv[faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    d1, d2 = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    turn = np.sign(_turned(d1, d2))[:, None]
    along_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * turn
    up = (e1 * d2[:, :1] - e2 * d1[:, :1]) * turn  # -dp/dv
    sums = np.zeros((2, len(vertices), 3))
    for corner in range(3):
        np.add.at(sums[0], faces[:, corner], along_u)
        np.add.at(sums[1], faces[:, corner], up)
    tangent = sums[0] - (sums[0] * normals).sum(1, keepdims=True) * normals
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    fallback = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    tangent = np.where(length > 0, tangent / np.where(length > 0, length, 1), fallback)
    side = np.where((np.cross(normals, tangent) * sums[1]).sum(1) < 0, -1.0, 1.0)
    return np.column_stack([tangent / np.linalg.norm(tangent, axis=1, keepdims=True), side])


def _turned(one: Float[np.ndarray, "n 2"], other: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Return the 2-D cross product of two vectors."""
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def _drawn(
    uv: Float[np.ndarray, "n 2"], faces: Integer[np.ndarray, "m 3"], size: int
) -> Integer[np.ndarray, "size size"]:
    """Return the triangle that covers or touches each texel; -1 if none does."""
    picture = np.full((size, size), -1, np.int32)
    corners = np.round((uv[faces] * size - 0.5) * 2**SUBTEXEL_BITS).astype(np.int32)
    for index, triangle in enumerate(corners):
        cv2.fillConvexPoly(picture, triangle, float(index), shift=SUBTEXEL_BITS)
    return picture


def _barycentric(triangles: Float[np.ndarray, "n 3 2"], at: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return barycentric weights at places in their triangles, limited to the triangle for places just outside."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    area = _turned(b - a, c - a)
    safe = np.where(np.abs(area) > 0, area, 1)
    second, third = _turned(at - a, c - a) / safe, _turned(b - a, at - a) / safe
    weights = np.clip(np.stack([1 - second - third, second, third], 1), 0, 1)
    weights[area == 0] = 1 / 3
    return weights / weights.sum(1, keepdims=True)


def _flat_normals(vertices: Float[np.ndarray, "n 3"], faces: Integer[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    p = vertices[faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)


def _on_the_cut(
    fields: SolvedScene, vertices: Float[np.ndarray, "n 3"], faces: Integer[np.ndarray, "m 3"]
) -> Bool[np.ndarray, " m"]:
    """Return which triangles form the base, where the ground cuts the object: they are level and on the ground."""
    low = (vertices[faces][..., 2] < fields.ground_height + CUT_VOXELS * fields.grid.spacing).all(1)
    return low & (_flat_normals(vertices, faces)[:, 2] < -LEVEL)


def _parted(
    faces: Integer[np.ndarray, "m 3"], is_base: Bool[np.ndarray, " m"]
) -> tuple[Integer[np.ndarray, " n"], Integer[np.ndarray, "m 3"]]:
    """Split vertices so that base and sides share none and the rim stays sharp; return vertex indices and faces."""
    keyed = 2 * faces + is_base[:, None]
    kept, corner = np.unique(keyed, return_inverse=True)
    return kept // 2, corner.reshape(-1, 3)


def _vertex_normals(
    fields: SolvedScene,
    vertices: Float[np.ndarray, "n 3"],
    faces: Integer[np.ndarray, "m 3"],
    is_base: Bool[np.ndarray, " m"],
) -> Float[np.ndarray, "n 3"]:
    """Return unit outward normals: of the surface, and straight down on the base."""
    flat, below = np.zeros_like(vertices), np.zeros(len(vertices), bool)
    for corner in range(3):
        np.add.at(flat, faces[:, corner], _flat_normals(vertices, faces))
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), np.finfo(float).tiny)
    below[faces[is_base]] = True
    return _surface(fields, vertices, flat, below)[1]


def _surface(
    fields: SolvedScene,
    points: Float[np.ndarray, "n 3"],
    flat: Float[np.ndarray, "n 3"],
    is_base: Bool[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Move points onto the zero of the SDF, and return also its unit normals there; the base is unchanged."""
    grid, where = fields.grid, torch.from_numpy(points).float()
    for _ in range(NEWTON_STEPS):
        gradient = grid.gradient(where)
        step = (grid.sdf(where) / (gradient**2).sum(-1).clamp(min=0.25)).clamp(-grid.spacing, grid.spacing)
        where = where - step[:, None] * gradient
    normals = normalize(grid.gradient(where), dim=-1).double().numpy()
    strange = is_base | ((normals * flat).sum(1) < MIN_FACING)
    moved = np.where(strange[:, None], points, where.double().numpy())
    return moved, np.where(strange[:, None], flat, normals)


def _in_frame(
    wanted: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    tangents: Float[np.ndarray, "n 3 4"],
    weights: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Express unit vectors in the tangent frame that a shader interpolates from the three corners."""
    normal = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    tangent = np.einsum("nk,nkd->nd", weights, tangents[..., :3])
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), np.finfo(float).tiny)
    bitangent = np.cross(normal, tangent) * tangents[:, 0, 3:]
    frame = np.stack([tangent, bitangent, normal], 2)
    singular = np.abs(np.linalg.det(frame)) < MIN_FACING
    frame[singular] = np.eye(3)
    local = np.linalg.solve(frame, wanted[..., None])[..., 0]
    local[singular] = [0.0, 0.0, 1.0]
    return local / np.linalg.norm(local, axis=1, keepdims=True)


class _SurfaceSampler:
    """Samples colour and normal of the surface at any point."""

    def __init__(self, fields: SolvedScene, full: trimesh.Trimesh, details: Sequence[Detail]):
        """Prepare the data that all points share."""
        self._fields, self._details = fields, details
        self._seen_material: SeenMaterial = seen_material(fields)
        self._material: MetalRough | None = mesh_material(fields, full)
        self._vertices = KDTree(np.asarray(full.vertices)) if self._material is not None else None

    def gloss(self) -> tuple[float, float]:
        """Return the metallic and roughness factors of the whole mesh (glTF)."""
        return (0.0, 1.0) if self._material is None else (self._material.metallic, self._material.roughness)

    def at(
        self, points: Float[np.ndarray, "n 3"], flat: Float[np.ndarray, "n 3"], is_base: Bool[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Return linear base colour and unit normals of the surface near points of a simplified mesh."""
        on_surface, normals = _surface(self._fields, points, flat, is_base)
        where = torch.from_numpy(on_surface).float()
        everywhere = torch.ones(len(where), dtype=torch.bool)
        albedo = material_at(self._seen_material, where, everywhere)[0].numpy()
        base = albedo.clip(0, 1) if self._material is None else self._glossy_base(on_surface)
        if not self._details:
            return base, normals
        at = detail_at(self._details, self._fields.grid, where)
        return _finer(base, albedo, normals, at, flat, is_base)

    def _glossy_base(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the base colour of the nearby vertices of the full mesh."""
        assert self._material is not None and self._vertices is not None
        distance, index = self._vertices.query(points, k=NEIGHBOURS)
        weight = 1 / np.maximum(distance, SAME_POINT) ** 2
        weight /= weight.sum(1, keepdims=True)
        return np.einsum("nk,nkc->nc", weight, self._material.base.numpy()[index])


def _finer(
    base: Float[np.ndarray, "n 3"],
    albedo: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    at: DetailSample,
    flat: Float[np.ndarray, "n 3"],
    is_base: Bool[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Blend base colour and normals with the detail, weighted by its confidence.

    Args:
        albedo: of the surface, from which the base colour was made; the finer albedo scales it.
    """
    share = np.where(is_base, 0.0, at.confidence.double().numpy())[:, None]
    finer = at.normals.double().numpy()
    share = share * ((finer * flat).sum(1) > MIN_FACING)[:, None]
    mixed = (1 - share) * normals + share * finer
    scale = at.albedo.numpy() / np.maximum(albedo, DARKEST)
    return (
        (base * (1 + share * (scale - 1))).clip(0, 1).astype(np.float32),
        mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), np.finfo(float).tiny),
    )


def _padded(
    face_of: Integer[np.ndarray, "size size"], values: UInt8[np.ndarray, "n 3"]
) -> UInt8[np.ndarray, "size size 3"]:
    """Return a picture of the values at the drawn texels; other texels take the nearest value, to hide seams."""
    is_drawn: Bool[np.ndarray, "size size"] = face_of >= 0
    picture = np.zeros((*face_of.shape, 3), np.uint8)
    picture[is_drawn] = values
    nearest = np.asarray(distance_transform_edt(~is_drawn, return_distances=False, return_indices=True))
    return picture[nearest[0], nearest[1]]
