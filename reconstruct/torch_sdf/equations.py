"""The paper's equations in plain torch: the reference for the kernels' values and gradients. Any frame and unit."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

SMALLEST_FACING = 1e-4  # |n . v| below which the intersection is not moved (as in the authors' code)
LEAST_SEEN = 1e-9  # transmittance below which the loss continues as a straight line; likewise for 1 - T


def opacity_from_sdf(
    sdf: Float[Tensor, "rays edges"], sharpness: Float[Tensor, ""] | float
) -> Float[Tensor, "rays edges-1"]:
    """Return the opacity of each interval along a ray, from the SDF at its two ends.

    alpha = 1 - Phi(sdf_far) / Phi(sdf_near), clipped at 0 [ShadowNeuS eq:neus_alpha, after NeuS]. It is computed in log
    space, because the plain ratio is 0 / 0 deep inside the object; so no epsilon is needed.

    Args:
        sdf: negative inside.
        sharpness: s > 0 in Phi(x) = sigmoid(s * x), 1 / length.

    Returns:
        In [0, 1]; 0 where the ray moves away from the surface.
    """
    return -torch.expm1(_log_transmitted(sdf, sharpness))


def transmittance(sdf: Float[Tensor, "rays edges"], sharpness: Float[Tensor, ""] | float) -> Float[Tensor, " rays"]:
    """Return the light left after a ray: prod_i (1 - alpha_i) [ShadowNeuS eq:shadow_ray_render with L = 1], sampled.

    Args:
        sdf, sharpness: as of opacity_from_sdf.
    """
    return _log_transmitted(sdf, sharpness).sum(-1).exp()


def transmittance_from_extrema(
    minima: Float[Tensor, "rays runs"], maxima: Float[Tensor, "rays runs"], sharpness: Float[Tensor, ""] | float
) -> Float[Tensor, " rays"]:
    """Return the transmittance in closed form: each run of falling SDF contributes Phi(minimum) / Phi(maximum before).

    Args:
        minima, maxima: SDF at the ends of each falling run; equal where a ray has fewer runs.
    """
    return (F.logsigmoid(sharpness * minima) - F.logsigmoid(sharpness * maxima)).sum(-1).exp()


def moved_intersection(
    points: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    sdf: Float[Tensor, " rays"],
    normals: Float[Tensor, "rays 3"],
    grazing: float = SMALLEST_FACING,
) -> Float[Tensor, "rays 3"]:
    """Return the same points, differentiable in the field: x - v / (n . v) f(x) [ShadowNeuS eq:diff_intersect].

    Args:
        points: intersections of camera rays with the surface, constants.
        directions: unit v of the rays.
        sdf: the field f at points, with gradients; its value is zero up to the root finder's tolerance.
        normals: gradient of the field there, constants.
        grazing: |n . v| below which a point stays.
    """
    facing = (normals * directions).sum(-1)
    safe = torch.where(facing.abs() < grazing, torch.full_like(facing, torch.inf), facing)
    return points - directions * (sdf / safe)[:, None]


def area_ratio(minimum: Float[Tensor, " rays"], footprint: Float[Tensor, " rays"]) -> Float[Tensor, " rays"]:
    """Return the share w of a boundary pixel that shows the near surface, in [0, 1] [ShadowNeuS eq:edge_vis].

    A minimum m of the SDF along a camera ray is a silhouette point (grad f . v = 0), at distance m from the pixel's
    centre. It covers the share 1/2 - m / footprint of a pixel of width `footprint`; both have the same unit.
    """
    return (0.5 - minimum / footprint).clamp(0, 1)


def blend(
    near: Float[Tensor, " rays"], far: Float[Tensor, " rays"], ratio: Float[Tensor, " rays"]
) -> Float[Tensor, " rays"]:
    """Return the incoming radiance of a boundary pixel: w C_near + (1 - w) C_far [ShadowNeuS eq:edge_vis]."""
    return ratio * near + (1 - ratio) * far


def shade(
    albedo: Float[Tensor, "rays 3"],
    normals: Float[Tensor, "rays 3"],
    towards: Float[Tensor, "rays 3"],
    irradiance: Float[Tensor, "rays 3"],
    visibility: Float[Tensor, " rays"],
) -> Float[Tensor, "rays 3"]:
    """Return the linear radiance of a diffuse surface, rho C_in (l . n) [ShadowNeuS eq:render_rgb, diffuse part].

    Args:
        normals: unit.
        towards: unit vectors l to the light.
        irradiance: on a surface that faces the light, see reconstruct.scene.irradiance.
        visibility: of the light, in [0, 1].
    """
    return albedo * irradiance * (visibility * (normals * towards).sum(-1).clamp(min=0))[:, None]


def shadow_loss(seen: Float[Tensor, " rays"], label: Float[Tensor, " rays"]) -> Float[Tensor, " rays"]:
    """Return the cross entropy of transmittance T and visibility y, -y log T - (1 - y) log(1 - T), per ray.

    The paper uses |T - y| [ShadowNeuS eq:loss_shadow], which saturates where a ray is deeply wrong. The cross entropy
    is linear in the ray's margin there: the depth error was 2 to 3 times lower at equal time in the solver study.
    """
    seen = seen.clamp(1e-7, 1 - 1e-7)
    return cross_entropy(seen, 1 - seen, label)


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
    return torch.where(x > LEAST_SEEN, x.clamp(min=LEAST_SEEN).log(), x / LEAST_SEEN + math.log(LEAST_SEEN) - 1)


def _log_transmitted(
    sdf: Float[Tensor, "rays edges"], sharpness: Float[Tensor, ""] | float
) -> Float[Tensor, "rays edges-1"]:
    log_phi = F.logsigmoid(sharpness * sdf)
    return (log_phi[:, 1:] - log_phi[:, :-1]).clamp(max=0.0)
