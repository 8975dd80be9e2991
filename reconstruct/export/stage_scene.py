"""A solved scene small enough for a browser: triangles with what is known of them, and pictures of the photos' grid.

FirstView, which a page opens with: which lamp shows the object's shape best there, and a picture of it.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, UInt8, UInt32
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates
from scipy.spatial import KDTree
from torch import Tensor

from calibration.light import Light
from calibration.posed_camera import PosedCamera
from capture.photos.photo import decode_srgb, encode_srgb, smaller
from reconstruct.detail.file import SURE, UNIT, Detail
from reconstruct.fields import SolvedScene
from reconstruct.mesh.evidence import SEEN
from reconstruct.mesh.mesh import vertex_colours
from reconstruct.mesh.simplify import simplified
from reconstruct.render.g_buffer import RenderView, SeenMaterial, SurfaceMaps, material_at, seen_material, surface_maps
from reconstruct.render.receivers import Receivers
from reconstruct.render.relight import relight_soft
from reconstruct.render.soft_light import SoftLight, ground_sky, soft_light
from reconstruct.render.studio import KEY_DISTANCE, LAMP_RADII, Studio, direction_of, studio_of, towards
from reconstruct.sdf.rays import shadow_starts
from reconstruct.stored_run.stored_run import StoredRun

MOST_FACES = 150_000  # a phone draws them sixty times a second, and so does a software renderer twenty times
MOST_GLOSSY = 4  # materials: the weights of one vertex are one texel
PICTURE_SIDE = 1024  # px, the longer side of the pictures that a page opens with
MARGIN = 4  # px of the working picture around the object
GROUND_HALF = 4.0  # radii of the object: farther out, it hides less than a hundredth of the sky from the ground
FULL_WEIGHT = 255  # stored for the largest weight of a glossy material
# Irradiance: key and fill as 4 to 1, as for a portrait; the brightest albedo (0.9) just unclipped.
LAMP, SKY = 0.7, 0.25
ASIDE = tuple(np.radians([-60.0, -45.0, -30.0, 30.0, 45.0, 60.0]))  # of a portrait's key light, from the camera
HIGH = tuple(np.radians([35.0, 45.0, 55.0]))  # above the ground
SHADES = 32  # brightnesses that an eye tells apart on a small picture
SPARSE = 7  # every such pixel of the object is asked: thousands, in no rows
RAYS = 3  # shadow rays per pixel of a picture that stands for a moment


@dataclass(frozen=True)
class StageScene:
    """What the page draws. World frame; colours are sRGB albedo; windows are shares of the photo: left, top, size."""

    vertices: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]  # unit, of the solved surface
    colours: UInt8[np.ndarray, "n 3"]
    evidence: UInt8[np.ndarray, " n"]  # as in reconstruct/mesh/evidence.py; SEEN everywhere where a run states none
    gloss: UInt8[np.ndarray, "n materials"]  # weights of SolvedScene.gloss over `gloss_scale`, times FULL_WEIGHT
    gloss_scale: float
    faces: UInt32[np.ndarray, "m 3"]
    object_picture: UInt8[np.ndarray, "height width 3"]  # grown beyond the object's outline, so that it may be sampled
    object_window: tuple[float, float, float, float]
    normal_picture: UInt8[np.ndarray, "height width 3"] | None  # (n + 1) / 2 on the same window; with a detail only
    ground_picture: UInt8[np.ndarray, "rows columns 3"]  # the whole photo's; filled where the object hides it
    ground_mean: UInt8[np.ndarray, "3"]
    soft: SoftLight  # at the vertices
    ground_sky: Float[np.ndarray, "side side"]  # the sky's share on a square of ground of GROUND_HALF radii


def stage_scene(run: StoredRun) -> StageScene:
    """Return the scene of a finished run.

    Raises:
        UserError: a file of the run cannot be used.
    """
    fields, mesh = run.fields, run.mesh
    small = simplified(mesh, MOST_FACES) if len(mesh.faces) > MOST_FACES else mesh
    vertices = np.asarray(small.vertices, np.float64)
    evidence = mesh.vertex_attributes.get("evidence")
    if evidence is not None and small is not mesh:
        evidence = evidence[KDTree(mesh.vertices).query(vertices)[1]]
    if evidence is None:
        evidence = np.full(len(vertices), SEEN, np.uint8)
    maps = surface_maps(fields.grid, fields.posed_camera)
    mask, finite = maps.mask.numpy(), torch.isfinite(maps.depth).numpy()
    ground = np.asarray(binary_erosion(finite & ~mask, np.ones((3, 3), bool), border_value=1), bool)
    material, studio = seen_material(fields), studio_of(np.asarray(mesh.bounds))
    gloss, scale = _gloss(fields, vertices, material)
    normals, is_whole = _normals(fields, small), any(one.object_from_world is not None for one in fields.further)
    picture, window, normal_picture = _object_pictures(fields, mask, run.detail)
    whole, mean = ground_pictures(fields.albedo.numpy(), ground)
    return StageScene(
        vertices,
        normals,
        vertex_colours(small)[:, :3],
        np.asarray(evidence, np.uint8),
        gloss,
        scale,
        np.asarray(small.faces, np.uint32),
        picture,
        window,
        normal_picture,
        whole,
        mean,
        soft_light(material, small, torch.from_numpy(normals).float(), is_whole),
        ground_sky(fields, studio.centre, GROUND_HALF * studio.radius),
    )


def filled(values: Float[np.ndarray, "height width 3"], known: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """Return a picture whose unknown pixels continue the known ones smoothly, by the pull-push algorithm.

    Averages over known pixels are made on ever coarser grids; unknown pixels take the interpolated coarser value
    [Gortler et al. 1996, The Lumigraph, section 4.4].
    """
    levels = [(values * known[..., None], known.astype(np.float32))]
    while min(levels[-1][1].shape) > 1:
        height, width = levels[-1][1].shape
        size = max(1, width // 2), max(1, height // 2)
        weight = cv2.resize(levels[-1][1], size, interpolation=cv2.INTER_AREA)
        weighted = cv2.resize(levels[-1][0] * levels[-1][1][..., None], size, interpolation=cv2.INTER_AREA)
        levels.append((weighted.reshape(*weight.shape, 3) / np.maximum(weight, 1e-6)[..., None], (weight > 0) * 1.0))
        levels[-1] = levels[-1][0].astype(np.float32), levels[-1][1].astype(np.float32)
    out = levels[-1][0]
    for mean, weight in reversed(levels[:-1]):
        coarse = cv2.resize(out, weight.shape[::-1], interpolation=cv2.INTER_LINEAR).reshape(*weight.shape, 3)
        out = mean * weight[..., None] + coarse * (1 - weight[..., None])
    return out


def _normals(fields: SolvedScene, mesh: trimesh.Trimesh) -> Float[np.ndarray, "n 3"]:
    """Return the surface's normals at the vertices; the mesh's own where the base is cut or the slope is not known."""
    own = np.asarray(mesh.vertex_normals, np.float64)
    points = torch.from_numpy(np.asarray(mesh.vertices)).float()
    slope = torch.nn.functional.normalize(fields.grid.gradient(points), dim=-1).double().numpy()
    agrees = ((own * slope).sum(1) > 0.5) & np.isfinite(slope).all(1)
    return np.where(agrees[:, None], slope, own)


def _gloss(
    fields: SolvedScene, vertices: Float[np.ndarray, "n 3"], material: SeenMaterial
) -> tuple[UInt8[np.ndarray, "n materials"], float]:
    if fields.gloss is None:
        return np.zeros((len(vertices), 0), np.uint8), 1.0
    points = torch.from_numpy(vertices).float()
    _, weights = material_at(material, points, torch.ones(len(vertices), dtype=torch.bool))
    weights = weights.numpy()[:, :MOST_GLOSSY]
    scale = float(weights.max(initial=0.0)) or 1.0
    return np.round(FULL_WEIGHT * np.clip(weights / scale, 0, 1)).astype(np.uint8), scale


def _object_pictures(
    fields: SolvedScene, mask: Bool[np.ndarray, "height width"], detail: Detail | None
) -> tuple[np.ndarray, tuple[float, float, float, float], np.ndarray | None]:
    """Return albedo, its window in the photo, and normals where there is a detail."""
    height, width = mask.shape
    if detail is not None and detail.confidence.any():
        small = detail.reduced(max(detail.confidence.shape) / PICTURE_SIDE)
        camera = detail.posed_camera.camera
        photo = camera.fx / fields.camera.fx * width, camera.fy / fields.camera.fy * height
        window = detail.window
        shares = window.left / photo[0], window.top / photo[1], window.width / photo[0], window.height / photo[1]
        albedo, normals = detail_pictures(small)
        return albedo, shares, normals
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        rows, columns = np.array([0, height - 1]), np.array([0, width - 1])
    top, left = max(int(rows[0]) - MARGIN, 0), max(int(columns[0]) - MARGIN, 0)
    bottom, right = min(int(rows[-1]) + MARGIN + 1, height), min(int(columns[-1]) + MARGIN + 1, width)
    cut = np.s_[top:bottom, left:right]
    inner = np.asarray(binary_erosion(mask, border_value=1), bool)
    picture = smaller(filled(fields.albedo.numpy()[cut], (inner if inner.any() else mask)[cut]), PICTURE_SIDE)
    return encode_srgb(picture), (left / width, top / height, (right - left) / width, (bottom - top) / height), None


def detail_pictures(detail: Detail) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]:
    """Return sRGB albedo and normals (n + 1) / 2 of a detail, both continued beyond the object's outline."""
    seen = np.asarray(detail.normals.any(-1))
    sure = detail.confidence > SURE // 20
    known = sure if sure.any() else seen
    albedo = filled(detail.albedo.astype(np.float32), known)
    normals = filled(detail.normals.astype(np.float32) / UNIT, known)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return encode_srgb(albedo), np.round(127.5 * (normals + 1)).astype(np.uint8)


