"""Read arrays from untrusted .npy, .npz and .mat files: only plain numbers of the stated size are accepted.

Nothing in the files is executed, and no memory is allocated before header and size agree.
"""

import io
import math
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped
from numpy.lib import format as npy

from capture.errors import CalibrationError
from capture.files.names import in_one_line
from capture.files.regular import why

LARGEST_FILE = 64 * 2**20  # bytes, unpacked: a hundred thousand lights, or a depth map of eight megapixels
MAT_HEAD, MAT_PACKED = 128, 15  # bytes before the parts of a MATLAB file, and the kind of a packed one
MAT_NUMBERS = ("double", "single", "int", "uint", "logical")  # kinds of its arrays
NUMBERS = "fiub"  # kinds of numpy dtypes: floats, integers, booleans
_DAMAGED = (
    *(OSError, ValueError, EOFError, KeyError, TypeError, SyntaxError, OverflowError, RuntimeError),
    *(NotImplementedError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


def read_npy(path: Path, largest: int = LARGEST_FILE) -> Float[np.ndarray, "..."]:
    """Return the numbers of a .npy file as float64, in the file's shape.

    Raises:
        CalibrationError: the file cannot be read, holds no numbers, or is larger than `largest` bytes.
    """
    try:
        if path.stat().st_size > largest:
            raise _too_large(path, largest)
        return parse_npy(path.read_bytes()).astype(float)
    except _DAMAGED as error:
        raise CalibrationError(f"{path} is no readable array of numbers ({why(error)}); export it again.") from error


def read_npz(path: Path, names: tuple[str, ...], largest: int = LARGEST_FILE) -> dict[str, Float[np.ndarray, "..."]]:
    """Return the named arrays of a .npz file as float64, in their shapes.

    Raises:
        CalibrationError: the file cannot be read, lacks a name, holds no numbers, or unpacks to more than `largest`
            bytes.
    """
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(part.file_size for part in packed.infolist()) > largest:
                raise _too_large(path, largest)
            found = {part.filename.removesuffix(".npy"): part for part in packed.infolist()}
            missing = [name for name in names if name not in found]
            if missing:
                raise CalibrationError(
                    f"{path} holds {in_one_line(', '.join(sorted(found)[:8])[:200]) or 'nothing'}; "
                    f"{', '.join(missing)} was needed."
                )
            return {name: parse_npy(_unpacked(packed, found[name])).astype(float) for name in names}
    except _DAMAGED as error:
        raise CalibrationError(f"{path} cannot be read ({why(error)}); {', '.join(names)} were needed.") from error


def read_mat(path: Path, largest: int = LARGEST_FILE) -> dict[str, Float[np.ndarray, "..."]]:
    """Return the arrays of numbers in a MATLAB file (version 4 to 7) as float64, by name; no objects, cells or text.

    Raises:
        CalibrationError: the file cannot be read, is of version 7.3 (HDF5), or unpacks to more than `largest` bytes.
    """
    import scipy.io  # takes a while, and few need it

    try:
        if path.stat().st_size > largest:
            raise _too_large(path, largest)
        file = io.BytesIO(_parts_of_mat(path, largest))
        names = [
            name
            for name, shape, kind in scipy.io.whosmat(file)
            if kind.startswith(MAT_NUMBERS) and math.prod(shape) * 8 <= largest
        ]
        content = scipy.io.loadmat(file, variable_names=names)
        return {name: np.asarray(content[name], dtype=float) for name in names}
    except NotImplementedError as error:
        raise CalibrationError(
            f"{path} is of MATLAB's version 7.3 (HDF5), which is not read. Save it with save(..., '-v7')."
        ) from error
    except (*_DAMAGED, IndexError, scipy.io.matlab.MatReadError) as error:
        raise CalibrationError(f"{path} cannot be read as MATLAB's file ({why(error)}).") from error


def _parts_of_mat(path: Path, largest: int) -> bytes:
    """Return the bytes of a MATLAB file with its packed parts unpacked: so none fills more memory than was checked.

    Raises:
        CalibrationError: they unpack to more than `largest` bytes.
    """
    data = path.read_bytes()
    order = {b"\0\1IM": "little", b"\1\0MI": "big"}.get(data[124:MAT_HEAD])
    if order is None:
        return data  # of version 4, which packs nothing, or of 7.3
    parts, at, size = [data[:MAT_HEAD]], MAT_HEAD, MAT_HEAD
    while at + 8 <= len(data):
        kind, length = (int.from_bytes(data[at + k : at + k + 4], order) for k in (0, 4))
        part = data[at : at + 8 + length]
        if kind == MAT_PACKED:
            part = zlib.decompressobj().decompress(part[8:], largest)
        parts.append(part)
        size, at = size + len(part), at + 8 + length
        if size >= largest:
            raise _too_large(path, largest)
    return b"".join(parts)


def _unpacked(packed: zipfile.ZipFile, part: zipfile.ZipInfo) -> bytes:
    """Unpack at most as many bytes as the archive's directory states; their sum was checked before."""
    with packed.open(part) as stream:
        return stream.read(part.file_size)


def parse_npy(data: bytes) -> Shaped[np.ndarray, "..."]:
    """Return the numbers in the bytes of a .npy file, of its kind and shape; nothing in it is unpickled.

    Raises:
        Exception: header and size do not agree, or the entries are not numbers; a header is Python text, and what
            parses it raises many kinds.
    """
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of the format")
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, is_by_column, kind = read_header(stream)
    if kind.kind not in NUMBERS or kind.hasobject:
        raise ValueError(f"its entries are {kind}, numbers were needed")
    if min(shape, default=0) < 0 or math.prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise ValueError(f"the shape {shape} does not fit its {len(data)} bytes")
    return np.frombuffer(data, kind, offset=stream.tell()).reshape(shape, order="F" if is_by_column else "C")


def _too_large(path: Path, largest: int) -> CalibrationError:
    return CalibrationError(
        f"{path} unpacks to more than {largest >> 20} MB; such a file is far smaller. Export it again."
    )
