"""The presets draft, standard, fine and paper: size of the photos, resolution of the grid, iterations of training."""

from dataclasses import replace
from typing import Any

from reconstruct.shadowneus.config import TrainConfig, Weights, ablated, shortened_training
from reconstruct.solve.solver import FitConfig, Level
from reconstruct.source.source import LONG_SIDES, RunOptions

DRAFT_LEVELS = (Level(40, 24, (0.5, 0.4), 4, 4.2e-4), Level(72, 24, (0.4, 0.15), 3, 4.2e-4))
FINE_NODES = 240  # along the object: about one voxel per pixel of an object that fills a third of the picture


BRIEF = {"draft": 1_000, "standard": 5_000, "fine": 20_000}  # iterations of a trained field
BRIEF_WEIGHTS = Weights(eikonal=0.03, bound=1.0, contain=0.2, early_foreground=1.0)  # see training
BRIEF_START = 150  # steps of a network onto a ball on the ground: to about 2 % of the bounding sphere's radius
RATES = {"neural": 1e-3, "hash": 5e-3, "grid": 2e-2}  # of learning; a grid node moves only itself


def preset(name: str, seed: int) -> tuple[int, FitConfig]:
    """Return the longer side of the working grid, px, and the solver's settings."""
    standard = FitConfig(seed=seed)
    if name == "draft":
        return LONG_SIDES[name], replace(standard, rays=standard.rays // 2, levels=DRAFT_LEVELS)
    if name == "fine":
        last = replace(standard.levels[-1], nodes=FINE_NODES)
        return LONG_SIDES[name], replace(standard, rays=2 * standard.rays, levels=(*standard.levels, last))
    return LONG_SIDES[name], standard


def solver_config(options: RunOptions) -> FitConfig:
    """Return the settings of the default solver for these options."""
    _, config = preset(options.preset, options.seed)
    return without(config, options.ablate)


def continued(config: FitConfig, done: int, name: str) -> FitConfig | None:
    """Return the schedule that continues as another preset after `done` levels of `config`; None if it is not finer."""
    _, other = preset(name, config.seed)
    finer = tuple(level for level in other.levels if level.nodes > config.levels[done - 1].nodes)
    return replace(config, rays=other.rays, levels=(*config.levels[:done], *finer)) if finer else None


def without(config: FitConfig, ablate: str | None) -> FitConfig:
    """Return the settings with one part of the method, named in ABLATIONS of its config, switched off."""
    changes: dict[str | None, dict[str, Any]] = {
        "intersection": {"use_start_gradient": False},
        "boundary": {"use_boundary": False},
        "foreground-only": {"supervised": "foreground"},
        "background-only": {"supervised": "background"},
    }
    return replace(config, **changes.get(ablate, {}))


def training(name: str, field: str, ablate: str | None, seed: int) -> tuple[int, TrainConfig]:
    """Return the longer side of the working grid, px, and the settings of a trained field.

    "paper" is the paper's schedule: any field, all 150 000 iterations. The other presets are brief. With so few
    iterations the paper's weights would flatten the object to the ground before its shadows are learnt, and the
    annealing of the opacity would not finish; so these presets start with the ground in place and weigh it less.
    """
    config = TrainConfig(seed=seed, field="neural" if field == "auto" else field)
    if name != "paper":
        config = replace(shortened_training(config, BRIEF[name]), weights=BRIEF_WEIGHTS, cosine_anneal=1)
        config = replace(config, learning_rate=RATES[config.field], start_steps=BRIEF_START)
    return LONG_SIDES[name], config if ablate is None else ablated(config, ablate)


def shortened(config: FitConfig, share: float) -> FitConfig:
    """Return the schedule with this share of its iterations, at least one per level.

    The penalty on unseen matter, summed over a level, stays the same.
    """
    levels = []
    for level in config.levels:
        iterations = max(1, round(share * level.iterations))
        levels.append(replace(level, iterations=iterations, shrink=level.shrink * level.iterations / iterations))
    return replace(config, levels=tuple(levels))
