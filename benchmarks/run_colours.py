"""Compare the colours of a run's mesh with those of a capture's true object, and look for seams between its views.

    python benchmarks/run_colours.py RUN REFERENCE

REFERENCE/gt holds object.ply (mm, board frame; 255 times the linear albedo per vertex) and seen.npz: `names` of the
views and `seen`, which of them sees each triangle (examples/make_capture.py writes both). RUN/mesh.ply is laid on it by
point-to-plane ICP. Albedo has no absolute scale: one factor for each channel, the median over the seen surface, comes
before the comparison. Prints one row for each view, for all of them, and for what no view sees.

    linear, srgb   mean absolute error of all channels, per cent of white
    seam           where a view's sight ends and others see on: the mean colour error on this side of the edge within
                   REACH less that on the other, absolute; its median and 95th percentile over the edge, sRGB
"""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree
from sheet import parser_of, table
from trimesh.visual import ColorVisuals

from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.evaluate.surface_distance import register

REACH = 3.0  # mm from the edge of a view's sight
MIXED = 0.5  # mm beside the edge that count on neither side
NEIGHBOURS = 4  # vertices of the result that give a place its colour
FEWEST = 20  # triangles on each side of a place on an edge
EDGES = 400  # places on the edge of each view


def main() -> None:
    """Compare and print."""
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("reference", type=Path)
    given = parser.parse_args()
    true = trimesh.load_mesh(given.reference / "gt" / "object.ply", process=False)
    found = trimesh.load_mesh(given.run / "mesh.ply", process=False)
    known = np.load(given.reference / "gt" / "seen.npz")
    print("\n".join(table(*colours(found, true, [str(name) for name in known["names"]], known["seen"]))))


def colours(
    found: trimesh.Trimesh, true: trimesh.Trimesh, names: list[str], seen: Bool[np.ndarray, "faces views"]
) -> tuple[list[str], list[list[object]]]:
    """Return the table's head and its rows."""
    places = np.asarray(true.triangles_center)
    motion = register(np.asarray(found.vertices), places, np.asarray(true.face_normals))
    tree = KDTree(motion.apply(np.asarray(found.vertices)))
    distance, index = tree.query(places, k=NEIGHBOURS)
    weight = 1 / np.maximum(distance, 1e-6)
    weight /= weight.sum(1, keepdims=True)
    own = (decode_srgb(_bytes(found)).astype(float)[index] * weight[..., None]).sum(1)
    truth = (_bytes(true) / 255.0)[np.asarray(true.faces)].mean(1)
    everywhere = seen.any(1)
    bright = everywhere & (truth > 0.02).all(1) & (own > 0.02).all(1)
    own = own * np.exp(np.median(np.log(truth[bright] / own[bright]), axis=0))
    linear = np.abs(own - truth).mean(1)
    away = (encode_srgb(own.clip(0, 1)).astype(float) - encode_srgb(truth)) / 255
    area = np.asarray(true.area_faces)
    rows: list[list[object]] = []
    parts = [(name, seen[:, k]) for k, name in enumerate(names)]
    for name, part in [*parts, ("all", everywhere), ("no view", ~everywhere)]:
        if not part.any():
            continue
        errors = [100 * float(np.average(e[part], weights=area[part])) for e in (linear, np.abs(away).mean(1))]
        steps = _steps(places, away, part, everywhere) if name in names else np.zeros(0)
        seams = [100 * float(np.percentile(steps, q)) if len(steps) else None for q in (50, 95)]
        rows.append([name, *errors, *seams])
    return ["seen by", "linear, %", "sRGB, %", "seam median, %", "seam p95, %"], rows


def _bytes(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, "n 3"]:
    visual = mesh.visual
    assert isinstance(visual, ColorVisuals)
    return np.asarray(visual.vertex_colors)[:, :3]


def _steps(
    places: Float[np.ndarray, "faces 3"],
    away: Float[np.ndarray, "faces 3"],
    inside: Bool[np.ndarray, " faces"],
    everywhere: Bool[np.ndarray, " faces"],
) -> Float[np.ndarray, " edges"]:
    """Return the step of the mean colour error across the edge of a view's sight, at places along it."""
    outside = everywhere & ~inside
    if inside.sum() < FEWEST or outside.sum() < FEWEST:
        return np.zeros(0)
    sides = [(KDTree(places[side]), away[side]) for side in (inside, outside)]
    on_edge = places[inside][sides[1][0].query(places[inside])[0] < MIXED]
    on_edge = on_edge[np.linspace(0, len(on_edge) - 1, min(EDGES, len(on_edge))).astype(int)]
    found = []
    for place in on_edge:
        means = []
        for tree, errors in sides:
            near = np.asarray(tree.query_ball_point(place, REACH), int)
            near = near[np.linalg.norm(tree.data[near] - place, axis=1) > MIXED]
            means.append(errors[near].mean(0) if len(near) >= FEWEST else None)
        if means[0] is not None and means[1] is not None:
            found.append(float(np.abs(means[0] - means[1]).mean()))
    return np.array(found)


if __name__ == "__main__":
    main()
