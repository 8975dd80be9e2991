"""FORMATS with the page in one file: everything that the command and the page can save a finished run as."""

from reconstruct.export.formats import FORMATS, Format, add_format

__all__ = ["FORMATS"]

add_format(
    "html",
    Format(
        ".html",
        "A page to send to somebody",
        "One file: the light can be dragged, no server is needed.",
        "viewer.report.offline_page:write_page",
        "viewer.report.offline_page:read_page",
    ),
    after="3mf",
)
