"""Losses of rays and their gradients: what the solver minimises. In torch, on the CPU or any device.

Marching along rays and spreading over nodes are the two operators of a RayField; all else is autograd. Rays are
processed in batches that bound the memory.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene, lights_in_frame
from reconstruct.sdf import kernels
from reconstruct.sdf.kernels import FAR, GRAZING, GROUND, JITTER, MASK_JITTER, MAX_START, NEVER, NO_WEIGHT, OBJECT
from reconstruct.sdf.level_set import LevelSet
from reconstruct.sdf.rays import first_surfaces
from reconstruct.torch_sdf.equations import area_ratio, cross_entropy, moved_intersection
from reconstruct.torch_sdf.march import central_differences
from reconstruct.torch_sdf.ray_field import RayField, ray_field
from reconstruct.torch_sdf.rays import BATCHES

LEAST_SHARE = 1e-3  # of a pixel: a smaller part of it has no gradient
Sums = tuple[float, float]  # of weight * error over rays, and of the weights


@dataclass(frozen=True)
class DrawnRays:
    """Shadow or camera rays of an iteration, on the host."""

    places: Int[np.ndarray, "rays n"]  # photo and pixel, or the pixel: places in the Supervision
    weights: Float[np.ndarray, " rays"]
    misses: Float[np.ndarray, " rays"]  # |T - label|, filled by the shadow operator; -1: the pixel shows no surface


class RayOperators:
    """Losses of one level's rays, and their gradients with respect to the surface, in one pass.

    Gradients are added up on the surface, divided by NeuS s and so in voxels, until its next step. `iteration` is of
    the whole solve: with the seed it determines every random number. `sharpness` is NeuS s per voxel.
    """

    def __init__(self, surface: LevelSet, scene: Scene, rays: Supervision, config: FitConfig):
        """Move what does not change to the surface's device, once."""
        self.surface, self.rays, self.config = surface, rays, config
        self.device, self.field = surface.values.device, ray_field(surface)
        origin = torch.from_numpy(np.asarray(surface.origin, np.float64))
        eye = ((scene.eye.double() - origin) / surface.spacing).numpy()
        ground_t = np.where(np.isfinite(rays.ground_t), rays.ground_t / surface.spacing, NEVER)
        self.eye, self.ground_t = self._moved(eye), self._moved(ground_t)
        self.lights = self._moved(lights_in_frame(scene.lights.double(), origin, surface.spacing))
        self.directions, self.role = self._moved(rays.directions), self._moved(rays.role)
        self.label = torch.from_numpy(rays.label).to(self.device)
        self.width = float(scene.pixel_angle)
        confidence = np.float32(config.normal_weight) * rays.normal_confidence
        self.normal_confidence = self._moved(confidence)
        # Rays of pixels that surely show ground start there, wherever the surface is.
        own = np.flatnonzero((rays.role != GROUND) | (confidence > NO_WEIGHT))
        self._on_surface = torch.from_numpy(own).to(self.device)
        self._view = np.tile(eye, (len(own), 1)), rays.directions[own], ground_t[own]
        self.hit, self.part_t = torch.full_like(self.ground_t, NEVER), torch.full_like(self.ground_t, -1.0)

    def find_surface(self) -> None:
        """Find where each pixel's ray meets the current surface: the other operators start there."""
        self.field: RayField = ray_field(self.surface)  # the surface moves only after all operators
        hit, part_t, _ = first_surfaces(self.field.blocks, *self._view, self.width)
        self.hit[self._on_surface], self.part_t[self._on_surface] = self._moved(hit), self._moved(part_t)

    def shadow(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """Compare the transmittance from each ray's pixel to its light with the label; fill `misses`."""
        photo, pixel = torch.from_numpy(rays.places).to(self.device).T.contiguous()
        weight, jitter = self._moved(rays.weights), self._uniforms(iteration, JITTER, len(rays.weights), 2, 3)
        on_object = (self.hit < FAR) & (self.role != GROUND)
        is_seen = (torch.where(on_object, self.hit, self.ground_t) <= FAR) & ((self.role != OBJECT) | on_object)
        misses = torch.full_like(weight, -1.0)
        shown = ((weight >= NO_WEIGHT) & is_seen[pixel]).nonzero()[:, 0]
        for some in shown.split(BATCHES.rays):
            misses[some] = self._shadow_batch(photo[some], pixel[some], weight[some], jitter[some], sharpness)
        rays.misses[...] = misses.cpu().numpy()
        return float(weight[shown] @ misses[shown]), float(weight[shown].sum())

    def mask(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """Compare the transmittance from camera to ground along pixels' rays with the object mask."""
        jitter, sums = self._uniforms(iteration, MASK_JITTER, len(rays.weights), 1, 1)[:, 0], self.eye.new_zeros(2)
        given = (torch.from_numpy(rays.places[:, 0]).to(self.device), self._moved(rays.weights), jitter)
        covered = self._moved(self.rays.mask)
        for pixel, weight, first in zip(*(x.split(BATCHES.rays) for x in given), strict=True):
            label, start = 1 - covered[pixel], self.eye.expand(len(pixel), 3)
            towards = torch.cat([self.directions[pixel], self.eye.new_zeros(len(pixel), 1)], 1)
            log_seen, clear = self.field.march(start, towards, sharpness, first, self.ground_t[pixel])
            loss = cross_entropy(log_seen.exp(), -log_seen.expm1(), label) / sharpness + (1 - label) * clear
            (weight @ loss).backward()
            sums += torch.stack([weight @ (log_seen.detach().exp() - label).abs(), weight.sum()])
        return float(sums[0]), float(sums[1])

    def normal(self) -> Sums:
        """Compare the SDF's gradient where pixel rays meet the surface with the pixels' normals: squared distances."""
        sums, normals = self.eye.new_zeros(2), self._moved(self.rays.normals)
        for pixel in ((self.normal_confidence >= NO_WEIGHT) & (self.hit <= FAR)).nonzero()[:, 0].split(BATCHES.rays):
            points = self.eye + self.hit[pixel, None] * self.directions[pixel]
            weight, rest = self.normal_confidence[pixel], central_differences(self.field.sample, points)
            error = weight @ (rest - normals[pixel]).square().sum(-1)
            (0.5 * error).backward()
            sums += torch.stack([error.detach(), weight.sum()])
        return float(sums[0]), float(sums[1])

    # --- parts of the operators ---------------------------------------------------------------------------------------

    def _shadow_batch(
        self,
        photo: Int[Tensor, " n"],
        pixel: Int[Tensor, " n"],
        weight: Float[Tensor, " n"],
        jitter: Float[Tensor, "n 2"],
        s: float,
    ) -> Float[Tensor, " n"]:
        """Return |C - label| of some drawn rays, and add their gradients to the surface.

        A boundary pixel mixes two rays, C = w T_near + (1 - w) T_far [ShadowNeuS eq:edge_vis].
        """
        view, label, part_t = self.directions[pixel], self.label[photo, pixel].to(self.field.real), self.part_t[pixel]
        edge = ((part_t > 0) & (self.role[pixel] != GROUND) & self.config.use_boundary).nonzero()[:, 0]
        silhouette = self.eye + part_t[edge, None] * view[edge]
        partial = _bounded(self.field.sample(silhouette), weight[edge])
        near = area_ratio(partial, self.width * part_t[edge])
        share = torch.ones_like(weight).index_put((edge,), 1 - near)  # of the pixel that the far ray has
        start, is_away = self._starts(pixel, share.detach(), photo, label)
        # The far ray of each pixel, then the near ones: marched together, they cost a device one march.
        starts, photos = torch.cat([start, silhouette]), torch.cat([photo, photo[edge]])
        first, parts = torch.cat([jitter[:, 0], jitter[edge, 1]]), [len(start), len(silhouette)]
        log_t, least = self.field.march(starts, self.lights[photos], s, first)
        (lost_far, lost_near), (clear_far, clear_near) = log_t.split(parts), least.split(parts)
        # A surface that faces away is dark by max(n . l, 0); its ray would pass a thin slice only and make a bulge.
        lit = torch.where(is_away, 0.0, share)
        seen = (lit * lost_far.exp()).index_add(0, edge, near * lost_near.exp())
        absorbed = (share - lit - lit * lost_far.expm1()).index_add(0, edge, -near * lost_near.expm1())
        # Of a ray with T = 1 to rounding, 1 - T tends to Phi(-s m) and -log(1 - T) to s m, m the least SDF on it.
        clear = torch.where(lit > LEAST_SHARE, clear_far, 0.0)
        clear = clear.index_add(0, edge, torch.where(near > LEAST_SHARE, clear_near, 0.0))
        loss = cross_entropy(seen, absorbed, label) / s + (1 - label) * clear
        (weight @ loss).backward()
        return (seen.detach() - label).abs()

    def _starts(
        self,
        pixel: Int[Tensor, " n"],
        share: Float[Tensor, " n"],
        photo: Int[Tensor, " n"],
        label: Float[Tensor, " n"],
    ) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]:
        """Return where each pixel's shadow ray starts, and whether it is dark and faces away from its light.

        The start moves with the SDF there [ShadowNeuS eq:diff_intersect]. "Dark" is by the label.
        """
        is_hit = (self.hit[pixel] < FAR) & (self.role[pixel] != GROUND)
        end = torch.where(is_hit, self.hit[pixel], self.ground_t[pixel])
        start = self.eye + end[:, None] * self.directions[pixel]
        hit = is_hit.nonzero()[:, 0]
        points, lights = start[hit], self.lights[photo[hit]]
        normals = self.field.gradient(points)
        faces_away = (normals * (lights[:, :3] - lights[:, 3:4] * points)).sum(-1) < 0
        away = torch.zeros_like(is_hit).index_put((hit,), faces_away & (label[hit] < 0.5))
        if self.config.use_start_gradient:
            value = _bounded(self.field.sample(points), torch.full_like(share[hit], MAX_START))
            change = torch.where(share[hit] > LEAST_SHARE, value - value.detach(), 0.0)
            moved = moved_intersection(points, self.directions[pixel[hit]], change, normals, GRAZING)
            start = start.index_put((hit,), moved)
        return start, away

    def _uniforms(self, iteration: int, turn: int, count: int, columns: int, step: int) -> Float[Tensor, "count c"]:
        """Return random shares of a first step, from a half to all of it; splitmix64: any step is repeatable."""
        seed = self.config.seed * 0x9E3779B97F4A7C15 + (iteration * kernels.TURNS + turn) * 0xBF58476D1CE4E5B9
        places = (step * np.arange(count)[:, None] + np.arange(columns)).astype(np.uint64)
        x = np.uint64(seed % 2**64) + places * np.uint64(0x94D049BB133111EB)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
            x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
        return self._moved(0.5 + 0.5 * (x >> np.uint64(11)) * 2.0**-53)

    def _moved(self, values: np.ndarray | Tensor) -> Tensor:
        """Move values to the device; floating-point values are converted to the type of positions along rays."""
        tensor = values if isinstance(values, Tensor) else torch.from_numpy(values)
        return tensor.to(self.field.real if tensor.is_floating_point() else tensor.dtype).to(self.device)


def _bounded(values: Float[Tensor, " n"], bound: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the same values, with gradients clamped to [-bound, bound]."""
    if values.requires_grad:
        values.register_hook(lambda gradient: gradient.clamp(-bound, bound))
    return values
