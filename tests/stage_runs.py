"""Finished runs of a few shapes for the stage: exact geometry on a 2 mm grid, no photos."""

from pathlib import Path

from fake_run import calibration_of, fields_of, mesh_of
from synthetic import HEAP, Box, Look, Sphere, Truth, render

from calibration.calibration import save_calibration
from reconstruct.fields import save_fields

SHAPES = {"heap": HEAP, "lollipop": (Sphere((0.0, 0.0, 50.0), 24.0), Box((-6, -6, 0), (6, 6, 40)))}


def truth_of(name: str) -> Truth:
    """What a perfect run of these shapes finds."""
    return render(SHAPES[name], Look(width=96, height=72, n_lights=4))[1]


def stage_run(folder: Path, name: str) -> Path:
    """Write what the stage of a run is made of, into a folder of the shapes' name."""
    run, truth = folder / name, truth_of(name)
    run.mkdir(parents=True)
    fields = fields_of(truth)
    save_calibration(calibration_of(truth), run / "calibration.json")
    save_fields(fields, run / "fields.safetensors")
    mesh_of(fields).export(run / "mesh.ply")
    return run
