"""What joint refinement of the lights does to captures and scenes whose lights are more and more wrong.

    python benchmarks/run_light_series.py [FOLDER...] [--errors 0 0.01 0.03 0.05 0.1] [--preset draft] [--out DIR]

FOLDER@BOARD names the board of a capture that does not say it; examples/spot unless given. Each folder is calibrated
once. Then every light is moved from its calibrated place by `error` times its distance in a random direction of its
own (a direction is turned by as many radians), its stated sigma grows to match, and the surface is solved twice, with
the settings of a preset: with the lights held, and with joint refinement. Both are scored as `shadowgraph evaluate`
does. "trial": whether the refined lights were kept, and how the error of held-out shadow rays changed, in its noises.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from sheet import Sheet
from solves import SHIPPED, Subject, open_subject, parsed, score, shown, solve, solve_parser, with_truth

from calibration.calibration import Calibration, load_calibration, save_calibration
from calibration.light import Light
from reconstruct.fields import Fields, Verdict
from reconstruct.run.presets import preset


def moved(calibration: Calibration, middle: np.ndarray, error: float, stated: float, seed: int) -> Calibration:
    """The calibration with every light off by `error` of its distance from `middle`, and said to be off by `stated`."""
    rng = np.random.default_rng(seed)
    lights = []
    for light in calibration.lights:
        by = rng.standard_normal(3)
        if light.direction is not None:
            by -= (by @ light.direction) * light.direction
        distance = 1.0 if light.position is None else float(np.linalg.norm(light.position - middle))
        by *= error * distance / np.linalg.norm(by)
        sigma = np.sqrt(light.sigma**2 + (stated * distance) ** 2 / 3)
        lights.append(_displaced(light, by, sigma))
    return dataclasses.replace(calibration, lights=tuple(lights))


def _displaced(light: Light, by: np.ndarray, sigma: np.ndarray) -> Light:
    if light.position is not None:
        return dataclasses.replace(light, position=light.position + by, sigma=sigma)
    assert light.direction is not None
    turned = light.direction + by
    return dataclasses.replace(light, direction=turned / np.linalg.norm(turned), sigma=sigma)


def with_lights(calibration: Calibration, solved: Fields) -> Calibration:
    """The calibration with its used lights where the solve left them."""
    assert solved.lights is not None
    places = iter(solved.lights.double().numpy())
    lights = []
    for light in calibration.lights:
        if light.used:
            place = next(places)[:3]
            key = "direction" if light.position is None else "position"
            light = dataclasses.replace(light, **{key: place})
        lights.append(light)
    return dataclasses.replace(calibration, lights=tuple(lights))


def light_error(found: Calibration, true: Calibration, middle: np.ndarray) -> tuple[float, float]:
    """Median distance of the used lights from given ones: per cent of their distance from `middle`, and degrees."""
    off, turned = [], []
    for light, other in zip(found.lights, true.lights, strict=True):
        if light.used:
            a, b = (x.homogeneous()[:3] - x.homogeneous()[3] * middle for x in (light, other))
            off.append(100 * np.linalg.norm(a - b) / np.linalg.norm(b))
            cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
            turned.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return float(np.median(off)), float(np.median(turned))


def calibrated(named: str, options: argparse.Namespace) -> Subject:
    """The subject, with the calibration that an earlier invocation left, if it did."""
    subject = open_subject(named, "auto", options.preset)
    kept = options.out / subject.name / "calibration.json"
    if kept.exists():
        subject = dataclasses.replace(subject, calibration=load_calibration(kept))
    kept.parent.mkdir(parents=True, exist_ok=True)
    save_calibration(subject.calibration, kept)
    return with_truth(subject, options.preset, options.seed)


def row(subject: Subject, wrong: Calibration, error: float, refine: bool, options: argparse.Namespace) -> dict:
    """One solve with wrong lights."""
    long_side, config = preset(options.preset, options.seed)
    solved, spent = solve(subject, wrong, long_side, dataclasses.replace(config, refine_lights=refine))
    found = with_lights(wrong, solved)
    numbers = score(solved, subject, found)
    middle = subject.calibration.posed_camera.looked_at()
    off, turned = light_error(found, subject.calibration, middle)
    if "light_median_pct" in numbers:  # a capture: against the true ones, not the calibrated ones
        off, turned = numbers["light_median_pct"], numbers["light_direction_median_deg"]
    if options.verbose:
        print(json.dumps(numbers, default=str), flush=True)
    begin = {"folder": subject.name, "moved by": f"{100 * error:g} %", "lights": "refined" if refine else "held"}
    begin |= {"off, %": off, "off, deg": turned, "moved back, %": round(light_error(found, wrong, middle)[0], 4)}
    return begin | shown(numbers) | {"CPU s": spent, "trial": decided(solved.light_trial)}


def decided(trial: Verdict | None) -> str | None:
    """What a trial of refined lights decided, and by how many times its noise the held-out error changed."""
    if trial is None:
        return None
    change = (trial.refined - trial.calibrated) / trial.noise
    return f"{'accepted' if trial.is_accepted else 'rejected'}, {change:+.1f}"


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """Every subject with each error of its lights, held and refined."""
    for named in options.subjects:
        subject = calibrated(named, options)
        middle = subject.calibration.posed_camera.looked_at()
        for error in options.errors:
            stated = error if options.stated is None else options.stated
            wrong = moved(subject.calibration, middle, error, stated, options.seed)
            for refine in (False, True) if options.only is None else (options.only == "refined",):
                yield row(subject, wrong, error, refine, options)


def main() -> None:
    """Parse, solve, write after every row."""
    parser = solve_parser(__doc__, SHIPPED[:1])
    parser.add_argument("--errors", nargs="+", type=float, default=[0, 0.01, 0.03, 0.05, 0.1])
    parser.add_argument("--stated", type=float, help="the error that the lights' sigmas tell; as moved unless given")
    parser.add_argument("--only", choices=["held", "refined"])
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("runs/light_series"))
    options = parsed(parser)
    Sheet("Wrong lights, held and refined", options.table, f"seed {options.seed}").fill(rows(options), "folder")


if __name__ == "__main__":
    main()
