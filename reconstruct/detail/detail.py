"""Normals and albedo at the photos' own resolution, by near-light photometric stereo on a solved surface.

Whole photos are read one at a time. Their object pixels go to a file on disk, from which blocks of pixels are read in
all photos at once. Memory: 80 bytes per object pixel (place, two normals, albedo, confidence), 40 bytes per pixel of
the photo being read, and shadows on a lattice half a voxel wide. Disk: 6 bytes per sample.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from calibration.camera import Camera
from reconstruct.appearance.brdf import Gloss
from reconstruct.appearance.lobe_fit import Indirect, Samples, from_endless_ground
from reconstruct.detail.file import SURE, UNIT, Detail
from reconstruct.detail.fit import fit_albedo, fit_detail
from reconstruct.detail.full_photos import BYTES_PER_SAMPLE, CHANNELS, FullPhotos, PixelFile, colours_of
from reconstruct.detail.surface import LitMap, SeenSurface, find_lit, merged, see_surface
from reconstruct.fields import SolvedScene
from reconstruct.labels.field_ground_test import label_ground
from reconstruct.labels.photometric_stereo import ground_light
from reconstruct.render.g_buffer import surface_maps
from reconstruct.render.interreflection import photo_interreflection
from reconstruct.scene import Scene, irradiance
from reconstruct.shading.noise import DEFAULT_NOISE, Noise

PIXELS_AT_ONCE = 8192  # 40 photos of them in colour take 4 MB: a dozen such arrays stay near the processor
LEAST_ALBEDO = 1e-3  # used where the surface's albedo is unknown
ENOUGH_PHOTOS = 4.0  # effective photos for a fitted albedo to count fully; with fewer it is blended with the surface's
BYTES_PER_PIXEL = 80  # of the object: see above
BYTES_PER_PHOTO_PIXEL = 40  # while it is decoded

OnProgress = Callable[[int, int, str], None]  # done, total, what is being done


@dataclass(frozen=True)
class Illumination:
    """The light at the surface of a solved scene, without shadows. World frame."""

    scene: Scene  # small
    indirect: Indirect
    noise: Noise


def estimate_illumination(scene: Scene, fields: SolvedScene) -> Illumination:
    """Estimate the photos' noise, and the indirect light from ground and object that the solve's albedo assumes.

    Args:
        scene: photos that the surface was solved from, in their order.
    """
    ground = label_ground(scene) if scene.ground_known else None
    noise = DEFAULT_NOISE if ground is None else ground.noise
    maps = surface_maps(fields.grid, replace(scene.posed_camera, ground_height=fields.ground_height))
    interreflection = photo_interreflection(fields, scene) if fields.interreflection > 0 else None
    if interreflection is not None:
        return Illumination(
            scene, lambda points, normals: fields.interreflection * interreflection.at(points, normals), noise
        )
    return Illumination(scene, from_endless_ground(ground_light(scene, maps.points, maps.mask, ground)), noise)


def needed_sentence(pixels: int, photos: int, photo_pixels: int) -> str:
    """State the memory and disk space that the detail needs, for the log."""
    memory = BYTES_PER_PIXEL * pixels + BYTES_PER_PHOTO_PIXEL * photo_pixels
    disk = photos * pixels * CHANNELS * BYTES_PER_SAMPLE
    return (
        f"{pixels / 1e6:.2f} million pixels show the object; beside what is held already, about {memory / 1e9:.2f} GB "
        f"of memory and {disk / 1e9:.2f} GB of disk for a while"
    )


def solve_detail(
    illumination: Illumination,
    fields: SolvedScene,
    camera: Camera,
    files: FullPhotos,
    folder: Path,
    on_progress: OnProgress,
) -> Detail | None:
    """Solve for the detail of a surface; None if no pixel sees it.

    Args:
        camera: of the photos at full resolution.
        files: in the order of the scene's photos.
        folder: on a disk with room for a temporary file.

    Raises:
        CaptureError: a photo cannot be read any more.
    """
    photos = len(files.paths)
    seen = see_surface(fields, camera)
    if seen is None:
        return None
    steps = photos + 1 + 2 * len(_blocks(seen))
    on_progress(0, steps, needed_sentence(len(seen.index), photos, camera.width * camera.height))
    with PixelFile(folder, photos, len(seen.index)) as pixels:
        size = (camera.width, camera.height)
        for done, colours in enumerate(colours_of(files, seen.window, seen.index, size), 1):
            pixels.append(colours)
            on_progress(done, steps, f"{files.paths[done - 1].name} read")
        lit = find_lit(fields.grid, seen, illumination.scene.lights)
        blocks = _Blocks(illumination, fields, camera, seen, lit, pixels)
        return _solved(blocks, lambda done, message: on_progress(photos + 1 + done, steps, message))


@dataclass(frozen=True)
class _Blocks:
    """Iterates over blocks of pixels with their samples and materials."""

    illumination: Illumination
    fields: SolvedScene
    camera: Camera
    seen: SeenSurface
    lit: LitMap
    pixels: PixelFile

    def __iter__(self) -> Iterator[tuple[slice, Samples, Float[Tensor, "n 3"], Gloss | None]]:
        """Yield each block's pixels, samples, albedo of the surface, and gloss."""
        for part in _blocks(self.seen):
            yield part, self._samples(part), *self.material(part)

    def _samples(self, part: slice) -> Samples:
        scene, points, normals = self.illumination.scene, self.seen.points[part], self.seen.normals[part]
        value = torch.from_numpy(self.pixels.read(part))
        known = value.isfinite().all(-1)
        towards, strength = irradiance(scene, points)
        indirect = scene.ambient + self.illumination.indirect(points, normals)
        return Samples(
            value=value.nan_to_num(),
            weight=(known & self.lit.at(self.seen.index[part])).float(),
            strength=strength.transpose(0, 1).contiguous(),
            indirect=indirect.expand_as(strength).transpose(0, 1).contiguous(),
            towards=towards.transpose(0, 1).contiguous(),
            eye=normalize(scene.eye - points, dim=-1),
            normals=normals,
        )

    def material(self, part: slice) -> tuple[Float[Tensor, "n 3"], Gloss | None]:
        """Return albedo and gloss of the working-resolution pixel that contains each pixel."""
        row, column = _in_working_picture(self.seen, self.seen.index[part], self.camera, self.fields.camera)
        gloss = self.fields.gloss
        return self.fields.albedo[row, column], gloss and Gloss(gloss.lobes, gloss.weights[row, column])


