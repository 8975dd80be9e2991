"""Turn off a mechanism that is not in the paper, and run the command: python benchmarks/switches.py NAME COMMAND...

    python benchmarks/switches.py matting run my_object --out runs/my_object
    python benchmarks/bed.py --seed 1000 --count 7 --without matting

The second measures what the mechanism is worth: it does the bed's runs again, from their calibrations on. What changes
neither success nor medians there is to be deleted. A mechanism that goes takes its entry here with it.
"""

import sys
from importlib import import_module
from typing import Any

import numpy as np
import torch

from reconstruct.hull import normal_integration
from reconstruct.labels.level_tops import LevelTops
from reconstruct.shading import normal_fit

Switch = dict[str, dict[str, Any]]  # module: name in it: what takes its place


def _nothing_found(region: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(region)


def _at_edges(photos: torch.Tensor, region: torch.Tensor) -> torch.Tensor:
    return region.float()


SWITCHES: dict[str, Switch] = {
    "matting": {  # pixels of an outline are object or ground
        "reconstruct.labels.ground_test": {"coverage_at_edges": _at_edges},
        "reconstruct.labels.field_ground_test": {"coverage_at_edges": _at_edges},
    },
    "pixel-priors": {  # one start from the bright samples; no neighbours' albedo, no surface's normal
        "reconstruct.labels.photometric_stereo": {
            "fit_normals": lambda pixels, prior=None: normal_fit.fit_normals(pixels)
        },
    },
    "interreflection": {  # an endless ground's bounce alone
        "reconstruct.labels.observer": {"Observer._between_surfaces": lambda self, solved, scene: (0.0, None)},
    },
    "level-tops": {  # what is lit as the ground is ground
        "reconstruct.labels.ground_test": {
            "find_level_tops": lambda scene, relative, seen, albedo, region: LevelTops(
                _nothing_found(region), _nothing_found(region)
            )
        },
    },
    "pockets": {  # behaviour alone tells object from ground
        "reconstruct.labels.ground_test": {
            "_pockets": lambda scene, pixels, region, few: _nothing_found(region),
        },
    },
    "trimming": {  # the hull is all that nothing proves empty
        "reconstruct.hull.shadow_hull": {
            "most_needed": lambda inside, needed, denied, needs, rays: (needs, inside.copy()),
            "before_object": lambda inside, *_: np.zeros(inside.shape, np.bool_),
            "with_seen_pixels": lambda keep, *_: keep,
            "without_floating": lambda keep, *_: keep,
            "with_support": lambda keep: keep,
            "pixel_rays": lambda *_: None,
        },
    },
    "hull-matter": {  # no piece of the hull in front of the integral is kept
        "reconstruct.hull.bent_hull": {
            "_Within._integrate": lambda self, labels, *given: normal_integration.integrate_within(*given)
        },
    },
    "second-bends": {  # normals are read, and the hull is bent, once
        "reconstruct.hull.bent_hull": {"SHADING_ROUNDS": 1, "LIT_ROUNDS": 1},
    },
    "judged-bends": {  # shadows on the ground do not judge a bend
        "reconstruct.hull.bent_hull": {"BentHull._best": lambda self, first, other, clearly: first},
    },
}


def turn_off(name: str) -> None:
    """Put what takes its place where the mechanism was, in every module that calls it."""
    for module, places in SWITCHES[name].items():
        for place, other in places.items():
            *owner, last = place.split(".")
            holder: Any = import_module(module)
            for part in owner:
                holder = getattr(holder, part)
            if not hasattr(holder, last):
                raise SystemExit(f"{module} has no {place}: mend or delete the entry {name!r} of {__file__}.")
            setattr(holder, last, other)


def main() -> int:
    """Turn a mechanism off and hand the rest of the words to the command."""
    from shadowgraph.__main__ import start

    if len(sys.argv) < 2 or sys.argv[1] not in SWITCHES:
        raise SystemExit(f"usage: switches.py NAME COMMAND..., NAME one of {', '.join(SWITCHES)}")
    name = sys.argv.pop(1)
    turn_off(name)
    return start()


if __name__ == "__main__":
    sys.exit(main())
