"""Photos under several known lights at once: split each photo into one picture per light."""

from dataclasses import replace
from itertools import product

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from capture.errors import ReconstructionError, Remedy
from reconstruct.labels.ground_test import GroundTest
from reconstruct.labels.photometric_stereo import label_object
from reconstruct.scene import Scene, grey_irradiance, ground_points
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import shadow_starts, unshadowed

MOST_LIGHTS = 4  # in one photo: 16 levels between dark and full light, a few per cent apart, are all a photo resolves
LEVEL_SIGMA = 0.04  # of the full light: error of a level by the light model and the surface
SURE_SIGMAS = 2.0  # by which the next best state of a light (on or off) must fit worse
PRIOR = 0.05  # of a light's radiance: penalty of a state that the current surface contradicts
FITS = 0.06  # of a level: half of ground.LIT_BAND, because levels in part lit lie closer together
PARTLY_LIT = 0.5  # of a fully lit photo: weight of a partly lit one as support for an albedo
SMALLEST_COSINE = 0.1  # least cosine to a light that the surface may face: its normal is not known better
ROUNDS = 3  # of splitting a photo by the normals estimated from the previous split
FLOOR = 3e-4  # linear: half of an 8-bit sRGB step in the darks
PIXELS_AT_ONCE = 8192  # with 20 photos, 20 albedos to try and 4 levels: 50 MB


def check_lights(scene: Scene) -> None:
    """Refuse lights in one photo that cannot be distinguished.

    Raises:
        ReconstructionError: more than MOST_LIGHTS, or several on uneven ground, which hides lights from itself.
    """
    if is_shared(scene) and scene.ground_depth is not None:
        raise ReconstructionError(
            "photos under several lights at once need level ground, this ground is uneven.",
            "take photos under one light each",
            Remedy.GROUND,
        )
    for rows in _groups(scene):
        if len(rows) > MOST_LIGHTS:
            raise ReconstructionError(
                f"{scene.photo_names[rows[0]]} is lit by {len(rows)} lights at once, at most {MOST_LIGHTS} can be told "
                "apart. Take photos with fewer lights on."
            )


def is_shared(scene: Scene) -> bool:
    """Return whether any photo shows the sum of several lights."""
    return any(len(rows) > 1 for rows in _groups(scene))


def split_on_ground(scene: Scene) -> Scene:
    """Split the scene into one light per picture, treating every pixel as bare ground.

    The levels of a pixel are albedo (sum_S E_k cos_k + ambient), over the sets S of lights that may arrive, with
    visibilities 0 or 1 [ShadowNeuS, supplement: the sum of the incoming radiance of two lights]. The ground's albedo is
    the one for which most photos match a level. A value that matches no level is divided among all lights, and so still
    does not look like ground.
    """
    if not is_shared(scene):
        return scene
    light = _ground_irradiance(scene)
    albedo = _ground_albedo(scene, light)
    return _split(scene, albedo * light, albedo * scene.ambient.mean(), None, only_levels=True)


def _ground_irradiance(scene: Scene) -> Float[Tensor, "photos height width"]:
    """Return the unoccluded irradiance of the ground under every light; 0 where a ray meets no ground."""
    shape = scene.directions.shape[:2]
    towards, strength = grey_irradiance(scene, ground_points(scene).reshape(-1, 3))
    return torch.nan_to_num(strength * towards[..., 2].clamp(min=0)).reshape(-1, *shape)


def _surface_light(
    scene: Scene, points: Float[Tensor, "height width 3"], normals: Float[Tensor, "height width 3"]
) -> Float[Tensor, "photos height width"]:
    """Return the irradiance of a surface under every light that reaches it; level ground where normals are 0."""
    level = torch.tensor([0.0, 0.0, 1.0]).expand_as(normals)
    facing = torch.where((normals == 0).all(-1, keepdim=True), level, normals).reshape(-1, 3)
    towards, strength = grey_irradiance(scene, points.reshape(-1, 3))
    cosine = torch.einsum("knc,nc->kn", towards, facing).clamp(min=SMALLEST_COSINE)
    return torch.nan_to_num(strength * cosine).reshape(-1, *points.shape[:2])


def _seen_albedo(
    scene: Scene, light: Float[Tensor, "photos height width"], lit: Float[Tensor, "photos height width"]
) -> Float[Tensor, "height width"]:
    """Return the median over photos of pixel value over arriving (lit) light; 0 where no light arrives."""
    assert scene.rgb is not None
    ratios = []
    for rows in _groups(scene):
        expected = (light[rows] * lit[rows]).sum(0)
        usable = scene.usable[rows[0]] & (expected > SMALLEST_COSINE * light[rows].sum(0))
        ratio = scene.rgb[rows[0]].mean(-1) / (expected + scene.ambient.mean()).clamp(min=1e-12)
        ratios.append(torch.where(usable, ratio, torch.nan))
    return torch.nan_to_num(torch.stack(ratios).nanmedian(0).values)


def split_on_surface(
    scene: Scene,
    surface: SdfGrid,
    points: Float[Tensor, "height width 3"],
    normals: Float[Tensor, "height width 3"],
    ground: GroundTest,
) -> Scene:
    """Split the scene into one light per picture, by the current surface, then by normals estimated from the split.

    Args:
        surface: the possible occluder.
        points: where each pixel's ray meets surface or ground, world.
        normals: the surface's there, world; 0 on ground.
        ground: of the scene split before; its albedo and mask.
    """
    if not is_shared(scene):
        return scene
    on_ground = (normals == 0).all(-1)
    where = points.isfinite().all(-1)
    lit = torch.zeros(len(scene.lights), *where.shape)
    starts = shadow_starts(surface, points[where], normals[where], ~on_ground[where])
    lit[:, where] = unshadowed(surface, starts, scene.lights)
    known, facing, single = ground.albedo.mean(-1), normals, scene
    for _ in range(ROUNDS):
        light = _surface_light(scene, points, facing)
        albedo = torch.where(on_ground & (known > 0), known, _seen_albedo(scene, light, lit))
        single = _split(scene, albedo * light, albedo * scene.ambient.mean(), lit)
        read = label_object(single, points, normals, ground.mask, ground)
        facing = torch.where(((read.normal_confidence > 0) & ~on_ground)[..., None], read.normals, normals)
    return single


