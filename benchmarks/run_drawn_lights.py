"""Do the stated uncertainties of lights hold? Photos made by the formula of a plane, each set drawn by lot.

    python benchmarks/run_drawn_lights.py [--sets 24] [--first 0] [--table FILE]

Each set of photos (tests/flashlight_photos.py: no renderer, truth is exact, camera and ground are given) has its own
lights, number of photos, noise, beam, powers, gloss, bounced light and tone curve. A coordinate of a light is inside
where it is off by less than 1, 2, 3 stated sigmas.
"""

import random
from collections.abc import Iterator

import numpy as np
from sheet import Sheet, parser_of, table

# isort: split
from flashlight_photos import POSED_CAMERA, Recipe, photograph  # pyright: ignore[reportMissingImports]

from calibration.flashlight.light_estimate import locate_lights
from capture.errors import UserError

DRAWN = {
    "n_photos": (6, 8, 12, 16, 24),
    "noise": (0.005, 0.01, 0.02),
    "asymmetry": (0.0, 0.0, 0.03),
    "power_jitter": (0.0, 0.0, 0.03),
    "gloss": (0.0, 0.0, 0.1),
    "bounce": (0.0, 0.02),
    "ambient": (0.0, 0.012, 0.05),
    "tone": (1.0, 1.0, 1.0, 0.95, 1.05, 0.9, 1.1),
}
WANTED = ("0.6 to 0.8", "0.9 to 0.98", "from 0.985")


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--sets", type=int, default=24)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.sets)
    note = "Error and sigma are shares of a light's distance, medians over the lights."
    sheet = Sheet("Stated uncertainty of lights, drawn sets", options.table, f"seeds {seeds[0]} to {seeds[-1]}", note)
    head = ["set", "photos", "tone", "drawn", "error", "sigma", "within 1 sigma", "2", "3"]
    rows: list[list[object]] = []
    groups: dict[str, list[np.ndarray]] = {}
    for row, group, off in _sets(seeds):
        rows.append(row)
        if off is not None:
            groups.setdefault(group, []).append(off)
        sheet.write(table(head, [*rows, *_together(groups)]))


def _sets(seeds: range) -> Iterator[tuple[list[object], str, np.ndarray | None]]:
    for seed in seeds:
        draw = random.Random(seed)
        values = {name: draw.choice(choices) for name, choices in DRAWN.items()}
        recipe = Recipe(**values)  # pyright: ignore[reportArgumentType]
        truth = photograph(recipe, seed)
        group = "the right tone curve" if recipe.tone == 1 else "another tone curve"
        told = ", ".join(f"{name} {value:g}" for name, value in values.items() if name not in ("n_photos", "tone"))
        known = [seed, recipe.n_photos, recipe.tone, told]
        try:
            lights = locate_lights(truth.stack, POSED_CAMERA, np.ones(recipe.n_photos, bool)).lights
        except UserError as error:
            yield [*known, "refused", str(error)[:80], "", "", ""], group, None
            continue
        used = np.array([light.used for light in lights])
        sigma = np.array([light.sigma for light in lights], float)
        off = np.abs(truth.off(lights))[used]
        reach = np.linalg.norm([light.position for light in truth.lights], axis=1)[used]
        size = float(np.median(np.linalg.norm(sigma[used], axis=1) / reach)) if used.any() else None
        error = float(np.median(np.linalg.norm(off, axis=1) / reach)) if used.any() else None
        in_sigmas = off / np.maximum(sigma[used], 1e-12)
        yield [*known, error, size, *_shares(in_sigmas)], group, in_sigmas


def _shares(in_sigmas: np.ndarray) -> list[object]:
    return [float((in_sigmas < k).mean()) for k in (1, 2, 3)] if in_sigmas.size else ["", "", ""]


def _together(groups: dict[str, list[np.ndarray]]) -> list[list[object]]:
    rows: list[list[object]] = []
    for group, members in groups.items():
        every = np.concatenate([np.ravel(one) for one in members])
        rows.append([group, "", "", f"{len(members)} sets, {len(every)} coordinates", "", "", *_shares(every)])
    return [*rows, ["wanted", "", "", "", "", "", *WANTED]]


if __name__ == "__main__":
    main()
