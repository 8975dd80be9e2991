"""The example: photos of a figure that come with the program, and their result, for who has no photos yet."""

from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from capture.errors import CaptureError
from reconstruct.stored_run.stage_pack import FORMAT, opened_pack
from viewer.stage.page import page_html

TITLE = "Spot, an example"
RESULT = Path(__file__).with_name(f"example-{FORMAT}.zip")  # a stage; .ci/example_result.py makes it
PLACE = ("examples", "spot", "session.toml")  # in a checkout, and in share/shadowgraph of an installation


@cache
def example_photos() -> Path:
    """Return the folder of the example's photos.

    Raises:
        CaptureError: it did not come with this installation.
    """
    checkout = Path(__file__).parents[2].joinpath(*PLACE)
    try:
        files = distribution("shadowgraph").files or ()
        installed = [Path(str(file.locate())) for file in files if file.parts[-len(PLACE) :] == PLACE]
    except PackageNotFoundError:
        installed = []
    for settings in (checkout, *installed):
        if settings.is_file():
            return settings.resolve().parent
    raise CaptureError("The example's photos did not come with this installation: install it with pip once more.")


@cache
def example_page() -> bytes | None:
    """Return the page of the example's result; None where it is of another version of the stage."""
    pack = opened_pack(RESULT)
    return None if pack is None else page_html("Spot", pack).encode()
