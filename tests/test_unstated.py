"""Photos with a bare list of directions: powers and tone curve that neither list nor files state."""

import numpy as np
import pytest
from dataset_folders import write_photo
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from calibration.scenes.distant_camera import distant_light
from calibration.scenes.unstated import read_shading
from capture.decode.formats import states_curve

SIDE, PHOTOS = 40, 12
POWERS = np.random.default_rng(1).permutation(np.geomspace(0.2, 1.0, PHOTOS))


def sphere_folder(folder, powers, curve, order=None, gloss=(0.0, 1.0)):
    """Photos of a sphere in the dark, albedo 0.9, and the directional lights that are listed for them.

    gloss: of its highlights, how bright before the matt part and how sharp (Blinn's exponent).
    """
    v, u = np.mgrid[:SIDE, :SIDE]
    x, y = (u - SIDE / 2 + 0.5) / (0.45 * SIDE), -(v - SIDE / 2 + 0.5) / (0.45 * SIDE)
    inside = x**2 + y**2 < 1
    normals = np.stack([x, y, np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))], -1) * inside[..., None]
    azimuth, height = np.arange(PHOTOS) * 2.4, np.linspace(0.55, 1.4, PHOTOS)
    towards = np.stack([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)], -1)
    photos = [folder / f"{i:02d}.png" for i in range(PHOTOS)]
    for path, light, power in zip(photos, towards, powers, strict=True):
        half = light + np.array([0, 0, 1])
        half /= np.linalg.norm(half)
        mirrored = gloss[0] * np.clip(normals @ half, 0, None) ** gloss[1] * (normals @ light > 0)
        grey = 0.9 * power * (np.clip(normals @ light, 0, None) + mirrored) / (1 + gloss[0])
        write_photo(path, np.repeat(grey[..., None], 3, -1), curve)
    listed = towards if order is None else towards[order]
    return photos, [distant_light(path.name, light) for path, light in zip(photos, listed, strict=True)]


def log_errors(shading, powers):
    logs = np.log([light.power.mean() for light in shading.lights]) - np.log(powers)
    return np.abs(logs - logs.mean())


@pytest.mark.parametrize("curve", ["sRGB", "linear8", "linear16"])
def test_powers_of_one_to_five_and_the_curve_are_read_from_shading(tmp_path, curve):
    photos, lights = sphere_folder(tmp_path, POWERS, curve)
    shading = read_shading(photos, lights, None, False)
    assert shading.is_linear == (curve != "sRGB")
    assert log_errors(shading, POWERS).max() < 0.05
    assert any("5.0 times" in note for note in shading.notes) and any("tone curve" in note for note in shading.notes)


@pytest.mark.parametrize(
    ("curve", "has_power", "gloss"),
    [("sRGB", True, (0.3, 20)), ("linear8", False, (1, 20)), ("sRGB", False, (4, 100)), ("linear8", True, (4, 400))],
)
def test_gloss_makes_no_other_curve(tmp_path, curve, has_power, gloss):
    photos, lights = sphere_folder(tmp_path, np.ones(PHOTOS), curve, gloss=gloss)
    assert read_shading(photos, lights, None, has_power).is_linear == (curve == "linear8")


@pytest.mark.parametrize("curve", ["sRGB", "linear16"])
def test_equal_powers_stay_equal(tmp_path, curve):
    photos, lights = sphere_folder(tmp_path, np.ones(PHOTOS), curve)
    shading = read_shading(photos, lights, None, False)
    assert shading.is_linear == (curve != "sRGB") and list(shading.lights) == lights


def test_powers_that_are_listed_stay_and_so_does_a_stated_curve(tmp_path):
    photos, lights = sphere_folder(tmp_path, POWERS, "linear16")
    shading = read_shading(photos, lights, False, True)
    assert not shading.is_linear and list(shading.lights) == lights and shading.notes == ()


def test_a_list_in_wrong_order_gives_no_powers(tmp_path):
    photos, lights = sphere_folder(tmp_path, np.ones(PHOTOS), "sRGB", np.roll(np.arange(PHOTOS), 5))
    shading = read_shading(photos, lights, False, False)
    assert list(shading.lights) == lights


def test_formats_for_display_and_files_with_a_profile_state_their_curve(tmp_path):
    grey = Image.new("RGB", (8, 8), (90, 90, 90))
    told = PngInfo()
    told.add(b"gAMA", (45455).to_bytes(4, "big"))
    grey.save(tmp_path / "gamma.png", pnginfo=told)
    grey.save(tmp_path / "photo.jpg")
    grey.save(tmp_path / "bare.png")
    grey.save(tmp_path / "bare.tif")
    found = {name: states_curve(tmp_path / name) for name in ("gamma.png", "photo.jpg", "bare.png", "bare.tif")}
    assert found == {"gamma.png": True, "photo.jpg": True, "bare.png": False, "bare.tif": False}
