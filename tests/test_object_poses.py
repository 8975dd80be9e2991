"""An object laid on another side: how it was turned is found, and one surface comes from all of its poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic import Look, Sphere, default_camera, grid_of, render

from calibration.pose import Pose
from capture.errors import ReconstructionError
from reconstruct.appearance.brdf import LOBES, Gloss
from reconstruct.fields import FurtherView, SolvedScene, load_fields, save_fields
from reconstruct.labels.held_out import hold_out
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import placed_rays, supervise
from reconstruct.object_poses import alignment
from reconstruct.object_poses import confirmed as confirmation
from reconstruct.object_poses.alignment import Alignment, SeenSurface, align, angle_between, mean_difference, stepped
from reconstruct.object_poses.confirmed import confirmed, how_met, withheld
from reconstruct.object_poses.light_motions import MODES, LightMotions, unseen_motion
from reconstruct.object_poses.motion_refine import MotionTrial, ObjectPoseRays, compare, refined_motion
from reconstruct.object_poses.together import PlacedObjectPose, SolvedObjectPose, Together, lay_together, merged_surface
from reconstruct.render.g_buffer import seen_material
from reconstruct.sdf.grid import SdfGrid
from reconstruct.views import placed

COLOUR = (0.7, 0.5, 0.3)
SHAPES = (
    Sphere((0.0, 0.0, 28.0), 28.0, COLOUR),
    Sphere((14.0, 10.0, 58.0), 14.0, (0.3, 0.5, 0.7)),
    Sphere((30.0, -18.0, 14.0), 14.0, COLOUR),
)
TURN = (Rotation.from_euler("z", 70, degrees=True) * Rotation.from_euler("x", 115, degrees=True)).as_matrix()
STILL = Pose(np.eye(3), np.zeros(3))
FRONT = np.array([0.0, -0.6, 0.8])  # the side of which the cameras are


def lying() -> tuple[tuple[Sphere, ...], Pose]:
    """Return the shapes laid on another side, on the ground, and the motion back: object_from_world."""
    centres = np.array([one.centre for one in SHAPES]) @ TURN.T
    drop = min(float(centre[2]) - one.radius for centre, one in zip(centres, SHAPES, strict=True))
    shift = np.array([*-centres[:, :2].mean(0), -drop])
    laid = tuple(replace(one, centre=tuple(centre + shift)) for one, centre in zip(SHAPES, centres, strict=True))
    return laid, Pose(TURN, shift).inverse()


def seen_from(shapes, side: np.ndarray, name: str = "", seed: int = 0) -> SeenSurface:
    """Return the half of the shapes' surface that faces a side, with its colours."""
    rng = np.random.default_rng(seed)
    points, albedo = [], []
    for one in shapes:
        normals = rng.standard_normal((int(one.radius**2), 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals[normals @ side > 0]
        own = np.array(one.centre) + one.radius * normals
        others = [np.linalg.norm(own - o.centre, axis=1) - o.radius for o in shapes if o is not one]
        kept = np.min(others, axis=0) > 0 if others else np.ones(len(own), bool)
        points.append(own[kept])
        albedo.append(np.broadcast_to(one.albedo, (int(kept.sum()), 3)))
    return SeenSurface(name, grid_of(shapes, 2.5), np.concatenate(points), np.concatenate(albedo), 0.0)


def off(found: Pose, true: Pose) -> tuple[float, float]:
    """Return degrees and length between two motions, at the middle of the object."""
    middle = true.inverse().apply(np.array([5.0, 0.0, 30.0]))
    return float(np.degrees(angle_between(found.rotation, true.rotation))), float(
        np.linalg.norm(found.apply(middle) - true.apply(middle))
    )


def fewer(monkeypatch) -> None:
    """Search fewer rotations: shapes of a few balls need no more."""
    monkeypatch.setattr(alignment, "ROTATIONS", 512)
    monkeypatch.setattr(alignment, "REFINED", 12)
    monkeypatch.setattr(alignment, "SOME_POINTS", 300)
    monkeypatch.setattr(alignment, "MOST_POINTS", 1500)


@pytest.fixture(scope="module")
def laid():
    """The scene of the object laid on another side, and object_from_world."""
    shapes, motion = lying()
    scene, _ = render(shapes, Look(width=64, height=48, n_lights=8, seed=3), default_camera(64, 48))
    return replace(scene, view="turned_1", light_sigma=torch.full_like(scene.lights[:, :3], 2.0)), motion


@pytest.fixture(scope="module")
def own_rays(laid):
    """The rays of that scene on the true surface, in its own world."""
    surface = grid_of(lying()[0], 2.5)
    return supervise(laid[0], Observer(laid[0]).labels(surface, laid[0]))


def test_how_an_object_was_turned_is_found_from_the_halves_that_either_object_pose_saw(monkeypatch):
    fewer(monkeypatch)
    shapes, motion = lying()
    found = align(seen_from(SHAPES, FRONT), seen_from(shapes, FRONT))
    degrees, length = off(found.motion, motion)
    assert degrees < 0.5 and length < 0.3
    assert not found.by_colour


@pytest.mark.parametrize("is_coloured", [True, False])
def test_look_alikes_are_told_apart_by_colour_or_refused(monkeypatch, is_coloured):
    fewer(monkeypatch)
    second = (0.2, 0.3, 0.6) if is_coloured else COLOUR
    third = (0.6, 0.2, 0.2) if is_coloured else COLOUR
    rest = [Sphere((0.0, 30.0, 20.0), 20.0, COLOUR), Sphere((26.0, -15.0, 20.0), 20.0, second)]
    top = Sphere((0.0, 0.0, 38.0), 14.0, COLOUR)
    triangle = (*rest, Sphere((-26.0, -15.0, 20.0), 20.0, third), top)  # the same when turned by a third
    first = seen_from(triangle, FRONT)
    turned = replace(seen_from(triangle, np.array([0.3, -0.5, 0.8]), seed=1), name="turned_1")
    if is_coloured:
        found = align(first, turned)
        assert off(found.motion, STILL)[0] < 2 and found.by_colour
    else:
        with pytest.raises(ReconstructionError, match=r"turned_1: two ways to lay it .* degrees apart.*sticker"):
            align(first, turned)


def test_another_object_is_refused_with_what_was_measured(monkeypatch):
    fewer(monkeypatch)
    other = (Sphere((0.0, 0.0, 12.0), 12.0, COLOUR), Sphere((60.0, 0.0, 10.0), 10.0, COLOUR))
    with pytest.raises(ReconstructionError, match=r"turned_1: .* mm apart .* same object"):
        align(seen_from(SHAPES, np.array([0.0, 0.0, 1.0])), seen_from(other, np.array([0.0, 0.0, 1.0]), "turned_1"))


def test_object_poses_of_an_object_of_a_few_voxels_are_named_and_the_first_is_kept():
    small = (Sphere((0.0, 0.0, 4.0), 4.0, COLOUR),)
    scene, _ = render(small, Look(width=32, height=24, n_lights=2), default_camera(32, 24))
    albedo = torch.full((24, 32, 3), 0.5)
    fields = SolvedScene(grid_of(small, 2.5), albedo, scene.camera, scene.world_from_camera, 0.0, "mm")
    found = lay_together((SolvedObjectPose("", (scene,), fields), SolvedObjectPose("turned_1", (scene,), fields)))
    assert not found.placed and "voxels of the object are seen" in dict(found.refused)["turned_1"]


def test_a_placed_scene_meets_the_surface_as_the_scene_does_in_its_own_world(laid, own_rays):
    scene, motion = laid
    there = replace(scene, object_from_world=motion)
    every = np.ones(own_rays.confidence.shape, bool)
    errors = []
    for one, surface in ((scene, grid_of(lying()[0], 2.5)), (there, grid_of(SHAPES, 2.5))):
        errors.append(hold_out(placed_rays(own_rays, one), every)[1].errors(surface, placed(one)))
    assert errors[0].mean() < 0.1 and np.abs(errors[0] - errors[1]).mean() < 0.02


def test_a_homology_about_the_eye_keeps_what_is_in_line():
    scene, _ = render((SHAPES[0],), Look(n_lights=6))
    scene = replace(scene, light_sigma=torch.ones(6, 3))
    eye, lights = scene.eye.double().numpy(), scene.lights.double().numpy()[:, :3]
    small = 1e-9  # moves the lights by some 1e-4 mm
    moved = lights + small * unseen_motion(scene)
    for light, light_moved in zip(lights, moved, strict=True):
        foot = np.array([30.0, -20.0, 0.0])
        blocker = foot + 0.2 * (light - foot)
        blocker_moved = blocker + small * blocker[2] * (eye - blocker)
        away = np.cross(blocker_moved - foot, light_moved - foot)
        alone = np.cross(blocker - foot, light_moved - foot)
        assert np.linalg.norm(away) < 1e-3 * np.linalg.norm(alone)  # of second order


def test_a_direction_that_is_moved_stays_a_unit_vector():
    scene, _ = render(SHAPES, Look(n_lights=4, kind="directional"))
    scene = replace(scene, light_sigma=torch.full((4, 3), 0.02))
    turned = LightMotions(scene, np.zeros(3), np.ones(MODES)).scene()
    torch.testing.assert_close(turned.lights.norm(dim=1), torch.ones(4))
    assert (turned.lights != scene.lights).any(1).all()


def test_a_motion_a_little_off_is_refined_on_rays_and_held_out_rays_agree(laid, own_rays):
    scene, motion = laid
    rays = ObjectPoseRays((replace(scene, light_sigma=torch.full_like(scene.light_sigma, 0.5)),), (own_rays,))
    about, surface = np.array([5.0, 0.0, 30.0]), grid_of(SHAPES, 2.5)
    start = stepped(motion, np.array([0.05, -0.04, 0.05, 1.5, -1.2, 1.0]), about)
    found = refined_motion(start, surface, rays, about, 40.0)
    before, after = off(start, motion), off(found[0], motion)
    assert after[0] < 0.5 * before[0] and after[1] < 0.5 * before[1]
    assert compare(surface, (start, rays), found).is_kept and not compare(surface, found, (start, rays)).is_kept


@pytest.mark.slow
def test_lights_that_are_all_too_high_pull_a_motion_less_where_they_may_be(laid, own_rays):
    scene, motion = laid
    about, surface = np.array([5.0, 0.0, 30.0]), grid_of(SHAPES, 2.5)
    high = replace(scene, lights=scene.lights + torch.tensor([0.0, 0.0, 40.0, 0.0]))  # mm, of 500
    found = []
    for sigma in (0.0, 20.0):
        doubted = replace(high, light_sigma=torch.full_like(scene.light_sigma, sigma))
        moved, lit = refined_motion(motion, surface, ObjectPoseRays((doubted,), (own_rays,)), about, 40.0)
        found.append((*off(moved, motion), lit.scenes[0].lights - high.lights))
    (turn, shift, still), (less_turn, less_shift, change) = found
    assert less_turn < 0.7 * turn and less_shift < 0.7 * shift
    assert not still.any() and float(change[:, 2].mean()) < 0


def test_a_refined_motion_is_kept_where_a_guessed_part_of_the_surface_hides_what_it_gains(laid, own_rays):
    scene, motion = laid
    rays, about = ObjectPoseRays((scene,), (own_rays,)), np.array([5.0, 0.0, 30.0])
    start = stepped(motion, np.array([-0.01, 0.01, -0.01, -0.4, 0.3, -0.3]), about)
    guessed = grid_of((*SHAPES, Sphere((-22.0, 16.0, 20.0), 9.0, COLOUR)), 2.5)
    found = compare(guessed, (start, rays), (motion, rays))
    assert found.before < found.after and found.is_kept
    worse = stepped(motion, np.array([0.05, -0.04, 0.05, 1.5, -1.2, 1.0]), about)
    assert not compare(grid_of(SHAPES, 2.5), (motion, rays), (worse, rays)).is_kept


@pytest.mark.parametrize("groups", [np.zeros(40, int), np.arange(40) // 10])
def test_the_noise_of_a_difference_comes_from_groups_and_one_group_knows_none(groups):
    rng = np.random.default_rng(0)
    common = rng.standard_normal(4)[groups]
    mean, noise = mean_difference(1.0 + common, np.zeros(40), groups)
    if groups.any():
        own = np.bincount(groups, 1.0 + common) / 10
        assert np.isclose(mean, own.mean()) and np.isclose(noise, own.std(ddof=1) / 2)
    else:
        assert (mean, noise) == (0.0, 0.0)


def test_a_solved_scene_of_two_object_poses_equals_its_file_and_knows_both_worlds(laid, tmp_path):
    scene, motion = laid
    first, _ = render(SHAPES, Look(width=64, height=48, n_lights=2), default_camera(64, 48))
    albedo = torch.full((48, 64, 3), 0.5)
    place = (first.camera, first.world_from_camera, 0.0, "mm")
    grid, gloss = grid_of(SHAPES, 2.5), Gloss(torch.full((1, LOBES, 3), 0.25), torch.ones(48, 64, 1))
    other = (scene.camera, scene.world_from_camera, torch.ones(48, 64, 1), motion)
    there = FurtherView("turned_1", albedo, *other)
    more = {"gloss": gloss, "evidence": torch.full_like(grid.values, 3.0), "light_share": 0.03}
    fields = SolvedScene(grid, albedo, *place, further=(there,), **more)
    save_fields(fields, tmp_path / "fields.safetensors")
    read = load_fields(tmp_path / "fields.safetensors")
    assert read.light_share == 0.03 and read.evidence is not None and bool((read.evidence == 3).all())
    assert read.gloss is not None and torch.allclose(read.gloss.coefficients(), gloss.coefficients(), rtol=1e-2)
    assert read.further[0].name == "turned_1" and torch.equal(read.further[0].albedo, albedo)
    view = read.views()[1]
    kept, scaled = (one.further[0].object_from_world for one in (read, fields.scaled(2.0, "mm")))
    assert kept is not None and scaled is not None
    np.testing.assert_allclose(kept.matrix(), motion.matrix())
    np.testing.assert_allclose(scaled.translation, 2 * motion.translation)
    assert float(view.grid.sdf(torch.tensor([lying()[0][1].centre], dtype=torch.float32)).item()) == pytest.approx(
        -14.0, abs=2.0
    )
    points = seen_material(read).on_object.points  # those that the other pose's camera saw lie on the surface, too
    assert np.abs(read.grid.sdf(torch.from_numpy(points).float()).numpy()).mean() < 0.3


def test_merged_surfaces_are_cut_at_every_table():
    shapes, motion = lying()
    merged = merged_surface([(seen_from(SHAPES, FRONT), STILL), (seen_from(shapes, FRONT), motion)])
    inside = torch.nonzero(merged.values < 0).double().numpy() * merged.spacing + merged.origin.double().numpy()
    assert inside[:, 2].min() >= 0 and motion.inverse().apply(inside)[:, 2].min() >= 0


def test_where_an_object_pose_saw_the_object_its_surface_counts_and_the_others_guess_does_not():
    ball = Sphere((0.0, 0.0, 40.0), 30.0, COLOUR)
    object_poses = []
    for side in (np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])):
        seen = seen_from((ball,), side)
        z = seen.grid.origin[2] + seen.grid.spacing * torch.arange(seen.grid.values.shape[2])
        swollen = seen.grid.values - 6 * (side[2] * (z - 40) < 0)  # mm: a guess that is far too thick
        object_poses.append((replace(seen, grid=replace(seen.grid, values=swollen)), STILL))
    merged = merged_surface(object_poses)
    points = np.concatenate([object_pose.points for object_pose, _ in object_poses])
    points = points[np.abs(points[:, 2] - 40) > 12]
    assert float(merged.sdf(torch.from_numpy(points).float()).abs().max()) < 0.5  # mm


# --- poses that do not belong on one surface -------------------------------------------------------------------------


MIDDLE = np.array([5.0, 0.0, 30.0])
BENT = replace(SHAPES[1], centre=(-6.0, -16.0, 56.0))  # the second ball sits elsewhere


def solved(name: str, shapes, seed: int) -> SolvedObjectPose:
    scene, _ = render(shapes, Look(width=64, height=48, n_lights=6, seed=seed), default_camera(64, 48))
    scene = replace(scene, view=name)
    albedo = torch.full((48, 64, 3), 0.5)
    return SolvedObjectPose(
        name, (scene,), SolvedScene(grid_of(shapes, 2.5), albedo, scene.camera, scene.world_from_camera, 0.0, "mm")
    )


@pytest.fixture(autouse=True)
def more_rays(monkeypatch):
    """Withhold more: a picture of 64 pixels has few blocks."""
    monkeypatch.setattr(confirmation, "SHARE", 0.25)


@pytest.fixture(scope="module")
def object_poses() -> tuple[SolvedObjectPose, SolvedObjectPose]:
    return solved("", SHAPES, 0), solved("turned_1", lying()[0], 3)


def placed_by(motion: Pose, start: SdfGrid) -> Together:
    placed = PlacedObjectPose("turned_1", motion, Alignment(motion, 0.0, 0.0, False), MotionTrial(0.0, 0.0))
    return Together((placed,), start, ())


def test_pixels_that_are_withheld_are_missing_in_the_scene_and_the_same_in_each_call(object_poses):
    (before,) = object_poses[0].scenes
    (once,), (again,) = withheld((before,), 7), withheld((before,), 7)
    assert torch.equal(once.usable, again.usable)
    missing = float((before.usable & ~once.usable).float().mean())
    assert 0.15 < missing < 0.35


def test_a_surface_of_all_meets_the_rays_of_each_object_pose_unless_a_motion_is_off(object_poses):
    motion, surface = lying()[1], grid_of(SHAPES, 2.5)
    right = how_met(object_poses[1], surface, motion)
    wrong = how_met(object_poses[1], surface, stepped(motion, np.array([0, 0, 0, 2.5, 2.0, 0]), MIDDLE))
    assert not right.is_worse(1.5) and right.excess < 1.2
    assert wrong.is_worse(1.5) and "turned_1" in wrong.numbers()
    assert not replace(wrong, noise=wrong.together).is_worse(1.5)


@pytest.mark.slow
def test_a_motion_that_is_off_is_refined_once_more_and_the_object_pose_is_kept(object_poses):
    motion = lying()[1]
    start = stepped(motion, np.array([0, 0, 0, 2.5, 2.0, 0]), MIDDLE)
    found = confirmed(object_poses, placed_by(start, grid_of(SHAPES, 2.5)), lambda *_: grid_of(SHAPES, 2.5))
    assert not found.refused and len(found.placed) == 1
    assert off(found.placed[0].motion, motion)[1] < 0.4 * off(start, motion)[1]


def test_an_object_that_changed_its_shape_between_two_object_poses_is_left_out_in_a_sentence(object_poses):
    shapes = (SHAPES[0], BENT, SHAPES[2])
    bent = solved("", shapes, 0)
    found = confirmed(
        (bent, object_poses[1]), placed_by(lying()[1], grid_of(shapes, 2.5)), lambda *_: grid_of(shapes, 2.5)
    )
    assert not found.placed
    name, sentence = found.refused[0]
    assert (
        name == "turned_1" and "% on the surface of all object poses and" in sentence and "keep its shape" in sentence
    )
