"""Presentation pictures of an object: a still, a video of the turning object, a video of the light moving around it.

The output of `shadowgraph relight`: one picture from the capture camera, or a video of a circling light.

Videos are written picture by picture: mp4 that every browser plays, webm, or gif.

Writers raise ReconstructionError for a width or a number of frames that cannot be made, OSError if a file cannot be
written.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from calibration.calibration import Calibration
from calibration.light import Light, irradiance
from capture.decode.exr import read_panorama, write_exr
from capture.errors import ReconstructionError
from capture.files.title import file_stem
from capture.photos.photo import encode_srgb
from reconstruct.detail.fit import with_detail
from reconstruct.export.export import Contents, ExportOptions, OnProgress
from reconstruct.render.environment import sky_map
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.relight import environment, relight_soft
from reconstruct.render.studio import direction_of, even, light_orbit, studio_of, towards, turntable
from reconstruct.stored_run.stored_run import StoredRun

FPS = 30
GIF_FPS = 25  # gif counts in hundredths of a second
H264_QUALITY = "20"  # x264's CRF: no blocks to be seen in even grounds
LOOP_FOREVER = 0
Frames = Iterable[Float[np.ndarray, "height width 3"]]  # linear
Encoded = Iterable[UInt8[np.ndarray, "height width 3"]]  # sRGB
WIDTH = 960  # px, unless another is asked for: two minutes on two cores
WIDTHS = (16, 4096)  # px: what video encoders take
STILL_WIDTH = 1920
STILL_SAMPLES = 64  # shadow rays per pixel: no grain
MAX_FRAMES = 3600  # two minutes
SKY_ROWS = 16  # rows of patches that a map is averaged to: 256 shadow rays per pixel
LAMP_SAMPLES = 64  # shadow rays per pixel of a lamp of some size
ORBIT_SAMPLES = 9  # the same in a video
STILLS, FILMS = (".png", ".exr"), (".mp4", ".webm", ".gif")
PNG_LEVEL = [cv2.IMWRITE_PNG_COMPRESSION, 6]


def write_film(path: Path, frames: Frames) -> tuple[int, int]:
    """Write the pictures as a video, by the file's ending: .mp4 (H.264, needs the extra `video`), .webm (VP9), .gif.

    Args:
        frames: one or more of one size, whose sides are even.

    Returns:
        Width and height, px.

    Raises:
        ReconstructionError: the package for .mp4 is not installed, or OpenCV cannot write the .webm.
    """
    pictures = (encode_srgb(frame) for frame in frames)
    first = next(pictures)
    write = {".mp4": _write_mp4, ".webm": _write_webm, ".gif": _write_gif}[path.suffix.lower()]
    write(path, first.shape[:2], chain([first], pictures))
    return first.shape[1], first.shape[0]


def _write_mp4(path: Path, size: tuple[int, int], frames: Encoded) -> None:
    """Write H.264 in 4:2:0, BT.709, with the index at the front, as browsers and phones require."""
    try:
        import av
    except ImportError as error:
        raise ReconstructionError(
            ".mp4 needs the package av, which is not installed: pip install 'shadowgraph[video]'. "
            ".webm and .gif need nothing more."
        ) from error
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", FPS, options={"crf": H264_QUALITY, "preset": "medium"})
        stream.height, stream.width = size
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, FPS)
        context = stream.codec_context
        context.color_range, context.colorspace = 1, 1  # 16..235, BT.709
        context.color_primaries = context.color_trc = 1
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            container.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
        container.mux(stream.encode())


def _write_webm(path: Path, size: tuple[int, int], frames: Encoded) -> None:
    """Write VP9 with OpenCV's encoder, which does not say when it fails: every frame is read back."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP90"), FPS, size[::-1])
    if not writer.isOpened():
        raise ReconstructionError(f"{path.name}: this OpenCV writes no WebM. Choose .gif or .mp4.")
    count = 0
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
        count += 1
    writer.release()
    video = cv2.VideoCapture(str(path))
    if sum(1 for _ in iter(video.grab, False)) != count:
        raise ReconstructionError(f"{path.name} does not play back as written. Check the disk, export again.")


