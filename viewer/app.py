"""The page: reads a run folder and follows it while it grows. It runs beside the run, never inside it.

A run without a browser costs nothing, a page that fails stops no run, and a page opened late shows what there is.
The page answers before anything heavy is imported: tabs (viewer/tabs.py) and fields come with what they show.
"""

import getpass
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
import viser

from calibration.result import Calibration, load_calibration
from capture.errors import UserError
from viewer.controls import Actions, Controls
from viewer.follow import FIELDS, HULL, RunFollower, Status, loss_curves, read_mesh, size_in_words, status
from viewer.guard import GuardedServer, is_loopback
from viewer.layers import (
    FIRST_FOV,
    Bulb,
    PageScale,
    draw_camera,
    draw_ground,
    draw_hull,
    draw_light,
    draw_mesh,
    first_view,
    page_scale,
)

if TYPE_CHECKING:
    from reconstruct.deviation import ReferenceMesh
    from viewer.light_panel import LightPanel
    from viewer.tabs import Tabs

POLL_S = 0.5  # how often the folder is looked at: the growing mesh is written every two seconds


class Page:
    """One run folder in one viser server. `refresh` is called by one thread; the controls call in from others."""

    def __init__(self, run_dir: Path, server: viser.ViserServer, reference: "ReferenceMesh | None" = None):
        """Lay the page out; nothing is read before `refresh`."""
        self.follower = RunFollower(run_dir)
        self.server = server
        self.is_over = False
        self.controls = Controls(server, run_dir.resolve().name, Actions(self._show_layers))
        self._tabs: Tabs | None = None
        self._lock = threading.RLock()
        self._mesh_lock = threading.Lock()  # of what stands for the mesh; nothing else is waited for under it
        self._calibration: Calibration | None = None
        self._scale = PageScale(1.0, np.zeros(3))
        self._bulbs: list[Bulb] = []
        self._ground: list[viser.SceneNodeHandle] = []
        self._frustum: viser.CameraFrustumHandle | None = None
        self._mesh: viser.GlbHandle | None = None
        self._hull: viser.MeshHandle | None = None
        self._final_mesh: trimesh.Trimesh | None = None
        self._instead: dict[str, tuple[trimesh.Trimesh, bool]] = {}  # by panel, the newest last: mesh, is lit
        self._reference = reference
        self._size = self._mesh_name = ""
        self.problem = ""  # with a file of this run, in words
        self._awaits_thumbnail = False
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        server.scene.configure_default_lights(True, cast_shadow=False)

    def refresh(self, is_watched: bool = True) -> None:
        """Look at the folder once and show what is new.

        Args:
            is_watched: by somebody; else a run that goes on is only followed, and shown once somebody comes.
        """
        with self._lock:
            lines, is_running = self.follower.log(), self.follower.is_running()
            now = status(lines, is_running)
            if is_running and not is_watched:
                self.controls.show_status(now, "")
                return
            try:
                self._read_results(lines)
            except UserError as error:  # a damaged file: the page stays, and says so
                self.problem = str(error)
            if self._awaits_thumbnail:
                self._show_photo(self.controls.pictures.photo_index())
            self._show_progress(lines, now)

    def _read_results(self, lines: list[dict[str, Any]]) -> None:
        if self.follower.changed("calibration.json"):
            self._show_calibration()
        name = self.follower.mesh_name(lines)
        is_new = bool(self._calibration and name and (self.follower.changed(name) or name != self._mesh_name))
        if name and is_new:
            self._show_mesh(name)
        if self._calibration and self.follower.changed(HULL):
            self._show_hull()
        if self._calibration and self.follower.has_result(lines) and (self.follower.changed(FIELDS) or is_new):
            self._show_result(self._calibration)

    def close(self) -> None:
        """End the panels' threads."""
        if self._tabs is not None:
            self._tabs.close()

    @property
    def tabs(self) -> "Tabs":
        """The tabs; the first to ask has them imported."""
        if self._tabs is None:
            from viewer.tabs import Lent, Tabs

            self._tabs = Tabs(
                Lent(
                    self.server,
                    self.controls,
                    self.follower.path,
                    self._look_at_photo,
                    self._show_instead,
                    self._reference,
                )
            )
        return self._tabs

    @property
    def light(self) -> "LightPanel | None":
        """The tab "Light", once there is one."""
        return None if self._tabs is None else self._tabs.light

    def _show_result(self, calibration: Calibration) -> None:
        from reconstruct.fields import load_fields
        from viewer.result import Result

        fields = load_fields(self.follower.path / FIELDS)
        self.tabs.show(Result(self.follower.path, calibration, fields, self._scale, self._final_mesh))
        self._show_photo(self.controls.pictures.photo_index())
        self._show_layers()

    # --- following the folder ----------------------------------------------------------------------------------------

    def _show_progress(self, lines: list[dict[str, Any]], now: Status) -> None:
        self.is_over = now.is_over
        self.controls.show_status(now, self.problem or self._size)
        if self._tabs is not None or not now.is_finished:
            self.tabs.follow(now, lines, self._calibration)
        if self.follower.changed("log.jsonl"):
            seconds, losses = loss_curves(lines)
            if len(seconds) > 1:
                self.controls.show_losses(seconds, losses)

    def _show_calibration(self) -> None:
        calibration = load_calibration(self.follower.path / "calibration.json")
        self._calibration, self._scale = calibration, page_scale(calibration)
        with self.server.atomic():
            for bulb in self._bulbs:
                bulb.remove()
            self._ground = draw_ground(self.server, calibration, self._scale)
            self._frustum = draw_camera(self.server, calibration, self._scale)
            self._bulbs = [draw_light(self.server, i, lt, self._scale) for i, lt in enumerate(calibration.lights)]
            self._look_from_the_side(calibration)
            self._show_layers()
        self.controls.pictures.show(len(calibration.lights), self.choose_photo)
        self._show_photo(0)

    def _look_from_the_side(self, calibration: Calibration) -> None:
        """Put the first view, and that of pages already open, where camera, lights and object are seen."""
        place, target = first_view(calibration, self._scale)
        for view in (self.server.initial_camera, *(client.camera for client in self.server.get_clients().values())):
            view.position, view.look_at, view.fov = place, target, FIRST_FOV

    def _show_mesh(self, name: str) -> None:
        mesh = read_mesh(self.follower.path / name)
        if mesh is None or self._calibration is None:
            return
        self._mesh_name = name
        self._mesh = draw_mesh(self.server, mesh, self._scale, self.controls.shows("Surface"))
        is_final = name == "mesh.ply"
        size = f"{size_in_words(mesh.extents, self._calibration.unit)} · {len(mesh.faces):,} faces"
        self._size, self._final_mesh = (size, mesh) if is_final else ("", None)

    def _show_hull(self) -> None:
        hull = read_mesh(self.follower.path / HULL)
        if hull is not None:
            self._hull = draw_hull(self.server, hull, self._scale, self.controls.shows("Shadow hull"))

    def _show_instead(self, panel: str, mesh: trimesh.Trimesh | None, is_lit: bool = True) -> None:
        """A panel's mesh in the finished one's place; None: the newest of the other panels', or the finished one."""
        with self._mesh_lock:
            before, was_lit = next(reversed(self._instead.values()), (self._final_mesh, True))
            self._instead.pop(panel, None)
            if mesh is not None:
                self._instead[panel] = (mesh, is_lit)
            shown, is_lit = next(reversed(self._instead.values()), (self._final_mesh, True))
            if shown is not None and not (shown is before and is_lit == was_lit):  # a large mesh takes a second
                visible = self.controls.shows("Surface")
                self._mesh = draw_mesh(self.server, shown, self._scale, visible, is_lit)

    # --- what the controls do ----------------------------------------------------------------------------------------

    def choose_photo(self, index: int) -> None:
        """Look at this photo, and hang the lamp where its light was."""
        with self._lock:
            self._show_photo(index)
            if self.light is not None:
                self.light.hang_at(index)

    def _look_at_photo(self, index: int) -> None:
        """Look at this photo; the lamp stays where it is."""
        with self._lock:
            if index != self.controls.pictures.photo_index():
                self.controls.pictures.set_photo(index)
                self._show_photo(index)

    def _show_photo(self, index: int) -> None:
        """Show this photo in the camera and in the panel, and mark its light."""
        if self._frustum is None or index >= len(self._bulbs):
            return
        light = self._bulbs[index].light
        picture = self.follower.thumbnail(light.photo)
        self._awaits_thumbnail = picture is None
        with self.server.atomic():
            for i, bulb in enumerate(self._bulbs):
                bulb.choose(i == index)
            self._frustum.image = picture
        self.controls.pictures.show_photo(light.photo, "" if light.used else f"not used: {light.reason}", picture)
        for watcher in () if self._tabs is None else self._tabs.photo_watchers:
            watcher(index)

    def _show_layers(self) -> None:
        """Apply the switches of what is shown."""
        shows = self.controls.shows
        for bulb in self._bulbs:
            bulb.show(shows("Lights"), shows("Uncertainty"))
        layers = [(self._frustum, "Camera"), (self._mesh, "Surface"), (self._hull, "Shadow hull")]
        for node, name in [*layers, *((g, "Ground") for g in self._ground)]:
            if node is not None:
                node.visible = shows(name)
        if self.light is not None:
            self.light.show_lamp(shows("Your lamp"))


