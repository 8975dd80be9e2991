"""One material for a surface that several cameras saw: their albedo and gloss in one scale, blended without seams."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from torch import Tensor

from reconstruct.appearance.brdf import Gloss
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import MIN_FACING, SAME_DEPTH, SurfaceMaps, away_from_outlines, finite, surface_maps

FEATHER = 0.06  # of the object's size in the picture: its weight grows so far from the outline, where seams would be
SHARED = 0.05  # of the largest weight: of points that compare two views' scales
FEWEST_SHARED = 50  # pixels; fewer do not compare them
MOST_COMPARED = 20_000  # pixels of each view, which tell the scales to a thousandth
DARKEST = 1e-3  # albedo below which no ratio is known


@dataclass(frozen=True)
class _View:
    """What one camera saw, and how well: channels are the albedo and the weights of all views' lobes."""

    fields: SolvedScene
    maps: SurfaceMaps  # in the view's world
    points: Float[np.ndarray, "height width 3"]  # of maps, in the frame that all views share
    values: Float[np.ndarray, "height width channels"]
    weight: Float[np.ndarray, "height width"]  # 0 where no object is seen, or not well

    def at(
        self, points: Float[np.ndarray, "n 3"], tolerance: float
    ) -> tuple[Float[np.ndarray, "n channels"], Float[np.ndarray, " n"]]:
        """Return the values and the weight at points of the object; weight 0 where the camera does not see one.

        Args:
            points: in the frame that all views share.
            tolerance: world length by which a pixel may see something nearer.
        """
        uv, depth = self.fields.posed_camera.project_with_depth(self.fields.in_world(points))
        uv = np.where((depth > 0)[:, None], uv, -10.0)
        front = _sampled(finite(self.maps.depth.numpy()), uv, 0)
        weight = _sampled(self.weight, uv)
        channels = [_sampled(channel * self.weight, uv) for channel in np.moveaxis(self.values, 2, 0)]
        seen = (weight > 0) & (depth > 0) & (depth < front + tolerance)
        values = np.stack(channels, 1) / np.where(weight > 0, weight, 1.0)[:, None]
        return values, np.where(seen, weight, 0.0)


def join_views(views: Sequence[SolvedScene]) -> SolvedScene:
    """Return one scene from what each camera saw of one surface.

    Each view's albedo has a factor per channel of its own: its photos' exposure and white balance. The factors make
    the views agree on the points that two of them see well; their mean, in logarithms, is kept. Then each pixel's
    albedo and gloss are the mean of all views that see its point, weighted by facing^2 / footprint^2 and by the
    distance from the view's outline. So the weight of a view ends at 0 where its sight ends, and no seam is left.

    Args:
        views: of one surface; the first becomes the scene's camera, and its world the frame that all share.
    """
    if len(views) == 1:
        return views[0]
    lobes, tables = _common_lobes(views)
    seen = [_view(view, table) for view, table in zip(views, tables, strict=True)]
    tolerance = SAME_DEPTH * views[0].grid.spacing
    gains = _gains(seen, tolerance)
    seen = [
        replace(one, values=np.concatenate([one.values[..., :3] * gain, one.values[..., 3:]], -1))
        for one, gain in zip(seen, gains, strict=True)
    ]
    pictures = [_blended(seen, number, tolerance) for number in range(len(seen))]
    albedos = [torch.from_numpy(picture[..., :3]) for picture in pictures]
    weights = [torch.from_numpy(picture[..., 3:]) if lobes is not None else None for picture in pictures]
    further = tuple(
        replace(view.cameras[0], albedo=albedo, gloss_weights=weight)
        for view, albedo, weight in zip(views[1:], albedos[1:], weights[1:], strict=True)
    )
    gloss = None if lobes is None or weights[0] is None else Gloss(lobes, weights[0])
    scales = [view.interreflection / float(gain.mean()) for view, gain in zip(views, gains, strict=True)]
    known = [scale for scale in scales if scale > 0]
    scale = float(np.mean(known)) if known else 0.0
    return replace(views[0], albedo=albedos[0], gloss=gloss, interreflection=scale, further=further)


