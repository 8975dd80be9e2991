"""A level set: it gathers the rays' gradient, takes bounded steps along it, and is redistanced to stay an SDF.

A signed distance grid in another frame: the same surface, turned and shifted.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage

from calibration.pose import Pose
from reconstruct.sdf import level_set_kernels as levelset
from reconstruct.sdf.blocks import Blocks, near_surface, pack
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import run, thread_count

MARGIN = 3.0  # voxels of empty space about the surface
NEAR = 1.0  # voxels: nodes that may lie inside or beside the surface
EVIDENCE_FLOOR = 0.01  # ray weights per node: below this a node hardly moves
CURVATURE_BAND = 3.0  # voxels
STABLE_BENDING = 1 / 80  # explicit steps of the biharmonic flow are stable below 2 / 12^2
BAND = 6.0  # voxels about the surface in which the SDF is kept and may move
WHOLE = BAND - 1e-3  # voxels: a node at the band itself does not move
SAME = 1e-3  # voxels: a box whose size is a whole number of them but for rounding


def carried(grid: SdfGrid, frame_from_grid: Pose) -> SdfGrid:
    """Return a surface in another frame, on a grid along that frame's axes with the same spacing.

    Values between nodes come from cubic splines, which leave a smooth surface where it was: to 0.01 voxels for a ball
    of ten.

    Args:
        grid: of the frame that `frame_from_grid` starts from.
    """
    inside = torch.nonzero(grid.values < NEAR * grid.spacing).double().numpy()
    origin = grid.origin.double().numpy()
    places = frame_from_grid.apply(origin + grid.spacing * inside) if len(inside) else origin[None]
    lower, upper = places.min(0) - MARGIN * grid.spacing, places.max(0) + MARGIN * grid.spacing
    shape = np.ceil((upper - lower) / grid.spacing).astype(int) + 1
    start = lower.astype(np.float32)
    return SdfGrid(
        torch.from_numpy(values_on(grid, frame_from_grid, start, grid.spacing, shape)),
        torch.from_numpy(start),
        grid.spacing,
    )


def values_on(
    grid: SdfGrid, frame_from_grid: Pose, origin: Float[np.ndarray, "3"], spacing: float, shape: np.ndarray
) -> Float[np.ndarray, "nx ny nz"]:
    """Return a grid's SDF at the nodes of another grid, of another frame; outside its box as SdfGrid.sdf."""
    last = np.array(grid.values.shape) - 1
    coefficients = ndimage.spline_filter(grid.values.numpy().astype(np.float64), order=3, mode="nearest")
    back, out = frame_from_grid.inverse(), np.empty(tuple(int(n) for n in shape), np.float32)
    along = [float(origin[axis]) + spacing * np.arange(out.shape[axis]) for axis in range(3)]
    for i, x in enumerate(along[0]):  # by layers: a fine grid has 14 million nodes
        nodes = np.stack(np.broadcast_arrays(x, along[1][:, None], along[2][None]), -1).reshape(-1, 3)
        at = (back.apply(nodes) - grid.origin.double().numpy()) / grid.spacing
        near = np.clip(at, 0, last)
        found = ndimage.map_coordinates(coefficients, near.T, order=3, mode="nearest", prefilter=False)
        found += grid.spacing * np.linalg.norm(at - near, axis=1)
        out[i] = found.reshape(out.shape[1:])
    return out


