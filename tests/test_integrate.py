"""Normals integrated to depth."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion, gaussian_filter
from synthetic import BALL, Box, Look, render
from torch.nn.functional import normalize

from reconstruct.hull.follow_normals import follow_normals
from reconstruct.hull.normal_integration import integrate_behind, integrate_normals, integrate_within
from reconstruct.labels.labels import assemble_labels
from reconstruct.labels.observer import Observer
from reconstruct.labels.outline import local_mean
from reconstruct.labels.supervision import normal_rays, supervise
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled
from reconstruct.sdf.normal_fusion import NormalRays, combine_with_normals
from reconstruct.sdf.rays import find_surface

BLOCK = Box((-45.0, -30.0, 0.0), (45.0, 30.0, 40.0))


POST = Box((-12.0, -60.0, 0.0), (12.0, -45.0, 60.0))
SURE = 1.0
PIXEL = 2.1  # mm at the object


@pytest.fixture(scope="module")
def block():
    return render((BLOCK,), Look(n_lights=2))


def rays_and_lengths(scene, truth):
    """Unit rays, the true distance along them (nan beside the object), and the true normals."""
    along = scene.directions.double().numpy()
    length = np.linalg.norm(truth.points - scene.eye.numpy(), axis=-1)
    return along, np.where(truth.mask, length, np.nan), truth.normals


def domed(length, truth, height):
    """Nearer to the eye on level tops by a dome that is 0 at their outline."""
    top = truth.mask & (truth.normals[..., 2] > 0.9)
    rows, columns = np.nonzero(top)
    bulge = np.zeros(top.shape)
    across = [np.pi * (x - x.min()) / np.ptp(x) for x in (rows, columns)]
    bulge[top] = height * np.sin(across[0]) * np.sin(across[1])
    return np.where(truth.mask, length - bulge, np.nan), top


def normals_of(along, length):
    """Of the surface length * along, by differences; the nearest pixel's beside its outline."""
    points = along * np.where(np.isfinite(length), length, np.nanmax(length))[..., None]
    down, right = np.gradient(points, axis=(0, 1))
    normal = np.cross(down, right)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def test_a_dome_over_a_flat_top_becomes_the_top_and_the_true_surface_stays(block):
    along, length, normals = rays_and_lengths(*block)
    bulged, top = domed(length, block[1], 10.0)
    found = integrate_normals(along, bulged, normals_of(along, bulged), normals, np.full(top.shape, SURE))
    assert np.abs(bulged - length)[top].mean() > 3
    assert np.abs(found - length)[top].mean() < 0.6 * PIXEL
    found = integrate_normals(along, length, normals, normals, np.full(length.shape, SURE))
    assert np.nanmax(np.abs(found - length)) < 0.05 * PIXEL


def test_a_thing_before_another_is_not_drawn_to_it():
    scene, truth = render((BLOCK, POST), Look(n_lights=2))
    along, length, normals = rays_and_lengths(scene, truth)
    bulged, top = domed(length, truth, 6.0)
    found = integrate_normals(along, bulged, normals_of(along, bulged), normals, np.full(top.shape, SURE))
    inner = binary_erosion(truth.mask, iterations=2)
    assert np.abs(found - length)[inner].max() < 1.2 * PIXEL


@pytest.mark.parametrize("wrong", [0.0, 0.02])
def test_a_top_under_the_dome_of_a_hull_is_found_at_the_rim(block, wrong):
    along, length, normals = rays_and_lengths(*block)
    bulged, top = domed(length, block[1], 20.0)
    bulged[~top] = np.nan
    lost = top & (np.random.default_rng(0).random(top.shape) < wrong)
    hull = np.where(lost, length + 20.0, bulged)
    given = (along, hull, normals_of(along, bulged), normals, np.full(top.shape, SURE))
    tied, behind = integrate_normals(*given, True), integrate_behind(*given)
    assert np.abs(behind - length)[top].mean() < PIXEL < np.abs(tied - length)[top].mean()


