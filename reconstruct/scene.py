"""Calibrated photos as tensors on one pixel grid: the only crossing from numpy to torch."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from calibration.side_view import SideView
from capture.errors import ReconstructionError
from capture.photos.photo import PhotoStack

SMALLEST_BEAM_COSINE = 0.02  # as in calibration.light: 89 degrees off the beam axis


@dataclass(frozen=True)
class Scene:
    """The solver's input. World frame (z up, the ground is z = ground_height), float32, one device.

    If `ground_depth` is given (uneven ground), ground_height is the ground's lowest point.

    Pixels lie on the grid of the input photos, reduced to a working size but never undistorted: `directions` holds the
    true ray of every pixel. A scene has `rgb`, or `shadow`, or both. A "photo" is a picture under one light; a photo
    under several lights is repeated once per light, marked in `photo_of_light`
    (reconstruct.labels.multiple_lights).
    """

    rgb: Float[Tensor, "photos height width 3"] | None  # linear, exposure divided out
    shadow: Float[Tensor, "photos height width"] | None  # given visibility pictures, 1 = lit
    usable: Bool[Tensor, "photos height width"]  # False where clipped or missing
    eye: Float[Tensor, "3"]  # camera centre
    directions: Float[Tensor, "height width 3"]  # unit rays
    forward: Float[Tensor, "3"]  # optical axis: z-depth = t * (direction . forward)
    pixel_angle: float  # rad subtended by one pixel at the centre
    lights: Float[Tensor, "photos 4"]  # homogeneous, see calibration.light.Light.homogeneous
    power: Float[Tensor, "photos 3"]
    axis: Float[Tensor, "photos 3"]  # beam axes; zero where isotropic
    beam: Float[Tensor, " terms"]  # profile of all beams, see beam_gain
    ambient: Float[Tensor, "3"]
    light_sigma: Float[Tensor, "photos 3"]
    ground_height: float
    mask: Float[Tensor, "height width"] | None  # given object coverage
    photo_names: tuple[str, ...]
    camera: Camera  # of this grid
    world_from_camera: Pose
    unit: str  # "mm" | "scene"
    ground_known: bool = True  # False: ground_height is an assumption, and sets the scale of everything
    photo_of_light: Int[Tensor, " photos"] | None = None  # None: one light each; else equal where one photo shows a sum
    ground_depth: Float[Tensor, "height width"] | None = None  # z-depth of uneven bare ground, nan where there is none
    side_views: tuple[SideView, ...] = ()  # photos from the side, whose silhouettes bound the object, too
    mask_known: bool = True  # False: the mask was found in the shadow pictures
    view: str = ""  # name, where several cameras look at one object
    object_from_world: Pose | None = (
        None  # None: the surface is solved in this world; else see reconstruct.views.placed
    )

    @property
    def tint(self) -> Float[Tensor, "photos 3"]:
        """The lights' colours: their power over its mean over the channels."""
        return self.power / self.power.mean(-1, keepdim=True)

    @property
    def posed_camera(self) -> PosedCamera:
        """The camera of this grid above its ground."""
        return PosedCamera(self.camera, self.world_from_camera, self.ground_height)


def build_scene(
    stack: PhotoStack | None,
    calibration: Calibration,
    long_side: int,
    shadow: Float[np.ndarray, "photos full_height full_width"] | None = None,
    mask: Float[np.ndarray, "mask_height mask_width"] | None = None,
    ground_depth: Float[np.ndarray, "full_height full_width"] | None = None,
) -> Scene:
    """Build a Scene from the photos with a used light, on a pixel grid of at most long_side pixels.

    Args:
        stack: photos of every light, matched by file name; None for shadow pictures alone.
        calibration: its camera is that of the files, before any reduction.
        shadow: given visibility in [0, 1], in the order of calibration.lights.
        mask: given object coverage in [0, 1].
        ground_depth: z-depth of the bare, uneven ground, nan where there is none; None for the plane of calibration.

    Raises:
        ReconstructionError: no photo has a usable light, or the photos are not of the calibrated size.
    """
    if stack is None and shadow is None:
        raise ValueError("a scene needs photos, shadow pictures or both")
    left_out = {light.photo for light in calibration.lights if not light.used}  # even if other lights are usable
    kept = [i for i, light in enumerate(calibration.lights) if light.photo not in left_out]
    place = {} if stack is None else {path.name: i for i, path in enumerate(stack.paths)}
    if stack is not None:
        _check_size(stack, calibration.camera)
        kept = [i for i in kept if calibration.lights[i].photo in place]
    if not kept:
        raise ReconstructionError(
            f"0 of {len(calibration.lights)} photos have a usable light, at least 1 is needed; see the reasons in "
            "calibration.json."
        )
    camera = _working_camera(calibration.camera, long_side)
    size = (camera.width, camera.height)
    rgb = None
    usable = torch.ones(len(kept), camera.height, camera.width, dtype=torch.bool)
    if stack is not None:
        order = [place[calibration.lights[i].photo] for i in kept]
        rgb = _shrunk([stack.rgb[i] for i in order], size)
        usable = _shrunk([stack.clipped[i].astype(np.float32) for i in order], size) == 0
    scene = Scene(
        rgb=rgb,
        shadow=None if shadow is None else _shrunk([shadow[i] for i in kept], size),
        usable=usable,
        mask=None if mask is None else _shrunk([mask], size)[0],
        ground_height=float(calibration.ground_height),
        unit=calibration.unit,
        side_views=calibration.side_views,
        **_rays(replace(calibration.posed_camera, camera=camera)),
        **_lights([calibration.lights[i] for i in kept], calibration),
    )
    return scene if ground_depth is None else _on_uneven_ground(scene, _shrunk([ground_depth], size)[0])


