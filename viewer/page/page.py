"""The page: it reads a run folder and follows it while it grows, in a process beside the run's.

A run without a browser has no cost for it, a page that fails does not stop the run, and a page opened late shows the
results so far. The page answers before large modules are imported: the panels of a finished run (viewer/page/tabs.py)
are imported once the run is over. viewer/display/rate_limit.py limits how often it sends expensive data.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import viser

from calibration.calibrated_views import CalibratedView, load_views
from calibration.calibration import Calibration
from capture.errors import UserError
from capture.files.title import title_of
from reconstruct.run_folder.cost import give_memory_back
from reconstruct.run_folder.folder import LOG
from reconstruct.stored_run.ply import read_mesh, read_preview
from reconstruct.stored_run.stored_run import CALIBRATION, DETAIL, FIELDS, MESH, StoredRun, refuse_far_mesh
from viewer.display.layers import (
    FIRST_FOV,
    LightMarker,
    PageScale,
    draw_camera,
    draw_ground,
    draw_hull,
    draw_light,
    draw_mesh,
    draw_preview,
    first_view,
    framed_view,
    light_room,
    mesh_glb,
    page_scale,
)
from viewer.display.rate_limit import RateLimit
from viewer.display.run_follower import (
    HULL,
    RunFollower,
    Status,
    loss_curves,
    size_text,
    stage_of,
    status,
)
from viewer.page.controls import Controls
from viewer.page.tabs import Tabs
from viewer.widgets.panel import PanelContext
from viewer.widgets.pointer import Pointer

if TYPE_CHECKING:
    import trimesh

    from reconstruct.evaluate.deviation import ReferenceMesh

T = TypeVar("T")
WIDE = 1.6  # aspect of a window that is not known yet
MOST_READ = 6  # files of a run that are kept for the next visitor
REREAD_EVERY = 10  # polls, after which a folder without changes is read, because a killed run makes none


class KeptReadings:
    """What was read of a run's files, for several pages of it while the files are the same. Nobody changes it."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._kept: dict[tuple[Path, str], tuple[tuple[int, int], Any]] = {}
        self._lock = threading.Lock()

    def mesh(self, path: Path) -> "trimesh.Trimesh":
        """Return a finished mesh."""
        return self.get(path, lambda: read_mesh(path))

    def glb(self, path: Path) -> bytes:
        """Return a finished mesh as the browser takes it, lit."""
        mesh = self.mesh(path)
        return self.get(path, lambda: mesh_glb(mesh, True), "glb")

    def get(self, path: Path, read: Callable[[], T], kind: str = "") -> T:
        """Return what `read` makes of a file, made anew when the file has changed; `kind`: one of several readings."""
        try:
            stat = path.stat()
        except OSError:
            return read()
        mark = (stat.st_mtime_ns, stat.st_size)
        with self._lock:
            known = self._kept.pop((path, kind), None)
            if known is None or known[0] != mark:
                known = (mark, read())
            self._kept[path, kind] = known
            while len(self._kept) > MOST_READ:
                self._kept.pop(next(iter(self._kept)))
            return known[1]


