"""Names that a file gives: they name a file in their own folder, or they are refused."""

from pathlib import Path

from capture.errors import CaptureError


def inside(folder: Path, name: str, said_by: str) -> Path:
    """The file of that name in a folder or below it.

    Absolute names, `..` and links that lead out of the folder are refused: the list of names may be a stranger's.

    Args:
        said_by: file and field that give the name, for the message.

    Raises:
        CaptureError: it leaves the folder, does not exist, or is no name at all.
    """
    shown = repr(name if len(name) <= 80 else name[:77] + "...")
    try:
        path = folder / name
        stays, exists = path.resolve().is_relative_to(folder.resolve()), path.is_file()
    except (OSError, ValueError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
        raise CaptureError(f"{said_by} {shown} is no file name ({reason}); a file in {folder} was needed.") from error
    if not stays:
        raise CaptureError(f"{said_by} {shown} leaves the folder {folder}; keep all files in it.")
    if not exists:
        raise CaptureError(
            f"{said_by} names {shown}, which does not exist in {folder}; complete the folder, or correct the name."
        )
    return path
