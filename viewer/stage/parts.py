"""The parts of a page, made of a run's results: its mesh, its pictures and tiles; and all of them in one archive."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import UInt8

from calibration.camera import Camera
from calibration.posed_camera import PosedCamera
from capture.errors import CaptureError, UserError
from reconstruct.export.stage_scene import StageScene, detail_pictures, relit_photo, stage_scene
from reconstruct.render.studio import KEY_TURN, Studio, key_light, studio_of
from reconstruct.stored_run.maps import read_thumbnail
from reconstruct.stored_run.stage_pack import stage_archive
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.cameras import lit_photos
from viewer.stage.facts import BACKGROUND, first_window, home_pose, home_view, stage_facts
from viewer.stage.pack import Block, jpeg, packed

QUALITY, NORMAL_QUALITY, PHOTO_QUALITY = 90, 95, 82  # JPEG
TILE = 512  # px
LEAST_GAIN = 1.3  # of the detail over the picture that the page opens with, for tiles to be worth their bytes
MOST_PIXELS = 1 << 24  # of a detail in tiles: what a graphics card holds besides the rest
BLOCK, OBJECT, NORMALS, GROUND, FIRST = "scene.bin", "object.jpg", "normals.jpg", "ground.jpg", "first.jpg"
FIRST_SIDE, FIRST_QUALITY = 400, 80  # px, JPEG


class StageParts:
    """The parts of one run's page by their names; the mesh and the pictures are made once, at the first request."""

    def __init__(self, run: StoredRun):
        """Read nothing yet."""
        self.run = run
        self._held: dict[str, bytes] = {}

    @cached_property
    def studio(self) -> Studio:
        """Middle and radius of the object."""
        return studio_of(np.asarray(self.run.mesh.bounds))

    @cached_property
    def scene(self) -> StageScene:
        """What the page draws."""
        return stage_scene(self.run)

    @cached_property
    def _block(self) -> Block:
        return packed(self.scene, self.studio.centre, self.studio.radius)

    @cached_property
    def _details(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]] | None:
        """Albedo and normals on the photo's own pixels, or None where that is no finer than what the page has."""
        detail = self.run.detail
        if detail is None:
            return None
        longer = max(detail.confidence.shape)
        if longer < LEAST_GAIN * max(self.scene.object_picture.shape) or detail.confidence.size > MOST_PIXELS:
            return None
        return detail_pictures(detail)

    @cached_property
    def _makers(self) -> dict[str, Callable[[], bytes]]:
        scene = self.scene
        makers: dict[str, Callable[[], bytes]] = {
            BLOCK: lambda: self._block.content,
            OBJECT: lambda: jpeg(scene.object_picture, QUALITY),
            GROUND: lambda: jpeg(scene.ground_picture, QUALITY),
            FIRST: lambda: jpeg(self._first(), FIRST_QUALITY),
        }
        normals = scene.normal_picture
        if normals is not None:
            makers[NORMALS] = lambda: jpeg(normals, NORMAL_QUALITY, is_exact=True)
        for i, photo in enumerate(self._photos):
            makers[f"photo{i}.jpg"] = lambda photo=photo: self._photo(photo)
        for row, column in self._tiles:
            for kind in range(2):
                makers[_tile_name(kind, row, column)] = lambda place=(kind, row, column): self._tile(*place)
        return makers

    @cached_property
    def _photos(self) -> list[str]:
        """Photos that have a small copy, in the order of their lights."""
        found: list[str] = []
        try:
            photos = lit_photos(self.run)
        except UserError:
            return found
        for photo in dict.fromkeys(name for name, *_ in photos):
            try:
                read_thumbnail(self.run.run_dir, photo)
            except (OSError, CaptureError):
                continue
            found.append(photo)
        return found

    @cached_property
    def _tiles(self) -> list[tuple[int, int]]:
        if self._details is None:
            return []
        height, width = self._details[0].shape[:2]
        return [(row, column) for row in range(-(-height // TILE)) for column in range(-(-width // TILE))]

    def names(self) -> list[str]:
        """Return the names of all parts."""
        return list(self._makers)

    def get(self, name: str) -> bytes:
        """Return a part.

        Raises:
            KeyError: there is none of this name.
        """
        if name not in self._held:
            self._held[name] = self._makers[name]()
        return self._held[name]

    def facts(self, addresses: Mapping[str, str]) -> dict[str, Any]:
        """Return what the page's scripts read.

        Args:
            addresses: of each of `names`.
        """
        tiles = None
        if self._details is not None:
            height, width = self._details[0].shape[:2]
            places = [[[addresses[_tile_name(kind, row, column)] for row, column in self._tiles] for kind in range(2)]][
                0
            ]
            tiles = {"side": TILE, "size": [width, height], "albedo": places[0], "normals": places[1]}
        photos = {photo: addresses[f"photo{i}.jpg"] for i, photo in enumerate(self._photos)}
        named = {
            "block": addresses[BLOCK],
            "object": addresses[OBJECT],
            "ground": addresses[GROUND],
            "first": addresses[FIRST],
            "normals": addresses.get(NORMALS),
            "photos": photos,
            "tiles": tiles,
        }
        return stage_facts(self.run, self.studio, self.scene, self._block, named)

    def _first(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture that stands where the page's own first picture will, until that is drawn."""
        fields, studio = self.run.fields, self.studio
        left, top, right, _ = first_window(self.scene.vertices, fields, studio)
        focal = FIRST_SIDE / (right - left)
        camera = Camera(FIRST_SIDE, FIRST_SIDE, focal, focal, -left * focal - 0.5, -top * focal - 0.5)
        place = PosedCamera(camera, home_pose(fields, studio), fields.ground_height)
        light = key_light(studio, home_view(fields, studio)["azimuth"] + KEY_TURN)
        return relit_photo(fields, place, light, studio, self.scene.ground_mean, np.array(BACKGROUND, np.uint8))

    def _photo(self, photo: str) -> bytes:
        return jpeg(read_thumbnail(self.run.run_dir, photo), PHOTO_QUALITY)

    def _tile(self, kind: int, row: int, column: int) -> bytes:
        assert self._details is not None
        top, left = row * TILE, column * TILE
        cut = np.ascontiguousarray(self._details[kind][top : top + TILE, left : left + TILE])
        return jpeg(cut, NORMAL_QUALITY if kind else QUALITY, is_exact=bool(kind))


def packed_stage(run: StoredRun) -> bytes:
    """Return the archive of a finished run's stage (reconstruct/stored_run/stage_pack.py).

    Raises:
        UserError: a file of the run cannot be used.
    """
    parts = StageParts(run)
    facts = parts.facts({name: name for name in parts.names()})
    return stage_archive(run.run_dir, facts, {name: parts.get(name) for name in parts.names()})


def _tile_name(kind: int, row: int, column: int) -> str:
    return f"{'normals' if kind else 'albedo'}-{row}-{column}.jpg"