def _split(
    scene: Scene,
    full: Float[Tensor, "photos height width"],
    base: Float[Tensor, "height width"],
    lit: Float[Tensor, "photos height width"] | None,
    only_levels: bool = False,
) -> Scene:
    """Split every photo of several lights into one picture per light; other photos stay as they are.

    The level base + sum_S full_k nearest to a photo's value is found; the lights in S share it in proportion to full_k.

    Args:
        scene: its photos are sums of lights.
        full: radiance that each light adds where it arrives.
        base: radiance without any light.
        lit: expected visibility; decides between similar levels.
        only_levels: divide a value that matches no level among all lights.
    """
    assert scene.rgb is not None
    rgb, usable = scene.rgb.clone(), scene.usable.clone()
    colour = scene.ambient / scene.ambient.mean().clamp(min=1e-12)
    for rows in _groups(scene):
        if len(rows) == 1:
            continue
        value = scene.rgb[rows[0]].mean(-1)
        chosen, sure = _nearest_level(value, full[rows], base, None if lit is None else lit[rows], only_levels)
        weight = full[rows] * chosen
        weight = torch.where((chosen.sum(0) > 0), weight, full[rows])
        share = weight / weight.sum(0).clamp(min=1e-12)
        without = base[..., None] * colour
        rgb[rows] = (without + (scene.rgb[rows[0]] - without) * share[..., None]).clamp(min=0)
        usable[rows] &= sure
    return replace(scene, rgb=rgb, usable=usable, photo_of_light=None)


def _groups(scene: Scene) -> list[list[int]]:
    """Return the rows of each photo's lights."""
    if scene.photo_of_light is None:
        return [[k] for k in range(len(scene.lights))]
    groups: dict[int, list[int]] = {}
    for k, photo in enumerate(scene.photo_of_light.tolist()):
        groups.setdefault(photo, []).append(k)
    return list(groups.values())


def _sets(count: int) -> Float[Tensor, "sets lights"]:
    """Return every set of lights that may arrive."""
    return torch.tensor(list(product((0.0, 1.0), repeat=count)))


def _nearest_level(
    value: Float[Tensor, "height width"],
    full: Float[Tensor, "lights height width"],
    base: Float[Tensor, "height width"],
    lit: Float[Tensor, "lights height width"] | None,
    only_levels: bool,
) -> tuple[Float[Tensor, "lights height width"], Bool[Tensor, "lights height width"]]:
    """Return which lights arrive (1) or not (0), and for each whether the other state would fit clearly worse."""
    sets, total = _sets(len(full)), full.sum(0)
    misfit = (value - base - torch.einsum("sk,khw->shw", sets, full)).abs()
    cost = misfit
    if lit is not None:
        contradicted = (sets[:, :, None, None] - lit).abs()
        cost = misfit + PRIOR * (contradicted * full).sum(1)
    best, index = cost.min(0)
    chosen = sets[index].movedim(-1, 0)
    sigma = (FLOOR**2 + (LEVEL_SIGMA * total) ** 2).sqrt()
    sure = []
    for k in range(len(full)):
        other = torch.where((sets[:, k, None, None] != chosen[k]), cost, torch.inf).min(0).values
        sure.append(other - best > SURE_SIGMAS * sigma)
    known = torch.stack(sure)
    if only_levels:
        odd = misfit.gather(0, index[None])[0] > FITS * (chosen * full).sum(0)
        chosen, known = torch.where(odd, torch.ones(()), chosen), known | odd
    return chosen, known & (total > 0)


def _ground_albedo(scene: Scene, light: Float[Tensor, "photos height width"]) -> Float[Tensor, "height width"]:
    """Return the albedo that explains most photos; candidates make some photo fully lit, and such photos count most."""
    assert scene.rgb is not None
    groups, ambient = _groups(scene), float(scene.ambient.mean())
    seen = torch.stack([scene.rgb[rows[0]].mean(-1).reshape(-1) for rows in groups])
    lights = light.reshape(len(light), -1)
    usable = torch.stack([scene.usable[rows[0]].reshape(-1) for rows in groups])
    albedo = torch.zeros(seen.shape[1])
    for start in range(0, seen.shape[1], PIXELS_AT_ONCE):
        part = slice(start, start + PIXELS_AT_ONCE)
        total = torch.stack([lights[rows, part].sum(0) for rows in groups]) + ambient
        candidate = seen[:, part] / total.clamp(min=1e-12)
        score = torch.zeros_like(candidate)
        for p, rows in enumerate(groups):
            off = seen[p, part] / candidate.clamp(min=1e-9)  # (candidates, n): light that the value implies
            full = (off - total[p]).abs() < FITS * total[p]
            levels = _sets(len(rows)) @ lights[rows, part] + ambient
            near = ((off[None] - levels[:, None]).abs() < FITS * levels[:, None]).any(0)
            brighter = (off > total[p]) & ~full  # than all lights together: no ground of this albedo
            score += usable[p, part] * torch.where(full, 1.0, PARTLY_LIT * near - 1.0 * brighter)
        score = torch.where(usable[:, part], score, -1.0)
        albedo[part] = candidate.gather(0, score.argmax(0, keepdim=True))[0]
    return albedo.reshape(light.shape[1:])
