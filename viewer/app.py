"""The page: reads a run folder and follows it while it grows. It runs beside the run, never inside it.

A run without a browser costs nothing, a page that fails stops no run, and a page opened late shows what there is.
"""

import getpass
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser
from jaxtyping import Float

from calibration.light import Light
from calibration.result import Calibration, load_calibration
from capture.errors import UserError
from reconstruct.fields import Fields, load_fields
from viewer.controls import Actions, Controls
from viewer.follow import RunFollower, loss_curves, read_mesh, size_in_words, status
from viewer.guard import GuardedServer, is_loopback
from viewer.layers import (
    FIRST_FOV,
    Bulb,
    Lamp,
    PageScale,
    draw_camera,
    draw_ground,
    draw_lamp,
    draw_light,
    draw_mesh,
    first_view,
    light_position,
    page_scale,
)
from viewer.relighting import RelightWorker, lamp_light, nearest_light, renderers

POLL_S = 0.5  # how often the folder is looked at: the growing mesh is written every two seconds


class Page:
    """One run folder in one viser server. `refresh` is called by one thread; the controls call in from others."""

    def __init__(self, run_dir: Path, server: viser.ViserServer):
        """Lay the page out; nothing is read before `refresh`."""
        self.follower = RunFollower(run_dir)
        self.server = server
        self.is_over = False
        self.controls = Controls(
            server, run_dir.resolve().name, Actions(self.choose_photo, self._change_brightness, self._show_layers)
        )
        self._lock = threading.RLock()
        self._calibration: Calibration | None = None
        self._scale = PageScale(1.0, np.zeros(3))
        self._bulbs: list[Bulb] = []
        self._ground: list[viser.SceneNodeHandle] = []
        self._frustum: viser.CameraFrustumHandle | None = None
        self._mesh: viser.GlbHandle | None = None
        self._size = self._mesh_name = ""
        self.problem = ""  # with a file of this run, in words
        self._lamp: Lamp | None = None
        self._worker: RelightWorker | None = None
        self._awaits_thumbnail = False
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        server.scene.configure_default_lights(True, cast_shadow=False)

    def refresh(self) -> None:
        """Look at the folder once and show what is new."""
        with self._lock:
            lines = self.follower.log()
            try:
                self._read_results(lines)
            except UserError as error:  # a damaged file: the page stays, and says so
                self.problem = str(error)
            if self._awaits_thumbnail:
                self._show_photo(self.controls.photo_index())
            self._show_progress(lines)

    def _read_results(self, lines: list[dict[str, Any]]) -> None:
        if self.follower.changed("calibration.json"):
            self._show_calibration()
        name = self.follower.mesh_name(lines)
        if self._calibration and name and (self.follower.changed(name) or name != self._mesh_name):
            self._show_mesh(name)
        if self._calibration and self.follower.changed("fields.safetensors"):
            self._start_relighting(self._calibration, load_fields(self.follower.path / "fields.safetensors"))

    def close(self) -> None:
        """End the rendering thread."""
        if self._worker is not None:
            self._worker.close()

    # --- following the folder ----------------------------------------------------------------------------------------

    def _show_progress(self, lines: list[dict[str, Any]]) -> None:
        now = status(lines, self.follower.is_running())
        self.is_over = now.is_over
        self.controls.show_status(now, self.problem or self._size)
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
        self.controls.show_photos(len(calibration.lights))
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
        size = f"{size_in_words(mesh.extents, self._calibration.unit)} · {len(mesh.faces):,} faces"
        self._size = size if name == "mesh.ply" else ""

    # --- what the controls do ----------------------------------------------------------------------------------------

    def choose_photo(self, index: int) -> None:
        """Look at this photo, and hang the lamp where its light was."""
        with self._lock:
            self._show_photo(index)
            if self._lamp is not None:
                self._lamp.handle.position = light_position(self._bulbs[index].light, self._scale)
                self._request_relit()

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
        self.controls.show_photo(light.photo, "" if light.used else f"not used: {light.reason}", picture)

    def _show_layers(self) -> None:
        """Apply the switches of what is shown."""
        shows = self.controls.shows
        for bulb in self._bulbs:
            bulb.show(shows("Lights"), shows("Uncertainty"))
        for node, name in [(self._frustum, "Camera"), (self._mesh, "Surface"), *((g, "Ground") for g in self._ground)]:
            if node is not None:
                node.visible = shows(name)
        if self._lamp is not None:
            self._lamp.show(shows("Your lamp"))

    # --- relighting --------------------------------------------------------------------------------------------------

    def lamp_position(self) -> Float[np.ndarray, "3"] | None:
        """Where the lamp hangs, page units; None while there is none."""
        return None if self._lamp is None else np.asarray(self._lamp.handle.position, dtype=np.float64)

    def _start_relighting(self, calibration: Calibration, fields: Fields) -> None:
        """Compute pictures from these fields; hang up the lamp, the first time where the chosen photo's light was."""
        self.close()
        self._worker = RelightWorker(renderers(fields, calibration), self.controls.show_relit)
        if self._lamp is None:
            index = self.controls.photo_index()
            place = light_position(calibration.lights[index], self._scale)
            self._lamp = draw_lamp(self.server, place, self._scale.factor * calibration.ground_height)
            self._lamp.handle.on_update(lambda _: self._lamp_dragged())
            self.controls.show_relighting()
            self._show_photo(index)
            self._show_layers()
        self._request_relit()

    def _lamp_dragged(self) -> None:
        """Ask for the lamp's picture, and look at the photo whose light was nearest to it."""
        light = self._request_relit()
        if light is None or self._calibration is None:
            return
        index = nearest_light(self._calibration, light)
        with self._lock:
            if index != self.controls.photo_index():
                self.controls.set_photo(index)
                self._show_photo(index)

    def _change_brightness(self) -> None:
        self._request_relit()

    def _request_relit(self) -> Light | None:
        """Ask for the picture of the lamp where it hangs now; returns at once."""
        place = self.lamp_position()
        if place is None or self._worker is None or self._calibration is None:
            return None
        light = lamp_light(self._calibration, self._scale, place, self.controls.brightness())
        self._worker.request(light)
        return light


def view(
    run_dir: Path,
    host: str = "127.0.0.1",
    port: int = 8080,
    once: bool = False,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the page of a run folder until Ctrl-C, or, with `once`, until the run is over.

    Args:
        run_dir: a run's folder; it may still be empty.
        host: 127.0.0.1 unless others are meant to see and move the page: there is no password.
        port: the next free one is taken where this one is busy.
        say: told the address, once it is known.

    Raises:
        UserError: there is no such folder.
    """
    if not Path(run_dir).is_dir():
        raise UserError(f"{run_dir} is not a folder; the folder of a run was needed (the --out of `shadowgraph run`).")
    server = GuardedServer(host, port)
    page = Page(Path(run_dir), server)
    for line in address_lines(host, server.get_port()):
        say(line)
    try:
        while not (once and page.is_over):
            page.refresh()
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        say("Page closed.")
    finally:
        page.close()
        server.stop()


def address_lines(host: str, port: int) -> list[str]:
    """What to open, here and from another machine, in words."""
    if is_loopback(host):
        return [
            f"Open http://localhost:{port}",
            f"From another machine: ssh -L {port}:localhost:{port} {getpass.getuser()}@{socket.gethostname()}, "
            f"then open http://localhost:{port} there",
        ]
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    return [
        f"Open http://{name}:{port}",
        f"Warning: --host {host} lets everybody who can reach this machine see and move this page; it has no password.",
    ]
