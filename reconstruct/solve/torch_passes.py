"""One iteration of the solver in torch, on any device: the four passes of reconstruct/sdf/kernels.py, ray for ray.

The same rays are drawn as by the kernels, and value and gradient agree to rounding. In float64 on the CPU (for tests),
in float32 elsewhere; rays go through in batches that bound the memory, and the device is waited for only where a batch
has to be compacted.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf.kernels import FAR, GRAZING, GROUND, MAX_START, NO_WEIGHT, OBJECT
from reconstruct.sdf.level_set import BAND
from reconstruct.solve.kernel_passes import rays_per_iteration
from reconstruct.solve.torch_draw import draw_rays, hash_uniform, record
from reconstruct.torch_sdf.level_set import QUANTUM, TorchLevelSet
from reconstruct.torch_sdf.rays import BATCHES, MISSED, Extrema, extrema, first_surface, towards
from reconstruct.torch_sdf.volume import Volume

LEAST_PART = 1e-6  # of a gradient: smaller ones are not worth a place
LEAST_SHARE = 1e-3  # of a pixel: a smaller part of it sends no gradient
LEAST_SEEN = 1e-9  # how near to 0 and 1 a transmittance may come in the loss


@dataclass(frozen=True)
class _Ends:
    """Where the pixels' rays end: the camera pass."""

    hit: Float[Tensor, " pixels"]
    part_t: Float[Tensor, " pixels"]
    part_f: Float[Tensor, " pixels"]


@dataclass(frozen=True)
class _Rays:
    """Marched rays, and what their gradients need."""

    found: Extrema
    origins: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    length: Float[Tensor, " n"]  # to the light, MISSED if it is a direction

    def seen(self) -> Float[Tensor, " n"]:
        """Transmittance."""
        return self.found.log_transmittance.exp()

    def absorbed(self) -> Float[Tensor, " n"]:
        """1 - transmittance, exact where it is tiny."""
        return -torch.expm1(self.found.log_transmittance)


