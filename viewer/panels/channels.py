"""CHANNELS: maps that the picture can show in the place of light: colour, normal, depth, shadow, roughness."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibration.light import Light
from capture.photos.photo import encode_srgb
from reconstruct.appearance.brdf import roughness
from reconstruct.render.g_buffer import RenderView
from reconstruct.render.relight import lit_share
from viewer.display.pictures import NEAR_TO_FAR, Picture, depth_picture, normal_picture
from viewer.widgets.legend import Colour, bar, remark, swatches

NOTHING_THERE = (44, 46, 51)
BLACK_TO_WHITE = np.array([[0, 0, 0], [255, 255, 255]], float)
DIRECTIONS: tuple[tuple[Colour, str], ...] = (  # as normal_picture draws them
    ((128, 128, 255), "Faces up"),
    ((255, 128, 128), "Faces the board's x (along its first row)"),
    ((0, 128, 128), "Faces away from x"),
    ((128, 255, 128), "Faces the board's y"),
    ((128, 0, 128), "Faces away from y"),
)


@dataclass(frozen=True)
class ChannelPicture:
    """A picture of a channel and what its colours mean."""

    picture: Picture
    legend: str  # HTML


def colour(view: RenderView, light: Light, unit: str) -> ChannelPicture:
    """Draw the albedo."""
    legend = remark("The surface's own colour, without light and shadow. White sends all light back.")
    return ChannelPicture(_where_seen(encode_srgb(view.albedo.numpy()), view), legend)


def direction(view: RenderView, light: Light, unit: str) -> ChannelPicture:
    """Draw the normals."""
    return ChannelPicture(_on_nothing(normal_picture(view.maps.normals.numpy(), _seen(view))), swatches(DIRECTIONS))


def distance(view: RenderView, light: Light, unit: str) -> ChannelPicture:
    """Draw the z-depth of the object."""
    depth, mask = view.maps.depth.numpy(), view.maps.mask.numpy()
    if not mask.any():
        return ChannelPicture(_on_nothing(depth_picture(depth, mask)), remark("The object is not in this picture."))
    near, far = float(depth[mask].min()), float(depth[mask].max())
    marks = [f"{v:.1f} {unit}" if unit == "mm" else f"{v:.3g} {unit}" for v in (near, 0.5 * (near + far), far)]
    return ChannelPicture(
        _on_nothing(depth_picture(depth, mask)), bar(NEAR_TO_FAR, marks, "In front of the camera, along its axis.")
    )


def shadow(view: RenderView, light: Light, unit: str) -> ChannelPicture:
    """Draw the visibility of the lamp: attached and cast shadows."""
    legend = bar(BLACK_TO_WHITE, ["in shadow", "sees your lamp"], "Turned away from the lamp counts as shadow.")
    return ChannelPicture(_grey(lit_share(view, light).numpy(), view), legend)


def gloss(view: RenderView, light: Light, unit: str) -> ChannelPicture:
    """Draw the perceptual roughness, as glTF defines it."""
    if view.gloss is None:
        return ChannelPicture(
            _grey(np.ones(view.maps.depth.shape, np.float32), view), remark("No gloss was found: all is matt.")
        )
    values = roughness(view.gloss.coefficients()).numpy()
    legend = bar(BLACK_TO_WHITE, ["0 mirror", "0.5 satin", "1 matt"], "Roughness, as glTF and most programs count it.")
    return ChannelPicture(_grey(values, view), legend)


Channel = Callable[[RenderView, Light, str], ChannelPicture]
CHANNELS: dict[str, Channel | None] = {
    "Light": None,
    "Colour": colour,
    "Direction": direction,
    "Distance": distance,
    "Shadow": shadow,
    "Roughness": gloss,
}


def _seen(view: RenderView) -> np.ndarray:
    return np.isfinite(view.maps.depth.numpy())


def _on_nothing(rgba: Picture) -> Picture:
    """Return a picture with transparent parts as RGB."""
    return np.where(rgba[..., 3:] > 0, rgba[..., :3], np.array(NOTHING_THERE, np.uint8))


def _where_seen(rgb: Picture, view: RenderView) -> Picture:
    """Return the picture, with a plain colour where no surface is seen."""
    return np.where(_seen(view)[..., None], rgb, np.array(NOTHING_THERE, np.uint8))


def _grey(values: np.ndarray, view: RenderView) -> Picture:
    """Draw values in [0, 1] from black to white, in perceptually equal steps."""
    return _where_seen(np.repeat(np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)[..., None], 3, -1), view)