class LevelSet:
    """phi in voxels on the blocks of a box that are near the surface, on the CPU or on a torch device.

    Rays add d loss / d phi, and its absolute value, to `gathered`. `step` averages both and moves every node by
    rate * g / (c + floor), so that no node moves by more than `rate` voxels or without evidence.

    The surface must move by less than BAND between two redistancings, so that the stored blocks contain all changes.
    """

    def __init__(
        self,
        phi: np.ndarray | Blocks,
        origin: np.ndarray,
        spacing: float,
        is_distance: bool = False,
        device: torch.device | None = None,
    ):
        """Keep the field.

        Args:
            phi: voxels, on the host.
            device: where rays are marched by torch; None: on the CPU, by compiled kernels.
        """
        self.origin, self.spacing, self.device = origin, spacing, device
        given = phi if isinstance(phi, Blocks) else pack(phi)
        self._keep(near_surface(given, BAND) if is_distance else redistanced(given))

    def _keep(self, field: Blocks) -> None:
        """Replace the field: find the nodes that may move, and set the gradient to zero."""
        active, around = active_nodes(field)
        number = np.full(field.pool.size, len(active), np.int32)  # of the active nodes; of all others, the one after
        number[active] = np.arange(len(active), dtype=np.int32)
        around_active = number[around]
        at_rest = np.where(around_active < len(active), np.float32(0), field.pool.reshape(-1)[around]).sum(1)
        where = self.device or torch.device("cpu")
        self._stored, self.values = field, torch.from_numpy(field.pool.reshape(-1)).to(where)
        self._active, self._around, self._at_rest = (
            torch.from_numpy(x).to(where) for x in (active, around_active, at_rest)
        )
        if self.device is None:  # side by side in memory, as the kernels add to both at once
            self.gathered = torch.zeros(thread_count(), field.pool.size, 2)
        else:  # one after the other: the gradients of two tensors
            self.gathered = torch.zeros(1, 2, field.pool.size, dtype=torch.float64, device=where).transpose(1, 2)

    def on(self, device: torch.device | None) -> "LevelSet":
        """Return the level set on a device; the same object if it is there."""
        same = device == self.device
        return self if same else LevelSet(self.field, self.origin, self.spacing, is_distance=True, device=device)

    @property
    def field(self) -> Blocks:
        """The current blocks, on the host."""
        return self._stored._replace(pool=self.values.cpu().numpy().reshape(self._stored.pool.shape))

    @property
    def phi(self) -> Float[np.ndarray, "nx ny nz"]:
        """A dense copy of phi on the host, float32, voxels."""
        return self.field.dense()

    def sums(self) -> Float[np.ndarray, "2 nx ny nz"]:
        """Return dense copies of the gathered d loss / d phi, and of the sum of its absolute values over rays."""
        total = torch.where(self.values.abs()[:, None] < BAND, self.gathered.sum(0), 0.0).float().cpu()
        pools = total.T.reshape(2, *self._stored.pool.shape).contiguous().numpy()
        return np.stack([self._stored._replace(pool=pool, far=0.0).dense() for pool in pools])

    def is_finite(self) -> bool:
        """Return whether the gathered gradient is finite: a sum is not finite if one of its terms is not."""
        return bool(self.gathered.sum().isfinite())

    def forget(self) -> None:
        """Clear the gradient, without a step."""
        self.gathered.zero_()

    def redistance(self) -> None:
        """Make |grad phi| = 1 within BAND of the same surface, +-BAND beyond; update the nodes that may move."""
        self._keep(redistanced(self.field))

    def step(self, passes: int, rate: float, shrink: float, curvature: float, stiffness: int, smoothing: float) -> None:
        """Apply the gradient of the rays and clear it.

        A node moves by -rate * (g - shrink) / (c + floor + shrink), and by the curvature, which is the SDF's Laplacian.
        Then follow steps of biharmonic flow, phi -= w * Laplacian(Laplacian phi), w = max(floor / (c + floor), least).
        Where few rays pass, as on hidden sides, the surface becomes a thin plate, not a soap film. Where many pass,
        `least` smooths their noise. Unlike curvature flow, this does not shrink round shapes: the Laplacian of a ball's
        SDF is 2 / r, whose Laplacian is zero.

        Args:
            passes: of averaging; rate: bound of the step, voxels; shrink: pull on nodes without evidence; curvature: of
                the flow, in units of rate; stiffness: passes against bending where there is no evidence; smoothing:
                their weight where there is all evidence, in units of rate.
        """
        total = sum(part.index_select(0, self._active) for part in self.gathered)
        assert isinstance(total, torch.Tensor)
        total = total.float()
        self.forget()
        for _ in range(passes):
            total = 0.25 * total + 0.125 * self._sum_around(total)
        gradient, count = total.unbind(1)
        before = self.values.index_select(0, self._active)
        phi = before - rate * (gradient - shrink) / (count + EVIDENCE_FLOOR + shrink)
        if curvature:
            bent = curvature * rate * self._laplacian(before).clamp(-0.5, 0.5)
            phi += torch.where(before.abs() < CURVATURE_BAND, bent, 0.0)
        soft = STABLE_BENDING * (EVIDENCE_FLOOR / (count + EVIDENCE_FLOOR)).clamp(min=smoothing * rate)
        for _ in range(stiffness):
            is_near = phi.abs() < CURVATURE_BAND
            bend = torch.where(is_near, self._laplacian(phi), 0.0)
            bending = self._sum_around(bend[:, None])[:, 0] - 6 * bend
            phi = torch.where(is_near, phi - soft * bending, phi)
        self.values[self._active] = phi

    def _sum_around(self, values: Float[torch.Tensor, "n columns"]) -> Float[torch.Tensor, "n columns"]:
        """Return the sum of each active node's six neighbours; those that do not move count as 0."""
        rows = torch.cat([values, values.new_zeros(1, values.shape[1])])
        return torch.nn.functional.embedding_bag(self._around, rows, mode="sum")

    def _laplacian(self, phi: Float[torch.Tensor, " n"]) -> Float[torch.Tensor, " n"]:
        return self._sum_around(phi[:, None])[:, 0] + self._at_rest - 6 * phi

    def grid(self) -> SdfGrid:
        """Return a copy as an SdfGrid in the world frame."""
        values = self.phi
        values *= np.float32(self.spacing)
        return SdfGrid(torch.from_numpy(values), torch.from_numpy(self.origin.astype(np.float32)), self.spacing)


