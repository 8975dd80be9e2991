"""ShadowNeuS in miniature: a ball from its shadows, the same after a stop, every field and ablation."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from dataset_folders import write_shadowneus
from synthetic import Look, Sphere, render
from test_solver import Listener

import shadowgraph
from capture.errors import ReconstructionError
from reconstruct.labels.observer import Observer
from reconstruct.render.g_buffer import surface_maps
from reconstruct.run import solve_stage
from reconstruct.shadowneus import trainer
from reconstruct.shadowneus.config import ABLATIONS, ShadowSamples, TrainConfig, Weights, ablated
from reconstruct.shadowneus.field import HashLevels, Network
from reconstruct.shadowneus.model import Model
from reconstruct.shadowneus.train_pixels import make_train_pixels, object_frame, unit_height
from reconstruct.shadowneus.train_step import losses
from reconstruct.shadowneus.trainer import iterations, train

BALL = Sphere((12.0, -6.0, 32.0), 32.0)
# The paper's weights suit 150 000 iterations; in 100 the ground must not win before the shadows have been seen.
MINIATURE = TrainConfig(
    iterations=100,
    start_steps=150,
    pixels=64,
    lights=3,
    learning_rate=2e-3,
    warm_up=10,
    cosine_anneal=1,
    foreground_anneal=0,
    resolutions=((0, 1),),
    camera_steps=48,
    samples=ShadowSamples(16, 2, 6, 2),
    weights=Weights(eikonal=0.03, bound=1.0, contain=0.2),
    network=Network(width=48, depth=3, skip=2, frequencies=3, features=16, material_width=32, material_depth=2),
    hash_levels=HashLevels(coarsest=8, finest=32, levels=3, rows=2**12, width=32, features=7),
    grid_nodes=32,
    mesh_nodes=48,
)
TINY = replace(MINIATURE, start_steps=5, iterations=6, pixels=24, camera_steps=24, mesh_nodes=12)


@pytest.fixture(scope="module")
def shadows():
    scene, truth = render((BALL,), Look(width=64, height=48, n_lights=10, with_shadow=True, with_mask=True))
    return replace(scene, rgb=None), truth


@pytest.fixture(scope="module")
def frame(shadows):
    scene, _ = shadows
    return object_frame(scene, Observer(scene).ground_labels(), MINIATURE.bound)


def errors(fields, scene, truth) -> tuple[float, float]:
    """Mean depth error in ball radii and mean angle between normals in degrees, where both see the object."""
    maps = surface_maps(fields.grid, replace(scene.posed_camera, ground_height=fields.ground_height))
    both = maps.mask.numpy() & truth.mask
    assert both.sum() > 0.7 * truth.mask.sum()
    depth = np.abs(maps.depth.numpy() - truth.depth)[both].mean() / BALL.radius
    return float(depth), float(truth.degrees(maps.normals)[both].mean())


@pytest.mark.slow  # 6 s; from photos a mesh is trained by the command, below
def test_photos_train_shape_and_material_together():
    scene, truth = render((BALL,), Look(width=64, height=48, n_lights=10))
    listener = Listener()
    fields = train(scene, MINIATURE, listener)
    depth, normal = errors(fields, scene, truth)
    colour = [line[3]["colour"] for line in listener.lines]
    assert colour[-1] < 0.2 * colour[0]
    assert 1e-3 < depth < 0.08 and 0.5 < normal < 10
    for seen in (truth.mask, ~truth.mask):
        expected = truth.albedo[seen].mean(0)
        assert np.abs(fields.albedo.numpy()[seen].mean(0) - expected).max() < 0.2


@pytest.mark.parametrize("field", ["neural", pytest.param("hash", marks=pytest.mark.slow)])
def test_a_training_that_was_stopped_ends_in_the_very_same_field(field, shadows, tmp_path, monkeypatch):
    monkeypatch.setattr(trainer, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(trainer, "REPORT_EVERY", 1)
    scene, _ = shadows
    config = replace(TINY, field=field)
    straight = train(scene, config, Listener())
    file = tmp_path / "checkpoint.safetensors"

    class Stop(Listener):
        def __call__(self, **step):
            super().__call__(**step)
            if step["done"] == 4:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(scene, config, Stop(), file)
    listener = Listener()
    resumed = train(scene, config, listener, file)
    assert [line[1] for line in listener.lines] == [4, 5, 6]  # the stop came before the fourth was saved
    torch.testing.assert_close(resumed.grid.values, straight.grid.values, rtol=0, atol=0)


@pytest.mark.parametrize("field", ["hash", "grid"])
def test_the_other_fields_train_on_the_same_rays(field, shadows, monkeypatch):
    monkeypatch.setattr(trainer, "REPORT_EVERY", 1)
    scene, _ = shadows
    listener = Listener()
    train(scene, replace(MINIATURE, field=field, iterations=30, learning_rate=2e-2), listener)
    losses = [line[3]["shadow"] for line in listener.lines]
    assert np.mean(losses[-10:]) < 0.9 * np.mean(losses[:10])


def shadow_pull(config, view, frame) -> tuple[float, torch.Tensor]:
    """The loss of the shadows on a ball that stands where none was photographed, and its gradient."""
    torch.manual_seed(0)
    model = Model(config, unit_height(0.0, frame))
    loss = losses(model, view, config, 0, torch.Generator().manual_seed(0))["shadow"]
    loss.backward()
    pulls = [p.grad.flatten() if p.grad is not None else torch.zeros(p.numel()) for p in model.field.parameters()]
    return float(loss.detach()), torch.cat(pulls)


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_changes_how_the_shadows_pull_at_the_surface(name, shadows, frame):
    view = make_train_pixels(shadows[0], frame, 1, torch.device("cpu"))
    whole = replace(TINY, pixels=200, use_telescoped=name == "sampled")
    before, pull = shadow_pull(whole, view, frame)
    after, other = shadow_pull(ablated(whole, name), view, frame)
    assert np.isfinite(after) and other.isfinite().all() and other.norm() > 0
    assert (other - pull).norm() > 0.01 * pull.norm()
    moves_no_start = name == "intersection"  # the same rays, of which only the gradient leaves a part out
    assert (after == before) == moves_no_start


def test_an_assumed_ground_is_not_held_to_its_plane(shadows, frame):
    scene, _ = shadows
    model = Model(TINY, unit_height(0.0, frame))
    found = []
    for known in (True, False):
        view = make_train_pixels(replace(scene, ground_known=known), frame, 1, torch.device("cpu"))
        found.append(losses(model, view, TINY, 0, torch.Generator().manual_seed(0))["contain"])
    assert found[0] > 0 and found[1] == 0


def test_a_training_without_finite_gradients_says_so(shadows, frame):
    scene, _ = shadows
    model = Model(TINY, unit_height(0.0, frame))
    model.sharpness.value.data.fill_(torch.nan)
    optimiser = torch.optim.Adam(model.parameters())
    with pytest.raises(ReconstructionError, match="no finite gradient for 5 iterations"):
        list(iterations(model, optimiser, scene, frame, TINY, 0))


@pytest.mark.slow
def test_a_trained_field_becomes_a_mesh_by_the_command(tmp_path, monkeypatch, capsys):
    scene = write_shadowneus(tmp_path / "ball", render((BALL,), Look(width=64, height=48, n_lights=10))[1])
    out = tmp_path / "out"
    monkeypatch.setattr(solve_stage, "training", lambda *_: (64, replace(TINY, mesh_nodes=32)))
    arguments = ["run", str(scene), "--out", str(out), "--viewer", "off", "--preset", "paper"]
    assert shadowgraph.main(arguments) == 0
    assert (out / "mesh.ply").stat().st_size > 0
    assert json.loads((out / "config.json").read_text())["network"]["width"] == 48
    assert shadowgraph.main([*arguments, "--force", "--time-budget", "60"]) == 2
    assert "--time-budget shortens the default solver" in capsys.readouterr().err
    assert shadowgraph.main([*arguments[:-2], "--force", "--ablate", "sampled"]) == 2
    assert "Add --field neural" in capsys.readouterr().err