def test_a_hollow_lies_below_the_lid_that_a_hull_puts_on_it(block):
    """Half a ball is taken out of the block's top, of which the hull knows nothing."""
    along, lid, own = rays_and_lengths(*block)
    centre, radius, eye = np.array([0.0, 0.0, 40.0]), 25.0, block[0].eye.numpy()
    top = block[1].mask & (own[..., 2] > 0.9)
    inside = top & (np.linalg.norm(eye + np.nan_to_num(lid)[..., None] * along - centre, axis=-1) < radius)
    middle = -((eye - centre) * along).sum(-1)
    length = middle + np.sqrt(np.maximum(radius**2 - ((eye - centre) ** 2).sum() + middle**2, 0))
    normals = np.where(inside[..., None], (centre - eye - length[..., None] * along) / radius, own)
    length = np.where(inside, length, lid)
    given = (along, lid, own, normals, np.full(inside.shape, SURE))
    tied, within = (np.abs(found - length) for found in (integrate_normals(*given, True), integrate_within(*given)))
    back = inside & (np.arange(len(inside))[:, None] < np.median(np.nonzero(inside)[0]))
    beside = block[1].mask & ~inside
    assert within[back].mean() < 0.7 * tied[back].mean()
    assert within[beside].mean() < 0.3 * PIXEL < 3 * PIXEL < tied[beside].mean()


