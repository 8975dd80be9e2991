"""The solver's settings: resolution, number of rays, iterations and step sizes."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Level:
    """One stage of coarse to fine."""

    nodes: int  # along the longest side of the object's box
    iterations: int
    rate: tuple[float, float]  # largest step, voxels, first and last iteration
    blur: int  # passes of gradient averaging at the first iteration, falling to one
    shrink: float = 0.0  # pull on nodes without evidence: unseen matter that no ray needs goes


@dataclass(frozen=True)
class FitConfig:
    """The solver's settings. Lengths in voxels."""

    seed: int = 0
    rays: int = 150_000  # at most so many: the weight of all shadow rays together, settled ones included
    rays_per_pixel: float = 1.3  # the same per supervised pixel: what shadows weigh beside normals
    levels: tuple[Level, ...] = (
        Level(48, 42, (0.5, 0.4), 4, 4.2e-4),
        Level(96, 48, (0.4, 0.25), 3, 4.2e-4),
        Level(160, 54, (0.25, 0.08), 2),
    )
    sharpness: tuple[float, float] = (4.0, 25.0)  # NeuS s per voxel, first and last iteration of every level
    stiffness: int = 4  # passes per iteration against bending where no ray passes
    smoothing: float = 0.1  # of the step size: weight of the same where many rays pass
    curvature: float = 0.0  # of the step size: curvature flow, which shrinks what is round
    mask_share: float = 0.25  # weight of all camera rays over that of all shadow rays
    mask_weight: float = 1.0
    normal_weight: float = 0.3
    votes: int | None = None  # lights that must prove a node empty for the hull; None: by the kind of labels
    use_boundary: bool = True
    use_start_gradient: bool = True
    supervised: str = "both"  # "both" | "foreground" | "background": whose shadow rays count, see restricted
