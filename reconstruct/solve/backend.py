"""The solver's backends: fused kernels on CPU cores, or differentiable torch on a device. Both share one loop."""

from typing import Protocol, runtime_checkable

import numpy as np
import torch

from capture.errors import ReconstructionError
from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet
from reconstruct.sdf.rays import thread_count
from reconstruct.solve.kernel_operators import KernelOperators
from reconstruct.solve.operators import JointPasses, RayPasses
from reconstruct.solve.torch_operators import TorchOperators
from reconstruct.torch_sdf.level_set import TorchLevelSet
from reconstruct.views import Scenes


@runtime_checkable
class MovingSurface(Protocol):
    """The solver's interface to a level set on any device; see reconstruct.sdf.level_set.LevelSet."""

    origin: np.ndarray
    spacing: float

    @property
    def phi(self) -> np.ndarray:
        """SDF in voxels on the host, float32."""
        ...

    def step(self, passes: int, rate: float, shrink: float, curvature: float, stiffness: int, smoothing: float) -> None:
        """Take one step along the gradient of the rays and clear it; arguments: see LevelSet.step."""
        ...

    def redistance(self) -> None:
        """Make phi the distance function of the same surface."""
        ...

    def is_finite(self) -> bool:
        """Return whether the accumulated gradient is finite."""
        ...

    def forget(self) -> None:
        """Clear the gradient, without a step."""
        ...

    def grid(self) -> SdfGrid:
        """Return a copy on the host, world frame."""
        ...


def solver_device(name: str) -> torch.device | None:
    """Return the torch device that --device selects for the solver; None for the kernels.

    "auto" selects the kernels on every machine. It may select a GPU once a GPU has passed benchmarks/run_gpu.py: the
    same surface as the kernels, in less time. An H200 makes the same surface in as long as eight CPU cores need: an
    iteration takes 2.5 times as long on small grids and half as long on large ones (docs/results.md).

    Args:
        name: "auto" and "cpu": the kernels; "cuda": torch on a GPU; "torch-cpu": the code of "cuda" on the CPU,
            several times slower than the kernels, for comparison.

    Raises:
        ReconstructionError: "cuda" if torch sees no such device.
    """
    return None if name == "auto" else training_device(name)


def training_device(name: str) -> torch.device | None:
    """Return the torch device that --device selects for training a field; None for the CPU.

    Args:
        name: as in solver_device, but "auto" selects a CUDA device if torch sees one.

    Raises:
        ReconstructionError: "cuda" if torch sees no such device.
    """
    if name == "torch-cpu":
        return torch.device("cpu")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return None
    if not torch.cuda.is_available():
        raise ReconstructionError(
            f"--device cuda: torch {torch.__version__} sees no CUDA device, which it needs; leave --device out to "
            "compute on the cpu."
        )
    return torch.device("cuda")


def backend_name(device: torch.device | None) -> str:
    """Describe the backend and its device in words."""
    if device is None:
        cores = thread_count()
        return f"{cores} processor core{'s' if cores > 1 else ''}"
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else f"the {device.type.upper()}"
    return where


def surface_on(device: torch.device | None, surface: LevelSet) -> MovingSurface:
    """Move a redistanced level set to the solver's device; the same object for the kernels."""
    if device is None:
        return surface
    return TorchLevelSet(torch.from_numpy(surface.phi).to(device), surface.origin, surface.spacing, is_distance=True)


def ray_passes(surface: MovingSurface, scene: Scene, rays: Supervision, config: FitConfig) -> RayPasses:
    """Return the ray passes of one view in a level, with the operators of the surface's backend."""
    if isinstance(surface, TorchLevelSet):
        return RayPasses(TorchOperators(surface, scene, rays, config), scene, rays, config)
    assert isinstance(surface, LevelSet)
    return RayPasses(KernelOperators(surface, scene, rays, config), scene, rays, config)


def joint_passes(
    surface: MovingSurface, scenes: Scenes, rays: tuple[Supervision, ...], config: FitConfig
) -> JointPasses:
    """Return the ray passes of all views over one surface."""
    return JointPasses([ray_passes(surface, *view, config) for view in zip(scenes, rays, strict=True)])
