"""The parts of a page, made of a run's results: its mesh, its pictures and tiles; and all of them in one archive."""

from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import UInt8

from calibration.camera import Camera
from calibration.posed_camera import PosedCamera
from capture.errors import CaptureError, UserError
from reconstruct.export.first_view import FirstView
from reconstruct.export.stage_scene import StageScene, detail_pictures, stage_scene
from reconstruct.render.studio import Studio, studio_of
from reconstruct.stored_run.maps import read_thumbnail
from reconstruct.stored_run.stage_pack import stage_archive
from reconstruct.stored_run.stored_run import StoredRun
from viewer.display.embedded import jpeg
from viewer.stage.facts import BACKGROUND, first_window, home_pose, lit_photos, stage_facts
from viewer.stage.pack import Block, packed

QUALITY, NORMAL_QUALITY, PHOTO_QUALITY = 90, 95, 82  # JPEG
TILE = 512  # px
LEAST_GAIN = 1.3  # of the detail over the picture that the page opens with, for tiles to be worth their bytes
MOST_PIXELS = 1 << 24  # of a detail in tiles: what a graphics card holds besides the rest
BLOCK, OBJECT, NORMALS, GROUND, FIRST = "scene.bin", "object.jpg", "normals.jpg", "ground.jpg", "first.jpg"
FIRST_SIDE, FIRST_QUALITY = 400, 80  # px, JPEG


class StageParts:
    """What the archive of one run's stage is made of."""

    def __init__(self, run: StoredRun):
        """Read nothing yet."""
        self.run = run

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

    def all(self) -> dict[str, bytes]:
        """Return all parts by their names."""
        scene = self.scene
        parts = {
            BLOCK: self._block.content,
            OBJECT: jpeg(scene.object_picture, QUALITY),
            GROUND: jpeg(scene.ground_picture, QUALITY),
            FIRST: jpeg(self.first.picture(np.array(BACKGROUND, np.uint8)), FIRST_QUALITY),
        }
        if scene.normal_picture is not None:
            parts[NORMALS] = jpeg(scene.normal_picture, NORMAL_QUALITY, is_exact=True)
        for i, photo in enumerate(self._photos):
            parts[_photo_name(i)] = jpeg(read_thumbnail(self.run.run_dir, photo), PHOTO_QUALITY)
        for place in self._tiles:
            parts |= {_tile_name(kind, *place): self._tile(kind, *place) for kind in range(2)}
        return parts

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

    def facts(self) -> dict[str, Any]:
        """Return what the page's scripts read; its "addresses" are names of parts."""
        tiles = None
        if self._details is not None:
            height, width = self._details[0].shape[:2]
            albedo, normals = ([_tile_name(kind, *place) for place in self._tiles] for kind in range(2))
            tiles = {"side": TILE, "size": [width, height], "albedo": albedo, "normals": normals}
        named = {
            "block": BLOCK,
            "object": OBJECT,
            "ground": GROUND,
            "first": FIRST,
            "normals": None if self.scene.normal_picture is None else NORMALS,
            "photos": {photo: _photo_name(i) for i, photo in enumerate(self._photos)},
            "tiles": tiles,
        }
        return stage_facts(self.run, self.studio, self.scene, self._block, self.first.lamp, named)

    @cached_property
    def first(self) -> FirstView:
        """What stands where the page's own first picture will, until that is drawn; and its lamp."""
        fields, studio = self.run.fields, self.studio
        left, top, right, _ = first_window(self.scene.vertices, fields, studio)
        focal = FIRST_SIDE / (right - left)
        camera = Camera(FIRST_SIDE, FIRST_SIDE, focal, focal, -left * focal - 0.5, -top * focal - 0.5)
        place = PosedCamera(camera, home_pose(fields, studio), fields.ground_height)
        return FirstView(fields, place, studio, self.scene)

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
    return stage_archive(run.run_dir, parts.facts(), parts.all())


def _photo_name(number: int) -> str:
    return f"photo{number}.jpg"


def _tile_name(kind: int, row: int, column: int) -> str:
    return f"{'normals' if kind else 'albedo'}-{row}-{column}.jpg"
