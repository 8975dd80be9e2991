"""A lamp walks around the object of a finished run: a GIF, computed from the reconstructed surface and its albedo.

python examples/relight_run.py runs/spot spot.gif
"""

import sys
from dataclasses import replace

import numpy as np
from PIL import Image

import shadowgraph
from capture.photos.photo import encode_srgb


def main(run: str, out: str, pictures: int = 24, width: int = 400) -> None:
    result = shadowgraph.RunResult(run)
    view = shadowgraph.look(result.fields, width)  # what the camera sees; another camera may be given
    calibration = result.calibration
    light = next(light for light in calibration.lights if light.used and light.position is not None)
    middle = result.mesh.bounds.mean(0)
    frames = []
    for angle in np.linspace(0, 2 * np.pi, pictures, endpoint=False):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        away = turn @ (light.position - middle)
        axis = None if light.axis is None else -away / np.linalg.norm(away)  # still aimed at the object
        lamp = replace(light, position=middle + away, axis=axis)
        linear = shadowgraph.relight(view, lamp, calibration.beam, calibration.ambient)
        frames.append(Image.fromarray(encode_srgb(linear.numpy())))
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=80, loop=0)


if __name__ == "__main__":
    main(*sys.argv[1:])