class Page:
    """Shows one run folder in one viser server. One thread calls `refresh`; the controls call from others."""

    def __init__(
        self,
        run_dir: Path,
        server: viser.ViserServer,
        reference: "ReferenceMesh | None" = None,
        kept: KeptReadings | None = None,
    ):
        """Lay the page out; `refresh` reads the folder.

        Args:
            kept: readings that are shared with other pages of this run.
        """
        self.follower = RunFollower(run_dir)
        self._kept = kept or KeptReadings()
        self.server = server
        self.is_over = False
        self.controls = Controls(server, title_of(run_dir), self._show_layers)
        self._context = PanelContext(
            server=server,
            run_dir=run_dir,
            pictures=self.controls.pictures,
            pointer=Pointer(server),
            show_mesh=self._show_panel_mesh,
            look_at_photo=self._look_at_photo,
            reference=reference,
        )
        self.tabs = Tabs(self._context, self.controls.add_tab)
        self._polls = 0
        self._mesh_limit, self._curve_limit = RateLimit(), RateLimit()
        self._lock = threading.RLock()
        self._mesh_lock = threading.Lock()  # of the mesh that is drawn; no other lock is acquired under it
        self._calibration: Calibration | None = None
        self._scale = PageScale(1.0, np.zeros(3))
        self._lights: list[LightMarker] = []
        self._ground: list[viser.SceneNodeHandle] = []
        self._frustum: viser.CameraFrustumHandle | None = None
        self._further: list[viser.CameraFrustumHandle] = []  # of the other views
        self._mesh: viser.GlbHandle | viser.MeshHandle | None = None
        self._hull: viser.MeshHandle | None = None
        self._final_mesh: trimesh.Trimesh | None = None
        self._panel_meshes: dict[object, tuple[trimesh.Trimesh, bool]] = {}  # by panel, the newest last: mesh, is lit
        self._size = self._mesh_name = ""
        self.problem = ""  # a sentence about a damaged file of this run
        self._is_framed = False
        self._awaits_thumbnail = self._has_unsent = self._was_watched = False
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        light_room(server, has_lamp=False)

    def poll(self, is_watched: bool) -> None:
        """Look for changes in the folder, and `refresh` if there are any. It can be called at any rate."""
        has_news = self.follower.has_news()
        self._polls += 1
        if has_news or self._has_unsent or is_watched != self._was_watched or self._polls % REREAD_EVERY == 0:
            self._was_watched = is_watched
            self.refresh(is_watched)

    def refresh(self, is_watched: bool = True) -> None:
        """Read the folder once and show what is new.

        Args:
            is_watched: a browser has the page open; if none has, only the status of a running run is updated.
        """
        with self._lock:
            lines, is_running = self.follower.log(), self.follower.is_running()
            now = status(lines, is_running)
            if is_running and not is_watched:
                self.controls.show_status(now, "")
                return
            self._has_unsent = False
            try:
                self._read_results(lines, now)
            except UserError as error:  # a damaged file: the page shows this and goes on
                self.problem = str(error)
            if self._awaits_thumbnail:
                self._show_photo(self.controls.pictures.photo_index())
            self._show_progress(lines, now)

    def _read_results(self, lines: list[dict[str, Any]], now: Status) -> None:
        if self.follower.changed(CALIBRATION):
            self._show_calibration()
        name = self.follower.mesh_name(lines)
        is_new = False
        is_ending = not now.is_over and stage_of(lines) == "report"  # the run ends within a second: no preview then
        if name and self._calibration and not is_ending and self._may_send(self._mesh_limit, now):
            is_new = self.follower.changed(name) or name != self._mesh_name
            if is_new:
                self._mesh_limit.begin()
                self._show_mesh(name)
        if self._calibration and self.follower.changed(HULL):
            self._show_hull()
        has_result = now.is_over and self.follower.has_result(lines)  # before, the processor is left to the run
        if self._calibration and has_result and (self.follower.any_changed(FIELDS, DETAIL) or is_new):
            self._show_result()

    def _may_send(self, limit: RateLimit, now: Status) -> bool:
        """Return whether what costs much may be sent now; else note that the next poll must read the folder again."""
        is_due = now.is_over or limit.is_due()
        self._has_unsent |= not is_due
        return is_due

    def close(self) -> None:
        """End the panels' threads."""
        self.tabs.close()

    def _show_result(self) -> None:
        from viewer.display.result import Result

        run, mesh, details = StoredRun(self.follower.path), self._final_mesh, ()
        fields, calibration = self._kept.get(run.run_dir / FIELDS, lambda: run.fields), run.calibration
        try:
            if mesh is not None:
                refuse_far_mesh(mesh, fields, run.run_dir)
            details = self._kept.get(run.run_dir / DETAIL, lambda: run.details)
        except UserError as error:  # the rest of the result is there
            self.problem = str(error)
        self.tabs.show(Result(run.run_dir, calibration, fields, self._scale, mesh, details))
        self._show_photo(self.controls.pictures.photo_index())
        self._show_layers()
        give_memory_back()  # of the previous result, if the same folder is run again

    # --- following the folder ----------------------------------------------------------------------------------------

    def _show_progress(self, lines: list[dict[str, Any]], now: Status) -> None:
        self.is_over = now.is_over
        has_picture = now.is_over and self._final_mesh is not None and self.follower.has_result(lines)
        self.controls.show_status(now, self.problem or self._size, has_picture)
        self.tabs.follow(now, lines, self._calibration)
        if self._may_send(self._curve_limit, now) and self.follower.changed(LOG):
            seconds, losses = loss_curves(lines)
            if len(seconds) > 1:
                self._curve_limit.begin()
                self.controls.show_losses(seconds, losses)

    def _show_calibration(self) -> None:
        first, *further = load_views(self.follower.path / CALIBRATION).views
        calibration = first.calibration
        self._calibration, self._scale = calibration, page_scale(calibration)
        with self.server.atomic():
            for node in (*self._lights, *self._further):
                node.remove()
            self._ground = draw_ground(self.server, calibration, self._scale)
            self._frustum = draw_camera(self.server, calibration, self._scale)
            self._further = [self._draw_further(i, view) for i, view in enumerate(further, start=1)]
            self._lights = [draw_light(self.server, i, lt, self._scale) for i, lt in enumerate(calibration.lights)]
            self._look_from_the_side(calibration)
            self._show_layers()
        self.controls.pictures.show(len(calibration.lights), self.choose_photo)
        self._show_photo(0)

    def _draw_further(self, number: int, view: CalibratedView) -> viser.CameraFrustumHandle:
        """Draw the camera of a further view, with one of its photos."""
        frustum = draw_camera(self.server, view.calibration, self._scale, number)
        used = [light.photo for light in view.calibration.lights if light.used]
        if used:
            frustum.image = self.follower.thumbnail(f"{view.name}/{used[len(used) // 2]}")
        return frustum

    def _look_from_the_side(self, calibration: Calibration) -> None:
        """Move the first view, and those of open pages, to a place from which camera, lights and object are visible."""
        place, target = first_view(calibration, self._scale)
        for view in (self.server.initial_camera, *(client.camera for client in self.server.get_clients().values())):
            view.position, view.look_at, view.fov = place, target, FIRST_FOV

    def _show_mesh(self, name: str) -> None:
        path, is_visible = self.follower.path / name, self.controls.shows("Surface")
        if name != MESH:
            growing = read_preview(path)
            if growing is not None:
                self._mesh_name, self._size, self._final_mesh = name, "", None
                self._mesh = draw_preview(self.server, growing, self._scale, is_visible)
            return
        if self._calibration is None:
            return
        mesh = self._kept.mesh(path)
        self._mesh_name, self._final_mesh = name, mesh
        self._mesh = draw_mesh(self.server, mesh, self._scale, is_visible, glb=self._kept.glb(path))
        self._frame(np.asarray(mesh.bounds))
        self._size = f"{size_text(mesh.extents, self._calibration.unit)} · {len(mesh.faces):,} faces"

    def _frame(self, bounds: np.ndarray) -> None:
        """Bring the finished object close: for open pages once, and for each that opens later."""
        calibration, scale = self._calibration, self._scale
        if calibration is None or self._is_framed:
            return
        self._is_framed = True

        def look(view: Any, aspect: float) -> None:
            view.position, view.look_at = framed_view(bounds, calibration, scale, aspect)

        look(self.server.initial_camera, WIDE)
        for client in self.server.get_clients().values():
            look(client.camera, client.camera.aspect)
        self.server.on_client_connect(lambda client: look(client.camera, client.camera.aspect))

    def _show_hull(self) -> None:
        hull = read_preview(self.follower.path / HULL)
        if hull is not None:
            self._hull = draw_hull(self.server, hull, self._scale, self.controls.shows("Shadow hull"))

    def _show_panel_mesh(self, owner: object, mesh: "trimesh.Trimesh | None", is_lit: bool = True) -> None:
        """Draw a panel's mesh in place of the finished one; None: the newest of other panels, or the finished one."""
        with self._mesh_lock:
            before, was_lit = next(reversed(self._panel_meshes.values()), (self._final_mesh, True))
            self._panel_meshes.pop(owner, None)
            if mesh is not None:
                self._panel_meshes[owner] = (mesh, is_lit)
            shown, is_lit = next(reversed(self._panel_meshes.values()), (self._final_mesh, True))
            if shown is not None and not (shown is before and is_lit == was_lit):  # a large mesh takes a second
                visible = self.controls.shows("Surface")
                self._mesh = draw_mesh(self.server, shown, self._scale, visible, is_lit)

    # --- what the controls do ----------------------------------------------------------------------------------------

    def choose_photo(self, index: int) -> None:
        """Show this photo, and move the lamp to where its light was."""
        with self._lock:
            self._show_photo(index)
            self._context.photo_chosen.emit(index)

    def _look_at_photo(self, index: int) -> None:
        """Show this photo; the lamp stays where it is."""
        with self._lock:
            if index != self.controls.pictures.photo_index():
                self.controls.pictures.set_photo(index)
                self._show_photo(index)

    def _show_photo(self, index: int) -> None:
        """Show this photo in the camera's frustum and in the panel, and mark its light."""
        if self._frustum is None or index >= len(self._lights):
            return
        light = self._lights[index].light
        picture = self.follower.thumbnail(light.photo)
        self._awaits_thumbnail = picture is None
        with self.server.atomic():
            for i, light_node in enumerate(self._lights):
                light_node.choose(i == index)
            self._frustum.image = picture
        self.controls.pictures.show_photo(light.photo, "" if light.used else f"not used: {light.reason}", picture)
        self._context.photo_shown.emit(index)

    def _show_layers(self) -> None:
        """Show and hide the layers according to their switches."""
        shows = self.controls.shows
        for light_node in self._lights:
            light_node.show(shows("Lights"), shows("Uncertainty"))
        cameras = [(frustum, "Camera") for frustum in (self._frustum, *self._further)]
        layers = [*cameras, (self._mesh, "Surface"), (self._hull, "Shadow hull")]
        for node, name in [*layers, *((g, "Ground") for g in self._ground)]:
            if node is not None:
                node.visible = shows(name)
        self._context.lamp_shown.emit(shows("Your lamp"))