def _common_lobes(
    views: Sequence[SolvedScene],
) -> tuple[Float[Tensor, "materials lobes 3"] | None, list[Float[np.ndarray, "height width materials"]]]:
    """Return the lobes of all views as one list, and each view's weights of them."""
    glossy = [view.gloss for view in views if view.gloss is not None]
    total = sum(len(gloss.lobes) for gloss in glossy)
    tables, first = [], 0
    for view in views:
        table = np.zeros((*view.albedo.shape[:2], total), np.float32)
        if view.gloss is not None:
            last = first + len(view.gloss.lobes)
            table[..., first:last], first = view.gloss.weights.numpy(), last
        tables.append(table)
    return torch.cat([gloss.lobes for gloss in glossy]) if glossy else None, tables


def _view(fields: SolvedScene, gloss: Float[np.ndarray, "height width materials"]) -> _View:
    maps = surface_maps(fields.grid, fields.posed_camera)
    eye = torch.from_numpy(fields.posed_camera.centre).float()
    towards = torch.nn.functional.normalize(eye - maps.points, dim=-1)
    facing = (maps.normals * towards).sum(-1).numpy()
    footprint = (maps.points - eye).norm(dim=-1).numpy() / fields.camera.fx
    sight = away_from_outlines(maps, facing, footprint, fields.grid.spacing)
    inside, feather = cv2.distanceTransform(sight.astype(np.uint8), cv2.DIST_L2, 5), FEATHER * float(sight.sum()) ** 0.5
    sure = np.clip(facing - MIN_FACING, 0, 1) ** 2 * np.clip((inside - 1) / max(1.0, feather), 0, 1)
    weight = np.where(maps.mask.numpy(), sure / np.maximum(footprint, 1e-12) ** 2, 0.0)
    places = maps.points.double().numpy()
    common = fields.in_common(places.reshape(-1, 3)).reshape(places.shape)
    return _View(fields, maps, common, np.concatenate([fields.albedo.numpy(), gloss], -1), weight)


def _gains(views: Sequence[_View], tolerance: float) -> list[Float[np.ndarray, "3"]]:
    """Return the factors of the views' albedo that make shared points agree; their mean is 1, in logarithms.

    Least squares over pairs of views of log g_a - log g_b = the median log ratio, weighted by the shared points. Views
    that share none keep their own scale.
    """
    rows, right, worth = [np.ones(len(views))], [np.zeros(3)], [1e-3]
    for a, view in enumerate(views):
        row, column = np.nonzero(view.weight > SHARED * view.weight.max(initial=0.0))
        some = slice(None, None, max(1, len(row) // MOST_COMPARED))
        row, column = row[some], column[some]
        points, own = view.points[row, column], view.values[row, column, :3]
        for b, other in enumerate(views):
            if a == b or not len(row):
                continue
            values, weight = other.at(points, tolerance)
            shared = weight > SHARED * other.weight.max(initial=0.0)
            shared &= (own > DARKEST).all(1) & (values[:, :3] > DARKEST).all(1)
            if shared.sum() < FEWEST_SHARED:
                continue
            row_of = np.zeros(len(views))
            row_of[[a, b]] = 1, -1
            rows.append(row_of)
            right.append(np.median(np.log(values[shared, :3] / own[shared]), axis=0))
            worth.append(np.sqrt(shared.sum()))
    scale = np.array(worth)[:, None]
    found = np.linalg.lstsq(np.array(rows) * scale, np.array(right) * scale, rcond=None)[0]
    return list(np.exp(found))


def _blended(views: Sequence[_View], number: int, tolerance: float) -> Float[np.ndarray, "height width channels"]:
    """Return the material of one view's pixels as all views saw it; its own where no view sees the point well."""
    view = views[number]
    picture = view.values.astype(np.float32)
    row, column = np.nonzero(view.maps.mask.numpy())
    points = view.points[row, column]
    total, weight = np.zeros((len(row), picture.shape[2])), np.zeros(len(row))
    for other in views:
        if other is view:
            values, sure = view.values[row, column], view.weight[row, column]
        else:
            values, sure = other.at(points, tolerance)
        total += sure[:, None] * values
        weight += sure
    known = weight > 0
    picture[row[known], column[known]] = total[known] / weight[known, None]
    return picture


def _sampled(
    image: Float[np.ndarray, "height width"], uv: Float[np.ndarray, "n 2"], order: int = 1
) -> Float[np.ndarray, " n"]:
    """Return an image's values at pixels, between them linear or, of order 0, the nearest; 0 outside."""
    return map_coordinates(image, uv[:, ::-1].T, order=order, mode="grid-constant")