def test_the_inside_of_a_cup_is_found_under_a_lid_that_touches_its_near_rim_only():
    """Its rim, in one piece all around, carries the depth of the far wall; the near rim stands before the inside."""
    outer, inner, high, eye = 40.0, 36.0, 80.0, np.array([0.0, -200.0, 230.0])
    forward = np.array([0.0, 0.0, 50.0]) - eye
    forward /= np.linalg.norm(forward)
    right, down = np.array([1.0, 0.0, 0.0]), np.cross(forward, [1.0, 0.0, 0.0])
    u, v = np.meshgrid(np.linspace(-0.2, 0.2, 72), np.linspace(-0.26, 0.2, 84))
    along = forward + u[..., None] * right + v[..., None] * down
    along /= np.linalg.norm(along, axis=-1, keepdims=True)

    def through(radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Lengths at which rays enter and leave an endless cylinder; nan beside it."""
        a, b = (along[..., :2] ** 2).sum(-1), (along[..., :2] * eye[:2]).sum(-1)
        root = np.sqrt(np.where((c := b**2 - a * ((eye[:2] ** 2).sum() - radius**2)) > 0, c, np.nan))
        return (-b - root) / a, (-b + root) / a

    def at(length: np.ndarray) -> np.ndarray:
        return eye + length[..., None] * along

    (front, _), (_, back) = through(outer), through(inner)
    rim = (high - eye[2]) / along[..., 2]
    wide = np.linalg.norm(at(rim)[..., :2], axis=-1)
    side = np.isfinite(front) & (at(front)[..., 2] < high) & (at(front)[..., 2] > 0)
    top, inside = (wide >= inner) & (wide <= outer), (wide < inner) & (at(back)[..., 2] > 0)
    length = np.where(top, rim, np.where(inside, back, np.where(side, front, np.nan)))
    radial = at(length) * [1, 1, 0] / np.linalg.norm(at(length)[..., :2], axis=-1, keepdims=True)
    normals = np.nan_to_num(np.where(top[..., None], [0.0, 0.0, 1.0], np.where(inside[..., None], -radial, radial)))
    leaning = np.array([0.0, -0.5, 1.0]) / 1.25**0.5
    lid = ((np.array([0.0, -outer, high]) - eye) @ leaning) / (along @ leaning)
    covered = (top | inside) & (lid < length)
    hull, own = np.where(covered, lid, length), np.where(covered[..., None], leaning, normals)
    found = integrate_within(along, hull, own, normals, np.full(hull.shape, SURE))
    assert np.median((length - hull)[inside]) > 40
    assert np.median(np.abs(found - length)[inside]) < 5
    assert np.nanmedian(np.abs(found - length)[side & ~inside & ~top]) < 0.5


def test_a_side_stays_on_its_hull_though_all_its_normals_err_alike():
    """Above a white table a wall seems to face down; it is as true to its hull in a large picture as in a small one."""
    u, v = np.meshgrid(np.linspace(-0.01, 0.01, 8), np.linspace(-0.25, 0.25, 200))
    along = np.stack([u, np.ones_like(u), v], -1) / np.sqrt(1 + u**2 + v**2)[..., None]
    wall = 300 / along[..., 1]
    own = np.broadcast_to([0.0, -1.0, 0.0], along.shape)
    down = np.radians(10.0)
    seeming = np.broadcast_to([0.0, -np.cos(down), -np.sin(down)], along.shape)
    found = integrate_within(along, wall, own, seeming, np.full(wall.shape, SURE))
    assert np.abs(found - wall).max() < 3 * 300 * 0.5 / 199  # three pixels


def test_what_is_in_front_of_a_hull_weighs_more(block):
    along, length, normals = rays_and_lengths(*block)
    uneven = length + np.where(np.arange(length.shape[1]) % 2 > 0, 2.0, -2.0)
    trust = np.full(length.shape, SURE)
    even, bound = (
        integrate_normals(along, uneven, normals_of(along, uneven), normals, trust, w) for w in (False, True)
    )
    assert np.nanmean(bound - even) > 0.3


def test_a_grid_follows_the_normals_of_its_labels(block):
    scene, truth = block
    nodes = 64
    low, spacing = torch.tensor([-56.0, -42.0, -6.0]), 112.0 / (nodes - 1)
    shape = (nodes, round(84 / spacing) + 1, round(62 / spacing) + 1)
    at = torch.stack(torch.meshgrid(*map(torch.arange, shape), indexing="ij"), -1) * spacing + low
    x, y = (at[..., i] / half for i, half in enumerate((45, 30)))
    dome = 8 * (1 - x**2).clamp(min=0) * (1 - y**2).clamp(min=0)
    true = torch.from_numpy(truth.sdf(at.reshape(-1, 3).numpy().astype(float))).float().reshape(shape)
    above = torch.maximum(torch.maximum((x.abs() - 1) * 45, (y.abs() - 1) * 30), at[..., 2] - 40 - dome)
    grid = resampled(SdfGrid(torch.minimum(true, above), low, spacing), nodes).grid()
    observer = Observer(replace(scene, mask=torch.from_numpy(truth.mask).float()))
    moved = follow_normals(grid, scene, *observer.seen(grid), truth.labels(0.0), integrate_normals)
    top = truth.mask & (truth.normals[..., 2] > 0.9)
    off = [np.abs(observer.seen(g)[0].numpy()[..., 2] - 40)[top].mean() for g in (grid, resampled(moved, nodes).grid())]
    assert off[1] < 0.45 * off[0]


# --- positions and normals combined ----------------------------------------------------------------------------------


RADIUS, NODES = 20.0, 52  # voxels; spacing 1, the ball's centre is the world's origin
EYES = ((90.0, 0.0, 0.0), (-45.0, 78.0, 0.0), (-45.0, -78.0, 0.0))


def ball(unevenness: float = 0.0) -> SdfGrid:
    """A ball whose distances are off by smooth noise, voxels."""
    axis = np.arange(NODES) - (NODES - 1) / 2
    away = np.sqrt(sum(x**2 for x in np.meshgrid(axis, axis, axis, indexing="ij"))) - RADIUS
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(away.shape), 2.0)
    values = away + unevenness * noise / noise.std()
    return SdfGrid(torch.from_numpy(values.astype(np.float32)), torch.full((3,), float(axis[0])), 1.0)


def camera(surface: SdfGrid, eye: tuple[float, float, float], trust: float = 0.8) -> NormalRays:
    """Rays over the whole ball and beyond, with the true normals of a ball where they meet the surface."""
    towards = normalize(-torch.tensor(eye), dim=0)
    right = normalize(torch.linalg.cross(towards, torch.tensor([0.0, 0, 1])), dim=0)
    up = torch.linalg.cross(right, towards)
    side = torch.linspace(-0.28, 0.28, 60)
    x, y = (part.reshape(-1, 1) for part in torch.meshgrid(side, side, indexing="xy"))
    rays = normalize(towards + x * right + y * up, dim=1)
    origin = torch.tensor(eye)
    t = find_surface(surface, origin.expand_as(rays), rays)
    hit = t.isfinite()
    points = origin + torch.where(hit, t, torch.zeros(()))[:, None] * rays
    normals = torch.where(hit[:, None], normalize(points, dim=1), torch.zeros(()))
    nothing = np.zeros(len(rays), bool)
    return NormalRays(origin, rays, torch.full((len(rays),), torch.inf), normals.numpy(), trust * hit.numpy(), nothing)


def seen(surface: SdfGrid, eye: tuple[float, float, float]) -> torch.Tensor:
    """Points of the surface that a camera sees."""
    rays = camera(surface, eye)
    t = find_surface(surface, rays.eye.expand_as(rays.directions), rays.directions)
    return (rays.eye + t[:, None] * rays.directions)[t.isfinite()]


def angle(surface: SdfGrid) -> float:
    """Mean angle between the normals of what the cameras see and a ball's, degrees."""
    points = torch.cat([seen(surface, eye) for eye in EYES])
    cosine = (normalize(surface.gradient(points), dim=1) * normalize(points, dim=1)).sum(1)
    return float(cosine.clamp(-1, 1).arccos().rad2deg().mean())


def test_an_uneven_ball_faces_as_its_normals_say_and_keeps_its_place():
    uneven = ball(0.15)
    smooth = combine_with_normals(uneven, [camera(uneven, eye) for eye in EYES])
    assert angle(uneven) > 3
    assert angle(smooth) < angle(uneven) / 3
    radius = [float(torch.cat([seen(one, eye) for eye in EYES]).norm(dim=1).mean()) for one in (uneven, smooth)]
    assert abs(radius[1] - radius[0]) < 0.02


def test_wrong_normals_among_right_ones_hardly_tell():
    uneven = ball(0.15)
    rng = np.random.default_rng(1)

    def spoilt(one: NormalRays) -> NormalRays:
        """A seventh of the normals point anywhere."""
        anywhere = rng.standard_normal(one.normals.shape).astype(np.float32)
        anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
        return replace(one, normals=np.where(rng.random((len(anywhere), 1)) < 1 / 7, anywhere, one.normals))

    after = combine_with_normals(uneven, [spoilt(camera(uneven, eye)) for eye in EYES])
    assert angle(after) < angle(uneven) / 2  # 3.2 degrees before, 0.4 without them, 1.1 with them


def test_outlines_stay_where_pixels_see_them():
    """Normals that lean by 6 degrees would turn the ball's limb; pixels at the outline know where it is."""
    even = ball()
    front = camera(even, EYES[0])
    lean = np.array([0, 0, np.tan(np.radians(6))], np.float32)
    normals = front.normals + lean * (front.trust > 0)[:, None]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    leaning = replace(front, normals=normals.astype(np.float32))
    facing = np.abs((front.directions.numpy() * front.normals).sum(1))
    limb = (front.trust > 0) & (facing < 0.35)
    free, held = (
        combine_with_normals(even, [replace(leaning, at_outline=flags)]) for flags in (leaning.at_outline, limb)
    )
    points = seen(even, EYES[0])
    at = (normalize(points, dim=1) * normalize(points - front.eye, dim=1)).sum(1).abs() < 0.35
    moved = [float(one.sdf(points[at]).abs().mean()) for one in (free, held)]
    assert moved[1] < 0.5 * moved[0]


@pytest.mark.parametrize("is_colour", [True, False])
def test_normals_are_taken_from_object_pixels_of_photos_and_not_of_shadow_pictures(is_colour):
    scene, _ = render((BALL,), Look(with_shadow=True, with_mask=True))
    scene = scene if is_colour else replace(scene, rgb=None)
    labels = assemble_labels(replace(scene, rgb=None), None, None)
    rays = supervise(scene, replace(labels, mask=local_mean(labels.mask[None], 3)[0]))  # grey at the outline
    rays = replace(rays, normal_confidence=np.ones_like(rays.normal_confidence))
    found = normal_rays(scene, rays)
    object_pixels = rays.role == kernels.OBJECT
    assert object_pixels.any() and (rays.role == kernels.EDGE).any()
    np.testing.assert_array_equal(found.trust > 0, object_pixels & is_colour)
    np.testing.assert_array_equal(found.at_outline, rays.role == kernels.EDGE)
