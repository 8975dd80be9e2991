"""The hull holds the object, leaves out what lit ground proves empty, and refuses what it cannot bound."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from flashlight_photos import looking_at
from scipy.ndimage import label
from synthetic import BALL, HEAP, Box, Look, Sphere, default_camera, render

from calibration.camera import Camera
from calibration.posed_camera import PosedCamera
from calibration.side_view import SideView
from capture.errors import ReconstructionError
from reconstruct.hull.hull_parts import PixelRays, most_needed
from reconstruct.hull.shadow_hull import shadow_hull
from reconstruct.labels.labels import assemble_labels

LOOK = Look(with_shadow=True, with_mask=True, n_lights=24)


def labels_of(scene):
    return assemble_labels(scene, None, None)


def nodes_of(grid) -> np.ndarray:
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.values.shape], indexing="ij"), -1)
    return grid.origin.numpy() + grid.spacing * index


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_the_hull_holds_the_ball_and_not_much_more(kind):
    scene, truth = render((BALL,), Look(with_shadow=True, with_mask=True, n_lights=24, kind=kind))
    grid = shadow_hull(scene, labels_of(scene), votes=1, nodes=40)
    nodes = nodes_of(grid)
    distance = truth.sdf(nodes.reshape(-1, 3)).reshape(grid.values.shape)
    inside = grid.values.numpy() < 0
    deep = (distance < -2.5 * grid.spacing) & (nodes[..., 2] > 0)
    assert inside[deep].mean() > 0.97
    volume = inside[nodes[..., 2] > 0].sum() * grid.spacing**3
    assert volume < 2.0 * 4 / 3 * np.pi * BALL.radius**3  # the hull of 24 lights, its unseen foot included


def test_a_photo_from_the_side_carves_what_few_lights_leave_and_nothing_else():
    scene, truth = render((BALL,), Look(with_shadow=True, with_mask=True, n_lights=4))
    eye, middle = np.array([420.0, 60.0, 200.0]), np.array(BALL.centre)
    side = PosedCamera(Camera(240, 180, 300.0, 300.0, 119.5, 89.5), looking_at(eye, middle), 0.0)
    rays = side.rays(side.camera.pixel_grid())
    miss = np.linalg.norm(np.cross(middle - eye, rays), axis=-1) / np.linalg.norm(rays, axis=-1)
    mask = miss < BALL.radius
    view = SideView("side.jpg", side, (0, 0, 240, 180), mask, np.ones_like(mask), 0.3)
    free, held = (shadow_hull(one, labels_of(one), 1, 40) for one in (scene, replace(scene, side_views=(view,))))
    volumes = [float((grid.values < 0).sum()) * grid.spacing**3 for grid in (free, held)]
    assert volumes[1] < 0.8 * volumes[0]
    nodes = nodes_of(held)
    distance = truth.sdf(nodes.reshape(-1, 3)).reshape(held.values.shape)
    deep = (distance < -2.5 * held.spacing) & (nodes[..., 2] > 0)
    assert (held.values.numpy() < 0)[deep].mean() > 0.97


def test_an_object_nearly_as_high_as_the_camera_is_not_cut():
    camera, pose = default_camera(LOOK.width, LOOK.height)
    wide = replace(camera, fx=70.0, fy=70.0)
    column = Box((-25.0, -25.0, 0.0), (25.0, 25.0, 290.0))  # the camera is 368 mm above the ground
    scene, _ = render((column,), LOOK, (wide, pose))
    grid = shadow_hull(scene, labels_of(scene), votes=1, nodes=40)
    assert float(grid.sdf(torch.tensor([[0.0, 0.0, 280.0]]))) < 0


def test_one_wrong_light_is_forgiven_by_a_second_vote():
    scene, _ = render((BALL,), LOOK)
    labels = labels_of(scene)
    longest = int(((labels.visibility < 0.5) & (labels.mask < 0.5)).sum((1, 2)).argmax())
    labels.visibility[longest] = 1.0  # read as lit everywhere: its shadow would prove the ball empty
    centre = torch.tensor([BALL.centre])
    assert float(shadow_hull(scene, labels, votes=1, nodes=40).sdf(centre)) > 0
    assert float(shadow_hull(scene, labels, votes=2, nodes=40).sdf(centre)) < 0


def test_no_object_is_said_to_be_no_object():
    scene, _ = render((BALL,), LOOK)
    labels = labels_of(scene)
    labels.mask[...] = 0
    with pytest.raises(ReconstructionError, match="no object found"):
        shadow_hull(scene, labels, votes=1, nodes=40)


@pytest.mark.parametrize("lights", [4, 6])
def test_few_lights_leave_no_floating_parts_between_camera_and_object(lights):
    scene, truth = render(HEAP, replace(LOOK, n_lights=lights))
    grid = shadow_hull(scene, labels_of(scene), votes=1, nodes=40)
    inside = grid.values.numpy() < 0
    assert label(inside, np.ones((3, 3, 3)), output=np.empty(inside.shape, np.int32)) == 1
    nodes = nodes_of(grid)
    distance = truth.sdf(nodes.reshape(-1, 3)).reshape(inside.shape)
    assert inside[(distance < -2.5 * grid.spacing) & (nodes[..., 2] > 0)].mean() > 0.95  # the object is still in it
    assert grid.spacing < 5  # mm: its box is not that of what floats, which was twice as long


@pytest.mark.parametrize(("rows", "needs"), [(4, 2), (1, 1)])
def test_where_object_pixels_meet_hardly_any_node_that_enough_lights_need_fewer_are_enough(rows, needs):
    inside, needed = np.ones((12, 12, 12), bool), np.ones((12, 12, 12), np.uint8)
    needed[:, : 3 * rows : 3] = 2  # a pixel meets these rows and their neighbours
    nodes = np.arange(12**3, dtype=np.int32).reshape(12, 144)  # one ray through each node of the first layer
    rays = PixelRays(nodes, np.ones(nodes.shape, bool), np.arange(12, dtype=np.float32), np.arange(144))
    enough, keep = most_needed(inside, needed, inside, 2, [rays])
    assert enough == needs and keep.sum() == (needed >= needs).sum()
    assert not rays.meet(np.zeros_like(inside)).any()


def test_a_hanging_object_that_pixels_need_stays():
    pair = (Sphere((-50.0, 0.0, 25.0), 25.0), Sphere((50.0, 0.0, 90.0), 20.0))
    scene, _ = render(pair, LOOK)
    grid = shadow_hull(scene, labels_of(scene), votes=1, nodes=48)
    for ball in pair:
        assert float(grid.sdf(torch.tensor([ball.centre]))) < 0