def active_nodes(field: Blocks) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, "n 6"]]:
    """Return flat pool indices of the nodes within BAND, except on faces of the box, and of their six neighbours."""
    moves = np.abs(field.dense()) < WHOLE
    for axis in range(3):
        np.moveaxis(moves, axis, 0)[[0, -1]] = False
    number = np.arange(field.pool.size, dtype=np.int32).reshape(field.pool.shape)
    places, at = field._replace(pool=number, far=0).dense().ravel(), np.flatnonzero(moves)
    _, ny, nz = field.nodes
    return places[at], places[at[:, None] + np.array([-1, 1, -nz, nz, -ny * nz, ny * nz])]


def redistanced(field: Blocks) -> Blocks:
    """Return the same surface as a distance function within BAND of it and +-BAND beyond. Voxels."""
    field = near_surface(field, BAND)
    out, fixed, places = np.empty_like(field.pool), np.empty(field.pool.shape, np.uint8), field.places()
    run(levelset.interface, len(places), field, places, BAND, out, fixed)
    for order in range(8):
        levelset.sweep(field.layout, out, field.nodes, fixed, BAND, order)
    return field._replace(pool=np.where(field.pool < 0, -out, out))


def as_distance(phi: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
    """Return the same of a dense array."""
    return redistanced(pack(phi)).dense()


def resampled(grid: SdfGrid, nodes: int) -> LevelSet:
    """Return a grid's surface as a level set with `nodes` nodes along the longest side of the same box."""
    lower, upper = grid.origin.double().numpy(), grid.upper().double().numpy()
    spacing = float((upper - lower).max() / (nodes - 1))
    shape = [int(n) + 1 for n in np.ceil((upper - lower) / spacing - SAME)]  # never smaller: the object must fit in
    phi = np.empty(shape, np.float32)
    y, z = (torch.from_numpy(own.ravel()) for own in np.indices(shape[1:]))
    for x, layer in enumerate(phi):  # a fine grid has 14 million nodes
        points = torch.stack([torch.full_like(y, x), y, z], 1).float() * spacing + torch.from_numpy(lower).float()
        layer[...] = (grid.sdf(points).numpy() / spacing).reshape(layer.shape)
    return LevelSet(phi, lower, spacing)
