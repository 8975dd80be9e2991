"""The tab "Light": a lamp to drag or surroundings to turn, and the pictures that are computed for them."""

import threading
from collections.abc import Iterator
from functools import partial
from pathlib import PurePath

import numpy as np
import viser
from jaxtyping import Float

from calibration.camera import Camera
from calibration.light import Light
from capture.decode.panorama import read_panorama
from capture.errors import UserError
from capture.photos.photo import encode_srgb
from reconstruct.render.environment import SKIES, Sky, exposed, sky_map
from reconstruct.render.g_buffer import RenderView, seen_material
from viewer.display.layers import CAMERA_DISTANCE, LampMarker, draw_lamp, light_position
from viewer.display.pictures import Picture
from viewer.display.result import Result
from viewer.panels.backdrop import Backdrop
from viewer.panels.light_controls import SKY, SUN, LightControls
from viewer.relighting.lighting import (
    LampLighting,
    Lighting,
    Linear,
    SkyLighting,
    angles_of,
    background,
    direction_of,
    far_light,
    lamp_light,
    nearest_light,
)
from viewer.relighting.worker import RelightWorker, Rendering, ViewCache, Viewpoint, relit
from viewer.widgets.legend import remark
from viewer.widgets.panel import PanelContext

LARGEST_LAMP = 0.12  # radius of the largest lamp over the camera's distance: half an angle of 7 degrees
STILL_S = 0.15  # a moving visitor gets no pictures of earlier viewpoints
MOST_SKIES = 24  # 1.5 MB each
NAME_SHOWN = 24  # characters of a visitor's file name


