"""Do the stated uncertainties of a solved surface hold? Vertices, lengths and volume of runs against rendered truth.

    python benchmarks/run_sigma.py CAPTURE=RUN [CAPTURE=RUN ...] [--pairs 2000] [--table FILE] [--plot FILE.png]

CAPTURE has its truth in gt/ (object.ply, maps.npz, camera.json, board.json); RUN is a finished run of it. Errors are
distances from the true surface in the board's frame, in which a checkerboard may be read from either end; vertices less
than 2 mm above the ground are left out. The evidence is computed anew from the fields, with the lights' uncertainty of
calibration.json, so that runs of earlier versions can be looked at. A length joins two pixels of the photo: its ends
are where the found and the true surface lie behind them, each found end half a pixel (one sigma) beside it.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree
from sheet import Sheet, parser_of, table

# isort: split
from calibration.calibration import Calibration, load_calibration
from calibration.camera import Camera
from reconstruct.evaluate.metrics import load_capture_truth
from reconstruct.fields import load_fields
from reconstruct.mesh.evidence import SEEN, SHADOW, UNCONSTRAINED, VertexEvidence, vertex_evidence, volume_sigma

ABOVE = 2.0  # mm
SAMPLES = 200_000  # points of the true surface
POINTING = 0.5  # px
OBLIQUE = 10.0  # times the distance straight across that half a pixel spans on a surface seen at 6 degrees
NAMED = {SEEN: "seen", SHADOW: "held by shadows", UNCONSTRAINED: "guessed"}


@dataclass(frozen=True)
class Measured:
    """Errors of one run in their stated sigmas, by what they are of; and errors themselves, world length."""

    name: str
    in_sigmas: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    sigmas: dict[str, np.ndarray]


def main() -> None:
    """Print the table, draw the plot."""
    parser = parser_of(__doc__)
    parser.add_argument("runs", nargs="+", metavar="CAPTURE=RUN")
    parser.add_argument("--pairs", type=int, default=2000, help="lengths of each run")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    named = [one.partition("=") for one in options.runs]
    found = [measured(Path(capture), Path(run), options.pairs) for capture, _, run in named]
    single = [row for one in found for row in _rows(one)]
    Sheet(options.table, f"{len(options.runs)} runs").write(_together(found), table(single))
    if options.plot:
        _draw(found, options.plot)


def _rows(one: Measured) -> list[dict]:
    """Return a run's rows: medians of errors and sigmas in mm, of volumes cm3, and the shares within 1, 2, 3 sigmas."""
    return [
        {"run": one.name, "of": what, "number": len(off), "error": float(np.median(np.abs(one.errors[what])))}
        | {"sigma": float(np.median(one.sigmas[what]))}
        | _named(_shares(off))
        for what, off in one.in_sigmas.items()
    ]


def _shares(off: np.ndarray) -> list[float]:
    return [float((np.abs(off) < k).mean()) for k in (1, 2, 3)]


def _named(shares: list[float]) -> dict:
    return dict(zip(("within 1", "within 2", "within 3"), shares, strict=True))


def _together(found: list[Measured]) -> list[dict]:
    rows = []
    for what in dict.fromkeys(name for one in found for name in one.in_sigmas):
        shares = [_shares(one.in_sigmas[what]) for one in found if what in one.in_sigmas]
        rows.append({"of": what, "runs": len(shares)} | _named(np.mean(shares, axis=0).tolist()))
    return rows