def view(
    run_dir: Path,
    host: str = "127.0.0.1",
    port: int = 8080,
    once: bool = False,
    say: Callable[[str], object] = print,
    reference: Path | None = None,
) -> None:
    """Serve the page of a run folder until Ctrl-C, or, with `once`, until the run is over.

    Args:
        run_dir: a run's folder; it may still be empty.
        host: 127.0.0.1 unless others are meant to see and move the page; they need the token of the address said.
        port: the next free one is taken where this one is busy.
        say: told the address, once it is known.
        reference: a mesh file or the folder of another run, to compare this one with.

    Raises:
        UserError: there is no such folder, or no reference.
    """
    if not Path(run_dir).is_dir():
        raise UserError(f"{run_dir} is not a folder; the folder of a run was needed (the --out of `shadowgraph run`).")
    compared_with = None
    if reference is not None:
        from reconstruct.deviation import load_reference

        compared_with = load_reference(Path(reference))
    server = GuardedServer(host, port)
    page = Page(Path(run_dir), server, compared_with)
    for line in address_lines(host, server.get_port(), server.token):
        say(line)
    try:
        while not (once and page.is_over):
            page.refresh(is_watched=bool(server.get_clients()))
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        say("Page closed.")
    finally:
        page.close()
        server.stop()


def address_lines(host: str, port: int, token: str = "") -> list[str]:
    """What to open, here and from another machine, in words; with the token that a page for others asks for."""
    if is_loopback(host):
        return [
            f"Open http://localhost:{port}",
            f"From another machine: ssh -L {port}:localhost:{port} {getpass.getuser()}@{socket.gethostname()}, "
            f"then open http://localhost:{port} there",
        ]
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    return [
        f"Open http://{name}:{port}/?token={token}",
        f"Warning: --host {host} lets everybody who can reach this machine and has this address see and move this "
        "page; it is sent unencrypted, so others on the network may read along.",
    ]