class TorchPasses:
    """RayPasses in torch: one level's rays in the grid frame, on the device of the level set."""

    def __init__(
        self,
        state: TorchLevelSet,
        scene: Scene,
        rays: Supervision,
        config: FitConfig,
        real: torch.dtype | None = None,
    ):
        """Everything the passes need, moved to the device once.

        Args:
            real: what positions along rays are computed in; float64 on the CPU and float32 elsewhere unless given.
        """
        device = state.field.device
        self.real = real or (torch.float64 if device.type == "cpu" else torch.float32)
        self.state, self.config, self._host = state, config, rays

        def moved(values: np.ndarray | Tensor) -> Tensor:
            tensor = values if isinstance(values, Tensor) else torch.from_numpy(values)
            return tensor.to(self.real if tensor.is_floating_point() else tensor.dtype).to(device)

        origin = torch.from_numpy(np.asarray(state.origin, np.float64))
        is_point = scene.lights[:, 3:].double()
        lights = (scene.lights[:, :3].double() - is_point * origin) / torch.where(is_point > 0, state.spacing, 1.0)
        self.eye = moved((scene.eye.double() - origin) / state.spacing)
        self.lights = moved(torch.cat([lights, is_point], 1))
        self.directions, self.role = moved(rays.directions), moved(rays.role)
        self.ground_t = moved(np.where(np.isfinite(rays.ground_t), rays.ground_t / state.spacing, MISSED))
        self.width = float(scene.pixel_angle)
        self.label, self.confidence = (torch.from_numpy(x).to(device) for x in (rays.label, rays.confidence))
        self.error, self.wrong = (torch.from_numpy(x).to(device) for x in (rays.error, rays.wrong))
        self.covered, self.normals = moved(rays.mask), moved(rays.normals)
        self.mask_confidence = config.mask_weight * moved(rays.mask_confidence)
        self.normal_confidence = config.normal_weight * moved(rays.normal_confidence)
        self._light_sums = torch.zeros(len(lights), 4, dtype=torch.long, device=device)
        self.n_rays = rays_per_iteration(config, len(rays.pixels))

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, shoot the rays, leave their gradients in the level set; the mean errors by name."""
        volume = Volume.of(self.state.field.to(self.real))
        ends = self._camera(volume)
        sums = torch.stack(
            [
                self._shadow(volume, ends, iteration, sharpness),
                self._mask(volume, iteration, sharpness),
                self._normal(volume, ends),
            ]
        )
        means = (sums[:, 0] / sums[:, 1].clamp(min=1e-9)).tolist()
        return dict(zip(("shadow", "mask", "normal"), means, strict=True))

    def light_gradient(self) -> Float[np.ndarray, "photos 4"]:
        """See RayPasses."""
        total = self._light_sums.cpu().double().numpy() * QUANTUM
        self._light_sums.zero_()
        return total

    def aim(self, lights: Float[np.ndarray, "photos 4"]) -> None:
        """See RayPasses."""
        self.lights = torch.from_numpy(lights).to(self.real).to(self.lights.device)

    def forget(self) -> list[int]:
        """See RayPasses."""
        self.light_gradient()
        spoilt = ~self.error.isfinite()
        self.error.masked_fill_(spoilt, 1.0)
        self.wrong.masked_fill_(spoilt, 0)
        return spoilt.any(1).nonzero()[:, 0].tolist()

    def settle(self) -> None:
        """Copy the running tables back to the Supervision that they came from."""
        self._host.error[...] = self.error.cpu().numpy()
        self._host.wrong[...] = self.wrong.cpu().numpy()

    # --- passes -------------------------------------------------------------------------------------------------------

    def _camera(self, volume: Volume) -> _Ends:
        found = []
        for d, end in zip(self.directions.split(BATCHES.rays), self.ground_t.split(BATCHES.rays), strict=True):
            found.append(first_surface(volume, self.eye.expand_as(d), d, end, self.width))
        return _Ends(*(torch.cat(parts) for parts in zip(*found, strict=True)))

    def _shadow(self, volume: Volume, ends: _Ends, iteration: int, s: float) -> Float[Tensor, "2"]:
        """kernels.shadow_pass, and its sums: of weight * |T - label|, and of weights."""
        seed = self.config.seed
        photo, pixel, weight = draw_rays(self.confidence, self.error, self.wrong, seed, iteration, self.n_rays)
        misses = torch.full_like(weight, -1.0)
        end, is_hit = self._starts(ends)
        shown = (weight >= NO_WEIGHT) & (end[pixel] <= FAR) & ((self.role[pixel] != OBJECT) | is_hit[pixel])
        sums = self.lights.new_zeros(2)
        for number in shown.nonzero()[:, 0].split(BATCHES.rays):
            batch = (photo[number], pixel[number], weight[number].to(self.real), number)
            miss = self._shadow_batch(volume, ends, batch, iteration, s)
            misses[number] = miss.to(misses.dtype)
            sums += torch.stack([(batch[2] * miss).sum(), batch[2].sum()])
        record(photo, pixel, weight, misses, self.error, self.wrong)
        return sums

    def _starts(self, ends: _Ends) -> tuple[Float[Tensor, " pixels"], Bool[Tensor, " pixels"]]:
        """Where each pixel's shadow rays start: t, and whether that is on the object."""
        is_hit = (ends.hit < FAR) & (self.role != GROUND)
        return torch.where(is_hit, ends.hit, self.ground_t), is_hit

    def _shadow_batch(
        self, volume: Volume, ends: _Ends, batch: tuple[Tensor, Tensor, Tensor, Tensor], iteration: int, s: float
    ) -> Float[Tensor, " n"]:
        """|C - label| of some drawn rays; their gradients go to the level set."""
        photo, pixel, weight, number = batch
        end, is_hit = (x[pixel] for x in self._starts(ends))
        part_t, part_f = ends.part_t[pixel], ends.part_f[pixel]
        two = (part_t > 0) & (self.role[pixel] != GROUND) & self.config.use_boundary
        footprint = torch.where(two, self.width * part_t, 1.0)
        share = torch.where(two, (0.5 - part_f / footprint).clamp(0, 1), 0.0)
        far = self._marched(volume, photo, pixel, end, (iteration, number, 0), s)
        label = self.label[photo, pixel].to(self.real)
        far = _dark_by_itself(volume, far, is_hit & (label < 0.5))
        edge = two.nonzero()[:, 0]
        near = self._marched(volume, photo[edge], pixel[edge], part_t[edge], (iteration, number[edge], 1), s)
        blend, absorbed = (1 - share) * far.seen(), (1 - share) * far.absorbed()
        blend[edge] += share[edge] * near.seen()
        absorbed[edge] += share[edge] * near.absorbed()
        slope = _loss_slope(blend, absorbed, label)

        back = self._leave(volume, far, s, 1 - share, slope, weight, label, photo)
        if self.config.use_start_gradient:
            moves = (is_hit & (1 - share > LEAST_SHARE)).nonzero()[:, 0]
            self._move_start(volume, far.origins[moves], self.directions[pixel[moves]], back[moves])
        self._leave(volume, near, s, share[edge], slope[edge], weight[edge], label[edge], photo[edge])
        amount = -slope[edge] * (near.seen() - far.seen()[edge]) / (footprint[edge] * s)
        self.state.add(volume, near.origins, weight[edge] * amount.clamp(-1, 1))
        return (blend - label).abs()

    def _marched(
        self, volume: Volume, photo: Tensor, pixel: Tensor, t: Tensor, turn: tuple[int, Tensor, int], s: float
    ) -> _Rays:
        """Shadow rays from t along each pixel's ray to the light of each photo."""
        iteration, number, which = turn
        origins = self.eye + t[:, None] * self.directions[pixel]
        directions, length = towards(origins, self.lights[photo])
        jitter = 0.5 + 0.5 * hash_uniform(self.config.seed, iteration * 16 + 9, 3 * number + which)
        found = extrema(volume, origins, directions, length, s, jitter.to(self.real))
        return _Rays(found, origins, directions, length)

    def _mask(self, volume: Volume, iteration: int, s: float) -> Float[Tensor, "2"]:
        """kernels.mask_pass: the camera is one more light, lit where the pixel is bare ground."""
        seed, sums = self.config.seed, self.lights.new_zeros(2)
        count = int(self.n_rays * self.config.mask_share)
        for number in torch.arange(count, device=self.lights.device).split(BATCHES.rays):
            pixel = (hash_uniform(seed, iteration * 16 + 11, number) * len(self.covered)).long()
            shot = self.mask_confidence[pixel] >= NO_WEIGHT
            number, pixel = number[shot], pixel[shot]
            weight, label = self.mask_confidence[pixel], 1 - self.covered[pixel]
            d, o = self.directions[pixel], self.eye.expand(len(pixel), 3)
            jitter = 0.5 + 0.5 * hash_uniform(seed, iteration * 16 + 12, number)
            found = extrema(volume, o, d, self.ground_t[pixel], s, jitter.to(self.real))
            rays = _Rays(found, o, d, torch.full_like(label, MISSED))
            slope = _loss_slope(rays.seen(), rays.absorbed(), label)
            self._leave(volume, rays, s, torch.ones_like(label), slope, weight, label, None)
            sums += torch.stack([(weight * (rays.seen() - label).abs()).sum(), weight.sum()])
        return sums

    def _normal(self, volume: Volume, ends: _Ends) -> Float[Tensor, "2"]:
        """kernels.normal_pass: half the squared distance between gradient and normal where a pixel's ray hits."""
        sums = self.lights.new_zeros(2)
        seen = (self.normal_confidence >= NO_WEIGHT) & (ends.hit <= FAR)
        for pixel in seen.nonzero()[:, 0].split(BATCHES.rays):
            points = self.eye + ends.hit[pixel, None] * self.directions[pixel]
            rest, weight = volume.gradient(points) - self.normals[pixel], self.normal_confidence[pixel]
            for axis in range(3):
                half = torch.zeros_like(points)
                half[:, axis] = 0.5
                self.state.add(volume, points + half, weight * rest[:, axis])
                self.state.add(volume, points - half, -weight * rest[:, axis])
            sums += torch.stack([(weight * rest.square().sum(-1)).sum(), weight.sum()])
        return sums

    # --- gradients ----------------------------------------------------------------------------------------------------

    def _leave(
        self,
        volume: Volume,
        rays: _Rays,
        s: float,
        share: Float[Tensor, " n"],
        slope: Float[Tensor, " n"],
        weight: Float[Tensor, " n"],
        label: Float[Tensor, " n"],
        photo: Int[Tensor, " n"] | None,
    ) -> Float[Tensor, "n 3"]:
        """Gradient of rays on the grid and, if there are photos, the lights; returns that of their starts.

        A ray whose transmittance is 1 to rounding has no extremum left; if it should be dark, its global minimum takes
        the limit of the gradient: T / (1 - T) * Phi(-s m) tends to 1 there.
        """
        found = rays.found
        is_clear = (found.count == 0) & (label < 1) & (found.best_t > 0) & (found.best_f < BAND)
        amount = torch.where(is_clear, weight * (1 - label), weight * slope * share * rays.seen())
        at_low, at_high = found.is_used(), found.is_used() & (found.high_t > 0)
        low = torch.where(at_low, amount[:, None] * torch.sigmoid(-s * found.low_f), 0.0)
        high = torch.where(at_high, -amount[:, None] * torch.sigmoid(-s * found.high_f), 0.0)
        low_t = found.low_t.clone()
        low_t[:, 0] = torch.where(is_clear, found.best_t, low_t[:, 0])
        low[:, 0] = torch.where(is_clear, amount, low[:, 0])
        parts = torch.where((share > LEAST_SHARE)[:, None], torch.cat([low, high], 1), 0.0)

        ray, place = (parts.abs() >= LEAST_PART).nonzero().unbind(1)
        part, t = parts[ray, place], torch.cat([low_t, found.high_t], 1)[ray, place]
        points = rays.origins[ray] + t[:, None] * rays.directions[ray]
        self.state.add(volume, points, part)
        pull = part[:, None] * volume.gradient(points)
        is_point = (rays.length[ray] < FAR)[:, None]
        along = torch.where(is_point, (t / rays.length[ray])[:, None], t[:, None])  # per unit that the light moves
        back = pull.new_zeros(*parts.shape, 3)
        back[ray, place] = pull * torch.where(is_point, 1 - along, 1.0)
        if photo is not None:
            of_light = torch.cat([pull, part[:, None].abs()], 1) * along
            self._light_sums.index_add_(0, photo[ray], (of_light / QUANTUM).round().long())
        return back.sum(1)

    def _move_start(
        self, volume: Volume, origins: Float[Tensor, "n 3"], views: Float[Tensor, "n 3"], back: Float[Tensor, "n 3"]
    ) -> None:
        """Differentiable intersection [ShadowNeuS eq:diff_intersect]: phi at the start moves it along its view."""
        facing = (volume.gradient(origins) * views).sum(-1)
        sees = facing <= -GRAZING
        amount = -(back * views).sum(-1)[sees] / facing[sees]
        self.state.add(volume, origins[sees], amount.clamp(-MAX_START, MAX_START))


def _dark_by_itself(volume: Volume, rays: _Rays, among: Bool[Tensor, " n"]) -> _Rays:
    """The same rays, but dark and without gradient where their surface faces away: kernels.shadow_pass."""
    normals = torch.nn.functional.normalize(volume.gradient(rays.origins), dim=-1, eps=1e-9)
    is_away = among & ((normals * rays.directions).sum(-1) < 0)
    log_t = torch.where(is_away, -torch.inf, rays.found.log_transmittance)
    count = torch.where(is_away, rays.found.count.clamp(min=1), rays.found.count)
    return replace(rays, found=replace(rays.found, log_transmittance=log_t, count=count))


def _loss_slope(
    seen: Float[Tensor, " n"], absorbed: Float[Tensor, " n"], label: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """dL/dT of L = -y log T - (1 - y) log(1 - T), finite at both ends; absorbed: 1 - T without cancellation."""
    return (1 - label) / absorbed.clamp(min=LEAST_SEEN) - label / seen.clamp(min=LEAST_SEEN)