def _write_gif(path: Path, size: tuple[int, int], frames: Encoded) -> None:
    """Write a looping GIF with one palette of 256 colours for all pictures, so that nothing flickers."""
    pictures = [Image.fromarray(frame) for frame in frames]
    some = np.concatenate([np.asarray(p)[::4, ::4].reshape(-1, 3) for p in pictures[:: max(1, len(pictures) // 8)]])
    palette = Image.fromarray(some[None]).quantize(256, method=Image.Quantize.MEDIANCUT)
    indexed = [p.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for p in pictures]
    indexed[0].save(
        path, save_all=True, append_images=indexed[1:], duration=1000 // GIF_FPS, loop=LOOP_FOREVER, optimize=False
    )


def turn(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write a video of the object turning once in front of camera and lamp."""
    return _film(run, path, options, on_progress, turntable)


def orbit(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write a video, seen from the capture camera, of the lamp moving once around the object."""
    return _film(run, path, options, on_progress, light_orbit)


def still(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write one picture of the object on even ground, sRGB."""
    on_progress(0, 1, "computing the picture")
    studio, width = studio_of(np.asarray(run.mesh.bounds)), checked_width(options.width, STILL_WIDTH)
    picture = next(iter(turntable(run.fields, studio, width, 1, options.lamp_size, STILL_SAMPLES)))
    Image.fromarray(encode_srgb(picture)).save(path)
    return Contents(pixels=(picture.shape[1], picture.shape[0]), note="sRGB")


def checked_width(asked: int | None, otherwise: int) -> int:
    """Return the requested width (px), or `otherwise` if none is given.

    Raises:
        ReconstructionError: no picture of that size can be made.
    """
    width = otherwise if asked is None else asked
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ReconstructionError(f"a width of {width} px was asked for; {WIDTHS[0]} to {WIDTHS[1]} px can be made.")
    return width


def film(path: Path, frames: Frames, total: int, on_progress: OnProgress) -> Contents:
    """Write so many pictures as a video, and report progress at the start and after each.

    Raises:
        ReconstructionError: a video cannot have that many.
    """
    if not 2 <= total <= MAX_FRAMES:
        raise ReconstructionError(f"{total} pictures were asked for; 2 to {MAX_FRAMES} make a video.")

    def counted() -> Iterator[np.ndarray]:
        on_progress(0, total, "picture by picture")
        for done, frame in enumerate(frames, start=1):
            yield frame
            on_progress(done, total, "picture by picture")

    return Contents(pixels=write_film(path, counted()), frames=total, note=f"{total / FPS:.1f} s, loops")


def _film(
    run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress, pictures: Callable[..., Frames]
) -> Contents:
    studio, width = studio_of(np.asarray(run.mesh.bounds)), checked_width(options.width, WIDTH)
    frames = pictures(run.fields, studio, width, options.frames, options.lamp_size)
    return film(path, frames, options.frames, on_progress)


@dataclass(frozen=True)
class NewLight:
    """The light of the new picture: exactly one of the first four fields is set."""

    light: tuple[float, float, float] | None = None  # a lamp's place, world
    direction: tuple[float, float, float] | None = None  # towards a far lamp, world, of any length
    env: Path | None = None  # an environment map, .hdr or .exr
    orbit: int | None = None  # number of places on a circle around the object
    turn: float = 0.0  # of the map about the vertical, rad
    radius: float = 0.0  # of the lamp, world length
    brightness: float = 1.0  # times the capture's flashlight, or times the map as exposed

    def __post_init__(self):
        chosen = [name for name in ("light", "direction", "env", "orbit") if getattr(self, name) is not None]
        if len(chosen) != 1:
            said = "none" if not chosen else " and ".join(f"--{name}" for name in chosen)
            raise ReconstructionError(f"one of --light, --direction, --env and --orbit was needed, {said} was given.")
        numbers = [*(self.light or ()), *(self.direction or ()), self.turn, self.radius, self.brightness]
        if not all(math.isfinite(number) for number in numbers) or min(self.radius, self.brightness) < 0:
            raise ReconstructionError("light, direction, lamp size and brightness must be finite, sizes not negative.")
        if self.direction is not None and np.linalg.norm(self.direction) == 0:
            raise ReconstructionError("the direction 0,0,0 leads nowhere; x,y,z towards the light was needed.")


def relit_file(run_dir: Path, new: NewLight, out: Path | None) -> Path:
    """Return the output file: as named, or RUN/exports/TITLE_relit.png (.webm).

    Raises:
        ReconstructionError: its ending does not fit the requested light.
    """
    endings = STILLS if new.orbit is None else FILMS
    if out is None:
        run = StoredRun(run_dir)
        return run.exports() / f"{file_stem(run_dir)}_relit{'.png' if new.orbit is None else '.webm'}"
    if out.suffix.lower() not in endings:
        kind = "a picture" if new.orbit is None else "a turn of the light"
        raise ReconstructionError(f"{out}: {kind} ends in {', '.join(endings)}. Name it so.")
    return out


def write_relit(run: StoredRun, path: Path, new: NewLight, width: int | None, on_progress: OnProgress) -> Contents:
    """Write the picture (linear in .exr, sRGB without tone mapping in .png), or the video of a turn of the light.

    Raises:
        UserError: a file of the run or the map cannot be read, or the width is out of range.
    """
    camera = run.fields.camera
    wide = checked_width(width, camera.width)
    tall = max(1, round(camera.height * wide / camera.width))
    if new.orbit is not None:
        wide, tall = even(wide), even(tall)
    posed_camera = run.fields.posed_camera.resized(wide, tall)
    view = with_detail(look(run.fields, None, posed_camera), run.details, posed_camera.camera)
    if new.orbit is not None:
        return film(path, _turning(run, view, new), new.orbit, on_progress)
    on_progress(0, 1, "computing the picture")
    picture = _picture(run, view, new)
    if path.suffix.lower() == ".exr":
        write_exr(path, {name: picture[..., i] for i, name in enumerate("RGB")}, {"comments": "linear, ITU-R BT.709"})
        return Contents(pixels=(wide, tall), note="linear, 1 = white of the photos")
    if not cv2.imwrite(str(path), np.ascontiguousarray(encode_srgb(picture)[..., ::-1]), PNG_LEVEL):
        raise ReconstructionError(f"{path.name} could not be written. Check the disk and try again.")
    return Contents(pixels=(wide, tall), note="sRGB, as exposed as the photos")


def lamp_at(
    calibration: Calibration, middle: Float[np.ndarray, "3"], place: Float[np.ndarray, "4"], brightness: float
) -> Light:
    """Return a light of the capture's typical power at a homogeneous place (world), aimed at the object's middle.

    If the capture's lights were of the other kind (far instead of near), the irradiance at the middle equals theirs.

    Args:
        middle: of the object, world.
        brightness: factor of the power.

    Raises:
        ReconstructionError: the lamp is in the middle of the object.
    """
    used = [light for light in calibration.lights if light.used] or list(calibration.lights)
    is_point = bool(place[3] > 0)
    unit = place[:3] / np.linalg.norm(place[:3]) if not is_point else place[:3]
    if is_point == (used[0].position is not None):
        power = np.median([light.power for light in used], axis=0)
    else:
        power = np.median([irradiance(middle, None, light, calibration.beam) for light in used], axis=0)
        power = power * (float(((place[:3] - middle) ** 2).sum()) if is_point else 1.0)
    if not is_point:
        return Light("", "directional", direction=unit, power=brightness * power)
    distance = np.linalg.norm(middle - unit)
    if distance == 0:
        raise ReconstructionError("the lamp is in the middle of the object, where it lights nothing. Move it out.")
    axis = (middle - unit) / distance if any(light.axis is not None for light in used) else None
    return Light("", "point", position=unit, power=brightness * power, axis=axis)


def _picture(run: StoredRun, view: RenderView, new: NewLight) -> Float[np.ndarray, "height width 3"]:
    if new.env is not None:
        try:
            panorama = read_panorama(new.env.read_bytes(), new.env.name)
        except OSError as error:
            raise ReconstructionError(
                f"{new.env} cannot be read ({error.strerror}); a .hdr or .exr was needed."
            ) from error
        return new.brightness * environment(view, sky_map(panorama), SKY_ROWS, new.turn).numpy()
    place = np.append(new.light, 1.0) if new.light is not None else np.append(new.direction or (), 0.0)
    return _under(run, view, new, place, LAMP_SAMPLES)


def _turning(run: StoredRun, view: RenderView, new: NewLight) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """Yield pictures lit from a circle at the capture lamps' typical height and distance, starting at the first."""
    assert new.orbit is not None
    middle, calibration = studio_of(np.asarray(run.mesh.bounds)).centre, run.calibration
    used = [light for light in calibration.lights if light.used] or list(calibration.lights)
    ways, distances = zip(*(light.seen_from(middle) for light in used), strict=True)
    elevation = float(np.median([direction_of(way)[1] for way in ways]))
    reach, first = float(np.median(distances)), direction_of(ways[0])[0]
    w = used[0].homogeneous()[3]
    for k in range(new.orbit):
        way = reach * towards(first + 2 * math.pi * k / new.orbit, elevation)
        yield _under(run, view, new, np.append(way + w * middle, w), ORBIT_SAMPLES)


def _under(
    run: StoredRun, view: RenderView, new: NewLight, place: Float[np.ndarray, "4"], samples: int
) -> Float[np.ndarray, "height width 3"]:
    middle, calibration = studio_of(np.asarray(run.mesh.bounds)).centre, run.calibration
    light = lamp_at(calibration, middle, place, new.brightness)
    # relight_soft takes a half angle for a far light: that of a lamp of this size at the usual distance
    usual = float(np.linalg.norm(run.fields.posed_camera.centre - middle))  # distance of a lamp given by its direction
    radius = new.radius if light.position is not None else math.atan2(new.radius, usual)
    samples = samples if radius > 0 else 1
    return relight_soft(view, light, radius, samples, calibration.beam, calibration.ambient).numpy()
