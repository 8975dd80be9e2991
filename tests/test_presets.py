"""Presets: what each asks for, and ablations of the solver that the command names."""

from dataclasses import asdict, replace

import pytest
from synthetic import BALL, Look, render

from reconstruct.labels.labels import assemble_labels
from reconstruct.labels.supervision import restricted, supervise
from reconstruct.run.presets import preset, training, without
from reconstruct.sdf import kernels
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.source.source import RunOptions


def test_the_paper_s_preset_is_the_paper_s_settings():
    long_side, config = training("paper", "auto", None, 0)
    assert (long_side, config) == (800, TrainConfig())
    # [ShadowNeuS, "Implementation details" and supplement]
    assert (config.iterations, config.pixels, config.lights, config.camera_steps) == (150_000, 256, 4, 256)
    assert (config.network.depth, config.network.width, config.network.frequencies) == (8, 256, 6)
    assert (config.network.material_depth, config.network.features) == (4, 256)
    assert (config.samples.uniform + config.samples.near, config.samples.importance) == (80, 64)
    assert (config.learning_rate, config.last_learning_rate * config.learning_rate) == (1e-3, pytest.approx(5e-5))
    assert (config.warm_up, config.weights.eikonal) == (5_000, 0.01)
    assert config.resolutions[0] == (0, 8) and config.resolutions[-1][1] == 1  # 100 px of 800 at first


def test_an_ablation_is_one_setting_of_either_solver():
    standard = preset("standard", 0)[1]
    changes = {
        "boundary": ("use_boundary", False),
        "intersection": ("use_start_gradient", False),
        "foreground-only": ("supervised", "foreground"),
        "background-only": ("supervised", "background"),
    }
    for name, change in changes.items():
        assert set(asdict(without(standard, name)).items() ^ asdict(standard).items()) >= {change}
    assert without(standard, "telescoped") == standard == without(standard, None)
    assert training("paper", "auto", "telescoped", 0)[1].use_telescoped


def test_shadows_of_one_role_alone_keep_their_confidence():
    scene, _ = render((BALL,), Look(n_lights=8, with_shadow=True, with_mask=True))
    rays = supervise(scene, assemble_labels(replace(scene, rgb=None), None, None))
    for supervised, role in (("foreground", kernels.OBJECT), ("background", kernels.GROUND)):
        kept = restricted(rays, supervised).confidence
        assert (kept[:, rays.role != role] == 0).all()
        assert (kept[:, rays.role == role] == rays.confidence[:, rays.role == role]).all()
    assert restricted(rays, "both") is rays


def test_a_trained_field_is_asked_for_by_the_paper_s_preset_or_by_name():
    assert not RunOptions().is_trained() and not RunOptions(field="grid").is_trained()
    assert RunOptions(preset="paper").is_trained() and RunOptions(field="hash").is_trained()
