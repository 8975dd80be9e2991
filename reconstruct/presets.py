"""draft, standard, fine: how many pixels the solver looks at, and how fine its grid becomes."""

from dataclasses import replace
from typing import Any

from calibration.source import LONG_SIDES
from reconstruct.solver import FitConfig, Level

DRAFT_LEVELS = (Level(40, 40, (0.5, 0.4), 4, 5e-4), Level(72, 40, (0.4, 0.15), 3, 5e-4))
FINE_NODES = 240  # along the object: about one voxel per pixel of an object that fills a third of the picture


def preset(name: str, seed: int) -> tuple[int, FitConfig]:
    """The longer side of the working grid, px, and the solver's settings."""
    standard = FitConfig(seed=seed)
    if name == "draft":
        return LONG_SIDES[name], replace(standard, rays=standard.rays // 2, levels=DRAFT_LEVELS)
    if name == "fine":
        last = replace(standard.levels[-1], nodes=FINE_NODES)
        return LONG_SIDES[name], replace(standard, rays=2 * standard.rays, levels=(*standard.levels, last))
    return LONG_SIDES[name], standard


def shortened(config: FitConfig, share: float) -> FitConfig:
    """The same schedule with this share of its iterations, at least one per level."""
    levels = tuple(replace(level, iterations=max(1, round(share * level.iterations))) for level in config.levels)
    return replace(config, levels=levels)


def config_from_json(document: dict[str, Any]) -> FitConfig:
    """The settings that `dataclasses.asdict` and JSON made of a FitConfig."""
    levels = tuple(Level(**level | {"rate": tuple(level["rate"])}) for level in document["levels"])
    return FitConfig(**document | {"levels": levels, "sharpness": tuple(document["sharpness"])})
