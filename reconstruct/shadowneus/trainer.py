"""ShadowNeuS in plain torch: train any of the three fields with the paper's rays, losses, lights and schedules.

Checkpoints of a training: networks and optimiser in one file, written atomically, for an exact resume.
"""

import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from capture.errors import ReconstructionError, Remedy
from reconstruct.fields import SolvedScene, as_stored
from reconstruct.labels.multiple_lights import is_shared
from reconstruct.labels.observer import Observer
from reconstruct.scene import Scene
from reconstruct.shadowneus.camera_rays import CameraRays, find_hits
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.model import Model
from reconstruct.shadowneus.train_pixels import (
    TrainPixels,
    UnitFrame,
    make_train_pixels,
    object_frame,
    read_onto_grid,
    unit_height,
)
from reconstruct.shadowneus.train_step import losses
from reconstruct.solve.checkpoint import FINGERPRINT, FORMAT, Log, fingerprint, read_checkpoint, write_checkpoint
from reconstruct.solve.level import Steering
from reconstruct.solve.solver import NO_STEERING, SolveReporter
from reconstruct.tensor_file import parsed

VERSION = "1"
MODEL, OPTIMISER = "model.", "optimiser."
REPORT_EVERY = 10  # iterations
SHOW_EVERY_S, SHOW_NODES = 60.0, 48  # between reported surfaces, and their nodes: an 8 x 256 MLP takes seconds
SAVE_EVERY_S = 30.0  # between checkpoints: the work that a kill can lose
MOST_FAILURES = 5  # iterations in a row without a finite gradient
SEEDS_APART = 1_000_003  # iterations of one seed share no random numbers with those of the next
PIXELS_AT_ONCE = 4096  # of the finished albedo


def save_training(
    model: nn.Module, optimiser: torch.optim.Optimizer, iteration: int, fingerprint: str, path: Path
) -> None:
    """Write a checkpoint, whole or not at all.

    All random numbers derive from (seed, iteration), so no generator state has to be saved.

    Args:
        iteration: iterations done.
        fingerprint: of everything the result depends on.

    Raises:
        ReconstructionError: a number in it is not finite.
        OSError: the file cannot be written.
    """
    tensors = {MODEL + name: value for name, value in model.state_dict().items()}
    for place, state in optimiser.state_dict()["state"].items():
        tensors |= {f"{OPTIMISER}{place}.{name}": value for name, value in state.items()}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    header = {FORMAT: VERSION, FINGERPRINT: fingerprint, "training": json.dumps({"iteration": iteration})}
    write_checkpoint(tensors, header, path)


def load_training(
    model: nn.Module, optimiser: torch.optim.Optimizer, fingerprint: str, path: Path, log: Log = lambda _: None
) -> int:
    """Load a checkpoint into model and optimiser, and return the iterations done.

    Returns 0 if there is no checkpoint, or it is damaged or belongs to another training; `log` gets the reason.
    """
    stored = read_checkpoint(path, VERSION, fingerprint, log)
    if stored is None:
        return 0
    tensors, iteration = stored.tensors, int(parsed(stored.header, "training")["iteration"])
    model.load_state_dict({n.removeprefix(MODEL): v for n, v in tensors.items() if n.startswith(MODEL)})
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(OPTIMISER):
            place, _, quantity = name.removeprefix(OPTIMISER).partition(".")
            state.setdefault(int(place), {})[quantity] = value
    optimiser.load_state_dict(optimiser.state_dict() | {"state": state})
    return iteration


def train(
    scene: Scene,
    config: TrainConfig,
    report: SolveReporter,
    checkpoint: Path | None = None,
    device: torch.device | None = None,
    steering: Steering = NO_STEERING,
) -> SolvedScene:
    """Reconstruct surface and albedo of a scene by training a field with shadow-ray supervision [ShadowNeuS].

    Args:
        scene: on the CPU; its full resolution is the finest of the schedule.
        checkpoint: a file that is written every SAVE_EVERY_S and resumed from, on the CPU exactly.
        device: the torch device; None: the CPU.
        steering: may pause the training and end it.

    Raises:
        ReconstructionError: no object or shadow is found, a photo has several lights, or the training diverges.
    """
    if is_shared(scene):
        raise ReconstructionError(
            "a photo is lit by several lights at once, and a trained field compares each photo with one light. Use "
            "another preset without a field."
        )
    place = device or torch.device("cpu")
    frame = object_frame(scene, Observer(scene).ground_labels(), config.bound)
    model = Model(config, unit_height(scene.ground_height, frame)).to(place)
    optimiser = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    mark = fingerprint(scene, config)

    def log(text: str) -> None:
        report(stage="solve", done=0, total=0, message=text, numbers={}, surface=None)

    done = load_training(model, optimiser, mark, checkpoint, log) if checkpoint else 0
    next_show, next_save = time.monotonic() + SHOW_EVERY_S, time.monotonic() + SAVE_EVERY_S
    for i, numbers in iterations(model, optimiser, scene, frame, config, done, log):
        surface, is_last = None, i + 1 == config.iterations or steering.is_stopped()
        if time.monotonic() > next_show:
            grid = read_onto_grid(model.field, frame, SHOW_NODES, scene.ground_height, config.bound, place)
            surface = grid if bool((grid.values < 0).any()) else None  # at first there may be no object
            next_show = time.monotonic() + SHOW_EVERY_S
        if (i + 1) % REPORT_EVERY == 0 or surface is not None or is_last:
            message = f"{config.field} field on {place.type}"
            report(
                stage="solve", done=i + 1, total=config.iterations, message=message, numbers=numbers, surface=surface
            )
        if checkpoint and (time.monotonic() > next_save or is_last):
            save_training(model, optimiser, i + 1, mark, checkpoint)
            next_save = time.monotonic() + SAVE_EVERY_S
        if is_last:
            break
        steering.wait(lambda: None)
    return finished(model, scene, frame, config)


