"""Material edits of parts of a solved scene: a later edit lies over an earlier one."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from reconstruct.appearance.brdf import Gloss, Material, conserving
from reconstruct.render.g_buffer import RenderView

Point = tuple[float, float, float]  # world
RECOVERED = -1  # a point that no edit reaches


@runtime_checkable
class Region(Protocol):
    """A part of a scene."""

    def contains(self, points: Float[Tensor, "n 3"], on_object: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """Find the surface points (world) that belong to it; points not on the object are on the ground."""
        ...


@dataclass(frozen=True)
class ObjectRegion:
    """Everything that stands on the ground."""

    def contains(self, points: Float[Tensor, "n 3"], on_object: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """See Region."""
        return on_object


@dataclass(frozen=True)
class GroundRegion:
    """The plane the object stands on."""

    def contains(self, points: Float[Tensor, "n 3"], on_object: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """See Region."""
        return ~on_object


@dataclass(frozen=True)
class BoxRegion:
    """The part of the object inside an upright box."""

    centre: Point
    half: Point  # half its edges, world length
    turn: float = 0.0  # about the vertical through its centre, from +x towards +y

    def contains(self, points: Float[Tensor, "n 3"], on_object: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """See Region."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        world_from_box = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        within = (points - torch.tensor(self.centre)) @ world_from_box
        return on_object & (within.abs() <= torch.tensor(self.half)).all(-1)


@dataclass(frozen=True)
class BrushRegion:
    """Everything within a radius of a point, on the object or on the ground as the point is."""

    centre: Point
    radius: float  # world length
    on_object: bool

    def contains(self, points: Float[Tensor, "n 3"], on_object: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """See Region."""
        near = (points - torch.tensor(self.centre)).norm(dim=-1) <= self.radius
        return near & (on_object == self.on_object)


@dataclass(frozen=True)
class Edit:
    """A material for a region; it replaces the recovered material or earlier edits there."""

    material: Material
    region: Region


def top_material(
    edits: Sequence[Edit], points: Float[Tensor, "n 3"], on_object: Bool[Tensor, " n"]
) -> tuple[list[Material], Int[Tensor, " n"]]:
    """Return the distinct materials of the edits, and the index of the top one at each point (RECOVERED: none)."""
    materials = list(dict.fromkeys(edit.material for edit in edits))
    top = torch.full((len(points),), RECOVERED)
    for edit in edits:
        top[edit.region.contains(points, on_object)] = materials.index(edit.material)
    return materials, top


def apply_edits(view: RenderView, edits: Sequence[Edit]) -> RenderView:
    """Return the view with the edits' materials in their regions [ShadowNeuS, supplement, "Applications"; its lobes].

    Every material is limited to reflect at most all light towards the camera (white furnace). A material without a
    colour keeps the recovered colour, also over an earlier edit.
    """
    if not edits:
        return view
    seen = torch.isfinite(view.maps.depth)
    points = view.maps.points[seen]
    materials, top = top_material(edits, points, view.maps.mask[seen])
    cosine = (view.maps.normals[seen] * normalize(view.eye - points, dim=-1)).sum(-1)
    old = points.new_zeros(len(points), 0) if view.gloss is None else view.gloss.weights[seen]
    chosen = torch.cat([old, points.new_zeros(len(points), len(materials))], 1)
    recovered, colours = view.albedo[seen], view.albedo[seen].clone()
    lobes = [material.coefficients() for material in materials]
    for k, material in enumerate(materials):
        where = top == k
        own = recovered[where] if material.albedo is None else torch.tensor(material.albedo).expand(int(where.sum()), 3)
        colours[where], _ = conserving(own, lobes[k].expand(len(own), *lobes[k].shape), cosine[where])
        chosen[where] = one_hot(torch.tensor(old.shape[1] + k), chosen.shape[1]).to(chosen)
    albedo, weights = view.albedo.clone(), points.new_zeros(*seen.shape, chosen.shape[1])
    albedo[seen], weights[seen] = colours, chosen
    before = [] if view.gloss is None else list(view.gloss.lobes)
    return replace(view, albedo=albedo, gloss=Gloss(torch.stack([*before, *lobes]), weights))


def edited_vertex_colours(
    edits: Sequence[Edit], vertices: Float[np.ndarray, "n 3"], recovered: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Return linear display colours of an object's vertices after the edits: reflectance at normal incidence.

    Args:
        vertices: world.
        recovered: linear colours without edits.
    """
    materials, top = top_material(
        edits, torch.from_numpy(vertices).float(), torch.ones(len(vertices), dtype=torch.bool)
    )
    colours = recovered.copy()
    for k, material in enumerate(materials):
        where = top.numpy() == k
        own = recovered[where] if material.albedo is None else np.array(material.albedo)
        colours[where] = np.clip(own + np.array(material.mirrored), 0, 1)
    return colours
