"""Shadowgraph: 3D from shadows. The names to import; the command `shadowgraph` is in shadowgraph/command.py.

    result = shadowgraph.run("photos/")
    from shadowgraph import open_source, read_photos, calibrate_source, prepare_scene, fit, extract_mesh, save_results

A name is imported from its module when it is first asked for.
"""

import importlib
import os
from typing import Any

# Threads of OpenMP (torch, numba) sleep between two parts of work. On a busy machine their loops took 5 to 10 times the
# CPU time of the work itself. OpenBLAS gets one thread: our matrices are small, and its second thread waits in a loop.
# Both read the environment once, when they are loaded, and so do processes started here; what the user set stays.
WAITING = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}
for _name, _value in WAITING.items():
    os.environ.setdefault(_name, _value)

FACADE = {
    "run": "shadowgraph.api",
    "main": "shadowgraph.command",
    "RunOptions": "reconstruct.source.source",
    "open_source": "reconstruct.source.source",
    "read_photos": "reconstruct.source.photos",
    "calibrate_source": "reconstruct.source.calibrate_source",
    "check_capture": "reconstruct.check.verdict",
    "prepare_scene": "reconstruct.run.solve_stage",
    "solver_config": "reconstruct.run.presets",
    "fit": "reconstruct.solve.solver",
    "extract_mesh": "reconstruct.mesh.mesh",
    "save_results": "reconstruct.run.results",
    "read_photo": "capture.photos.photo",
    "read_stack": "capture.photos.photo",
    "load_session": "capture.session.session",
    "check_stack": "capture.checks.check_stack",
    "calibrate": "calibration.calibrate",
    "Calibration": "calibration.calibration",
    "load_calibration": "calibration.calibration",
    "save_calibration": "calibration.calibration",
    "load_known_scene": "calibration.scenes.shadowneus",
    "build_scene": "reconstruct.scene",
    "FitConfig": "reconstruct.config",
    "load_fields": "reconstruct.fields",
    "save_fields": "reconstruct.fields",
    "save_mesh": "reconstruct.mesh.mesh",
    "relight": "reconstruct.render.relight",
    "evaluate": "reconstruct.evaluate.metrics",
    "view": "viewer.page.serve",
    "look": "reconstruct.render.g_buffer",
    "RunResult": "shadowgraph.run_result",
}


def __getattr__(name: str) -> Any:
    """Import a name of FACADE from its module when it is first asked for, so that --help stays fast."""
    if name in FACADE:
        return getattr(importlib.import_module(FACADE[name]), name)
    raise AttributeError(f"module 'shadowgraph' has no attribute {name!r}")
