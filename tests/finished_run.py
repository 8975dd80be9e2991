"""A finished run of balls and a box, with the mesh that a run would have extracted from its field."""

from pathlib import Path

import fake_run

from reconstruct.mesh.mesh import extract_mesh, save_mesh


def make(folder: Path, width: int = 96, n_lights: int = 6) -> Path:
    truth = fake_run.make_truth(width, n_lights)
    run = folder / "heap"
    fake_run.start_run(run, truth)
    fake_run.finish_run(run, truth)
    save_mesh(extract_mesh(fake_run.fields_of(truth)), run / "mesh.ply", run / "mesh.glb", "mm")
    return run
