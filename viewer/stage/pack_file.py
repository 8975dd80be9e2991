"""The packed stage of a run: from its file where it is there, else made; `shadowgraph run` leaves the file."""

from pathlib import Path

from capture.errors import ReconstructionError
from capture.files.atomic import atomic_file
from reconstruct.stored_run.stage_pack import STAGE_PACK, StagePack, read_stage_pack
from reconstruct.stored_run.stored_run import FIELDS, MESH, StoredRun

JPEG, BINARY = "image/jpeg", "application/octet-stream"


def is_finished(run_dir: Path) -> bool:
    """Return whether the run has left what the stage shows."""
    return all((run_dir / name).is_file() for name in (MESH, FIELDS))


def stored_stage(run_dir: Path, spare: Path | None = None) -> StagePack | None:
    """Return the packed stage that is kept with the run, or in the file `spare`; None where neither is of its results.

    Raises:
        ReconstructionError: the run is not finished.
    """
    if not is_finished(run_dir):
        raise ReconstructionError(f"{run_dir} holds no finished run yet: its picture comes with the mesh.")
    try:
        for path in (run_dir / STAGE_PACK, spare):
            if path is not None and (pack := read_stage_pack(run_dir, path)) is not None:
                return pack
    except OSError as error:
        raise ReconstructionError(f"{run_dir} cannot be read ({error.strerror or error}).") from error
    return None


def stage_pack(run_dir: Path) -> StagePack:
    """Return the packed stage of a run; made in memory where the run holds none.

    Raises:
        UserError: the run is not finished, or a file of it cannot be used.
    """
    pack = stored_stage(run_dir)
    if pack is None:
        from viewer.stage.parts import packed_stage  # torch takes seconds to import; a packed stage needs none of it

        pack = StagePack(packed_stage(StoredRun(run_dir)))
    return pack


def write_stage(run_dir: Path, path: Path | None = None) -> None:
    """Write the packed stage of a run into its folder, or to `path`, whole or not at all.

    Raises:
        UserError: a file of the run cannot be used.
        OSError: it cannot be written.
    """
    from viewer.stage.parts import packed_stage

    content = packed_stage(StoredRun(run_dir))
    with atomic_file(path or run_dir / STAGE_PACK) as temporary:
        temporary.write_bytes(content)


def kind_of(name: str) -> str:
    """Return the media type of a part."""
    return JPEG if name.endswith(".jpg") else BINARY
