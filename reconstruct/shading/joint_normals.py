"""Normals and albedos of all of an object's pixels together, where too few photos light a pixel to tell its own.

One lit photo leaves a pixel's normal on a cone, two leave two normals if its albedo is known; three are needed for
both, and a fourth to detect a shadow. What is missing, the neighbours tell: the normals are those of one surface, which
is smooth nearly everywhere, and a surface is of few materials. So the most probable field of normals n and log albedos
a is found, given every sample of every pixel at once. -2 log of its probability is

    SAMPLE sum rho(sample)  +  sum rho(|n_p - n_q|^2 / BEND^2)  +  sum w_pq rho((a_p - a_q)^2 / SPECKLE^2)
    +  sum rho(curl^2 / UNEVEN^2)  +  sum rho(|n - g|^2 / GUESS^2)

over neighbours p, q, with g the normals of the surface so far and rho Geman-McClure's bounded cost: creases, edges of
materials and depth breaks cost no more than they must. w_pq is small across an edge of the colour. A sample is lit, as
Lambert's law says, or dark: turned from its light, or at a cost in a cast shadow; an unlit photo so bounds a normal,
too. `curl` is the sum of the slopes of log depth around four pixels, which is 0 of the normals of any one surface.
With l = log t of the surface's points t d, its slope between two rays is -(n . (d_q - d_p)) / (n . (d_p + d_q) / 2).

The unknowns are sums of images of several sizes, so that a step changes wide regions as easily as a pixel; Adam steps.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from reconstruct.shading.normal_fit import Pixels, bounded, indirect_light
from reconstruct.shading.normal_kernels import NORMAL_SIGMA, TAIL

SAMPLE = 0.2  # of its cost: errors of Lambert's law, as gloss makes them, are common to a pixel and its neighbours
SHADOWED = 1.5  # -2 log of the odds of a cast shadow on a pixel that faces its light: one in two among few photos
BEND, SPECKLE = 0.3, 0.2  # one sigma between neighbours: of normals, rad, and of log albedo
UNEVEN = 0.02  # one sigma of the curl, in slopes
BROKEN = 10.0  # squared sigmas: largest cost of a crease, of an edge between materials, of a depth break
SAME_COLOUR, LEAST_ALIKE = 0.03, 0.05  # one sigma of chromaticity of one material; weight across another's edge
FACING_EDGE = 0.03  # cosine to the light over which a pixel turns from dark to lit
MOST_OBLIQUE, OBLIQUE_COST = 0.05, 1000.0  # cosine of a visible normal to its ray, and what less costs
STEEPEST = 0.1  # the same cosine, in slopes
LEVELS, STEPS, RATE = 3, 150, 0.05  # images that the unknowns are sums of; Adam's steps and their size
DECAY = (0.9, 0.99)
LAST_RATE = 0.02  # of RATE; half of the steps are at RATE
DUST = 1e-6


@dataclass(frozen=True)
class Picture:
    """Where some pixels lie in the picture, and their rays."""

    places: Int[Tensor, "n 2"]  # row, column
    rays: Float[Tensor, "height width 3"]  # unit, world
    colour: Float[Tensor, "n 3"]  # chromaticity, sums to 1: of the pixel's brightest photos


def fit_together(
    picture: Picture,
    pixels: Pixels,
    guess: Float[Tensor, "n 3"] | None,
    own: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n photos"]]:
    """Fit albedo * normal of all pixels together, world frame; also return the weights of their photos, in [0, 1].

    Args:
        guess: world, the surface's normals so far, which attract; 0 where there are none.
        own: albedo * normal of each pixel by itself, to begin from.
    """
    field = _Field(picture, pixels, guess, own)
    optimiser = torch.optim.Adam(field.unknown, lr=RATE, betas=DECAY)
    for step in range(STEPS):
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, 2 * (1 - step / STEPS) + LAST_RATE)
        optimiser.zero_grad()
        field.improbability().backward()
        optimiser.step()
    with torch.no_grad():
        normal, log_albedo = (image[field.at] for image in field.images())
        lit, _ = _residuals(pixels, normal, log_albedo.exp()[:, None])
        facing = (pixels.towards @ normal[..., None])[..., 0] > 0
        weight = (1 / (1 + lit**2 / TAIL)) ** 2 * pixels.usable * facing
        return log_albedo.exp()[:, None] * normal, weight


class _Field:
    """Normals and log albedos over the part of the picture that shows the pixels, and their improbability."""

    def __init__(self, picture: Picture, pixels: Pixels, guess: Tensor | None, own: Tensor):
        first, last = picture.places.amin(0), picture.places.amax(0) + 1
        self.at = tuple((picture.places - first).unbind(1))
        shape = tuple((last - first).tolist())
        self._pixels, self._guess = pixels, guess
        self._rays = picture.rays[first[0] : last[0], first[1] : last[1]]
        there = torch.zeros(shape, dtype=torch.bool)
        there[self.at] = True
        self._pairs = [(there[_before(axis)] & there[_after(axis)]).float() for axis in (0, 1)]
        self._rings = self._pairs[0][:, :-1] * self._pairs[0][:, 1:]
        self._steps = [self._rays[_after(axis)] - self._rays[_before(axis)] for axis in (0, 1)]
        self._pixel = float(self._steps[1].norm(dim=-1).mean())
        colour = torch.zeros(*shape, 3)
        colour[self.at] = picture.colour
        self._alike = [_alike(colour, axis) for axis in (0, 1)]
        albedo = torch.linalg.vector_norm(own, dim=-1).clamp(min=DUST)
        self._normals, self._logs = torch.zeros(*shape, 3), torch.zeros(shape)
        self._normals[self.at], self._logs[self.at] = own / albedo[:, None], albedo.log()
        sizes = [[max(2, -(-side // 2**level)) for side in shape] for level in range(LEVELS)]
        self.unknown = [torch.zeros(1, 4, *size, requires_grad=True) for size in sizes]

    def images(self) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
        """Return unit normals and log albedos."""
        shape = self._logs.shape
        finest, *coarser = self.unknown
        total = finest + sum(interpolate(image, shape, mode="bilinear", align_corners=False) for image in coarser)
        return normalize(self._normals + total[0, :3].permute(1, 2, 0), dim=-1), self._logs + total[0, 3]

    def improbability(self) -> Float[Tensor, ""]:
        """Return -2 log probability of the field as it is, per pixel."""
        normals, logs = self.images()
        total = SAMPLE * self._of_samples(normals[self.at], logs[self.at])
        slopes = []
        for axis in (0, 1):
            before, after, pair = _before(axis), _after(axis), self._pairs[axis]
            bend = (normals[after] - normals[before]).square().sum(-1) / BEND**2
            speckle = ((logs[after] - logs[before]) / SPECKLE) ** 2
            total = total + (pair * (_broken(bend) + self._alike[axis] * _broken(speckle))).sum()
            normal, ray = normals[after] + normals[before], self._rays[after] + self._rays[before]
            oblique = (normal * ray).sum(-1).clamp(max=-4 * STEEPEST) / 2
            slopes.append(-(normal * self._steps[axis]).sum(-1) / oblique / self._pixel)
        down, right = slopes
        curl = right[:-1] + down[:, 1:] - right[1:] - down[:, :-1]
        total = total + (self._rings * _broken((curl / UNEVEN) ** 2)).sum()
        return total / len(self._pixels.value)

    def _of_samples(self, normal: Float[Tensor, "n 3"], log_albedo: Float[Tensor, " n"]) -> Float[Tensor, ""]:
        pixels = self._pixels
        lit, dark = (bounded(residual) for residual in _residuals(pixels, normal, log_albedo.exp()[:, None]))
        cosine = (pixels.towards @ normal[..., None])[..., 0]
        dark = dark + SHADOWED * torch.sigmoid(cosine / FACING_EDGE - 1)
        total = (-2 * torch.logaddexp(-lit / 2, -dark / 2) * pixels.usable).sum()
        hidden = MOST_OBLIQUE + (normal * self._rays[self.at]).sum(-1)
        total = total + OBLIQUE_COST / SAMPLE * hidden.clamp(min=0).square().sum()
        guess = self._guess
        if guess is None:
            return total
        turned = (normal - guess).square().sum(-1) / NORMAL_SIGMA**2
        return total + ((guess != 0).any(-1) * _broken(turned)).sum() / SAMPLE


def _residuals(
    pixels: Pixels, normal: Float[Tensor, "n 3"], albedo: Float[Tensor, "n 1"]
) -> tuple[Float[Tensor, "n photos"], Float[Tensor, "n photos"]]:
    """Return the residuals of each sample as a lit one and as a dark one, in sigmas."""
    indirect = albedo * indirect_light(pixels, normal)
    direct = albedo * pixels.strength * (pixels.towards @ normal[..., None])[..., 0].clamp(min=0)
    with torch.no_grad():  # a large sigma is no merit
        sigma = pixels.variance(albedo, indirect).sqrt()
    return (pixels.value - indirect - direct) / sigma, (pixels.value - indirect) / sigma


def _broken(squared: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    return BROKEN * squared / (BROKEN + squared)


def _alike(colour: Float[Tensor, "height width 3"], axis: int) -> Float[Tensor, "rows columns"]:
    apart = (colour[_after(axis)] - colour[_before(axis)]).square().sum(-1) / SAME_COLOUR**2
    return LEAST_ALIKE + (1 - LEAST_ALIKE) * torch.exp(-apart / 2)


def _before(axis: int) -> tuple[slice, ...]:
    return (slice(None),) * axis + (slice(None, -1),)


def _after(axis: int) -> tuple[slice, ...]:
    return (slice(None),) * axis + (slice(1, None),)
