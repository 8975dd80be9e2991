"""draft, standard, fine: how many pixels the solver looks at, and how fine its grid becomes."""

from dataclasses import replace

from reconstruct.solver import FitConfig, Level

LONG_SIDES = {"draft": 256, "standard": 400, "fine": 640}  # px of the working grid
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
