"""The tab "Light": a lamp to drag, and the picture that our own renderer computes for it."""

import threading
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from calibration.light import Light
from capture.photo import encode_srgb
from reconstruct.relight import relight
from reconstruct.view import View
from viewer.layers import Lamp, draw_lamp, light_position
from viewer.panel import Desk, Edit, Map, Shown
from viewer.picture_panel import MUTED
from viewer.pictures import Picture
from viewer.relighting import RelightWorker, lamp_light, nearest_light, views
from viewer.result import Result


class LightPanel:
    """Lamp, its controls, and the thread that computes its picture."""

    def __init__(self, desk: Desk):
        """Lay the controls out."""
        self._desk = desk
        self._lock = threading.RLock()
        self._result: Result | None = None
        self._worker: RelightWorker | None = None
        self._lamp: Lamp | None = None
        self._edit: Edit | None = None
        self._map: Map | None = None
        self._map_name = ""
        gui = desk.server.gui
        with desk.tab:
            gui.add_html(
                f'<div style="padding:.2rem .75rem .4rem;{MUTED}">Drag the arrows of the lamp in the 3D view: the '
                "picture on the left is computed for it, cast shadows included.</div>"
            )
            self._brightness = gui.add_slider("Brightness", 0.1, 3.0, 0.05, 1.0, hint="1 = as the flashlight")
        self._brightness.on_update(lambda _: self._ask())

    def show(self, result: Result) -> None:
        """Compute pictures of this result; hang up the lamp, the first time where the first light was."""
        self.close()
        with self._lock:
            self._result = result
            self._worker = RelightWorker([self._renderer(v) for v in views(result.fields)], self._publish)
            if self._lamp is None:
                calibration, scale = result.calibration, result.scale
                place = light_position(calibration.lights[0], scale)
                self._lamp = draw_lamp(self._desk.server, place, scale.factor * calibration.ground_height)
                self._lamp.handle.on_update(lambda _: self._lamp_dragged())
            self._request()

    def close(self) -> None:
        """End the rendering thread."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.close()

    # --- for the other panels and the page ---------------------------------------------------------------------------

    def set_edit(self, edit: Edit | None) -> None:
        """Compute the picture with other materials; None: as they were recovered."""
        self._edit = edit
        self._request()

    def set_map(self, name: str, a_map: Map | None) -> None:
        """Show a map of the surface in the picture's place; None: the lit picture again."""
        self._map_name, self._map = name, a_map
        self._request()

    def shown(self) -> Shown | None:
        """What the computed picture shows now."""
        light, result = self._light(), self._result
        if light is None or result is None:
            return None
        fields, calibration = result.fields, result.calibration
        return Shown(
            fields.camera,
            fields.world_from_camera,
            self._edit or _unchanged,
            lambda view: relight(view, light, calibration.lobe, calibration.ambient).numpy(),
        )

    def hang_at(self, index: int) -> None:
        """Hang the lamp where this photo's light was."""
        if self._lamp is not None and self._result is not None:
            self._lamp.handle.position = light_position(self._result.calibration.lights[index], self._result.scale)
            self._request()

    def show_lamp(self, is_shown: bool) -> None:
        """Show the lamp in the scene, and let it light the mesh there."""
        if self._lamp is not None:
            self._lamp.show(is_shown)

    def lamp_position(self) -> Float[np.ndarray, "3"] | None:
        """Where the lamp hangs, page units; None while there is none."""
        return None if self._lamp is None else np.asarray(self._lamp.handle.position, dtype=np.float64)

    # --- rendering ---------------------------------------------------------------------------------------------------

    def _renderer(self, view: View) -> Callable[[Light], Picture]:
        def picture(light: Light) -> Picture:
            edit, a_map = self._edit or _unchanged, self._map
            if a_map is not None:
                return a_map(edit(view), light)
            assert self._result is not None
            calibration = self._result.calibration
            return encode_srgb(relight(edit(view), light, calibration.lobe, calibration.ambient).numpy())

        return picture

    def _publish(self, picture: Picture, is_final: bool) -> None:
        self._desk.pictures.show_computed(picture, is_final, self._map_name if self._map else "Computed")

    def _lamp_dragged(self) -> None:
        """Ask for the lamp's picture, and look at the photo whose light was nearest to it."""
        light = self._request()
        if light is not None and self._result is not None:
            self._desk.look_at_photo(nearest_light(self._result.calibration, light))

    def _light(self) -> Light | None:
        place = self.lamp_position()
        if place is None or self._result is None:
            return None
        return lamp_light(self._result.calibration, self._result.scale, place, float(self._brightness.value))

    def _ask(self) -> None:
        self._request()

    def _request(self) -> Light | None:
        """Ask for the picture of the lamp where it hangs now; returns at once."""
        light, worker = self._light(), self._worker
        if light is not None and worker is not None:
            worker.request(light)
        return light


def _unchanged(view: View) -> View:
    return view
