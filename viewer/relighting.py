"""The picture that a lamp at some place would make, computed beside the page: a small one at once, then a full one."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from calibration.light import Light
from calibration.result import Calibration
from reconstruct.fields import Fields
from reconstruct.view import View, look
from viewer.layers import PageScale, light_position
from viewer.pictures import Picture

SMALL_WIDTH = 160  # px: a few hundredths of a second on two cores, so that it follows the hand
FULL_WIDTHS = (400, 800)  # px: as wide as the panel it is shown in, at most twice that
SAME_PLACE = 1e-4  # page units: the page sends places as float32
REST_S = 0.35  # a hand that holds still for this long waits for the full picture


class RelightWorker:
    """One thread that renders the newest request and forgets the ones in between.

    For each request it publishes a small picture, then, unless something newer was asked within REST_S, the full one.
    """

    def __init__(self, renderers: Sequence[Callable[[Light], Picture]], publish: Callable[[Picture, bool], None]):
        """Start the thread.

        Args:
            renderers: the picture for a light, from the quickest to the final one.
            publish: called in this thread with a picture and whether it is the final one for its light.
        """
        self._renderers, self._publish = tuple(renderers), publish
        self._wanted: Light | None = None
        self._news = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def request(self, light: Light) -> None:
        """Ask for this light's picture instead of any asked before. Returns at once."""
        with self._news:
            self._wanted = light
            self._news.notify()

    def close(self) -> None:
        """End the thread after the picture it is working on."""
        with self._news:
            self._is_closed = True
            self._news.notify()
        self._thread.join()

    def _work(self) -> None:
        while (light := self._next()) is not None:
            for step, render in enumerate(self._renderers):
                if step and self._has_newer_within(REST_S):
                    break
                self._publish(render(light), step == len(self._renderers) - 1)

    def _next(self) -> Light | None:
        with self._news:
            self._news.wait_for(self._has_news)
            light, self._wanted = self._wanted, None
            return None if self._is_closed else light

    def _has_newer_within(self, seconds: float) -> bool:
        with self._news:
            return self._news.wait_for(self._has_news, timeout=seconds)

    def _has_news(self) -> bool:
        return self._wanted is not None or self._is_closed


def views(fields: Fields) -> list[View]:
    """The scene as the capture camera sees it: small for a quick picture, and full; looked up here, once."""
    return [look(fields, width) for width in (SMALL_WIDTH, int(np.clip(fields.camera.width, *FULL_WIDTHS)))]


def lamp_light(
    calibration: Calibration, scale: PageScale, place: Float[np.ndarray, "3"], brightness: float = 1.0
) -> Light:
    """The light of a lamp hung at `place` on the page: of the capture's kind and typical power, aimed at the middle.

    Where a light of the capture was, it is that light, so that the picture can be compared with the photo.

    Args:
        place: page units.
        brightness: times the power.
    """
    for light in calibration.lights:
        if light.used and np.allclose(light_position(light, scale), place, rtol=0, atol=SAME_PLACE):
            return replace(light, power=brightness * light.power)
    used = [light for light in calibration.lights if light.used] or list(calibration.lights)
    power = brightness * np.median([light.power for light in used], axis=0)
    towards = scale.centre - scale.to_world(place)
    towards = towards / np.linalg.norm(towards)
    if used[0].kind == "directional":
        return Light("", "directional", direction=-towards, power=power)
    axis = towards if any(light.axis is not None for light in used) else None
    return Light("", "point", position=scale.to_world(place), power=power, axis=axis)


def nearest_light(calibration: Calibration, light: Light) -> int:
    """The index of the used light closest to `light`: by distance, or by angle for directions."""
    ours = light.homogeneous()[:3]
    places = np.array([other.homogeneous()[:3] for other in calibration.lights])
    unused = np.array([not other.used for other in calibration.lights])
    return int(np.argmin(np.linalg.norm(places - ours, axis=1) + np.where(unused, np.inf, 0.0)))
