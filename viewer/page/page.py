"""The page: it reads a run folder and follows it while it grows, in a process beside the run's.

A run without a browser has no cost for it, a page that fails does not stop the run, and a page opened late shows the
results so far. What is done with a finished run is the stage's (viewer/stage), to which the page leads.
"""

import math
import threading
import time
from pathlib import Path

import numpy as np
import viser

from calibration.calibrated_views import CalibratedView, load_views
from calibration.calibration import Calibration
from capture.errors import UserError
from reconstruct.stored_run.maps import THUMBS
from reconstruct.stored_run.ply import read_preview
from reconstruct.stored_run.stored_run import CALIBRATION
from viewer.display.layers import (
    FIRST_FOV,
    Host,
    LampMarker,
    LightMarker,
    PageScale,
    draw_camera,
    draw_ground,
    draw_hull,
    draw_lamp,
    draw_light,
    draw_mesh,
    first_view,
    light_position,
    light_room,
    page_scale,
)
from viewer.display.run_follower import HULL, PREVIEW, RunFollower, status
from viewer.page.controls import Controls
from viewer.stage.page import is_finished

MIN_INTERVAL_S = 2.0  # as often as a run writes its growing mesh, and as a visitor can follow
COST_FACTOR = 25.0  # times what the last sending cost: at most a 25th of one processor, 4 % of a run that uses one


