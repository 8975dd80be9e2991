"""Lists of lights as rows of numbers over the picture: text, tables whose head names the columns, arrays of programs.

The picture's frame: x right, y up, z towards the camera. Places are counted from where its middle shows the ground.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from calibration.lights.layouts import Rows, turned, view_note
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.files.arrays import read_mat, read_npy
from capture.files.schema import read_text

READABLE = (
    "Lights are read from .lp, .txt and .csv lists, .mat, .npy, .dome, lights.json, calibration.json and the files of "
    "ShadowNeuS and S3-NeRF scenes"
)
SAME_LENGTH = 1.1  # longest row over the shortest: directions rounded to one digit, or of a dome, stay below
UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}  # millimetres; px and no unit: the unit of the scene
HEAD = re.compile(r"(?P<name>[a-z_]+?)[ _]*[\[(]?(?P<unit>mm|cm|m|px|pixels?|deg|degrees?|rad|radians?|°)?[\])]?")
AXIS = re.compile(r"(?P<kind>l|light|d|dir|direction|n|p|pos|position|place)?_?(?P<axis>[xyz])")
DIRECTIONS, PLACES = ("l", "d", "dir", "direction", "n"), ("p", "pos", "position", "place")
AZIMUTH = ("azimuth", "azi", "az", "phi")
ELEVATION = ("elevation", "elev", "el", "altitude", "alt")
POLAR = ("polar", "zenith", "theta", "inclination", "colatitude")
ARRAYS = (  # names of the lights in .mat files, the clearest first, without _ and capitals
    re.compile("(?=.*(light|led|source)).*(dir|vec).*|directions|dirs"),
    re.compile("(?=.*(light|led|source)).*pos.*|positions"),
    re.compile("(light|led|source)s?(matrix|mat)?|l|s"),
)
NEEDED = "a name and x y z of its light are needed"


def number_rows(path: Path, posed_camera: PosedCamera) -> Rows:
    """Read a list by its ending: arrays, RTI's .lp, and tables (.csv), whose head may name angles or places.

    Raises:
        CalibrationError: the file cannot be read, or a line is no light; names it and what can be read.
    """
    if path.suffix.lower() == ".mat":
        return _mat_rows(path, posed_camera)
    if path.suffix.lower() == ".npy":
        return _array_rows(read_npy(path), "its array", path, posed_camera)
    text = read_text(path)
    if "\0" in text or "\ufffd" in text:
        raise CalibrationError(f"{path} is no text, and of no other kind that gives lights. {READABLE}.")
    names, vectors, head = named_numbers(text, path)
    if head.kind == "angles":
        vectors, note = head.vectors(vectors, path)
        return Rows(names, turned(vectors, posed_camera), "directional", note=note)
    kind = head.kind or ("" if path.suffix.lower() == ".csv" else "directional")
    return _rows(names, vectors, kind, head.unit, path.name, posed_camera)


def named_numbers(text: str, path: Path) -> tuple[tuple[str | None, ...], Float[np.ndarray, "rows columns"], "Head"]:
    """Return the name (or none) and the numbers of each line as they stand, and the columns that hold them.

    Decimal commas are read (in tables between semicolons); names may hold spaces.

    Raises:
        CalibrationError: a line is no light; names it.
    """
    names, values, head = [], [], Head()
    split = _cells if path.suffix.lower() == ".csv" else str.split
    for number, line in enumerate(text.splitlines(), start=1):
        words = split(line)
        if not words or (len(words) == 1 and not values and words[0].isdigit()):
            continue
        found = None if values else Head.of(words)
        if found is not None:
            head = found
            continue
        try:
            value = [float(words[place].replace(",", ".")) for place in head.places]
        except (ValueError, IndexError):
            value = []
        if not value or not np.isfinite(value).all() or not (np.any(value) or head.kind == "angles"):
            raise CalibrationError(f"{path}, line {number} is {line[:60]!r}; {NEEDED}. {READABLE}.")
        names.append(" ".join(words[: len(words) + min(head.places)]) or None)
        values.append(value)
    if not values:
        raise CalibrationError(f"{path} lists no light; a line 'name x y z' for each photo is needed. {READABLE}.")
    return tuple(names), np.array(values), head


@dataclass(frozen=True)
class Head:
    """The columns of a list: of x y z, or of two angles; the last three where nothing names them."""

    places: tuple[int, ...] = (-3, -2, -1)  # from the line's end
    kind: str = ""  # "point" | "directional" | "angles"; empty: not said
    unit: str = ""
    polar: bool = False  # the second angle is from the axis of view

    @classmethod
    def of(cls, words: list[str]) -> "Head | None":
        """Return the columns that a line names; None for a line of numbers, or of other words."""
        found = [HEAD.fullmatch(word.strip().strip("#").strip().lower()) for word in words]
        columns = {match["name"]: (i - len(words), match["unit"] or "") for i, match in enumerate(found) if match}
        axes = {
            match["axis"]: (match["kind"] or "", *columns[name]) for name in columns if (match := AXIS.fullmatch(name))
        }
        if len(axes) == 3:
            kinds, places, units = zip(*(axes[axis] for axis in "xyz"), strict=True)
            is_place = kinds[0] in PLACES or bool(units[0])
            kind = "point" if is_place else "directional" if kinds[0] in DIRECTIONS else ""
            return cls(places, kind, units[0])
        around, up, down = (
            next((columns[n] for n in names if n in columns), None) for names in (AZIMUTH, ELEVATION, POLAR)
        )
        second = up or down
        if around is None or second is None:
            return None
        return cls((around[0], second[0]), "angles", around[1][:3], up is None)

    def vectors(self, angles: Float[np.ndarray, "rows 2"], path: Path) -> tuple[Float[np.ndarray, "rows 3"], str]:
        """Return the directions of angles, picture's frame, and how they were read.

        Raises:
            CalibrationError: an elevation beyond what its unit allows.
        """
        is_radian = self.unit == "rad" or (not self.unit and np.abs(angles).max() <= 2 * np.pi)
        around, up = (angles if is_radian else np.radians(angles)).T
        up = np.pi / 2 - up if self.polar else up
        if np.abs(up).max() > np.pi / 2 + 1e-6:
            row = int(np.abs(up).argmax())
            raise CalibrationError(
                f"{path}: light {row + 1} has the elevation {np.degrees(up[row]):.0f} degrees; -90 to 90 were needed. "
                "Correct its columns, or name their unit in the head: azimuth_deg, elevation_deg."
            )
        vectors = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)
        unit, second = "radians" if is_radian else "degrees", "from the axis of view" if self.polar else "elevation"
        note = f"lights: {path.name} is read as angles in {unit}: azimuth from x (right) towards y (up), and {second}"
        return vectors, note


def _rows(
    names: tuple[str | None, ...],
    values: Float[np.ndarray, "rows 3"],
    kind: str,
    unit: str,
    file: str,
    posed_camera: PosedCamera,
) -> Rows:
    """Return rows of directions or places; where nothing says which, rows of one length are directions."""
    why_so = "as its head says" if kind == "point" else ""
    if not kind:
        length = np.linalg.norm(values, axis=1)
        kind = "directional" if length.max() <= SAME_LENGTH * length.min() else "point"
        why_so = f"since its rows are {length.min():.3g} to {length.max():.3g} long"
    vectors = turned(values * UNITS.get(unit, 1.0), posed_camera)
    if kind == "directional":
        return Rows(names, vectors, kind, note=view_note(posed_camera))
    note = f"lights: {file} is read as places from the picture's middle (x right, y up, z towards the camera), {why_so}"
    return Rows(names, posed_camera.looked_at() + vectors, kind, note=note, unit="mm" if unit in UNITS else unit)


def _cells(line: str) -> list[str]:
    """Return the cells of a line of a table; empty for an empty line."""
    cells = [cell.strip().strip('"') for cell in line.split(";" if ";" in line else ",")]
    return cells if any(cells) else []


# --- arrays ----------------------------------------------------------------------------------------------------------


def _mat_rows(path: Path, posed_camera: PosedCamera) -> Rows:
    """Read MATLAB's file: the array of three columns, or rows, that has a usual name or is the only one, or two angles.

    Raises:
        CalibrationError: it cannot be read, or holds no such array; names those it has.
    """
    try:
        known = read_mat(path)
    except CalibrationError as error:
        raise CalibrationError(f"{error} {READABLE}.") from error
    fit = [name for name, array in known.items() if array.ndim == 2 and 3 in array.shape]
    usual = [name for names in ARRAYS for name in fit if names.fullmatch(name.lower().replace("_", ""))]
    chosen = usual[0] if usual else fit[0] if len(fit) == 1 else None
    head = None if usual else Head.of(list(known))
    if head is not None and head.kind == "angles":
        angles = [known[list(known)[place]].ravel() for place in head.places]
        if len({len(one) for one in angles}) == 1 and np.isfinite(angles).all():
            vectors, note = head.vectors(np.stack(angles, axis=-1), path)
            return Rows((None,) * len(vectors), turned(vectors, posed_camera), "directional", note=note)
    if chosen is None:
        shown = ", ".join(f"{name} {' x '.join(map(str, array.shape))}" for name, array in [*known.items()][:8])
        raise CalibrationError(
            f"{path} holds {shown or 'no array of numbers'}; an array of three columns named light_directions, lights, "
            f"L or S was needed, or one only. {READABLE}."
        )
    return _array_rows(known[chosen], chosen, path, posed_camera)


def _array_rows(values: Float[np.ndarray, "..."], name: str, path: Path, posed_camera: PosedCamera) -> Rows:
    """Return the rows of an array, or its columns where there are three rows."""
    table = values.T if values.ndim == 2 and values.shape[0] == 3 and values.shape[1] != 3 else values
    is_list = table.ndim == 2 and table.shape[1] == 3 and len(table)
    if not is_list or not np.isfinite(table).all() or not table.any(1).all():
        shape = " x ".join(map(str, values.shape)) or "one number"
        raise CalibrationError(
            f"{path}: {name} is {shape}; three finite numbers per light, not all 0, were needed. {READABLE}."
        )
    kind = "point" if "pos" in name.lower() else "directional" if "dir" in name.lower() else ""
    return _rows((None,) * len(table), table, kind, "", f"{path.name} ({name})", posed_camera)
