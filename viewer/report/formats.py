"""FORMATS with the page in one file: everything that the command and the page can save a finished run as."""

from reconstruct.export.formats import FORMATS, Format, add_format

__all__ = ["FORMATS"]

add_format(
    "html",
    Format(
        ".html",
        "A page to send to somebody",
        "One file: the light follows the pointer, no server is needed.",
        "viewer.stage.page:write_page",
        "viewer.stage.page:read_page",
    ),
    after="3mf",
)
