"""The paper's equations in plain torch: the reference for the kernels, in value and gradient."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

SMALLEST_FACING = 1e-4  # |n . v| below which the intersection is not moved (as in the authors' code)


def opacity_from_sdf(
    sdf: Float[Tensor, "rays edges"], sharpness: Float[Tensor, ""] | float
) -> Float[Tensor, "rays edges-1"]:
    """Opacity of each interval along a ray, from the SDF at its two edges.

    1 - Phi(sdf_far) / Phi(sdf_near), clipped at 0 [ShadowNeuS eq:neus_alpha, after NeuS]. In log space, because deep
    inside the object the plain ratio is 0 / 0; no epsilon is needed.

    Args:
        sdf: negative inside.
        sharpness: s > 0 in Phi(x) = sigmoid(s * x), 1 / length.

    Returns:
        In [0, 1]; 0 where the ray moves away from the surface.
    """
    return -torch.expm1(_log_transmitted(sdf, sharpness))


def transmittance(sdf: Float[Tensor, "rays edges"], sharpness: Float[Tensor, ""] | float) -> Float[Tensor, " rays"]:
    """Light left after a whole ray: prod_i (1 - alpha_i) [ShadowNeuS eq:shadow_ray_render with L = 1], sampled form."""
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
        points: where camera rays meet the surface, constants.
        sdf: the field at points, carrying gradients (its value is zero up to the root finder's tolerance).
        normals: gradient of the field there, constants.
        grazing: |n . v| below which a point stays.
    """
    facing = (normals * directions).sum(-1)
    safe = torch.where(facing.abs() < grazing, torch.full_like(facing, torch.inf), facing)
    return points - directions * (sdf / safe)[:, None]


def area_ratio(minimum: Float[Tensor, " rays"], footprint: Float[Tensor, " rays"]) -> Float[Tensor, " rays"]:
    """Share w of a boundary pixel that shows the near surface.

    A minimum m of the SDF along a camera ray is a silhouette point (grad f . v = 0 there), at distance m beside the
    pixel's centre; a pixel as wide as `footprint` is covered by 1/2 - m / footprint of it. Same length unit in both.
    """
    return (0.5 - minimum / footprint).clamp(0, 1)


def blend(
    near: Float[Tensor, " rays"], far: Float[Tensor, " rays"], ratio: Float[Tensor, " rays"]
) -> Float[Tensor, " rays"]:
    """Incoming radiance of a boundary pixel: w C_near + (1 - w) C_far [ShadowNeuS eq:edge_vis]."""
    return ratio * near + (1 - ratio) * far


def shade(
    albedo: Float[Tensor, "rays 3"],
    normals: Float[Tensor, "rays 3"],
    towards: Float[Tensor, "rays 3"],
    irradiance: Float[Tensor, "rays 3"],
    visibility: Float[Tensor, " rays"],
) -> Float[Tensor, "rays 3"]:
    """Outgoing radiance of a diffuse surface, rho C_in (l . n) [ShadowNeuS eq:render_rgb without the specular part].

    Args:
        towards: unit vectors to the light; irradiance: on a surface that faces it, see reconstruct.scene.irradiance.
    """
    return albedo * irradiance * (visibility * (normals * towards).sum(-1).clamp(min=0))[:, None]


def shadow_loss(seen: Float[Tensor, " rays"], label: Float[Tensor, " rays"]) -> Float[Tensor, " rays"]:
    """Cross entropy of transmittance against visibility, -y log T - (1 - y) log(1 - T).

    The paper takes |T - y| [ShadowNeuS eq:loss_shadow], which saturates where a ray is deeply wrong; this is linear in
    the ray's margin there (2-3 times lower depth error at equal time in the solver study).
    """
    return F.binary_cross_entropy(seen.clamp(1e-7, 1 - 1e-7), label, reduction="none")


def _log_transmitted(
    sdf: Float[Tensor, "rays edges"], sharpness: Float[Tensor, ""] | float
) -> Float[Tensor, "rays edges-1"]:
    log_phi = F.logsigmoid(sharpness * sdf)
    return (log_phi[:, 1:] - log_phi[:, :-1]).clamp(max=0.0)
