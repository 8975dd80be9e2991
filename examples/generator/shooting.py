"""Render the photos under the flashlight, those of the phone that holds it, and those without it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.errors import CaptureError

from . import hand, poses, truth
from .paint import PAPER
from .photo_file import DARK_ISO, ROOM_ISO, PhotoFile, developed, write_photo
from .pipeline import Picture
from .rendering import Guide, Stage, flash, guide, plain_room, room
from .sheet import lay

WHITE = 0.8  # pixel value of paper in room light
NOVEL_SEED = 1000  # of the renderer, beyond those of the photos
LIGHT_SEED = 2000
FIRST_NUMBER = 30  # in the order taken
LIGHT_CLOCK_S = 1.37  # by which that phone's clock is ahead
Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Sight:
    """What is the same in all photos of one view: the guide for indirect light, the room light."""

    ready: Stage
    view: poses.Viewpoint

    @cached_property
    def guide(self) -> Guide:
        """The guide for indirect light."""
        return guide(self.ready, self.view)

    @cached_property
    def level(self) -> float:
        """Pixel value per albedo of a sheet that faces the flashlight at mean distance."""
        return self.ready.setup.exposure.exposure / PAPER

    @cached_property
    def intensity(self) -> float:
        """Of the flashlight, in pixel values."""
        return self.level * np.pi * np.mean(self.ready.setup.flashlight.reach) ** 2

    @cached_property
    def ambient(self) -> Picture:
        """The picture without the flashlight."""
        setup = self.ready.setup
        dim = setup.exposure.ambient * self.level
        if dim <= 0:
            camera = self.view.camera
            return np.zeros((camera.height, camera.width, 3), np.float32)
        return dim * room(self.ready, self.view, True, setup.table.board_stays, seed=0)

    def under(self, lamp: poses.Lamp, seed: int) -> Picture:
        """Render the picture under a flashlight, linear."""
        return self.intensity * flash(self.ready, self.view, self.guide, lamp, seed) + self.ambient


@dataclass(frozen=True)
class Place:
    """Where the files of one place of the tripod go, and from which number on its photos count."""

    folder: Path  # with board/ and photos/
    truth: Path
    first: int = 0  # added to the numbers in names, and in the order taken


def take_board(
    folder: Path, ready: Stage, views: dict[str, poses.Viewpoint], first: int, rng: np.random.Generator, say: Say
) -> None:
    """Render photos of the board in room light; the first of a tripod shows the object where both stay.

    Args:
        views: by the names of the photos; the tripod's is the first.
        first: added to the number in the order taken; negative: no photo is the tripod's.
    """
    setup = ready.setup
    with_thing = setup.table.board_stays and not setup.table.on_board
    for number, (name, view) in enumerate(views.items()):
        say(f"board, photo {number + 1} of {len(views)}")
        has_thing = with_thing and number == 0 and first >= 0
        picture = room(ready, view, has_thing=has_thing, has_board=True, seed=number)
        pixels = developed(picture * WHITE / PAPER, setup, rng, ROOM_ISO, name)
        write_photo(PhotoFile(folder / name, max(first, 0) + number), pixels, setup)


def take_photos(out: Place, ready: Stage, fixed: poses.Viewpoint, rng: np.random.Generator, say: Say) -> None:
    """Render the photos under the flashlight, and write their shadows and the other ground truth."""
    setup = ready.setup
    count, novel = setup.flashlight.photos, setup.exposure.novel
    rays, laid = truth.Rays(ready.thing), lay(ready.board, setup)
    seen = truth.seen(rays, fixed, setup, laid)
    if not seen.mask.any():
        raise CaptureError("the camera does not see the object. Change --elevation, --distance or --board-stays.")
    (out.truth / "shadow").mkdir(parents=True, exist_ok=True)
    truth.write_maps(out.truth, seen, rays, fixed, setup)
    views = hand.views(fixed, setup)
    sights = {id(view): Sight(ready, view) for view in (fixed, *views)}
    lamps = hand.held(poses.lamps(setup, count, ready.thing, ready.board, rng), setup)
    entries = []
    for i, (lamp, view) in enumerate(zip(lamps, views, strict=True), 1):
        say(f"photo {i} of {count}")
        name = f"IMG_{out.first + 100 + i:04d}"
        photo = developed(_light(sights[id(view)], lamp, i), setup, rng, DARK_ISO, name)
        write_photo(PhotoFile(out.folder / "photos" / f"{name}.jpg", out.first + FIRST_NUMBER + i), photo, setup)
        cv2.imwrite(str(out.truth / "shadow" / f"{name}.png"), truth.shadow(rays, seen, lamp))
        more = truth.photo_json(photo, lamp, setup)
        entries.append(truth.lamp_json(f"{name}.jpg", lamp) | _verdict(i, view, fixed, ready, out.first) | more)
    truth.write_lights(out.truth, entries, setup, float(sights[id(fixed)].intensity))
    further = poses.lamps(setup, novel, ready.thing, ready.board, rng)
    for i, lamp in enumerate(further, 1):
        say(f"picture under a further light, {i} of {len(further)}")
        picture = sights[id(fixed)].under(lamp, NOVEL_SEED + i)
        truth.write_novel(out.truth / "novel", f"NOVEL_{i:02d}", picture, truth.shadow(rays, seen, lamp))
    if further:
        truth.write_novel_lights(out.truth / "novel", further)
    _take_dark(out, sights[id(views[-1])])
    if setup.further.light_photos:
        take_light_photos(out, ready, lamps, say)


def _light(sight: Sight, lamp: poses.Lamp, photo: int) -> Picture:
    """Return the light of one photo, with what went wrong in it."""
    setup = sight.ready.setup
    if photo in setup.hand.arm:
        mesh, colour = hand.arm(sight.view, sight.ready.thing, setup.stream(f"arm {photo}"))
        sight = Sight(sight.ready.with_arm(mesh, colour), sight.view)
    linear = sight.ambient if photo in setup.hand.no_flash else sight.under(lamp, photo)
    if photo in setup.hand.shaken:
        linear = hand.shaken(linear, sight.view.camera, setup.hand.shaken_px, setup.stream(f"shaken {photo}"))
    return linear


def _verdict(photo: int, view: poses.Viewpoint, fixed: poses.Viewpoint, ready: Stage, first: int) -> dict[str, Any]:
    """Return whether a photo can be used, why not, and its camera where that is not the fixed one."""
    why = hand.fault(ready.setup, photo)
    out: dict[str, Any] = {"usable": why is None} | ({"bad": why} if why else {})
    if photo in ready.setup.hand.twice:
        out["same_place_as"] = f"IMG_{first + 99 + photo:04d}.jpg"
    if view is not fixed and photo not in ready.setup.exposure.moved:
        ahead = ready.thing.bounds.mean(0)[None]
        now, then = (v.camera.project(v.world_from_camera.inverse().apply(ahead))[0] for v in (view, fixed))
        out |= {"camera": truth.view_json(view), "shift_px": (now - then).tolist()}
    return out


def _take_dark(out: Place, sight: Sight) -> None:
    """Render the photos without the flashlight, after all others."""
    setup = sight.ready.setup
    rng, first = setup.stream("noise of dark photos"), FIRST_NUMBER + setup.flashlight.photos + 1
    for i in range(setup.further.dark_photos):
        name = f"IMG_{out.first + 301 + i:04d}"
        photo = developed(sight.ambient, setup, rng, DARK_ISO, name)
        write_photo(PhotoFile(out.folder / "dark" / f"{name}.jpg", out.first + first + i), photo, setup)


def take_light_photos(out: Place, ready: Stage, lamps: list[poses.Lamp], say: Say) -> None:
    """Render what the phone that holds the flashlight sees; it sets its exposure for each photo."""
    setup, camera = ready.setup, poses.light_phone(ready.setup.phone.width)
    rng, hers, taken = setup.stream("noise of light photos"), ready.seen_by(camera), {}
    for i, lamp in enumerate(lamps, 1):
        say(f"photo {i} of {len(lamps)} from the flashlight")
        name, photo = (f"IMG_{out.first + number + i:04d}.jpg" for number in (200, 100))
        view = poses.from_the_light(lamp, camera, setup.stream(f"light {i}"))
        sight = Sight(hers, view)
        if i in setup.hand.no_flash:
            linear = sight.ambient
        else:
            around = setup.exposure.ambient * sight.level * plain_room(hers, sight.guide)
            linear = around + sight.intensity * flash(hers, view, sight.guide, lamp, LIGHT_SEED + i)
        picture = developed(linear, setup, rng, DARK_ISO, name, metering=1.0)
        file = PhotoFile(
            out.folder / "light" / name,
            out.first + FIRST_NUMBER + i,
            "Simulated flashlight phone",
            poses.LIGHT_PHONE_FOCAL,
            LIGHT_CLOCK_S,
        )
        write_photo(file, picture, setup)
        taken[name] = (photo, view, lamp)
    truth.write_light_phone(out.truth, taken, lay(ready.board, setup), LIGHT_CLOCK_S)
