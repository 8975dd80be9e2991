"""StoredRun: the files of one run folder, each read at its first use and checked against the others."""

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.calibrated_views import load_views
from calibration.calibration import Calibration, load_calibration
from capture.errors import ReconstructionError
from capture.files.regular import is_own_folder
from capture.files.title import title_of
from reconstruct.stored_run.documents import MANIFEST, REPORT, read_manifest, read_report
from reconstruct.stored_run.maps import Maps, read_maps
from reconstruct.stored_run.ply import read_mesh

if TYPE_CHECKING:  # torch and trimesh take seconds to import, and a page that follows a run needs neither
    import trimesh

    from reconstruct.detail.file import Detail
    from reconstruct.fields import SolvedScene

CALIBRATION, FIELDS, DETAIL, MESH = "calibration.json", "fields.safetensors", "detail.safetensors", "mesh.ply"
FARTHEST = 1e6  # sizes of the grid from its origin to a light or a vertex: beyond, a float32 knows no voxel any more
EXPORTS = "exports"  # subfolder of a run's folder, for exports without a given file name


class StoredRun:
    """A run's results, each read at its first use.

    Raises:
        UserError: the requested file is missing, damaged, or does not agree with the others.
    """

    def __init__(self, run_dir: Path):
        """Read nothing yet."""
        self.run_dir = run_dir

    @property
    def name(self) -> str:
        """The run's title: what a person called it, else the name of its folder."""
        return title_of(self.run_dir)

    @property
    def unit(self) -> str:
        """The unit of lengths in this run: "mm" | "scene"."""
        return self.fields.unit

    @cached_property
    def fields(self) -> "SolvedScene":
        """The solved scene."""
        from reconstruct.fields import load_fields

        return load_fields(self.run_dir / FIELDS)

    @cached_property
    def details(self) -> "tuple[Detail, ...]":
        """Normals and albedo at the photos' own resolution, of each view, if they were read on this surface."""
        from reconstruct.detail.file import load_details

        return load_details(self.run_dir / DETAIL, self.fields)

    @property
    def detail(self) -> "Detail | None":
        """The first view's of the details."""
        return next((detail for detail in self.details if detail.view == 0), None)

    @cached_property
    def calibration(self) -> Calibration:
        """Camera, ground and lights; of the unit of the solved scene."""
        found = load_calibration(self.run_dir / CALIBRATION)
        refuse_elsewhere(found, self.fields, self.run_dir)
        return found

    @cached_property
    def views(self) -> "tuple[tuple[str, Calibration, SolvedScene], ...]":
        """Each camera of the solve: the name of its view, its calibration, and the scene as it saw it.

        Those of another object pose are in that pose's world; SolvedScene.object_from_world leads to the others'.
        """
        first = self.calibration
        stored = {view.name: view.calibration for view in load_views(self.run_dir / CALIBRATION).every()}
        found = [(self.fields.view, first, self.fields.views()[0])]
        for seen in self.fields.views()[1:]:
            if seen.view not in stored:
                raise ReconstructionError(
                    f"{self.run_dir}: {FIELDS} has a view {seen.view!r:.80} that {CALIBRATION} lacks; both of one run "
                    "were needed. Run again, or ask for the folder again."
                )
            refuse_elsewhere(stored[seen.view], seen, self.run_dir / seen.view)
            found.append((seen.view, stored[seen.view], seen))
        return tuple(found)

    @cached_property
    def mesh(self) -> "trimesh.Trimesh":
        """mesh.ply: world frame, sRGB colours and normals per vertex."""
        mesh = read_mesh(self.run_dir / MESH)
        _refuse_far(np.asarray(mesh.bounds), self.fields, f"{self.run_dir / MESH}: the mesh")
        return mesh

    @cached_property
    def maps(self) -> Maps:
        """Depth, normals and mask on the pixels of the photos."""
        camera = self.calibration.camera
        return read_maps(self.run_dir, (camera.height, camera.width))

    @cached_property
    def report(self) -> dict[str, Any]:
        """The content of report.json."""
        return read_report(self.run_dir / REPORT)

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """The content of manifest.json."""
        return read_manifest(self.run_dir / MANIFEST)

    def exports(self) -> Path:
        """Return the folder for exports without a given file name.

        Raises:
            ReconstructionError: the folder of a stranger holds something else under that name.
        """
        folder = self.run_dir / EXPORTS
        if (folder.exists() or folder.is_symlink()) and not is_own_folder(folder):
            raise ReconstructionError(f"{folder} is a link or a file, a folder was needed. Name the file to write.")
        return folder


def refuse_elsewhere(calibration: Calibration, fields: "SolvedScene", run_dir: Path) -> None:
    """Check that calibration.json and fields.safetensors are of one scene: its unit, and lights that can reach it.

    Raises:
        ReconstructionError: they are not.
    """
    if calibration.unit != fields.unit:
        units = f"{CALIBRATION} is in {calibration.unit!r} and {FIELDS} in {fields.unit!r}, one unit was needed"
        raise ReconstructionError(f"{run_dir}: {units}. Run again, or ask for the folder again.")
    for light in calibration.lights:
        if light.used and light.position is not None:
            _refuse_far(light.position[None], fields, f"{run_dir / CALIBRATION}: the light of {light.photo!r:.80}")


def _refuse_far(places: np.ndarray, fields: "SolvedScene", what: str) -> None:
    size = fields.grid.spacing * max(fields.grid.values.shape)
    away = float(np.abs(places - fields.grid.origin.double().numpy()).max())
    if not away <= FARTHEST * size:
        raise ReconstructionError(
            f"{what} is {away:.3g} from the solved surface, which is {size:.3g} large; at most {FARTHEST:g} times its "
            "size was needed. Run again, or ask for the folder again."
        )
