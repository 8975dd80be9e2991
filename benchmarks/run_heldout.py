"""Render a solved scene under lights that no run saw, and compare with the truth.

    python benchmarks/run_heldout.py SCENE RUN [--samples 3] [--pictures DIR] [--table FILE]

SCENE is a simulated scene (gt/heldout) or a simulated phone capture (gt/novel), RUN the folder of a finished run.

Pixels: `whole` is the whole picture, `object` the pixels of gt/mask.png. PSNR is of linear RGB clipped to [0, 1] (and
of its sRGB code where the truth is 8-bit), per picture, then averaged. Every pixel is the mean of samples x samples
rays, as the truth's pixels are means over their area. Shadow IoU: pixels in shadow (turned away counts), by the
majority of their samples, against the truth's; over the whole picture and over the object.

Lights: a scene's held-out lights have the power of its training lights, so they get the run's. A capture's have the
power, colour and beam that the run found, at their true places, moved by what the fixed camera's estimated pose differs
from the true one, since world frames are the run's own.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from sheet import Sheet, parser_of, table

from calibration.calibration import Calibration, load_calibration
from calibration.light import Light
from calibration.pose import Pose
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.detail.file import DETAIL, load_details
from reconstruct.detail.sample import with_detail
from reconstruct.fields import load_fields
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.relight import lit_share, relight

NOTHING = 128  # captures mark pixels that show nothing with this grey


@dataclass(frozen=True)
class Truth:
    """One held-out picture."""

    name: str
    light: Light
    picture: Float[np.ndarray, "height width 3"]  # linear
    lit: Float[np.ndarray, "height width"]  # 1 lit, 0 in shadow; nan where nothing is seen
    is_srgb: bool


def scene_truth(scene: Path, calibration: Calibration) -> list[Truth]:
    """Held-out lights of a simulated scene: 16-bit linear pictures."""
    lights = json.loads((scene / "gt/lights.json").read_text())
    power = np.median([light.power for light in calibration.lights if light.used], axis=0)
    out = []
    for entry in lights["heldout"]:
        given = entry["lights"][0]
        if "position" in given:
            light = Light(entry["image"], "point", np.array(given["position"]), power=power)
        else:
            light = Light(entry["image"], "directional", direction=np.array(given["direction_to_light"]), power=power)
        picture = read(scene / entry["image"], cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535
        out.append(Truth(Path(entry["image"]).stem, light, picture, shadow(scene / entry["visibility"]), False))
    return out


def capture_truth(capture: Path, calibration: Calibration) -> list[Truth]:
    """Novel lights of a simulated phone capture: 8-bit sRGB pictures."""
    camera = json.loads((capture / "gt/camera.json").read_text())["upright"]
    ours_from_true = calibration.world_from_camera.matrix() @ np.array(camera["T_cam_from_board"])
    move = Pose.from_matrix(ours_from_true)
    power = np.median([light.power for light in calibration.lights if light.used], axis=0)
    has_beam = any(light.axis is not None for light in calibration.lights)
    out = []
    for entry in json.loads((capture / "gt/novel/novel.json").read_text()):
        axis = move.rotate(np.array([entry["axis"]]))[0] if has_beam else None
        place = move.apply(np.array([entry["position_mm"]]))[0]
        light = Light(entry["file"], "point", place, power=power, axis=axis)
        file = capture / "gt/novel" / entry["file"]
        picture = decode_srgb(read(file, cv2.IMREAD_COLOR_RGB))
        lit = shadow(file.with_name(f"{file.stem}_shadow.png"))
        lit[lit == NOTHING / 255] = np.nan
        out.append(Truth(file.stem, light, picture, lit, True))
    return out


def shadow(file: Path) -> Float[np.ndarray, "height width"]:
    """Visibility of a picture of it."""
    return read(file, cv2.IMREAD_GRAYSCALE) / 255


def read(file: Path, flags: int) -> np.ndarray:
    """Pixels as OpenCV reads them."""
    pixels = cv2.imread(str(file), flags)
    if pixels is None:
        raise SystemExit(f"{file} is not a picture.")
    return pixels


def psnr(error: Float[np.ndarray, "height width 3"], where: Bool[np.ndarray, "height width"]) -> float:
    """dB of a difference of pictures whose range is 1."""
    return float(-10 * np.log10(np.mean(error[where] ** 2)))


def iou(ours: Bool[np.ndarray, "height width"], true: Float[np.ndarray, "height width"], where: np.ndarray) -> float:
    """Intersection over union of the pixels in shadow."""
    known = where & np.isfinite(true)
    dark = true[known] < 0.5
    return float((ours[known] & dark).sum() / max((ours[known] | dark).sum(), 1))


def averaged(image: np.ndarray, samples: int) -> np.ndarray:
    """Mean over blocks of samples x samples."""
    height, width = image.shape[0] // samples, image.shape[1] // samples
    return image.reshape(height, samples, width, samples, *image.shape[2:]).mean((1, 3))


def score(
    truth: Truth, view: RenderView, calibration: Calibration, mask: np.ndarray, samples: int
) -> tuple[dict, np.ndarray]:
    """Measures of one picture by name, and the picture."""
    picture = relight(view, truth.light, calibration.beam, calibration.ambient).numpy().clip(0, 1)
    picture = averaged(picture, samples)
    dark = averaged(lit_share(view, truth.light).numpy(), samples) < 0.5
    whole = np.ones_like(mask)
    error = picture - truth.picture
    row = {"PSNR whole": psnr(error, whole), "PSNR object": psnr(error, mask)}
    if truth.is_srgb:
        coded = (encode_srgb(picture).astype(float) - encode_srgb(truth.picture)) / 255
        row |= {"sRGB whole": psnr(coded, whole), "sRGB object": psnr(coded, mask)}
    row |= {"shadow IoU whole": iou(dark, truth.lit, whole), "shadow IoU object": iou(dark, truth.lit, mask)}
    return row, picture


def main() -> None:
    """Parse, render, print."""
    parser = parser_of(__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--samples", type=int, default=3, help="rays per pixel and axis")
    parser.add_argument("--without-detail", action="store_true", help="even where the run read the photos' full detail")
    parser.add_argument("--pictures", type=Path, help="write ours | truth | 4 x difference here, sRGB")
    arguments = parser.parse_args()
    sheet = Sheet(f"Lights that no run saw: {arguments.scene.name}", arguments.table, "no randomness")
    calibration, fields = (
        load_calibration(arguments.run / "calibration.json"),
        load_fields(arguments.run / "fields.safetensors"),
    )
    truths = (scene_truth if (arguments.scene / "gt/heldout").is_dir() else capture_truth)(arguments.scene, calibration)
    mask = read(arguments.scene / "gt/mask.png", cv2.IMREAD_GRAYSCALE) > 127
    camera = calibration.camera.resized(
        *(arguments.samples * size for size in (calibration.camera.width, calibration.camera.height))
    )
    view = look(fields, posed_camera=replace(fields.posed_camera, camera=camera))
    if not arguments.without_detail:
        view = with_detail(view, load_details(arguments.run / DETAIL, fields), camera)
    rows = []
    for truth in truths:
        row, picture = score(truth, view, calibration, mask, arguments.samples)
        rows.append(row)
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            side = [picture, truth.picture, 4 * np.abs(picture - truth.picture)]
            coded = encode_srgb(np.concatenate(side, 1).clip(0, 1).astype(np.float32))
            cv2.imwrite(str(arguments.pictures / f"{truth.name}.png"), coded[..., ::-1])
    names = [truth.name for truth in truths] + ["mean"]
    rows.append({key: float(np.mean([row[key] for row in rows])) for key in rows[0]})
    sheet.write(table(["", *rows[0]], [[name, *row.values()] for name, row in zip(names, rows, strict=True)]))


if __name__ == "__main__":
    main()
