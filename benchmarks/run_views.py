"""Does a view more harm what the others see? Runs with all views of a capture, and with each of them left out.

    python benchmarks/run_views.py CAPTURE [--preset draft] [--table FILE]

CAPTURE holds view_1/ view_2/ ...; its gt/ holds object.ply (mm, the board's frame) and seen.npz, which says which
place of the tripod sees which triangle (examples/make_capture.py writes both). Each mesh is laid on the truth by
point-to-plane ICP. Over the part of the true surface that the other views see, for the run without a view and for that
with all:

    distance   mean distance of the true surface from the mesh, mm
    within     share of it that is nearer than 1 mm
    normals    mean angle to the normals of the nearest triangles, degrees
"""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from one_run import run
from scipy.spatial import KDTree
from sheet import Sheet, parser_of, table

from reconstruct.evaluate.surface_distance import angle_deg, register

SAMPLES = 100_000  # of the true surface
DENSE = 4  # times as many of the mesh
NEAR_MM = 1.0


def some_views(capture: Path, views: list[str], copy: Path) -> Path:
    """Copy a capture with some of its views, and without its truth and its lies."""
    copy.mkdir()
    for part in ("board", "session.toml"):
        if (capture / part).is_dir():
            shutil.copytree(capture / part, copy / part)
        elif (capture / part).exists():
            shutil.copy(capture / part, copy / part)
    for view in views:
        shutil.copytree(capture / view, copy / view)
    return copy


class Truth:
    """Samples of the true surface, and which place of the tripod sees them."""

    def __init__(self, folder: Path):
        """Read gt/."""
        mesh = trimesh.load_mesh(folder / "object.ply", process=False)
        points, face = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[:2]
        self.points = np.asarray(points)
        self.normals = np.asarray(mesh.face_normals)[face]
        with np.load(folder / "seen.npz") as stored:
            self.names = [str(name) for name in stored["names"]]
            self.seen = stored["seen"][face]

    def errors(self, path: Path) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Distance (mm) of each sample from a mesh, and angle (degrees) to the normal there."""
        mesh = trimesh.load_mesh(path, process=False)
        points, face = trimesh.sample.sample_surface(mesh, DENSE * SAMPLES, seed=1)[:2]
        motion = register(np.asarray(points), self.points, self.normals)
        distance, index = KDTree(motion.apply(np.asarray(points))).query(self.points)
        normals = np.asarray(mesh.face_normals)[face][index] @ motion.rotation.T
        return np.asarray(distance), angle_deg(normals, self.normals)

    def row(self, views: list[str], path: Path) -> list[float]:
        """Mean distance, share that is near, and mean angle, over what some views see."""
        part = self.seen[:, [self.names.index(view) for view in views]].any(1)
        distance, angle = (error[part] for error in self.errors(path))
        return [float(distance.mean()), float((distance < NEAR_MM).mean()), float(angle.mean())]


def main() -> None:
    """Run, compare, print."""
    parser = parser_of(__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--preset", default="draft")
    given = parser.parse_args()
    views, truth = sorted(path.name for path in given.capture.glob("view_*")), Truth(given.capture / "gt")
    sheet = Sheet("A view more", given.table, "seed 0")
    head = ["views", "CPU s", "GiB", "seen by", "distance, mm", "within 1 mm", "normals, deg"]
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder:
        done = {}
        for left_out in (None, *views):
            kept = [view for view in views if view != left_out]
            copy = some_views(given.capture, kept, Path(folder) / f"without_{left_out}")
            found = run(str(copy), Path(folder) / "runs", ["--preset", given.preset])
            done[left_out] = Path(folder) / "runs" / copy.name / "mesh.ply", found
        for left_out in views:
            others = [view for view in views if view != left_out]
            for named, key in ((", ".join(others), left_out), ("all", None)):
                path, found = done[key]
                cost = [found["cpu_seconds"], found.get("peak_memory_gib")]
                rows.append([named, *cost, ", ".join(others), *truth.row(others, path)])
    sheet.write(table(head, rows))


if __name__ == "__main__":
    main()
