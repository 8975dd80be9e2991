"""RelightWorker: computes pictures of the newest request, a quick one at once and better ones afterwards."""

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from calibration.camera import Camera
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from reconstruct.detail.file import Detail
from reconstruct.detail.sample import with_detail
from reconstruct.fields import Fields
from reconstruct.render.g_buffer import RenderView, SeenMaterial, look_steps
from viewer.display.pictures import Picture
from viewer.relighting.lighting import Lighting, Linear, Quality
from viewer.widgets.panel import ViewEdit

QUICK_WIDTHS = (200, 400)  # px: the first within 0.1 s, the second within 0.3 s on two cores
WIDEST = 1600  # px of a full picture
REST_S = 0.35  # after a visitor holds still for this long, the full picture is computed
VIEWS_KEPT = 3  # two quick ones and the full one


@dataclass(frozen=True)
class Viewpoint:
    """A camera and its pose, to compute a picture from."""

    camera: Camera
    world_from_camera: Pose

    def resized(self, width: int) -> Camera:
        """Return the camera for a picture of this width."""
        return self.camera.resized(width, max(1, round(self.camera.height * width / self.camera.width)))


@dataclass(frozen=True)
class Rendering:
    """One picture of a job."""

    picture: Picture
    is_final: bool
    view: RenderView  # what it shows
    place: Viewpoint  # from where


Draw = Callable[[RenderView, Linear, Camera, Viewpoint], Picture]
Job = Callable[[], Iterator[Rendering | float | None]]  # None: more is coming; a number: after resting this long, s


class RelightWorker:
    """One thread that does the newest job. Older jobs that wait are dropped.

    Jobs are iterators: after everything they yield, a newer job takes over.
    """

    def __init__(self, publish: Callable[[Rendering], None]):
        """Start the thread.

        Args:
            publish: called in this thread with each picture.
        """
        self._publish = publish
        self._wanted: Job | None = None
        self._news = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def request(self, job: Job) -> None:
        """Do this job instead of any earlier one. Returns at once."""
        with self._news:
            self._wanted = job
            self._news.notify()

    def close(self) -> None:
        """End the thread after the part it is working on."""
        with self._news:
            self._is_closed = True
            self._news.notify()
        self._thread.join()

    def _work(self) -> None:
        while (job := self._next()) is not None:
            for step in job():
                if isinstance(step, Rendering):
                    self._publish(step)
                if self._has_newer_within(step if isinstance(step, float) else 0.0):
                    break

    def _next(self) -> Job | None:
        with self._news:
            self._news.wait_for(self._has_news)
            job, self._wanted = self._wanted, None
            return None if self._is_closed else job

    def _has_newer_within(self, seconds: float) -> bool:
        with self._news:
            return self._news.wait_for(self._has_news, timeout=seconds)

    def _has_news(self) -> bool:
        return self._wanted is not None or self._is_closed


class ViewCache:
    """Views of a solved scene, kept by viewpoint and width, with the photos' full detail where the run has it."""

    def __init__(self, fields: Fields, material: SeenMaterial, details: Sequence[Detail] = ()):
        """Compute nothing yet."""
        self._fields, self._material, self._details = fields, material, details
        self._kept: list[tuple[Viewpoint, int, RenderView]] = []

    def steps(self, place: Viewpoint, width: int) -> Iterator[RenderView | None]:
        """Yield None while there is more to do, and the view at the end."""
        for known, known_width, view in self._kept:
            if known is place and known_width == width:
                yield view
                return
        camera = place.resized(width)
        posed_camera = PosedCamera(camera, place.world_from_camera, self._fields.ground_height)
        for view in look_steps(self._fields, posed_camera, self._material):
            if view is not None:
                view = with_detail(view, self._details, camera)
                self._kept = [*self._kept, (place, width, view)][-VIEWS_KEPT:]
            yield view


def relit(
    views: ViewCache, place: Viewpoint, lighting: Lighting, edit: ViewEdit, draw: Draw, is_quick: bool = False
) -> Iterator[Rendering | float | None]:
    """Compute pictures from small and quick to full and finest: the steps of a Job.

    Args:
        draw: the picture of a linear one, or of a map in its place.
        is_quick: end with the quick pictures.
    """
    qualities = lighting.qualities()
    full = min(max(place.camera.width, QUICK_WIDTHS[-1]), WIDEST)
    quick = QUICK_WIDTHS if len(qualities) > 1 else QUICK_WIDTHS[-1:]  # few rays need no smaller picture first
    better = [(full, quality) for quality in qualities[1:] or qualities]
    ladder = [*((width, Quality.QUICK) for width in quick), *([] if is_quick else better)]
    for number, (width, quality) in enumerate(ladder):
        if number == len(quick):
            yield REST_S
        view = None
        for view in views.steps(place, width):
            if view is None:
                yield None
        assert view is not None
        edited = edit(view)
        for linear in lighting.steps(edited, quality):
            if linear is None:
                yield None
            else:
                yield Rendering(
                    draw(edited, linear, place.resized(width), place), number == len(ladder) - 1, view, place
                )
