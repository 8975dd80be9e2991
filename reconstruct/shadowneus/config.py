"""The settings of the torch trainer, by default the paper's values, and its ablations by name."""

import dataclasses
from dataclasses import dataclass, replace

from reconstruct.shadowneus.field import HashLevels, Network

ABLATIONS: dict[str, dict[str, bool | str]] = {  # what each changes of a TrainConfig
    "intersection": {"use_moved_intersection": False},
    "boundary": {"use_boundary": False},
    "expected-depth": {"use_expected_depth": True},
    "foreground-only": {"supervised": "foreground"},
    "background-only": {"supervised": "background"},
    "sampled": {"use_telescoped": False},
    "telescoped": {"use_telescoped": True},
}


@dataclass(frozen=True)
class ShadowSamples:
    """Samples per shadow ray [ShadowNeuS, supplement: 80 uniform, of which 16 near the start, and 64 by importance]."""

    uniform: int = 64
    near: int = 16
    importance: int = 64
    rounds: int = 4  # of importance sampling, each with twice the sharpness of the last


@dataclass(frozen=True)
class Weights:
    """Weights of the losses."""

    colour: float = 1.0
    visibility: float = 1.0  # of given shadow pictures
    eikonal: float = 0.01  # [ShadowNeuS, supplement]; the others are those of the authors' code
    bound: float = 100.0
    contain: float = 100.0
    early_foreground: float = 0.1  # of object pixels' colour and visibility at first, so that ground shadows dominate


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training; the defaults are the paper's. Lengths: unit frame, bounding sphere of radius `bound`."""

    seed: int = 0
    field: str = "neural"  # "grid" | "neural" | "hash"
    iterations: int = 150_000
    pixels: int = 256  # per iteration, each under `lights` photos
    lights: int = 4
    learning_rate: float = 1e-3
    last_learning_rate: float = 0.05  # of the learning rate, at the end of the cosine
    warm_up: int = 5_000
    cosine_anneal: int = 25_000  # iterations until the NeuS cosine is the true one
    foreground_anneal: int = 5_000
    resolutions: tuple[tuple[int, int], ...] = ((0, 8), (5_000, 4), (10_000, 2), (15_000, 1))  # from iteration, divisor
    camera_steps: int = 256  # uniform, then bisection
    samples: ShadowSamples = dataclasses.field(default_factory=ShadowSamples)
    weights: Weights = dataclasses.field(default_factory=Weights)
    bound: float = 2.0
    radius: float = 1.0  # of the field's initial ball
    start_steps: int = 0  # that fit a network to a ball on the ground before the training; the paper has none
    network: Network = dataclasses.field(default_factory=Network)
    hash_levels: HashLevels = dataclasses.field(default_factory=HashLevels)
    grid_nodes: int = 160  # of a trainable grid
    mesh_nodes: int = 320  # of the grid that the finished field is sampled on, along the object's box
    use_moved_intersection: bool = True
    use_boundary: bool = True
    use_expected_depth: bool = False
    use_telescoped: bool = False
    supervised: str = "both"  # "both" | "foreground" | "background": whose shadows count


def ablated(config: TrainConfig, name: str) -> TrainConfig:
    """Return the settings with one part of the method changed; `name` is one of ABLATIONS."""
    return replace(config, **ABLATIONS[name])


def shortened_training(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return the same schedule in fewer iterations."""
    share = iterations / config.iterations

    def scaled(count: int) -> int:
        return max(1, round(share * count))

    return replace(
        config,
        iterations=iterations,
        warm_up=scaled(config.warm_up),
        cosine_anneal=scaled(config.cosine_anneal),
        foreground_anneal=scaled(config.foreground_anneal),
        resolutions=tuple((round(share * start), divisor) for start, divisor in config.resolutions),
    )