class Page:
    """Shows one run folder in one browser. One thread calls `refresh`; the controls call from others."""

    def __init__(self, run_dir: Path, host: Host, camera: viser.CameraHandle | None = None):
        """Lay the page out; `refresh` reads the folder.

        Args:
            camera: of the browser, to show it lights and object; None: it looks where it likes.
        """
        self.follower = RunFollower(run_dir)
        self.host, self._camera = host, camera
        self.is_over = False
        self.controls = Controls(host, run_dir, self._show_layers, self.choose_photo)
        self.problem = ""  # a sentence about a damaged file of this run
        self._sent, self._cpu_s = -math.inf, 0.0  # clock and CPU seconds when the surface was sent last
        self._cost_s: float | None = 0.0  # CPU seconds that it took; None: not asked since
        self._lock = threading.RLock()
        self._calibration: Calibration | None = None
        self._scale = PageScale(1.0, np.zeros(3))
        self._lights: list[LightMarker] = []
        self._ground: list[viser.SceneNodeHandle] = []
        self._cameras: list[viser.CameraFrustumHandle] = []  # of each view; the first shows the chosen photo
        self._mesh: viser.GlbHandle | viser.MeshHandle | None = None
        self._hull: viser.MeshHandle | None = None
        self._lamp: LampMarker | None = None
        self._awaits_thumbnail = False
        host.scene.set_up_direction("+z")
        host.scene.configure_environment_map(None)
        light_room(host, has_lamp=False)

    def poll(self) -> None:
        """Look for changes in the folder, and `refresh` if there are any. It can be called at any rate.

        A run that is not over is looked at now and then all the same: one that is killed changes nothing.
        """
        if self.follower.has_news() or (self._is_due() and not self.is_over):
            self.refresh()

    def _is_due(self) -> bool:
        """Return whether the surface, which costs much, may be sent: a run beside this keeps the processor.

        The cost of a sending is the CPU time of the whole process until this is asked: other threads do it.
        """
        if self._cost_s is None:
            self._cost_s = time.process_time() - self._cpu_s
        return time.monotonic() - self._sent >= max(MIN_INTERVAL_S, COST_FACTOR * self._cost_s)

    def refresh(self) -> None:
        """Read the folder once and show what is new."""
        with self._lock:
            lines = self.follower.log()
            now = status(lines, self.follower.is_running(), self.follower.since_last_line_s())
            self.is_over = now.is_over
            try:
                self._read_results()
            except UserError as error:  # a damaged file: the page shows this and goes on
                self.problem = str(error)
            if self._awaits_thumbnail:
                self._show_photo(self.controls.photo_index())
            elif self._calibration is None and self.follower.changed(THUMBS):
                self._show_read_photo()
            self.controls.follow(now, lines, self.problem, now.is_finished and is_finished(self.follower.path))

    def _read_results(self) -> None:
        if self.follower.changed(CALIBRATION):
            self._show_calibration()
        if self._calibration and (self.is_over or self._is_due()) and self.follower.changed(PREVIEW):
            self._sent, self._cpu_s, self._cost_s = time.monotonic(), time.process_time(), None
            self._show_mesh(self._calibration)
        if self._calibration and self.follower.changed(HULL):
            hull = read_preview(self.follower.path / HULL)
            if hull is not None:
                self._hull = draw_hull(self.host, hull, self._scale, self.controls.shows("Shadow hull"))

    # --- following the folder ----------------------------------------------------------------------------------------

    def _show_calibration(self) -> None:
        first, *further = load_views(self.follower.path / CALIBRATION).views
        calibration = first.calibration
        self._calibration, self._scale = calibration, page_scale(calibration)
        with self.host.atomic():
            for node in (*self._lights, *self._cameras):
                node.remove()
            self._ground = draw_ground(self.host, calibration, self._scale)
            self._cameras = [draw_camera(self.host, calibration, self._scale)]
            self._cameras += [self._draw_further(i, view) for i, view in enumerate(further, start=1)]
            self._lights = [draw_light(self.host, i, lt, self._scale) for i, lt in enumerate(calibration.lights)]
            self._look(*first_view(calibration, self._scale))
            self._show_layers()
        self._show_photo(0)

    def _draw_further(self, number: int, view: CalibratedView) -> viser.CameraFrustumHandle:
        """Draw the camera of a further view, with one of its photos."""
        frustum = draw_camera(self.host, view.calibration, self._scale, number)
        used = [light.photo for light in view.calibration.lights if light.used]
        if used:
            frustum.image = self.follower.thumbnail(f"{view.name}/{used[len(used) // 2]}")
        return frustum

    def _look(self, place: np.ndarray, target: np.ndarray) -> None:
        if self._camera is not None:
            self._camera.position, self._camera.look_at, self._camera.fov = place, target, FIRST_FOV

    def _show_mesh(self, calibration: Calibration) -> None:
        mesh = read_preview(self.follower.path / PREVIEW)
        if mesh is None:
            return
        self._mesh = draw_mesh(self.host, mesh, self._scale, self.controls.shows("Surface"))
        if self._lamp is None:
            self._lamp = draw_lamp(self.host, np.zeros(3), self._scale.factor * calibration.ground_height)
            self._move_lamp(self.controls.photo_index())
        self._show_layers()

    # --- what the controls do ----------------------------------------------------------------------------------------

    def choose_photo(self, index: int) -> None:
        """Show this photo, and move the lamp to where its light was."""
        with self._lock:
            self._show_photo(index)
            self._move_lamp(index)

    def _move_lamp(self, index: int) -> None:
        if self._lamp is not None and index < len(self._lights):
            self._lamp.handle.position = light_position(self._lights[index].light, self._scale)

    def _show_photo(self, index: int) -> None:
        """Show this photo in the camera's frustum and among the controls, and mark its light."""
        if self._calibration is None:
            self._show_read_photo(index)
        if index >= len(self._lights):
            return
        light = self._lights[index].light
        picture = self.follower.thumbnail(light.photo)
        self._awaits_thumbnail = picture is None
        with self.host.atomic():
            for i, light_node in enumerate(self._lights):
                light_node.choose(i == index)
            self._cameras[0].image = picture
            words = light.photo if light.used else f"{light.photo}, not used: {light.reason}"
            self.controls.show_photo(index, len(self._lights), words, picture)

    def _show_read_photo(self, index: int = -1) -> None:
        """Show how many photos have been read so far, and one of them: the newest unless told."""
        names = self.follower.thumbnails()
        if names:
            index %= len(names)
            self.controls.show_photo(index, len(names), names[index], self.follower.thumbnail(names[index]))

    def _show_layers(self) -> None:
        """Show and hide the layers according to their switches."""
        shows = self.controls.shows
        for light_node in self._lights:
            light_node.show(shows("Lights"), shows("Uncertainty"))
        layers = [(self._mesh, "Surface"), (self._hull, "Shadow hull")]
        for node, name in [*layers, *((c, "Camera") for c in self._cameras), *((g, "Ground") for g in self._ground)]:
            if node is not None:
                node.visible = shows(name)
        if self._lamp is not None:
            self._lamp.show(shows("Your lamp"))