class LightPanel:
    """Lamp, surroundings, their controls, and the thread that computes their pictures."""

    def __init__(self, context: PanelContext, tab: viser.GuiTabHandle):
        """Lay the controls out."""
        self._context = context
        self._lock = threading.RLock()
        self._result: Result | None = None
        self._worker: RelightWorker | None = None
        self._lamp: LampMarker | None = None
        self._shows_lamp = True
        self._direction = direction_of(0.0, 45.0)  # of the far lamp
        self._skies: dict[str, Sky] = {name.capitalize(): exposed(make()) for name, make in SKIES.items()}
        self._controls = LightControls(context.server.gui, tab, self._skies, self._choice_changed, self._sky_uploaded)
        self._backdrop = Backdrop(context.server, partial(self._request, only_here=True))
        context.content.changed.connect(lambda _: self._request())
        context.photo_chosen.connect(self.move_lamp_to_photo)
        context.lamp_shown.connect(self.show_lamp)

    def show(self, result: Result) -> None:
        """Compute pictures of this result. The first time, put the lamp where the light of the chosen photo was."""
        self.close()
        material = seen_material(result.fields)
        with self._lock:
            self._result = result
            self._place = Viewpoint(result.fields.camera, result.fields.world_from_camera)
            self._views, self._free_views = (ViewCache(result.fields, material, result.details) for _ in range(2))
            self._worker = RelightWorker(self._publish)
            if self._lamp is None:
                if result.calibration.lights[0].position is None:
                    self._controls.set_kind(SUN)
                floor = result.scale.factor * result.calibration.ground_height
                self._lamp = draw_lamp(self._context.server, np.zeros(3), floor)
                self._lamp.handle.on_update(lambda _: self._lamp_dragged())
                self.move_lamp_to_photo(self._context.pictures.photo_index())
        self._choice_changed()

    def close(self) -> None:
        """End the rendering thread."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.close()

    # --- the lamp ----------------------------------------------------------------------------------------------------

    def move_lamp_to_photo(self, index: int) -> None:
        """Move the lamp to where this photo's light was."""
        if self._result is not None:
            light = self._result.calibration.lights[index]
            place = light_position(light, self._result.scale)
            self._direction = self._direction_from_centre(place) if light.direction is None else light.direction
            self._move_lamp(place)
            self._request()

    def show_lamp(self, is_shown: bool) -> None:
        """Show or hide the lamp in the scene, where it lights the mesh too. Surroundings hide it."""
        self._shows_lamp = is_shown
        if self._lamp is not None:
            self._lamp.show(is_shown and self._controls.choice().kind != SKY)

    def lamp_position(self) -> Float[np.ndarray, "3"] | None:
        """Return the lamp's position, page units; None while there is none."""
        return None if self._lamp is None else np.asarray(self._lamp.handle.position, dtype=np.float64)

    # --- what visitors do --------------------------------------------------------------------------------------------

    def _choice_changed(self) -> None:
        choice = self._controls.choice()
        if choice.kind == SUN and angles_of(self._direction) != (choice.azimuth, choice.elevation):
            shown = np.round(angles_of(self._direction))
            if not np.allclose(shown, (choice.azimuth, choice.elevation)):
                self._direction = direction_of(choice.azimuth, choice.elevation)
                self._move_lamp(None)
        if self._lamp is not None and self._result is not None:
            self._lamp.resize(choice.size * LARGEST_LAMP * CAMERA_DISTANCE)
        self.show_lamp(self._shows_lamp)
        self._backdrop.follow(choice.from_here)
        self._request()

    def _lamp_dragged(self) -> None:
        """Ask for the lamp's picture, and look at the photo whose light was nearest to it."""
        place, result = self.lamp_position(), self._result
        if place is None or result is None:
            return
        self._direction = self._direction_from_centre(place)
        self._controls.set_angles(*angles_of(self._direction))
        self._request()
        light = self._light()
        if light is not None:
            self._context.look_at_photo(nearest_light(result.calibration, light, result.scale))

    def _sky_uploaded(self, name: str, content: bytes) -> None:
        """Offer a visitor's panorama; what is wrong with it is said under the controls."""
        shown = PurePath(name).stem[:NAME_SHOWN] or "Your map"
        if len(self._skies) >= MOST_SKIES and shown not in self._skies:
            self._controls.say(remark(f"{MOST_SKIES} maps are kept at most; open the page's command again for others."))
            return
        try:
            self._skies[shown] = sky_map(read_panorama(content, shown))
        except UserError as error:
            self._controls.say(remark(str(error)))
            return
        self._controls.add_sky(shown)
        self._request()

    def _move_lamp(self, place: Float[np.ndarray, "3"] | None) -> None:
        """Put the lamp at a place of the page; None: far away in its direction."""
        if self._lamp is not None and self._result is not None:
            middle = self._result.scale.to_page(self._result.scale.centre)
            self._lamp.handle.position = middle + CAMERA_DISTANCE * self._direction if place is None else place
            self._controls.set_angles(*angles_of(self._direction))

    def _direction_from_centre(self, place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        assert self._result is not None
        offset = place - self._result.scale.to_page(self._result.scale.centre)
        return offset / np.linalg.norm(offset)

    # --- rendering ---------------------------------------------------------------------------------------------------

    def _light(self) -> Light | None:
        """Return the chosen lamp; None while there is none."""
        place, choice, result = self.lamp_position(), self._controls.choice(), self._result
        if place is None or result is None:
            return None
        if choice.kind == SUN:
            return far_light(result.calibration, result.scale, self._direction, choice.brightness, choice.colour)
        return lamp_light(result.calibration, result.scale, place, choice.brightness, choice.colour)

    def _lighting(self) -> Lighting | None:
        light, choice, result = self._light(), self._controls.choice(), self._result
        if light is None or result is None:
            return None
        if choice.kind == SKY:
            sky = self._skies.get(choice.sky, next(iter(self._skies.values())))  # browsers send what they like
            return SkyLighting(choice.sky, sky, float(np.radians(choice.turn)), choice.brightness)
        reach = choice.size * LARGEST_LAMP
        if light.position is not None:
            reach *= CAMERA_DISTANCE / result.scale.factor
        return LampLighting(light, reach, result.calibration)

    def _request(self, only_here: bool = False) -> None:
        """Ask for the picture of the light as it is now; returns at once."""
        worker, lighting, light, result = self._worker, self._lighting(), self._light(), self._result
        if worker is not None and lighting is not None and light is not None and result is not None:
            here = self._backdrop.place(result.scale) if self._controls.choice().from_here else None
            worker.request(partial(self._renderings, lighting, light, here, only_here))

    def _renderings(
        self, lighting: Lighting, light: Light, here: Viewpoint | None, only_here: bool
    ) -> Iterator[Rendering | float | None]:
        """Yield the pictures of one request: from the camera, then, if requested, from the visitor's viewpoint."""
        edit, surface_map = self._context.content.edit or _unchanged, self._context.content.map

        def draw(view: RenderView, linear: Linear, camera: Camera, place: Viewpoint) -> Picture:
            if surface_map is not None:
                return surface_map(view, light)
            nothing = ~np.isfinite(view.maps.depth.numpy())
            if place is here and nothing.any():
                along = place.world_from_camera.rotate(camera.unproject(camera.pixel_grid()[nothing]))
                linear[nothing] = background(lighting, along)
            return encode_srgb(linear)

        if not only_here:
            yield from relit(self._views, self._place, lighting, edit, draw, is_quick=here is not None)
        if here is not None:
            yield STILL_S if only_here else None
            yield from relit(self._free_views, here, lighting, edit, draw)

    def _publish(self, rendering: Rendering) -> None:
        if rendering.place is self._place:
            content = self._context.content
            title = "Computed" if content.map is None else content.map_name
            self._context.pictures.show_computed(rendering.picture, rendering.is_final, title)
        elif self._result is not None:
            self._backdrop.show(rendering, self._result.scale)


def _unchanged(view: RenderView) -> RenderView:
    return view
