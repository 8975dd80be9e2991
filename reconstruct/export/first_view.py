"""The view that a page opens with: which lamp shows the object's shape best there, and a picture of it."""

from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree
from torch import Tensor

from calibration.light import Light
from calibration.posed_camera import PosedCamera
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.export.stage_scene import GROUND_HALF, StageScene
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import RenderView, SurfaceMaps, surface_maps
from reconstruct.render.receivers import Receivers
from reconstruct.render.relight import relight_soft
from reconstruct.render.soft_light import SoftLight
from reconstruct.render.studio import KEY_DISTANCE, LAMP_RADII, Studio, direction_of, towards
from reconstruct.sdf.rays import shadow_starts

LAMP, SKY = (
    0.7,
    0.25,
)  # irradiance: key and fill as 4 to 1, as for a portrait; the brightest albedo (0.9) just unclipped
ASIDE = tuple(np.radians([-60.0, -45.0, -30.0, 30.0, 45.0, 60.0]))  # of a portrait's key light, from the camera
HIGH = tuple(np.radians([35.0, 45.0, 55.0]))  # above the ground
SHADES = 32  # brightnesses that an eye tells apart on a small picture
SPARSE = 7  # every such pixel of the object is asked: thousands, in no rows
RAYS = 3  # shadow rays per pixel of a picture that stands for a moment


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
        )
