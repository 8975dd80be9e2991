"""FORMATS: the table of export formats, one row each. reconstruct.export.export writes them.

The row of the single-file page is in viewer/stage/page.py, where that page is made.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Format:
    """One row of FORMATS: a kind of file, and the function that writes it."""

    suffix: str  # with its dot
    title: str  # for people who do not know the format's name
    about: str  # in one sentence
    writer: str  # "module:function", a reconstruct.export.export.Writer; imported when it is used
    others: tuple[str, ...] = ()  # further suffixes that the same writer supports; "" of a folder
    ending: str = ""  # of the file's name before the suffix, where formats share a suffix
    takes: tuple[str, ...] = ()  # names of the ExportOptions that change the file


_FACES, _PRINTED, _SKINNED = ("faces",), ("faces", "print_size"), ("faces", "texture")
_LOOK, _MOVES = ("width", "lamp_size"), ("width", "frames", "lamp_size")
_SOLID, _SKIN, _MAPS = "reconstruct.export.solid", "reconstruct.export.textured", "reconstruct.export.maps"
_FILM, _DATA = "reconstruct.export.film", "reconstruct.export.datasets"
_VIDEO, _FOLDER = (".webm", ".gif"), ("",)
FORMATS: dict[str, Format] = {
    "glb": Format(
        ".glb",
        "For the web and Blender (GLB)",
        "A light mesh with its colours and fine relief in pictures; metres.",
        f"{_SKIN}:glb",
        takes=_SKINNED,
    ),
    "3mf": Format(
        ".3mf",
        "For 3D printing (3MF)",
        "A closed solid in millimetres that stands on its base.",
        f"{_SOLID}:threemf",
        takes=_PRINTED,
    ),
    "turntable": Format(
        ".mp4",
        "A video of the object turning",
        "One full turn on even ground, softly lit; it loops.",
        f"{_FILM}:turn",
        _VIDEO,
        "_turn",
        _MOVES,
    ),
    "orbit": Format(
        ".mp4",
        "A video of the light going around",
        "From where the photos were taken; it loops.",
        f"{_FILM}:orbit",
        _VIDEO,
        "_light",
        _MOVES,
    ),
    "still": Format(
        ".png",
        "A picture of it (PNG)",
        "On even ground, softly lit.",
        f"{_FILM}:still",
        takes=_LOOK,
    ),
    "usdz": Format(
        ".usdz",
        "For iPhone and iPad (USDZ)",
        "To put on a table by augmented reality.",
        f"{_SKIN}:usdz",
        takes=_SKINNED,
    ),
    "stl": Format(
        ".stl",
        "For older 3D printers (STL)",
        "A closed solid; numbers are millimetres.",
        f"{_SOLID}:stl",
        takes=_PRINTED,
    ),
    "obj": Format(
        ".obj",
        "For older programs (OBJ)",
        "A light mesh with two pictures, in millimetres.",
        f"{_SKIN}:obj",
        takes=_SKINNED,
    ),
    "ply": Format(
        ".ply",
        "Every detail (PLY)",
        "The full mesh, a colour per vertex, what is known of each place.",
        f"{_SOLID}:ply",
        takes=_FACES,
    ),
    "off": Format(
        ".off",
        "For geometry software (OFF)",
        "Corners and triangles as text.",
        f"{_SOLID}:off",
        takes=_FACES,
    ),
    "normal-png": Format(
        ".png",
        "Normals (16-bit PNG)",
        "Which way each pixel faces, with a file that says how to read it.",
        f"{_MAPS}:normals",
        (),
        "_normals",
    ),
    "depth-png": Format(
        ".png",
        "Depth (16-bit PNG)",
        "How far each pixel is, with a file that says how to read it.",
        f"{_MAPS}:depth",
        (),
        "_depth",
    ),
    "normal-exr": Format(
        ".exr",
        "Normals (EXR)",
        "Which way each pixel faces, as exact numbers.",
        f"{_MAPS}:normals",
        (),
        "_normals",
    ),
    "shadowneus": Format(
        ".zip", "ShadowNeuS", "Photos, camera, lights, ground.", f"{_DATA}:shadowneus", _FOLDER, "_shadowneus"
    ),
    "rti": Format(".zip", "RTI (relight, OpenLIME)", "Photos, .lp, .dome.", f"{_DATA}:rti", _FOLDER, "_rti"),
    "colmap": Format(".zip", "COLMAP (text)", "Camera, photos, points.", f"{_DATA}:colmap", _FOLDER, "_colmap"),
    "nerf": Format(".zip", "NeRF (transforms)", "Photos, camera, light.", f"{_DATA}:nerf", _FOLDER, "_nerf"),
    "depth-exr": Format(
        ".exr", "Depth (EXR)", "How far each pixel is, as exact numbers.", f"{_MAPS}:depth", (), "_depth"
    ),
}
