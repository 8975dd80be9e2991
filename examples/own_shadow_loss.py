"""Shadow rays in a loss of one's own, by torch: where a ball is and how large, from its shadows under three lamps.

python examples/own_shadow_loss.py
"""

import torch

from reconstruct.sdf.grid import SdfGrid
from reconstruct.torch_sdf.autograd import transmittance
from reconstruct.torch_sdf.equations import shadow_loss

NODES, SPACING = 40, 0.1
SHARPNESS = 10.0 / SPACING  # of the edge of shadows: NeuS s, 1 / length
# The last number is 1 for a place, 0 for a direction.
LAMPS = torch.tensor([[0.0, 1.0, 6.0, 1.0], [5.0, 3.0, 6.0, 1.0], [1.0, 6.0, 5.0, 1.0]])


def ball(centre: torch.Tensor, radius: torch.Tensor) -> SdfGrid:
    """Signed distances to a ball; the values of any grid may be trained instead, or come from a network."""
    axis = SPACING * torch.arange(NODES)
    nodes = torch.cartesian_prod(axis, axis, axis).view(NODES, NODES, NODES, 3)
    return SdfGrid((nodes - centre).norm(dim=-1) - radius, torch.zeros(3), SPACING)


def main(steps: int = 80, side: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    across = torch.linspace(-4.0, 8.0, side)
    ground = torch.cat([torch.cartesian_prod(across, across), torch.zeros(side**2, 1)], 1)
    points, lamps = ground.repeat(len(LAMPS), 1), LAMPS.repeat_interleave(len(ground), 0)

    def photos(centre: torch.Tensor, radius: torch.Tensor) -> torch.Tensor:
        """How much of each lamp each point of the ground sees; give it points of a surface for shadows on itself."""
        return transmittance(ball(centre, radius), points, lamps, SHARPNESS)

    shadows = (photos(torch.tensor([1.8, 2.2, 1.7]), torch.tensor(1.2)) > 0.5).float()
    centre, radius = torch.tensor([2.2, 1.8, 2.0], requires_grad=True), torch.tensor(0.7, requires_grad=True)
    optimizer = torch.optim.Adam([centre, radius], lr=0.03)
    for step in range(steps):
        optimizer.zero_grad()
        loss = shadow_loss(photos(centre, radius), shadows).mean()
        loss.backward()
        optimizer.step()
        if step % 20 == 0:
            print(f"{step}: {loss.item():.4f}, centre {centre.detach().numpy().round(2)}, radius {radius.item():.2f}")
    return centre.detach(), radius.detach()


if __name__ == "__main__":
    print(*main())