def iterations(
    model: Model,
    optimiser: torch.optim.Optimizer,
    scene: Scene,
    frame: UnitFrame,
    config: TrainConfig,
    done: int,
    log: Callable[[str], None] = lambda _: None,
) -> Iterator[tuple[int, dict[str, float]]]:
    """Train from iteration `done` on; yields after each iteration its number and its weighted losses.

    Args:
        log: called with a sentence for every iteration without a finite gradient, which is skipped.

    Raises:
        ReconstructionError: MOST_FAILURES iterations in a row had no finite gradient.
    """
    device = next(model.parameters()).device
    view: TrainPixels | None = None
    divisor, failures = 0, 0
    for i in range(done, config.iterations):
        wanted = [d for start, d in config.resolutions if i >= start][-1]
        if view is None or wanted != divisor:
            view, divisor = make_train_pixels(scene, frame, wanted, device), wanted
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * learning_factor(i, config)
        generator = torch.Generator().manual_seed(config.seed * SEEDS_APART + i)
        terms = losses(model, view, config, i, generator)
        optimiser.zero_grad(set_to_none=True)
        torch.stack(list(terms.values())).sum().backward()
        gradients = [p.grad.abs().sum() for p in model.parameters() if p.grad is not None]
        failures = 0 if bool(torch.stack(gradients).isfinite().all()) else failures + 1
        if not failures:
            optimiser.step()
        else:
            bad = [name for name, term in terms.items() if not bool(term.detach().isfinite())]
            log(f"iteration {i + 1}: {' and '.join(bad) or 'gradient'} gave no finite number; the step was skipped")
        if failures == MOST_FAILURES:
            raise ReconstructionError(
                f"training has had no finite gradient for {failures} iterations, at iteration {i}; finite ones were "
                "needed.",
                Remedy.OTHER_SEED,
                "use the default field",
            )
        yield i, {name: float(term.detach()) for name, term in terms.items()}


def learning_factor(iteration: int, config: TrainConfig) -> float:
    """Return the factor of the learning rate: linear warm-up to 1, then a cosine down to last_learning_rate.

    Source: [ShadowNeuS, supplement, "Training"].
    """
    if iteration < config.warm_up:
        return (iteration + 1) / config.warm_up
    share = (iteration - config.warm_up) / max(1, config.iterations - config.warm_up)
    return config.last_learning_rate + (1 - config.last_learning_rate) * 0.5 * (1 + math.cos(math.pi * share))


def finished(model: Model, scene: Scene, frame: UnitFrame, config: TrainConfig) -> SolvedScene:
    """Convert the trained model to SolvedScene: SDF on a grid, albedo per pixel, world frame."""
    device = next(model.parameters()).device
    grid = read_onto_grid(model.field, frame, config.mesh_nodes, scene.ground_height, config.bound, device)
    if scene.rgb is None:
        return as_stored(Observer(scene).fields(grid, scene))
    albedo = _albedo(model, make_train_pixels(scene, frame, 1, device), config)
    camera, ground = (scene.camera, scene.world_from_camera), scene.ground_height
    return as_stored(SolvedScene(grid, albedo, *camera, ground, scene.unit))


@torch.no_grad()
def _albedo(model: Model, view: TrainPixels, config: TrainConfig) -> Float[Tensor, "height width 3"]:
    """Return the trained diffuse albedo where each pixel's ray meets object or ground; 0 if it meets neither."""
    out = []
    for part in torch.arange(len(view.directions), device=view.directions.device).split(PIXELS_AT_ONCE):
        rays = CameraRays(view.scene.eye, view.directions[part], view.ground_t[part], view.scene.pixel_angle)
        hits = find_hits(model.field, rays, config.bound, config.camera_steps, with_edges=False)
        points = rays.at(torch.where(hits.t.isfinite(), hits.t, 0.0))
        normals = normalize(model.field.gradient(points), dim=-1)
        albedo, _ = model.materials(points, normals, model.field.features(points))
        out.append(torch.where(hits.t.isfinite()[:, None], albedo, 0.0).cpu())
    return torch.cat(out).reshape(*view.scene.directions.shape[:2], 3)