def ground_pictures(
    albedo: Float[np.ndarray, "height width 3"], ground: Bool[np.ndarray, "height width"]
) -> tuple[UInt8[np.ndarray, "rows columns 3"], UInt8[np.ndarray, "3"]]:
    """Return the ground's albedo on the photo's grid, without what the object hides and no light reaches, and its mean.

    Where no photo lights the ground, under a belly and beyond a table's edge, its albedo is exactly 0.
    """
    lit = ground & albedo.any(-1)
    ground = lit if lit.any() else ground
    mean = albedo[ground].mean(0) if ground.any() else np.full(3, 0.5, np.float32)
    hidden = np.asarray(binary_dilation(~ground, iterations=2), bool)
    known = ~hidden if (~hidden).any() else ground
    picture = filled(albedo, known) if known.any() else np.broadcast_to(mean, albedo.shape)
    return encode_srgb(smaller(np.ascontiguousarray(picture), PICTURE_SIDE)), encode_srgb(mean)


class FirstView:
    """What a camera at the capture camera's centre sees of a scene. Its albedo is the photo's own."""

    def __init__(self, fields: SolvedScene, place: PosedCamera, studio: Studio, scene: StageScene):
        """Take where it is seen from."""
        self._fields, self._place, self._studio, self._scene = fields, place, studio, scene

    @cached_property
    def lamp(self) -> tuple[float, float]:
        """Azimuth and elevation (rad) of the key light, high and to a side of the camera, that shows the most shape.

        That is the one under which the object, were it white, would use the available brightnesses most evenly: of the
        largest entropy [Gumhold 2002, Maximum entropy light source placement].
        """
        camera = direction_of(self._place.centre - self._studio.centre)[0]
        return max(((camera + aside, high) for high in HIGH for aside in ASIDE), key=lambda place: self.entropy(*place))

    def entropy(self, azimuth: float, elevation: float) -> float:
        """Return the entropy (nats) of the brightnesses of the object, were it white, under a far lamp (rad)."""
        way = torch.from_numpy(towards(azimuth, elevation)).float()
        direct = self._receivers.from_afar(way[None])[0][:, None]
        light = LAMP * direct + self._soft(self._receivers.points).arriving(way, LAMP, SKY)
        shades = encode_srgb(light.mean(-1).clamp(0, 1).numpy()).astype(int) * SHADES // 256
        share = np.bincount(shades, minlength=SHADES) / max(1, len(shades))
        return float(-(share[share > 0] * np.log(share[share > 0])).sum())

    def picture(self, background: UInt8[np.ndarray, "3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Return the scene, sRGB, under `lamp`.

        Args:
            background: where nothing is, sRGB.
        """
        maps, radius, way = self._maps, self._studio.radius, towards(*self.lamp)
        distance, seen = KEY_DISTANCE * radius, torch.isfinite(maps.depth)
        light = Light("", "point", self._studio.centre + distance * way, power=np.full(3, LAMP * distance**2))
        eye = torch.from_numpy(self._place.centre).float()
        albedo = self._albedo()
        linear = relight_soft(RenderView(maps, albedo, self._fields.grid, eye), light, LAMP_RADII * radius, RAYS)
        soft = self._soft(maps.points[maps.mask]).arriving(torch.from_numpy(way).float(), LAMP, SKY)
        linear[maps.mask] += albedo[maps.mask] * soft
        ground = seen & ~maps.mask
        linear[ground] += albedo[ground] * (SKY * self._ground_sky(maps.points[ground]))[:, None]
        picture = encode_srgb(linear.numpy())
        picture[~seen.numpy()] = background
        return picture

    @cached_property
    def _maps(self) -> SurfaceMaps:
        return surface_maps(self._fields.grid, self._place)

    @cached_property
    def _receivers(self) -> Receivers:
        mask = self._maps.mask
        points, normals = self._maps.points[mask][::SPARSE], self._maps.normals[mask][::SPARSE]
        starts = shadow_starts(self._fields.grid, points, normals, torch.ones(len(points), dtype=torch.bool))
        return Receivers(self._fields.grid, points, normals, starts)

    @cached_property
    def _vertices(self) -> KDTree:
        return KDTree(self._scene.vertices)

    def _soft(self, points: Float[Tensor, "n 3"]) -> SoftLight:
        """Return the soft light of the nearest vertices."""
        index, soft = torch.from_numpy(self._vertices.query(points.numpy())[1]), self._scene.soft
        return SoftLight(soft.sky[index], soft.bounce[index], soft.tint[index])

    def _ground_sky(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        share, half = self._scene.ground_sky, GROUND_HALF * self._studio.radius
        x, y = ((points.numpy() - self._studio.centre)[:, :2].T / half + 1) / 2 * (len(share) - 1)
        return torch.from_numpy(map_coordinates(share, [y, x], order=1, cval=1.0)).float()

    def _albedo(self) -> Float[Tensor, "height width 3"]:
        points = self._maps.points
        pixels = self._fields.posed_camera.project(points.reshape(-1, 3).double().numpy()).astype(np.float32)
        x, y = (np.ascontiguousarray(pixels[:, k].reshape(points.shape[:2])) for k in (0, 1))
        outside = (*decode_srgb(self._scene.ground_mean).tolist(), 0.0)
        return torch.from_numpy(
            cv2.remap(self._fields.albedo.numpy(), x, y, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, outside)
        ).clamp(max=1)  # as in the pictures that the page draws with
