"""FORMATS with the page in one file: everything that the command and the page can save a finished run as."""

from reconstruct.export.formats import FORMATS, Format

PAGE = Format(
    ".html",
    "A page to send to somebody",
    "One file: the light follows the pointer, no server is needed.",
    "viewer.stage.page:write_page",
)
OTHERS = {name: FORMATS.pop(name) for name in list(FORMATS)}
for name, row in OTHERS.items():
    FORMATS[name] = row
    if name == "3mf":  # behind which a person looks for it
        FORMATS["html"] = PAGE