def reduced(scene: Scene, long_side: int) -> Scene:
    """Reduce a scene to at most long_side pixels; each new pixel is the mean of those it covers."""
    camera = _working_camera(scene.camera, long_side)
    if camera.width == scene.camera.width:
        return scene
    size = (camera.width, camera.height)

    def shrink(images: Tensor | None) -> Tensor | None:
        return None if images is None else _shrunk(list(images.numpy()), size)

    clipped = _shrunk(list((~scene.usable).float().numpy()), size)
    return replace(
        scene,
        rgb=shrink(scene.rgb),
        shadow=shrink(scene.shadow),
        usable=clipped == 0,
        mask=None if scene.mask is None else _shrunk([scene.mask.numpy()], size)[0],
        ground_depth=None if scene.ground_depth is None else _shrunk([scene.ground_depth.numpy()], size)[0],
        **_rays(replace(scene.posed_camera, camera=camera)),
    )


def irradiance(
    scene: Scene, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "photos n 3"], Float[Tensor, "photos n 3"]]:
    """Return unit directions towards each light, and its irradiance on an unoccluded surface that faces it.

    The torch twin of calibration.light.irradiance: power * g(c) / d^2 for points, power for directional lights, per
    channel in linear pixel value for albedo 1.

    Args:
        points: world.
    """
    towards, gain = _arriving(scene, points)
    return towards, gain[..., None] * scene.power[:, None, :]


def grey_irradiance(
    scene: Scene, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "photos n 3"], Float[Tensor, "photos n"]]:
    """As `irradiance`, which is the mean of the channels here."""
    towards, gain = _arriving(scene, points)
    return towards, gain * scene.power.mean(-1)[:, None]


def grey_of(rgb: Float[Tensor, "*places 3"]) -> Float[Tensor, "*places"]:
    """Return the mean of the channels; torch's own over a last axis of three takes ten times as long."""
    red, green, blue = rgb.unbind(-1)
    return (red + green + blue) / 3


def _arriving(
    scene: Scene, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "photos n 3"], Float[Tensor, "photos n"]]:
    """Return unit directions to each light, and g(c) / d^2. By axes: torch sums slowly over a last axis of three."""
    is_point = scene.lights[:, 3:]
    x, y, z = (scene.lights[:, axis, None] - is_point * points[:, axis] for axis in range(3))
    square = x * x + y * y + z * z
    distance = square.sqrt()
    x, y, z = x / distance, y / distance, z / distance
    gain = torch.where(is_point > 0, 1 / square, torch.ones(()))
    if len(scene.beam):
        cosine = -(x * scene.axis[:, :1] + y * scene.axis[:, 1:2] + z * scene.axis[:, 2:])
        has_axis = (scene.axis != 0).any(-1)[:, None]
        gain = gain * torch.where(has_axis, beam_gain(cosine, scene.beam), torch.ones(()))
    return torch.stack((x, y, z), -1), gain


def ground_points(scene: Scene) -> Float[Tensor, "height width 3"]:
    """Return the point where each pixel's ray meets the ground, world; nan if it never does."""
    if scene.ground_depth is None:
        t = (scene.ground_height - scene.eye[2]) / scene.directions[..., 2]
    else:
        t = scene.ground_depth / (scene.directions @ scene.forward)
    t = torch.where((t > 0) & t.isfinite(), t, torch.full_like(t, torch.nan))
    return scene.eye + t[..., None] * scene.directions


def lights_in_frame(lights: Float[Tensor, "n 4"], origin: Float[Tensor, "3"], scale: float) -> Float[Tensor, "n 4"]:
    """Transform homogeneous lights to a translated and scaled frame; directional lights do not change.

    Args:
        lights: in the frame in which `origin` and `scale` are given, for example the world.
        origin: origin of the new frame.
        scale: length of its unit.
    """
    is_point = lights[:, 3:].detach()  # what kind of light it is, is a constant
    unit = torch.where(is_point > 0, torch.full_like(is_point, scale), torch.ones_like(is_point))
    place = (lights[:, :3] - is_point * origin) / unit
    return torch.cat([place, is_point], 1)