def _blocks(seen: SeenSurface) -> list[slice]:
    count = len(seen.index)
    return [slice(first, min(first + PIXELS_AT_ONCE, count)) for first in range(0, count, PIXELS_AT_ONCE)]


def _in_working_picture(
    seen: SeenSurface, index: Int[np.ndarray, " n"], camera: Camera, working: Camera
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Return row and column of the working-resolution pixel that contains each pixel of the window."""
    row, column = np.divmod(index, seen.window.width)
    small_row = (row + seen.window.top) * working.height // camera.height
    small_column = (column + seen.window.left) * working.width // camera.width
    return torch.from_numpy(small_row).long(), torch.from_numpy(small_column).long()


def _solved(blocks: _Blocks, on_progress: Callable[[int, str], None]) -> Detail:
    """Fit normals of all blocks, merge them with the surface's normals, then fit albedo."""
    seen, noise = blocks.seen, blocks.illumination.noise
    normals, trust = torch.empty_like(seen.normals), torch.empty(len(seen.index))
    total = len(_blocks(seen))
    for done, (part, samples, albedo, pixel_gloss) in enumerate(blocks, 1):
        about = albedo.mean(-1).clamp(min=LEAST_ALBEDO)
        normals[part], trust[part] = fit_detail(samples, about, noise, pixel_gloss)
        on_progress(done, f"relief of {min(done * PIXELS_AT_ONCE, len(trust)) / 1e6:.2f} million pixels")
    trust *= torch.from_numpy(seen.inner)
    normals = merged(seen, normals, trust, blocks.fields.grid.spacing)
    colour, share = torch.empty_like(normals), torch.empty(len(seen.index))
    for done, (part, samples, _, pixel_gloss) in enumerate(blocks, 1):
        colour[part], photos = fit_albedo(samples, normals[part], pixel_gloss)
        share[part] = (photos / ENOUGH_PHOTOS).clamp(0, 1)
        on_progress(total + done, f"colours of {min(done * PIXELS_AT_ONCE, len(trust)) / 1e6:.2f} million pixels")
    confidence = torch.from_numpy(seen.inner) * share
    gain = _gain(blocks, colour, confidence) if blocks.fields.view else torch.ones(CHANNELS)
    for part in _blocks(seen):
        colour[part] = torch.lerp(blocks.material(part)[0], gain * colour[part], share[part, None])
    return _detail(blocks, normals, colour, confidence)


def _gain(blocks: _Blocks, colour: Float[Tensor, "n 3"], confidence: Float[Tensor, " n"]) -> Float[Tensor, "3"]:
    """Return the factor from one view's own albedo to the scale that the albedo of several views has in common.

    See reconstruct/render/joined.py: exposure and white balance of its photos. The mean albedo stays the surface's.
    """
    own, common = torch.zeros(CHANNELS), torch.zeros(CHANNELS)
    for part in _blocks(blocks.seen):
        own += confidence[part] @ colour[part]
        common += confidence[part] @ blocks.material(part)[0]
    return torch.where((own > 0) & (common > 0), common / own, 1.0)


def _detail(
    blocks: _Blocks, normals: Float[Tensor, "n 3"], albedo: Float[Tensor, "n 3"], confidence: Float[Tensor, " n"]
) -> Detail:
    """Arrange the pixels' values as pictures of the window."""
    seen = blocks.seen
    window, count = seen.window, seen.window.height * seen.window.width
    stored = np.zeros((count, 3), np.int16), np.zeros((count, 3), np.float16), np.zeros(count, np.uint8)
    stored[0][seen.index] = (UNIT * normals).round().to(torch.int16).numpy()
    stored[1][seen.index] = albedo.half().numpy()
    stored[2][seen.index] = (SURE * confidence).round().to(torch.uint8).numpy()
    shape = window.height, window.width
    return Detail(
        stored[0].reshape(*shape, 3),
        stored[1].reshape(*shape, 3),
        stored[2].reshape(shape),
        replace(blocks.fields.posed_camera, camera=blocks.camera).cropped(
            window.left, window.top, window.width, window.height
        ),
        window,
    )
