"""RunResult: a finished run as a Python object, which a notebook shows as a card with a picture."""

import html
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from calibration.calibrated_views import load_views
from capture.errors import ReconstructionError
from reconstruct.stored_run.documents import lit_photos
from reconstruct.stored_run.stored_run import StoredRun
from viewer.display.run_follower import size_text
from viewer.report.document import data_uri, mesh_picture
from viewer.report.pictures import view_from_camera

NEEDED = ("calibration.json", "fields.safetensors", "mesh.ply", "report.json")
CARD_PX = (420, 315)


class RunResult(StoredRun):
    """The results of a finished run. Each is read when it is first asked for. World frame, lengths in `unit`."""

    def __init__(self, path: str | Path):
        """Open a run's folder.

        Raises:
            ReconstructionError: the run is not finished, or this is no run's folder.
        """
        super().__init__(Path(path))
        missing = [name for name in NEEDED if not (self.path / name).is_file()]
        if missing:
            raise ReconstructionError(
                f"{self.path} lacks {', '.join(missing)}; the folder of a finished run was needed. "
                "Run it again with the same settings: it continues where it stopped."
            )

    @property
    def path(self) -> Path:
        """Return the run's folder."""
        return self.run_dir

    @property
    def warnings(self) -> list[str]:
        """Return sentences about what may make this result worse than it looks."""
        return [str(line) for line in self.report.get("warnings", [])]

    @property
    def depth(self) -> Float[np.ndarray, "height width"]:
        """Return the z-depth of the object on the photos' pixels; inf elsewhere."""
        return self.maps.depth

    @property
    def normals(self) -> Float[np.ndarray, "height width 3"]:
        """Return the outward unit normals of the object on the photos' pixels; 0 elsewhere."""
        return self.maps.normals

    @property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        """Return which of the photos' pixels show the object.

        Raises:
            UserError: mask.png cannot be read.
        """
        return self.maps.mask

    def __repr__(self) -> str:
        size = size_text(self.mesh.extents, self.unit)
        return f"RunResult({str(self.path)!r}: {size}, {len(self.mesh.faces):,} faces)"

    def _repr_html_(self) -> str:
        """Return the card that a notebook shows: a picture of the mesh, its size and the warnings."""
        picture = mesh_picture(self.mesh, view_from_camera(self.mesh, self.calibration), CARD_PX)
        lit = lit_photos(self.report, load_views(self.path / "calibration.json").every()).values()
        facts = [
            size_text(self.mesh.extents, self.unit),
            f"{len(self.mesh.faces):,} triangles, {'closed' if self.mesh.is_watertight else 'open'}",
            f"{sum(bool(row['used']) for row in lit)} of {len(lit)} photos used",
            *self.warnings,
        ]
        lines = "".join(f"<div>{html.escape(line)}</div>" for line in facts)
        return (
            '<div style="display:flex;gap:1.5em;align-items:center;flex-wrap:wrap">'
            f'<img alt="The mesh from the camera\'s side" width="{CARD_PX[0] // 2}" src="{data_uri(picture)}">'
            f"<div><b>{html.escape(self.name)}</b>{lines}"
            f"<code>shadowgraph view {html.escape(str(self.path))}</code></div></div>"
        )
