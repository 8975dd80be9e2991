"""Rays through a level set by plain torch, on any device: what the compiled kernels do on the CPU. Grid frame, voxels.

Gradients are multiples of QUANTUM and summed in float64. This is exact, so that neither the order of a device's
additions nor the number of rays at once changes a bit of the result.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.sdf.blocks import SIDE, overlapping
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.torch_sdf.autograd import DifferentiableSdf, march
from reconstruct.torch_sdf.volume import Volume

QUANTUM = 2.0**-28  # of the gradients: 4e-9, far below the smallest one that counts (1e-6)


class DenseRays:
    """RayField of a level set on a torch device, as the surface is now; all nodes of its box are in memory."""

    def __init__(self, surface: LevelSet, real: torch.dtype | None = None):
        """Spread the stored blocks over the box.

        Args:
            real: type of positions along rays; by default float64 on the CPU and float32 elsewhere.
        """
        values, device, field = surface.values, surface.values.device, surface.field
        self.blocks = overlapping(field)
        self.real = real or (torch.float64 if device.type == "cpu" else torch.float32)
        layout = torch.from_numpy(field.layout).to(device)
        beyond = values.new_tensor([field.far, -field.far])
        index = torch.where(layout < 0, len(values) // SIDE**3 + (layout & 1), layout).long()
        blocks = torch.cat([values.view(-1, SIDE**3), beyond[:, None].expand(2, SIDE**3)])
        places = torch.arange(len(values), device=device).view(-1, SIDE**3)
        none = torch.full((2, SIDE**3), len(values), device=device)
        whole, stored = (_in_box(x[index], field.nodes) for x in (blocks, torch.cat([places, none])))
        # Leaves of autograd, both 0: a change of phi, and what receives the absolute values of its gradients. Theirs
        # are the sums of the surface.
        leaves = [torch.zeros(len(values), dtype=torch.float64, device=device) for _ in range(2)]
        for leaf, sums in zip(leaves, surface.gathered[0].unbind(1), strict=True):
            leaf.requires_grad_().grad = sums
        volume = Volume.of(whole.to(self.real), stored.reshape(-1))
        self.sdf = DifferentiableSdf(volume, leaves[0], leaves[1], QUANTUM)

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """See RayField."""
        return self.sdf.volume.gradient(points)

    def sample(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """See RayField."""
        return self.sdf.sample(points)

    def march(
        self,
        origins: Float[Tensor, "n 3"],
        lights: Float[Tensor, "n 5"],
        sharpness: float,
        jitter: Float[Tensor, " n"],
        far: Float[Tensor, " n"] | None = None,
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """See RayField."""
        if lights.requires_grad:
            lights.register_hook(_rounded)
        ends = lights.to(self.real)
        rays = march(self.sdf, origins, ends[:, :4], sharpness, jitter, far, ends[:, 4])
        found = rays.found
        clear = ((found.count == 0) & (found.best_t > 0) & (found.best_f < BAND)).nonzero()[:, 0]
        least = torch.zeros_like(found.best_f).index_put((clear,), rays.sample(clear, found.best_t[clear]))
        return rays.log_transmittance(sharpness, from_surface=True), least


def _in_box(blocks: Tensor, nodes: tuple[int, int, int]) -> Tensor:
    """Return the values of blocks at the nodes of their box, (bx, by, bz, SIDE^3) to (nx, ny, nz)."""
    bx, by, bz, _ = blocks.shape
    whole = blocks.view(bx, by, bz, SIDE, SIDE, SIDE).permute(0, 3, 1, 4, 2, 5)
    return whole.reshape(bx * SIDE, by * SIDE, bz * SIDE)[tuple(slice(n) for n in nodes)].contiguous()


def _rounded(gradient: Tensor) -> Tensor:
    """Round a float64 gradient to a multiple of QUANTUM, so that its sums are exact."""
    return (gradient / QUANTUM).round() * QUANTUM
