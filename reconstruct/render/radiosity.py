"""Interreflection of object and ground with one bounce: coarse patches and the visibility between them.

The visibility depends on shape alone, so it is computed once; then any light costs one shadow ray per patch.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.render.receivers import across, disc
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import find_surface, shadow_starts

OBJECT_PATCHES = 1500  # about: light between surfaces changes slowly along them
GROUND_PATCHES = 4000  # an eighth of the object's radius apart beside it
GROUND_REACH = 30.0  # in radii of the object: an endless plane, to a form factor of 1 / 30^2
LIT_REACH = 6.0  # in radii: beyond this, light from the object on the ground is invisible
DIRECTIONS = 64  # sampled directions of light to a patch: each stands for 1/64 of the hemisphere
NORMAL_WEIGHT = 3.0  # distance, in patch sizes, that one radian between normals counts for in the nearest-patch search
NEIGHBOURS = 4  # patches between which light is interpolated


@dataclass(frozen=True)
class Patches:
    """Coarse pieces of object and ground. World frame."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    on_object: Bool[Tensor, " n"]
    starts: Float[Tensor, "n 3"]  # of shadow rays
    seen: Int[Tensor, "n directions"]  # the patch met along each direction, all of equal weight; n: none
    size: float  # of a patch of the object, world length

    def bounced(self, albedo: Float[Tensor, "n 3"], arriving: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the irradiance of every patch by light that the other patches reflect.

        E(x) = 1 / pi * integral of albedo(y) E(y) max(n . w, 0) dw, with y the first point from x along w. It is the
        mean of albedo * E over directions distributed by cosine / pi.

        Args:
            albedo: true albedo of every patch, not relative to a light's power.
            arriving: direct irradiance of every patch.
        """
        sent = torch.cat([albedo * arriving, torch.zeros(1, 3)])
        return sent[self.seen].mean(1)

    @cached_property
    def tree(self) -> KDTree:
        """A search tree over the patches by position and normal, see `nearest_patches`."""
        return KDTree(_keys(self.points, self.normals, self.size))


@dataclass(frozen=True)
class PatchWeights:
    """Indices and weights to interpolate patch values at many points."""

    index: Int[Tensor, "n neighbours"]
    weight: Float[Tensor, "n neighbours"]

    def interpolated(self, values: Float[Tensor, "patches 3"]) -> Float[Tensor, "n 3"]:
        """Interpolate values of the patches at the points."""
        out = self.weight[:, :1] * values[self.index[:, 0]]
        for k in range(1, self.index.shape[1]):
            out += self.weight[:, k, None] * values[self.index[:, k]]
        return out


def nearest_patches(patches: Patches, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> PatchWeights:
    """Find the patches nearest to world points with similar unit normals, weighted by 1 / distance^2."""
    keys = _keys(points, normals, patches.size)
    distance, index = patches.tree.query(keys, k=NEIGHBOURS, workers=-1)
    weight = 1 / np.maximum(distance, 1e-3) ** 2
    weight /= weight.sum(1, keepdims=True)
    return PatchWeights(torch.from_numpy(index.astype(np.int32)), torch.from_numpy(weight.astype(np.float32)))


def _keys(points: Tensor, normals: Tensor, size: float) -> np.ndarray:
    return np.ascontiguousarray(torch.cat([points / size, NORMAL_WEIGHT * normals], 1).double().numpy())


def find_patches(grid: SdfGrid, ground_height: float | None) -> Patches | None:
    """Return the patches of an object and its ground with the visibility between them; None if there is no surface.

    Args:
        ground_height: world z; None: there is no ground.
    """
    height = -torch.inf if ground_height is None else ground_height
    points, normals, size = _on_surface(grid, height)
    if not len(points):
        return None
    middle = (points.amax(0) + points.amin(0)) / 2
    radius = float((points - middle).norm(dim=-1).max())
    floor = torch.zeros(0, 3) if ground_height is None else _on_ground(middle, radius, ground_height)
    floor = floor[grid.sdf(floor) > 0]
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(floor)
    everywhere, facing = torch.cat([points, floor]), torch.cat([normals, up])
    on_object = torch.arange(len(everywhere)) < len(points)
    starts = shadow_starts(grid, everywhere, facing, on_object)
    seen = torch.full((len(everywhere), DIRECTIONS), len(everywhere))
    patches = Patches(everywhere, facing, on_object, starts, seen, size)
    lit = torch.nonzero(on_object | ((everywhere - middle)[:, :2].norm(dim=-1) < LIT_REACH * radius))[:, 0]
    seen[lit] = _hit_patches(grid, patches, lit, height)
    return patches


def _on_surface(grid: SdfGrid, ground_height: float) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], float]:
    """Return points spread over the surface above the ground, their normals, and their spacing."""
    h = grid.spacing
    nodes = torch.nonzero(grid.values.abs() < h)
    points = grid.origin + h * nodes.float()
    for _ in range(2):  # two steps of Newton's
        points = points - grid.sdf(points)[:, None] * normalize(grid.gradient(points), dim=-1)
    slope = normalize(grid.gradient(points), dim=-1)
    keep = (points[:, 2] > ground_height + h) & (grid.sdf(points).abs() < 0.1 * h)
    points, slope = points[keep], slope[keep]
    area = len(points) / 2 * h**2  # a layer of nodes on either side of the surface
    size = max((area / OBJECT_PATCHES) ** 0.5, h)
    side = slope.abs().argmax(-1)
    facing = slope.gather(1, side[:, None])[:, 0] > 0  # the two sides of a thin wall are two patches
    cells = torch.cat([((points - grid.origin) / size).floor().long(), (2 * side + facing)[:, None]], 1)
    _, first = np.unique(cells.numpy(), axis=0, return_index=True)
    chosen = torch.from_numpy(np.sort(first))
    return points[chosen], slope[chosen], size


def _on_ground(middle: Float[Tensor, "3"], radius: float, height: float) -> Float[Tensor, "n 3"]:
    """Return ground points around the object, even near it and sparse far away (as sinh), on no lines or rings."""
    places = torch.tensor(disc(GROUND_PATCHES))
    reach = places.norm(dim=-1, keepdim=True)
    x, y = (radius * torch.sinh(reach * np.arcsinh(GROUND_REACH)) * places / reach).unbind(1)
    return torch.stack([middle[0] + x, middle[1] + y, torch.full_like(x, height)], -1)


def _hit_patches(
    grid: SdfGrid, patches: Patches, lit: Int[Tensor, " some"], height: float
) -> Int[Tensor, "some directions"]:
    """Return the patches hit along cosine-distributed directions (Malley's method)."""
    places, starts, axis = patches.points[lit], patches.starts[lit], patches.normals[lit]
    one, other = across(axis, places / grid.spacing)
    out = torch.full((len(lit), DIRECTIONS), len(patches.points))
    ours = [torch.nonzero(patches.on_object == which)[:, 0] for which in (False, True)]  # of the ground, of the object
    trees = [KDTree(patches.points[own].numpy()) for own in ours]
    for k, (x, y) in enumerate(disc(DIRECTIONS)):
        towards = normalize(x * one + y * other + (1 - x * x - y * y) ** 0.5 * axis, dim=-1)
        to_object = find_surface(grid, starts, towards)
        to_ground = (height - places[:, 2]) / towards[:, 2]  # not lifted: just above the ground that is much
        to_ground = torch.where((towards[:, 2] < 0) & patches.on_object[lit], to_ground.clamp(min=0), torch.inf)
        on_object = to_object < to_ground
        points = torch.where(
            on_object[:, None], starts + to_object[:, None] * towards, places + to_ground[:, None] * towards
        )
        hit = torch.isfinite(torch.minimum(to_object, to_ground))
        for which, (own, tree) in enumerate(zip(ours, trees, strict=True)):
            theirs = hit & (on_object == bool(which))
            out[theirs, k] = own[torch.from_numpy(np.asarray(tree.query(points[theirs].numpy())[1]))]
    return out
