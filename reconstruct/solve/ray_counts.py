"""The number of rays that determine each point of a solved surface."""

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet
from reconstruct.solve.operators import EMPHASIS, JointPasses, rays_per_iteration
from reconstruct.views import Scenes, each

FEWEST_RAYS = 0.05  # per node, from which shadows determine it: with fewer the error begins to grow
SHARPNESS = 8.0  # NeuS s per voxel: a ray counts where it passes within about a quarter of a voxel
SPREAD = 1.0  # voxels: a node's count is the mean about it, as wide as the solver's averaging


def ray_counts(
    scenes: Scene | Scenes, rays: Supervision | tuple[Supervision, ...], grid: SdfGrid, config: FitConfig
) -> Float[Tensor, "nx ny nz"]:
    """Return, for every node near the surface, the weight of shadow and camera rays whose edge passes there.

    This is the count c of the level set's step for a surface at rest: shadow rays well inside or outside a shadow do
    not add to it. It is scaled as if every label of the views together were one ray.
    """
    surface = LevelSet(grid.in_voxels(), grid.origin.double().numpy(), grid.spacing, is_distance=True)
    scenes, rays = each(scenes), each(rays)
    passes = JointPasses(surface, scenes, rays, config)
    first = sum(level.iterations for level in config.levels)
    passes.look(grid, first, SHARPNESS, 0.0)
    passes(first, SHARPNESS)
    count = surface.sums()[1]
    labels = float(sum((part.confidence > kernels.NO_WEIGHT).sum() for part in rays))
    count *= np.float32(labels / (EMPHASIS * sum(rays_per_iteration(config, len(part.pixels)) for part in rays)))
    return torch.from_numpy(ndimage.gaussian_filter(count, SPREAD))
