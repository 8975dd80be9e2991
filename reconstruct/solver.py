"""From labels to a surface: an SDF grid moved until every shadow ray agrees with what its pixel saw."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from calibration.camera import Camera
from calibration.pose import Pose
from reconstruct import kernels, levelset
from reconstruct.grid import SdfGrid
from reconstruct.march import in_parts, lights_to_grid, thread_count, to_grid
from reconstruct.observe import Labels
from reconstruct.scene import Scene, ground_points

BAND = 6.0  # voxels about the surface in which the SDF is kept and may move
REDISTANCE_EVERY = 10  # iterations: steps of at most 0.5 voxel stay well inside the band


@dataclass(frozen=True)
class Fields:
    """A solved scene: all that a mesh or a relit picture needs. World frame."""

    grid: SdfGrid
    albedo: Float[Tensor, "height width 3"]  # linear, object and ground, on the pixel grid of `camera`
    camera: Camera  # of the working grid
    world_from_camera: Pose
    ground_height: float
    unit: str  # "mm" | "scene"


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
    rays: int = 40_000  # shadow rays per iteration
    levels: tuple[Level, ...] = (
        Level(48, 70, (0.5, 0.4), 4, 5e-4),
        Level(96, 80, (0.4, 0.25), 3, 5e-4),
        Level(160, 90, (0.25, 0.08), 2),
    )
    sharpness: tuple[float, float] = (4.0, 25.0)  # NeuS s per voxel, first and last iteration of every level
    curvature: float = 0.25  # of the step size: curvature flow
    mask_weight: float = 0.3
    normal_weight: float = 1.0
    votes: int = 1  # lights that must prove a node empty for the hull
    use_boundary: bool = True
    use_start_gradient: bool = True


@dataclass
class _Rays:
    """What the kernels need of the supervised pixels, flattened; world frame."""

    directions: np.ndarray  # (pixels, 3)
    ground_t: np.ndarray  # (pixels,) world length, inf above the horizon
    pixels: np.ndarray  # flat indices into the picture
    label: np.ndarray  # (photos, pixels)
    confidence: np.ndarray
    mask: np.ndarray  # (pixels,)
    mask_confidence: np.ndarray
    normals: np.ndarray  # (pixels, 3)
    normal_confidence: np.ndarray
    error: np.ndarray = field(init=False)  # running |T - label|: where to look next
    wrong: np.ndarray = field(init=False)  # times in a row that a ray contradicted its label

    def __post_init__(self):
        self.error = np.ones_like(self.label)
        self.wrong = np.zeros(self.label.shape, np.uint8)


DILATE = 7  # px: ground beside object and shadow is supervised too
DARK_ENOUGH = 0.5  # visibility below which a pixel counts as in shadow somewhere


def supervised_rays(scene: Scene, labels: Labels) -> _Rays:
    """The pixels worth a ray: object, ground that is ever in shadow, and a rim about both."""
    dark = ((labels.visibility < DARK_ENOUGH) & (labels.confidence > 0.3)).any(0)
    wanted = (dark | (labels.mask > 0.02)).numpy().astype(np.uint8)
    wanted = cv2.dilate(wanted, np.ones((DILATE, DILATE), np.uint8)).reshape(-1) > 0
    pixels = np.flatnonzero(wanted)
    ground = ground_points(scene).reshape(-1, 3)[pixels]
    t = torch.linalg.vector_norm(ground - scene.eye, dim=-1).double().numpy()

    def pick(image: Tensor) -> np.ndarray:
        return np.ascontiguousarray(image.reshape(-1, *image.shape[2:])[pixels].float().numpy())

    n = len(scene.lights)
    return _Rays(
        np.ascontiguousarray(scene.directions.reshape(-1, 3)[pixels].double().numpy()),
        np.where(np.isfinite(t), t, np.inf),
        pixels,
        np.ascontiguousarray(labels.visibility.reshape(n, -1)[:, pixels].float().numpy()),
        np.ascontiguousarray(labels.confidence.reshape(n, -1)[:, pixels].float().numpy()),
        pick(labels.mask),
        pick(labels.mask_confidence),
        pick(labels.normals),
        pick(labels.normal_confidence),
    )


def redistanced(phi: np.ndarray) -> np.ndarray:
    """The same surface with |grad| = 1 within BAND of it and +-BAND beyond. Voxels."""
    out, fixed = np.empty_like(phi), np.empty(phi.shape, np.uint8)
    levelset.interface(phi, BAND, out, fixed)
    near = cv2_free_dilation(fixed, int(BAND) + 1)
    for order in (7, 6, 5, 4, 3, 2, 1, 0):
        levelset.sweep(phi, out, fixed, near, order)
    return np.where(phi < 0, -out, out)


def cv2_free_dilation(marks: np.ndarray, radius: int) -> np.ndarray:
    """Nodes within `radius` (box) of a marked node."""
    from scipy.ndimage import maximum_filter1d

    for axis in range(3):
        marks = maximum_filter1d(marks, 2 * radius + 1, axis)
    return marks


class _Grid:
    """The level set of one stage with its per-thread accumulators. Grid frame."""

    def __init__(self, phi: np.ndarray, origin: np.ndarray, spacing: float):
        self.phi, self.origin, self.spacing = phi, origin, spacing
        self.g_parts = tuple(np.zeros_like(phi) for _ in range(thread_count()))
        self.c_parts = tuple(np.zeros_like(phi) for _ in range(thread_count()))
        self.g, self.c, self.spare = (np.zeros_like(phi) for _ in range(3))
        self.redistance()

    def redistance(self):
        self.phi = np.ascontiguousarray(redistanced(self.phi))
        self.spare = self.phi.copy()
        inner = np.zeros(self.phi.shape, bool)
        inner[1:-1, 1:-1, 1:-1] = np.abs(self.phi[1:-1, 1:-1, 1:-1]) < BAND - 1e-3
        self.active = np.flatnonzero(inner)

    def step(self, passes: int, rate: float, shrink: float, curvature: float):
        """Merge, average and apply what the rays left behind."""
        active, n = self.active, len(self.active)
        for parts, total in ((self.g_parts, self.g), (self.c_parts, self.c)):
            total.fill(0)
            in_parts(n, lambda _, a, b, parts=parts, total=total: levelset.merge(parts, total, active, a, b))
        for _ in range(passes):
            for name in ("g", "c"):
                source = getattr(self, name)
                target = np.zeros_like(source)
                in_parts(n, lambda _, a, b, s=source, t=target: levelset.smooth(s, t, active, a, b))
                setattr(self, name, target)
        setting = (rate, shrink, curvature * rate)
        in_parts(
            n,
            lambda _, a, b: levelset.level_set_step(self.phi, self.spare, self.g, self.c, active, setting, a, b),
        )
        self.phi, self.spare = self.spare, self.phi

    def sdf(self) -> SdfGrid:
        """The same as an SdfGrid in the world frame."""
        values = torch.from_numpy(self.phi * np.float32(self.spacing))
        return SdfGrid(values, torch.from_numpy(self.origin.astype(np.float32)), self.spacing)


def resampled(grid: SdfGrid, nodes: int) -> _Grid:
    """A level set with `nodes` nodes along the longest side of the same box."""
    lower, upper = grid.origin.double().numpy(), grid.upper().double().numpy()
    spacing = float((upper - lower).max() / (nodes - 1))
    shape = np.floor((upper - lower) / spacing + 1e-6).astype(int) + 1
    axes = [torch.arange(int(n)) * spacing + float(o) for n, o in zip(shape, lower, strict=True)]
    slabs = [
        grid.sdf(torch.stack(torch.meshgrid(x[None], axes[1], axes[2], indexing="ij"), -1).reshape(-1, 3))
        for x in axes[0]
    ]
    phi = torch.stack(slabs).reshape(*map(int, shape)).numpy() / spacing
    return _Grid(np.ascontiguousarray(phi, np.float32), lower, spacing)


def _between(ends: tuple[float, float], share: float) -> float:
    """Geometric interpolation."""
    return ends[0] * (ends[1] / ends[0]) ** share


def fit_level(
    grid: SdfGrid,
    scene: Scene,
    rays: _Rays,
    level: Level,
    config: FitConfig,
    first_iteration: int,
    on_iteration: Callable[[int, dict[str, float], _Grid], None],
) -> SdfGrid:
    """One stage: the SDF on level.nodes nodes after level.iterations steps."""
    state = resampled(grid, level.nodes)
    sdf = state.sdf()
    eye = to_grid(sdf, scene.eye)
    lights = lights_to_grid(sdf, scene.lights)
    ground_t = np.where(np.isfinite(rays.ground_t), rays.ground_t / state.spacing, 1e9)
    n = len(rays.pixels)
    hit, part_t, part_f = np.empty(n), np.empty(n), np.empty(n)
    light_g = tuple(np.zeros((len(lights), 4)) for _ in range(thread_count()))
    mask_confidence = np.float32(config.mask_weight) * rays.mask_confidence
    normal_confidence = np.float32(config.normal_weight) * rays.normal_confidence
    has_normals = bool((normal_confidence > 0).any())
    for i in range(level.iterations):
        share = i / max(1, level.iterations - 1)
        s, rate = _between(config.sharpness, share), _between(level.rate, share)
        iteration = first_iteration + i
        phi = state.phi
        in_parts(
            n,
            lambda _, a, b: kernels.camera_pass(
                phi, eye, rays.directions, ground_t, scene.pixel_angle, hit, part_t, part_f, a, b
            ),
        )
        view = (eye, rays.directions, ground_t, scene.pixel_angle, hit, part_t, part_f)
        shadow = in_parts(
            config.rays,
            lambda t, a, b: kernels.shadow_pass(
                phi,
                state.g_parts[t],
                state.c_parts[t],
                light_g[t],
                BAND,
                s,
                view,
                (lights, rays.error, rays.wrong),
                (rays.label, rays.confidence),
                (config.seed, iteration, config.use_boundary, config.use_start_gradient),
                a,
                b,
            ),
        )
        mask = in_parts(
            config.rays // 4,
            lambda t, a, b: kernels.mask_pass(
                phi,
                state.g_parts[t],
                state.c_parts[t],
                BAND,
                s,
                (eye, rays.directions, ground_t),
                rays.mask,
                mask_confidence,
                (config.seed, iteration),
                a,
                b,
            ),
        )
        normal = [(0.0, 0.0)]
        if has_normals:
            normal = in_parts(
                n,
                lambda t, a, b: kernels.normal_pass(
                    phi,
                    state.g_parts[t],
                    state.c_parts[t],
                    BAND,
                    (eye, rays.directions, hit),
                    rays.normals,
                    normal_confidence,
                    a,
                    b,
                ),
            )
        passes = max(1, round(level.blur * (1 - share) + share))
        state.step(passes, rate, level.shrink, config.curvature)
        if (i + 1) % REDISTANCE_EVERY == 0 or i + 1 == level.iterations:
            state.redistance()
        losses = {
            name: sum(p[0] for p in parts) / max(sum(p[1] for p in parts), 1e-9)
            for name, parts in (("shadow", shadow), ("mask", mask), ("normal", normal))
        }
        on_iteration(i, losses, state)
    return state.sdf()
