"""FORMATS with the page in one file: everything that the command and the page can save a finished run as."""

from reconstruct.export.formats import FORMATS, Format

PAGE = Format(
    ".html",
    "A page to send to somebody",
    "One file: the light follows the pointer, no server is needed.",
    "viewer.stage.page:write_page",
)
_rows = list(FORMATS.items())
_rows.insert(list(FORMATS).index("3mf") + 1, ("html", PAGE))  # behind which a person looks for it
FORMATS.clear()
FORMATS.update(_rows)
