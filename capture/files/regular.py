"""Open files of strangers: regular files only, of a stated size at most, without following a link or waiting.

A folder that somebody sent may hold, under the name of a result, a link to a file elsewhere, a named pipe that never
answers, or a device without end. The system says which before anything is read.
"""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

LARGEST_TEXT = 64 << 20  # bytes: the lights of a hundred thousand photos
_FLAGS = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_FLAGS |= getattr(os, "O_CLOEXEC", 0)


def open_regular(path: Path, largest: int) -> BinaryIO:
    """Open a regular file for reading.

    Args:
        largest: bytes that it may have.

    Raises:
        OSError: it does not exist, cannot be read, is a link, a folder, a pipe or a device, or is too large; the
            message says which.
    """
    try:
        number = os.open(path, _FLAGS)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EMLINK) or path.is_symlink():
            raise OSError(errno.ELOOP, "it is a link, a file was needed", str(path)) from error
        raise
    try:
        found = os.fstat(number)
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "it is a folder, a pipe or a device, a file was needed", str(path))
        if found.st_size > largest:
            size = f"{found.st_size / 1e6:,.0f} MB were found, at most {largest / 1e6:,.0f} MB were needed"
            raise OSError(errno.EFBIG, size, str(path))
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def read_regular(path: Path, largest: int = LARGEST_TEXT) -> bytes:
    """Return the content of a regular file of at most `largest` bytes.

    Raises:
        OSError: as `open_regular`.
    """
    with open_regular(path, largest) as file:
        return file.read(min(os.fstat(file.fileno()).st_size, largest))  # a buffer of `largest` bytes may be large


def is_regular(path: Path) -> bool:
    """Return whether there is a regular file of this name, and not a link to one."""
    try:
        return stat.S_ISREG(os.lstat(path).st_mode)
    except OSError:
        return False


def is_own_folder(path: Path) -> bool:
    """Return whether there is a folder of this name, and not a link to one."""
    try:
        return stat.S_ISDIR(os.lstat(path).st_mode)
    except OSError:
        return False


def why(error: Exception) -> str:
    """Return the reason in an error in one line, without the path that an OSError repeats."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or type(error).__name__
    return " ".join(text.split())[:300]
