"""The solver's operators in differentiable torch, on any device: the gradients come from autograd.

They compute in float64 on the CPU, in float32 elsewhere; rays are processed in batches that bound the memory. Gradients
are summed as multiples of a small number in float64, so that neither the order of a device's additions nor the batch
size changes a bit of the result.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene, lights_in_frame
from reconstruct.sdf import kernels
from reconstruct.sdf.kernels import FAR, GRAZING, GROUND, JITTER, MASK_JITTER, MAX_START, NO_WEIGHT, OBJECT
from reconstruct.sdf.level_set import BAND
from reconstruct.sdf.rays import run
from reconstruct.solve.operators import DrawnRays, Sums
from reconstruct.torch_sdf.autograd import LightRays, march
from reconstruct.torch_sdf.equations import area_ratio, moved_intersection
from reconstruct.torch_sdf.level_set import TorchLevelSet, rounded
from reconstruct.torch_sdf.rays import BATCHES, MISSED, first_surface

LEAST_SHARE = 1e-3  # of a pixel: a smaller part of it has no gradient
LEAST_SEEN = 1e-9  # transmittance below which the loss continues as a straight line; likewise for 1 - T


class TorchOperators:
    """RayOperators of one level; its rays are kept in the grid frame on the level set's device."""

    def __init__(
        self,
        surface: TorchLevelSet,
        scene: Scene,
        rays: Supervision,
        config: FitConfig,
        real: torch.dtype | None = None,
    ):
        """Move the operators' data to the device, once.

        Args:
            real: type of positions along rays; by default float64 on the CPU and float32 elsewhere.
        """
        self.device = surface.field.device
        self.real = real or (torch.float64 if self.device.type == "cpu" else torch.float32)
        self.surface, self.config = surface, config
        origin = torch.from_numpy(np.asarray(surface.origin, np.float64))
        self.eye = self._moved((scene.eye.double() - origin) / surface.spacing)
        self.move_lights(lights_in_frame(scene.lights.double(), origin, surface.spacing).numpy())
        self.directions, self.role = self._moved(rays.directions), self._moved(rays.role)
        self.ground_t = self._moved(np.where(np.isfinite(rays.ground_t), rays.ground_t / surface.spacing, MISSED))
        self.width = float(scene.pixel_angle)
        self.label = torch.from_numpy(rays.label).to(self.device)
        self.covered, self.normals = self._moved(rays.mask), self._moved(rays.normals)
        self.normal_confidence = config.normal_weight * self._moved(rays.normal_confidence)

    def find_surface(self) -> None:
        """See RayOperators."""
        self.sdf = self.surface.differentiable(self.real)
        batches = zip(self.directions.split(BATCHES.rays), self.ground_t.split(BATCHES.rays), strict=True)
        found = [first_surface(self.sdf.volume, self.eye.expand_as(d), d, end, self.width) for d, end in batches]
        self.hit, self.part_t, self.part_f = (torch.cat(parts) for parts in zip(*found, strict=True))

    def shadow(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """See RayOperators."""
        photo, pixel = torch.from_numpy(rays.places).to(self.device).T
        weight, jitter = self._moved(rays.weights), self._uniforms(iteration, JITTER, len(rays.weights), 2, 3)
        on_object = (self.hit < FAR) & (self.role != GROUND)
        end = torch.where(on_object, self.hit, self.ground_t)
        shown = (weight >= NO_WEIGHT) & (end[pixel] <= FAR) & ((self.role[pixel] != OBJECT) | on_object[pixel])
        misses = torch.full_like(weight, -1.0)
        for some in shown.nonzero()[:, 0].split(BATCHES.rays):
            batch = (photo[some], pixel[some], weight[some], 0.5 + 0.5 * jitter[some])
            misses[some] = self._shadow_batch(*batch, sharpness)
        rays.misses[...] = misses.cpu().numpy()
        return float((weight * misses)[shown].sum()), float(weight[shown].sum())

    def mask(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """See RayOperators."""
        jitter, sums = self._uniforms(iteration, MASK_JITTER, len(rays.weights), 1, 1)[:, 0], self.eye.new_zeros(2)
        given = (torch.from_numpy(rays.places[:, 0]).to(self.device), self._moved(rays.weights), jitter)
        for pixel, weight, first in zip(*(x.split(BATCHES.rays) for x in given), strict=True):
            label = 1 - self.covered[pixel]
            camera = torch.cat([self.directions[pixel], torch.zeros_like(weight)[:, None]], 1)
            start, far = self.eye.expand(len(pixel), 3), self.ground_t[pixel]
            along = march(self.sdf, start, camera, sharpness, 0.5 + 0.5 * first, far)
            log_seen = along.log_transmittance(sharpness)
            loss = self._clear_loss(along, label) + cross_entropy(log_seen.exp(), -log_seen.expm1(), label) / sharpness
            (weight * loss).sum().backward()
            sums += torch.stack([weight @ (log_seen.detach().exp() - label).abs(), weight.sum()])
        return float(sums[0]), float(sums[1])

    def normal(self) -> Sums:
        """See RayOperators."""
        sums = self.eye.new_zeros(2)
        for pixel in ((self.normal_confidence >= NO_WEIGHT) & (self.hit <= FAR)).nonzero()[:, 0].split(BATCHES.rays):
            points = self.eye + self.hit[pixel, None] * self.directions[pixel]
            weight, rest = self.normal_confidence[pixel], self.sdf.gradient(points) - self.normals[pixel]
            error = weight @ rest.square().sum(-1)
            (0.5 * error).backward()
            sums += torch.stack([error.detach(), weight.sum()])
        return float(sums[0]), float(sums[1])

    def light_gradient(self) -> Float[np.ndarray, "photos 4"]:
        """See RayOperators."""
        left = self.lights.grad
        total = torch.zeros_like(self.lights) if left is None else left
        self.lights.grad = None
        return total[:, [0, 1, 2, 4]].cpu().numpy()

    def move_lights(self, lights: Float[np.ndarray, "photos 4"]) -> None:
        """See RayOperators."""
        left = getattr(self, "lights", None)
        given = torch.cat([torch.from_numpy(lights), torch.zeros(len(lights), 1, dtype=torch.float64)], 1)
        # The fifth number is 0, and gets the sum of the gradient's sizes.
        self.lights = given.to(self.device).requires_grad_()
        self.lights.grad = None if left is None else left.grad

    # --- parts of the operators ---------------------------------------------------------------------------------------

    def _shadow_batch(
        self,
        photo: Int[Tensor, " n"],
        pixel: Int[Tensor, " n"],
        weight: Float[Tensor, " n"],
        jitter: Float[Tensor, "n 2"],
        s: float,
    ) -> Float[Tensor, " n"]:
        """Return |C - label| of some drawn rays, and add their gradients to the surface and the lights.

        A boundary pixel mixes two rays, C = w T_near + (1 - w) T_far [ShadowNeuS eq:edge_vis].
        """
        view, label = self.directions[pixel], self.label[photo, pixel].to(self.real)
        is_edge = (self.part_t[pixel] > 0) & (self.role[pixel] != GROUND) & self.config.use_boundary
        edge = is_edge.nonzero()[:, 0]
        silhouette = self.eye + self.part_t[pixel[edge], None] * view[edge]
        partial = _bounded(self.sdf.sample(silhouette), weight[edge])
        share = torch.zeros_like(weight).index_put((edge,), area_ratio(partial, self.width * self.part_t[pixel[edge]]))
        start, is_away = self._starts(pixel, share, self._lights(photo)[0], label)
        # The far ray of each pixel, then the near ones: marched together, they cost a device one march.
        starts, photos = torch.cat([start, silhouette]), torch.cat([photo, photo[edge]])
        lights, sizes = self._lights(photos)
        first = torch.cat([jitter[:, 0], jitter[edge, 1]])
        both = march(self.sdf, starts, lights, s, first, light_sizes=sizes)
        parts = [len(start), len(silhouette)]
        lost_far, lost_near = both.log_transmittance(s, True).split(parts)
        clear_far, clear_near = self._clear_loss(both, torch.cat([label, label[edge]])).split(parts)
        # A surface that faces away from its light is dark by itself, max(n . l, 0): see kernels.shadow_pass.
        seen = (1 - share) * torch.where(is_away, 0.0, lost_far.exp())
        absorbed = (1 - share) * torch.where(is_away, 1.0, -lost_far.expm1())
        seen = seen.index_add(0, edge, share[edge] * lost_near.exp())
        absorbed = absorbed.index_add(0, edge, share[edge] * -lost_near.expm1())
        loss = cross_entropy(seen, absorbed, label) / s
        loss = loss + torch.where(~is_away & (1 - share > LEAST_SHARE), clear_far, 0.0)
        of_near = torch.where(share[edge] > LEAST_SHARE, clear_near, 0.0)
        (weight * loss.index_add(0, edge, of_near)).sum().backward()
        return (seen.detach() - label).abs()

    def _starts(
        self,
        pixel: Int[Tensor, " n"],
        share: Float[Tensor, " n"],
        lights: Float[Tensor, "n 4"],
        label: Float[Tensor, " n"],
    ) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]:
        """Return where each pixel's shadow ray starts, and whether it is dark and faces away from its light.

        The start moves with the SDF there [ShadowNeuS eq:diff_intersect]. "Dark" is by the label.
        """
        view = self.directions[pixel]
        is_hit = (self.hit[pixel] < FAR) & (self.role[pixel] != GROUND)
        start = self.eye + torch.where(is_hit, self.hit[pixel], self.ground_t[pixel])[:, None] * view
        normals = self.sdf.volume.gradient(start)
        away = (normals * (lights[:, :3] - lights[:, 3:] * start)).sum(-1) < 0
        if self.config.use_start_gradient:
            free = (is_hit & (1 - share > LEAST_SHARE)).nonzero()[:, 0]
            sdf = _bounded(self.sdf.sample(start[free]), torch.full_like(share[free], MAX_START))
            change = sdf - sdf.detach()
            moved = moved_intersection(start[free], view[free], change, normals[free], GRAZING)
            start = start.index_put((free,), moved)
        return start, is_hit & (label < 0.5) & away

    def _lights(self, photo: Int[Tensor, " n"]) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
        """Return the light of each ray, and the tensor that collects the magnitude of the light's gradient."""
        rows = self.lights[photo]
        rows.register_hook(rounded)
        return rows[:, :4].to(self.real), rows[:, 4].to(self.real)

    def _clear_loss(self, rays: LightRays, label: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Return the cross entropy over s of rays without an extremum, T = 1 to rounding; 0 for other rays.

        1 - T tends to Phi(-s m) and -log(1 - T) to s m, m the least SDF on the ray.
        """
        found = rays.found
        clear = ((found.count == 0) & (label < 1) & (found.best_t > 0) & (found.best_f < BAND)).nonzero()[:, 0]
        least = rays.sample(clear, found.best_t[clear])
        return torch.zeros_like(label).index_put((clear,), (1 - label[clear]) * least)

    def _uniforms(self, iteration: int, turn: int, count: int, columns: int, step: int) -> Float[Tensor, "count c"]:
        """Return the same random numbers as the kernels."""
        numbers = np.empty((count, columns))
        run(kernels.uniforms, count, self.config.seed, iteration * kernels.TURNS + turn, step, numbers)
        return self._moved(numbers)

    def _moved(self, values: np.ndarray | Tensor) -> Tensor:
        """Move values to the device; floating-point values are converted to type `real`."""
        tensor = values if isinstance(values, Tensor) else torch.from_numpy(values)
        return tensor.to(self.real if tensor.is_floating_point() else tensor.dtype).to(self.device)


def cross_entropy(
    seen: Float[Tensor, " n"], absorbed: Float[Tensor, " n"], label: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Return -y log T - (1 - y) log(1 - T), with a finite slope at both ends.

    Args:
        seen: T, in [0, 1].
        absorbed: 1 - T, computed without cancellation.
        label: y, visibility in [0, 1].
    """
    return -label * _log(seen) - (1 - label) * _log(absorbed)


def _log(x: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the logarithm, and below LEAST_SEEN its tangent there."""
    return torch.where(x > LEAST_SEEN, x.clamp(min=LEAST_SEEN).log(), x / LEAST_SEEN + np.log(LEAST_SEEN) - 1)


def _bounded(values: Float[Tensor, " n"], bound: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the same values, with gradients clamped to [-bound, bound]."""
    if values.requires_grad:
        values.register_hook(lambda gradient: gradient.clamp(-bound, bound))
    return values