def carried_lights(lights: Float[np.ndarray, "n 4"], motion: Pose) -> Float[np.ndarray, "n 4"]:
    """Return homogeneous lights after a rigid motion: places are turned and shifted, directions turned."""
    turned = motion.rotate(lights[:, :3]) + lights[:, 3:] * motion.translation
    return np.concatenate([turned, lights[:, 3:]], 1)


def _on_uneven_ground(scene: Scene, ground_depth: Float[Tensor, "height width"]) -> Scene:
    scene = replace(scene, ground_depth=ground_depth)
    heights = ground_points(scene)[..., 2]
    lowest = float(heights[heights.isfinite()].min())
    if not lowest < float(scene.eye[2]):
        raise ReconstructionError(
            f"the lowest place of the uneven ground, z = {lowest:.4g}, is above the camera, z = {scene.eye[2]:.4g}; "
            "ground below it was needed. The depth map must be z-depth from the camera of the photos."
        )
    return replace(scene, ground_height=lowest)


def beam_gain(cosine: Float[Tensor, "*batch"], beam: Float[Tensor, " terms"]) -> Float[Tensor, "*batch"]:
    """Return the gain g(c) of a radially symmetric beam, the torch twin of calibration.light.beam_gain.

    log g = m log c + r2 u^2 + r3 u^3 + ..., u = 1 - c.

    Args:
        cosine: of the angle between beam axis and the direction to the surface; below SMALLEST_BEAM_COSINE clamped.
        beam: (m, r2, r3, ...), not empty.
    """
    c = cosine.clamp(SMALLEST_BEAM_COSINE, 1.0)
    u, log_gain = 1 - c, beam[0] * c.log()
    power = u
    for r in beam[1:]:
        power = power * u
        log_gain = log_gain + r * power
    return log_gain.exp()


def _check_size(stack: PhotoStack, camera: Camera) -> None:
    if (stack.full_width, stack.full_height) != (camera.width, camera.height):
        raise ReconstructionError(
            f"the photos are {stack.full_width} x {stack.full_height} pixels, the calibrated camera is "
            f"{camera.width} x {camera.height}; calibrate with these photos."
        )


def _working_camera(camera: Camera, long_side: int) -> Camera:
    scale = min(1.0, long_side / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def _shrunk(images: list[np.ndarray], size: tuple[int, int]) -> Tensor:
    """Images averaged down (area) to size = (width, height), stacked as a float32 tensor."""
    out = []
    for image in images:
        same = image.shape[1::-1] == size
        out.append(image if same else cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    return torch.from_numpy(np.stack(out).astype(np.float32))


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float32))


def _rays(posed_camera: PosedCamera) -> dict[str, Any]:
    """The fields of a Scene that follow from its camera."""
    camera = posed_camera.camera
    rays = posed_camera.rays(camera.pixel_grid())
    return {
        "eye": _tensor(posed_camera.centre),
        "directions": _tensor(rays / np.linalg.norm(rays, axis=-1, keepdims=True)),
        "forward": _tensor(posed_camera.forward),
        "pixel_angle": 1.0 / camera.fx,
        "camera": camera,
        "world_from_camera": posed_camera.world_from_camera,
    }


def _lights(lights: list[Light], calibration: Calibration) -> dict[str, Any]:
    """The fields of a Scene that follow from its lights."""
    return {
        "lights": _tensor([light.homogeneous() for light in lights]),
        "power": _tensor([light.power for light in lights]),
        "axis": _tensor([np.zeros(3) if light.axis is None else light.axis for light in lights]),
        "beam": _tensor(calibration.beam),
        "ambient": _tensor(calibration.ambient),
        "light_sigma": _tensor([light.sigma for light in lights]),
        "photo_names": tuple(light.photo for light in lights),
        "photo_of_light": _photo_of_light([light.photo for light in lights]),
    }


def light_share(scene: Scene, middle: Float[np.ndarray, "3"]) -> float:
    """Return one sigma of a light's place over its distance from a point: the median of the photos.

    Args:
        middle: of the object, world. A direction's sigma counts as it is.
    """
    lights, sigma = scene.lights.double().numpy(), scene.light_sigma.double().numpy()
    away = np.where(lights[:, 3] > 0, np.linalg.norm(lights[:, :3] - middle, axis=1), 1.0)
    return float(np.median(np.linalg.norm(sigma, axis=1) / np.maximum(away, 1e-12)))


def _photo_of_light(names: list[str]) -> Int[Tensor, " photos"] | None:
    """Return a photo index for each light; None if no two lights share a photo."""
    if len(set(names)) == len(names):
        return None
    order = list(dict.fromkeys(names))
    return torch.tensor([order.index(name) for name in names])