def measured(capture: Path, run: Path, pairs: int) -> Measured:
    """Return the errors of a run."""
    calibration = load_calibration(run / "calibration.json")
    turn = _turn(capture, calibration)
    truth = trimesh.load(capture / "gt" / "object.ply", process=False)
    assert isinstance(truth, trimesh.Trimesh)
    mesh = trimesh.load(run / "mesh.ply", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    fields = replace(load_fields(run / "fields.safetensors"), light_share=_light_share(calibration, mesh))
    known = vertex_evidence(fields, np.asarray(mesh.vertices))
    assert known is not None
    off = _across(truth, trimesh.transform_points(mesh.vertices, turn))
    ground = json.loads((capture / "gt" / "ground.json").read_text())["offset_mm"]
    above = mesh.vertices[:, 2] > ground + ABOVE
    errors = {name: off[above & (known.kind == kind)] for kind, name in NAMED.items()}
    sigmas = {name: known.sigma[above & (known.kind == kind)].astype(float) for kind, name in NAMED.items()}
    errors["lengths"], sigmas["lengths"] = _lengths(capture, run, calibration, KDTree(mesh.vertices), known, pairs)
    mesh.vertex_attributes |= {"evidence": known.kind, "sigma": known.sigma}
    told = volume_sigma(mesh)
    if told is not None and (volume := _volume(truth)) is not None:
        errors["volume"], sigmas["volume"] = np.array([mesh.volume - volume]) / 1000, np.array([told]) / 1000
    errors = {name: values for name, values in errors.items() if len(values)}
    in_sigmas = {name: values / np.maximum(sigmas[name], 1e-12) for name, values in errors.items()}
    return Measured(f"{capture.name}, {run.name}", in_sigmas, errors, sigmas)


def _turn(capture: Path, found: Calibration) -> Float[np.ndarray, "4 4"]:
    """From the found world to the true one: nothing, or half a turn about the middle of a plain checkerboard."""
    truth = load_capture_truth(capture, found.camera.width, found.camera.height)
    between = truth.posed_camera.world_from_camera.rotate(found.world_from_camera.inverse().rotate(np.eye(3)))
    turn = np.eye(4)
    if between[0, 0] < 0:
        known = json.loads((capture / "gt" / "board.json").read_text())
        middle = np.array(known["inner_corners_mm"], float).reshape(-1, 3).mean(axis=0)
        turn[:2, :2] *= -1
        turn[:2, 3] = 2 * middle[:2]
    return turn


def _light_share(calibration: Calibration, mesh: trimesh.Trimesh) -> float:
    middle = mesh.bounds.mean(axis=0)
    shares = [
        float(np.linalg.norm(light.sigma) / np.linalg.norm(light.position - middle))
        for light in calibration.lights
        if light.used and light.position is not None
    ]
    return float(np.median(shares)) if shares else 0.0


def _across(truth: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return signed distances from the true surface, by the plane at the nearest of many points of it."""
    samples, faces, *_ = trimesh.sample.sample_surface(truth, SAMPLES, seed=0)
    nearest = KDTree(samples).query(points)[1]
    return ((points - samples[nearest]) * truth.face_normals[faces[nearest]]).sum(axis=1)


def _volume(truth: trimesh.Trimesh) -> float | None:
    """Return the true volume; None if the true mesh does not close even where its holes are filled."""
    whole = trimesh.Trimesh(truth.vertices, truth.faces)
    if not whole.is_watertight:
        whole.fill_holes()
    return abs(float(whole.volume)) if whole.is_watertight else None


def _lengths(
    capture: Path, run: Path, calibration: Calibration, tree: KDTree, known: VertexEvidence, pairs: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of lengths between pixels, and their stated sigmas."""
    draw = np.random.default_rng(0)
    depth = np.load(run / "depth.npy").astype(float)
    maps, camera = np.load(capture / "gt" / "maps.npz"), json.loads((capture / "gt" / "camera.json").read_text())
    true_camera = camera.get("upright", camera)
    k = np.array(true_camera["K"], float)
    lens = Camera(
        depth.shape[1], depth.shape[0], k[0, 0], k[1, 1], k[0, 2], k[1, 2], tuple(true_camera["dist_k1_k2_p1_p2_k3"])
    )
    inner = np.isfinite(depth) & maps["mask"]
    inner[1:-1, 1:-1] &= inner[:-2, 1:-1] & inner[2:, 1:-1] & inner[1:-1, :-2] & inner[1:-1, 2:]
    inner[[0, -1]] = inner[:, [0, -1]] = False
    chosen = draw.choice(np.flatnonzero(inner), (pairs, 2))
    aside = draw.normal(0, POINTING, (pairs, 2, 2))
    true = _places(lens, maps["depth_mm"].astype(float), chosen)
    found, beside = _pointed_at(calibration.camera, depth, chosen, aside)
    ends, leans = [], []
    for end in (0, 1):
        here, middle = found[:, end], _places(calibration.camera, depth, beside[:, end])
        straight = POINTING * depth.ravel()[beside[:, end]] / calibration.camera.fx
        moves = [
            POINTING * np.linalg.norm(_places(calibration.camera, depth, beside[:, end] + step) - middle, axis=1)
            for step in (1, -1, depth.shape[1], -depth.shape[1])
        ]
        capped = [np.minimum(np.nan_to_num(move, nan=np.inf), OBLIQUE * straight) for move in moves]
        pointing = np.sqrt(np.mean(np.square(capped), axis=0))
        nearest = tree.query(calibration.world_from_camera.apply(here))[1]
        ends.append(np.hypot(known.sigma[nearest], pointing))
        leans.append(known.lean[nearest])
    lengths = [np.linalg.norm(places[:, 0] - places[:, 1], axis=1) for places in (found, true)]
    # errors of the ends are independent but for the part that moves both alike
    sigmas = np.sqrt(np.maximum(ends[0] ** 2 + ends[1] ** 2 - 2 * leans[0] * leans[1], 0.0))
    return lengths[0] - lengths[1], sigmas


def _pointed_at(
    camera: Camera, depth: np.ndarray, chosen: np.ndarray, aside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what lies behind points beside pixels, in the camera's frame, and the pixel nearest to each point.

    Inverse depth is linear on a plane: between four pixels of one surface it is interpolated; else it is the nearest
    pixel's, or the chosen one's where the object does not cover that.
    """
    width = depth.shape[1]
    v, u = np.divmod(chosen, width)
    place = np.stack([u, v], -1) + aside
    near = np.rint(place).astype(int)
    near = near[..., 1] * width + near[..., 0]
    near = np.where(np.isfinite(depth.ravel()[near]), near, chosen)
    low = np.floor(place).astype(int)
    part = place - low
    corners = (low[..., 1] * width + low[..., 0])[..., None] + [0, 1, width, width + 1]
    inverse = 1 / depth.ravel()[corners]
    weights = np.stack([(1 - part[..., 0]) * (1 - part[..., 1]), part[..., 0] * (1 - part[..., 1])], -1)
    weights = np.concatenate([weights, np.stack([1 - part[..., 0], part[..., 0]], -1) * part[..., 1:]], -1)
    between = (weights * inverse).sum(-1)
    is_one = np.ptp(1 / inverse.clip(1e-12), axis=-1) <= OBLIQUE / between.clip(1e-12) / camera.fx
    z = np.where(is_one, 1 / between.clip(1e-12), depth.ravel()[near])
    rays = camera.unproject(place.reshape(-1, 2)).reshape(*z.shape, 3)
    return rays / rays[..., 2:] * z[..., None], near


def _places(camera: Camera, depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return what lies behind pixels, by their numbers, in the camera's frame."""
    v, u = np.divmod(pixels, depth.shape[1])
    rays = camera.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float)).reshape(*pixels.shape, 3)
    with np.errstate(invalid="ignore"):
        return rays / rays[..., 2:] * depth.ravel()[pixels][..., None]


def _draw(found: list[Measured], path: Path) -> None:
    """Draw the share of errors within each multiple of their sigma, a line for each kind, beside a normal error."""
    import matplotlib.pyplot as plt
    from scipy.special import erf

    figure, axes = plt.subplots(figsize=(6.2, 3.6), constrained_layout=True)
    multiples = np.linspace(0, 4, 81)
    axes.plot(multiples, erf(multiples / np.sqrt(2)), "k--", lw=1, label="a normal error")
    for what in (*NAMED.values(), "lengths"):
        shares = [
            [(np.abs(one.in_sigmas[what]) < k).mean() for k in multiples] for one in found if what in one.in_sigmas
        ]
        axes.plot(multiples, np.mean(shares, axis=0), label=what)
    axes.set(xlabel="error, in stated sigmas", ylabel="share of errors below", xlim=(0, 4), ylim=(0, 1.01))
    axes.legend(loc="lower right", fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
