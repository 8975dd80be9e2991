"""A list of lights that is turned or mirrored against its photos: the way that fits is said by check and run."""

import numpy as np
import pytest
from dataset_folders import loaded, write_photo
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from calibration.scenes.distant_camera import distant_light
from calibration.scenes.unstated import UPRIGHT, WAYS, read_shading
from capture.decode.formats import states_curve
from capture.photos.photo import encode_srgb

SIDE, PHOTOS = 48, 10
ROWS = ("x y z", "-y x z", "-x -y z", "y -x z", "x -y z", "y x z", "-x y z", "-y -x z")  # of WAYS, to be written


def lights():
    azimuth, height = np.arange(PHOTOS) * 2.4, np.linspace(0.6, 1.4, PHOTOS)
    return np.stack([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)], -1)


def egg(x, y):
    """A quarter of an egg's height, in the dark."""
    return np.sqrt(np.clip(1 - (x / 0.9) ** 2 - (y / 0.6) ** 2, 0, None)) * 0.7


def waves(x, y):
    return 0.1 * np.sin(5 * x + y) * np.cos(4 * y)


def saddle(x, y):
    return 0.3 * x * y + 0.1 * x**2 + 0.08 * np.sin(6 * x - 3 * y)


def photos_of(height):
    """Lambert photos of a height field, albedo 0.8; black where it is 0 of a body in the dark."""
    v, u = np.mgrid[:SIDE, :SIDE]
    x, y = 2 * (u + 0.5) / SIDE - 1, 1 - 2 * (v + 0.5) / SIDE
    rise = height(x, y)
    q, p = np.gradient(rise, -2 / SIDE, 2 / SIDE)
    normals = np.stack([-p, -q, np.ones_like(p)], -1) / np.sqrt(1 + p**2 + q**2)[..., None]
    is_lit = rise > 0 if height is egg else np.ones_like(rise, bool)
    return [0.8 * np.clip(normals @ light, 0, None) * is_lit for light in lights()]


def write(folder, height, listed, turned=None, power=None):
    """A folder with a list; `turned` stores the pictures turned for EXIF orientation of that number."""
    folder.mkdir(exist_ok=True)
    lines = []
    for i, (grey, towards) in enumerate(zip(photos_of(height), listed, strict=True)):
        name = f"{i:02d}.{'png' if turned is None else 'jpg'}"
        rgb = np.repeat(grey[..., None], 3, -1) * (1 if power is None else power[i])
        if turned is None:
            write_photo(folder / name, rgb)
        else:
            exif = Image.Exif()
            exif[274] = turned
            Image.fromarray(stored(encode_srgb(rgb), turned)).save(folder / name, exif=exif, quality=98)
        lines.append(f"{name} {towards[0]:.5f} {towards[1]:.5f} {towards[2]:.5f}")
    (folder / "lights.lp").write_text("\n".join([str(PHOTOS), *lines]))
    return folder


def stored(upright, orientation):
    """The picture that a viewer turns upright by this EXIF orientation."""
    undo = {2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM}
    undo |= {5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE}
    undo[8] = Image.Transpose.ROTATE_270
    return np.asarray(Image.fromarray(upright).transpose(undo[orientation]))


def warnings_of(folder):
    return loaded(folder).calibration.residuals.get("warnings", [])


def listed_so_that(way):
    """Lights of a list that fits the photos once it is laid this way."""
    found = lights()
    found[:, :2] = found[:, :2] @ WAYS[way]
    return found


@pytest.mark.parametrize(("height", "way"), [(egg, 0), (egg, 1), (egg, 6), (waves, 0), (waves, 2), (saddle, 5)])
def test_the_way_that_a_list_fits_is_said_with_the_figures(tmp_path, height, way):
    said = warnings_of(write(tmp_path, height, listed_so_that(way)))
    if way == 0 or (way == 2 and height is not egg):  # of a relief, hills and dales look the same
        assert said == []
        return
    (sentence,) = said
    assert f"'{ROWS[way]}'" in sentence and "Nothing was changed" in sentence
    if height is egg:
        assert f"Write '{ROWS[way]}' for x y z" in sentence


@pytest.mark.parametrize("orientation", [2, 3, 4, 5, 6, 7, 8])
def test_a_list_over_the_upright_pictures_is_told_by_their_orientation(tmp_path, orientation):
    """The frame is that of the stored photos."""
    known = loaded(write(tmp_path, egg, lights(), orientation))
    (sentence,) = known.calibration.residuals["warnings"]
    assert f"in the frame of the upright photos (EXIF orientation {orientation})" in sentence
    assert f"Write '{ROWS[UPRIGHT[orientation]]}' for x y z" in sentence
    assert any(f"EXIF orientation {orientation} not applied" in note for note in known.notes)


@pytest.mark.parametrize("orientation", [6, 7])
def test_a_list_over_the_stored_pictures_fits_whatever_their_orientation(tmp_path, orientation):
    right = lights()
    right[:, :2] = right[:, :2] @ WAYS[UPRIGHT[orientation]].T
    assert warnings_of(write(tmp_path, egg, right, orientation)) == []


@pytest.mark.parametrize("height", [egg, waves])
def test_lines_in_another_order_fit_in_no_way(tmp_path, height):
    (sentence,) = warnings_of(write(tmp_path, height, lights()[np.random.default_rng(5).permutation(PHOTOS)]))
    assert "contradicts the listed lights" in sentence and "order" in sentence


# --- powers and tone curve that neither list nor files state ---------------------------------------------------------


PX, FRAMES = 40, 12
POWERS = np.random.default_rng(1).permutation(np.geomspace(0.2, 1.0, FRAMES))


def sphere_folder(folder, powers, curve, order=None, gloss=(0.0, 1.0)):
    """Photos of a sphere in the dark, albedo 0.9, and the directional lights that are listed for them.

    gloss: of its highlights, how bright before the matt part and how sharp (Blinn's exponent).
    """
    v, u = np.mgrid[:PX, :PX]
    x, y = (u - PX / 2 + 0.5) / (0.45 * PX), -(v - PX / 2 + 0.5) / (0.45 * PX)
    inside = x**2 + y**2 < 1
    normals = np.stack([x, y, np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))], -1) * inside[..., None]
    azimuth, height = np.arange(FRAMES) * 2.4, np.linspace(0.55, 1.4, FRAMES)
    towards = np.stack([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)], -1)
    photos = [folder / f"{i:02d}.png" for i in range(FRAMES)]
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
    photos, lights = sphere_folder(tmp_path, np.ones(FRAMES), curve, gloss=gloss)
    assert read_shading(photos, lights, None, has_power).is_linear == (curve == "linear8")


@pytest.mark.parametrize("curve", ["sRGB", "linear16"])
def test_equal_powers_stay_equal(tmp_path, curve):
    photos, lights = sphere_folder(tmp_path, np.ones(FRAMES), curve)
    shading = read_shading(photos, lights, None, False)
    assert shading.is_linear == (curve != "sRGB") and list(shading.lights) == lights


def test_powers_that_are_listed_stay_and_so_does_a_stated_curve(tmp_path):
    photos, lights = sphere_folder(tmp_path, POWERS, "linear16")
    shading = read_shading(photos, lights, False, True)
    assert not shading.is_linear and list(shading.lights) == lights and shading.notes == ()


def test_a_list_in_wrong_order_gives_no_powers(tmp_path):
    photos, lights = sphere_folder(tmp_path, np.ones(FRAMES), "sRGB", np.roll(np.arange(FRAMES), 5))
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
