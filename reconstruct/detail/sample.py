"""Sample the details of all views at points of their surface: which normal and albedo a place has."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from calibration.camera import Camera
from reconstruct.detail.file import SURE, Detail
from reconstruct.render.g_buffer import RenderView
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import in_line_of_sight

SAME_VOXELS = 1.0  # a point this close to the camera's first hit counts as seen
POINTS_AT_ONCE = 2**18
LEAST_FACING = 0.01  # cosine; a view that sees a place at less counts as this
NO_WEIGHT = 1e-12


@dataclass(frozen=True)
class DetailSample:
    """A detail sampled at points of the surface."""

    normals: Float[Tensor, "n 3"]  # unit, world; 0 where there is none
    albedo: Float[Tensor, "n 3"]
    confidence: Float[Tensor, " n"]  # in [0, 1]; 0 where no camera of the capture sees the place


def detail_at(details: Sequence[Detail], grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    """Interpolate the details of all views at points on the surface, in the frame that the views share.

    Where several views see a point, it gets their mean, weighted as their materials are (reconstruct/render/joined.py):
    by facing^2 / footprint^2, and by the confidence, which falls to 0 towards outlines. So no seam is left.
    """
    parts = [_of_views(details, grid, part) for part in points.split(POINTS_AT_ONCE)]
    if not parts:
        return DetailSample(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    return DetailSample(*(torch.cat([getattr(p, name) for p in parts]) for name in ("normals", "albedo", "confidence")))


def _of_views(details: Sequence[Detail], grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    found = [_of_view(detail, grid, points) for detail in details]
    if len(found) == 1:
        return found[0]
    normals, albedo, weights = torch.zeros_like(points), torch.zeros_like(points), torch.zeros(len(points), 1)
    for detail, one in zip(details, found, strict=True):
        offset = _eye(detail) - points
        away = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        facing = ((one.normals * offset).sum(-1, keepdim=True) / away).clamp(min=LEAST_FACING)
        weight = one.confidence[:, None] * (facing * detail.posed_camera.camera.fx / away) ** 2
        normals, albedo, weights = normals + weight * one.normals, albedo + weight * one.albedo, weights + weight
    confidence = torch.stack([one.confidence for one in found]).amax(0) if found else torch.zeros(len(points))
    return DetailSample(normalize(normals, dim=-1), albedo / weights.clamp(min=NO_WEIGHT), confidence)


def _eye(detail: Detail) -> Float[Tensor, "3"]:
    """Return the camera's centre in the frame that all views share."""
    centre = detail.posed_camera.centre
    own = centre if detail.object_from_world is None else detail.object_from_world.apply(centre[None])[0]
    return torch.from_numpy(own).float()


def _of_view(detail: Detail, grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    """Interpolate one view's detail."""
    pixels, depth = detail.posed_camera.project_with_depth(detail.in_world(points.double().numpy()))
    u, v = pixels.T
    height, width = detail.confidence.shape
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    is_seen = torch.from_numpy(inside) & in_line_of_sight(grid, _eye(detail), points, SAME_VOXELS * grid.spacing)
    out = DetailSample(torch.zeros_like(points), torch.zeros_like(points), torch.zeros(len(points)))
    places = np.flatnonzero(is_seen.numpy())
    columns, rows = np.minimum(u[places].astype(int), width - 2), np.minimum(v[places].astype(int), height - 2)
    right, down = u[places] - columns, v[places] - rows
    total = np.zeros((len(places), 7))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (down if i else 1 - down) * (right if j else 1 - right)
        at = rows + i, columns + j
        sure = share * detail.confidence[at] / SURE
        total[:, :3] += sure[:, None] * detail.normals[at]
        total[:, 3:6] += sure[:, None] * detail.albedo[at]
        total[:, 6] += sure
    if detail.object_from_world is not None:
        total[:, :3] = total[:, :3] @ detail.object_from_world.rotation.T
    found = torch.from_numpy(total).float()
    out.normals[places] = normalize(found[:, :3], dim=-1)
    out.albedo[places] = found[:, 3:6] / found[:, 6:].clamp(min=1e-6)
    out.confidence[places] = found[:, 6]
    return out


def with_detail(view: RenderView, details: Sequence[Detail], camera: Camera) -> RenderView:
    """Return the view with finer normals and albedo where a camera of the capture saw the surface.

    Args:
        view: in the frame that all views share.
        details: where there are none, the view is returned unchanged.
        camera: of the view, at about the capture camera's distance.
    """
    if not details:
        return view
    details = [detail.reduced(detail.posed_camera.camera.fx / camera.fx) for detail in details]
    at = detail_at(details, view.grid, view.maps.points[view.maps.mask])
    share = at.confidence[:, None]
    normals, albedo = view.maps.normals.clone(), view.albedo.clone()
    normals[view.maps.mask] = normalize(torch.lerp(normals[view.maps.mask], at.normals, share), dim=-1)
    albedo[view.maps.mask] = torch.lerp(albedo[view.maps.mask], at.albedo, share)
    return replace(view, maps=replace(view.maps, normals=normals), albedo=albedo)
