"""Read every file of a folder as a photo or clip: of each format, how many are read and how many refused in a sentence.

    python benchmarks/read_files.py [FOLDER...] [--table FILE]

examples/spot unless a folder is given. What each file is, or the sentence that refuses it, is printed below the table.
Exit code 1 if any file ends in anything but a picture or a sentence.
"""

import sys
from pathlib import Path

from one_run import SPOT
from sheet import Sheet, parser_of

from capture.decode.video import read_clip
from capture.errors import CaptureError
from capture.files.names import is_clip_name
from capture.photos.photo import read_photo

REFUSED, FAULT = "refused", "fault"


def described(path: Path) -> tuple[str, str]:
    """What the file turned out to be, and more of it."""
    try:
        if is_clip_name(path):
            clip = read_clip(path)
            return "clip", f"{clip.width} x {clip.height}, {clip.duration_s:.1f} s"
        photo = read_photo(path)
    except CaptureError as error:
        return REFUSED, str(error).replace(str(path), path.name)
    except Exception as error:  # noqa: BLE001  whatever else is raised is what this script looks for
        return FAULT, repr(error)
    height, width = photo.clipped.shape
    return "linear" if photo.is_linear else "sRGB", f"{width} x {height}, {photo.clipped.mean():.1%} clipped"


def main() -> int:
    """Read all, write the table."""
    parser = parser_of(__doc__)
    parser.add_argument("folders", nargs="*", type=Path, default=[SPOT])
    options = parser.parse_args()
    sheet, rows, lines = Sheet(options.table, "no randomness"), {}, []
    for path in sorted(path for folder in options.folders for path in folder.rglob("*") if path.is_file()):
        ending = path.suffix.lower().lstrip(".")
        what, words = described(path)
        start = {"files": ending, "number": 0, "linear": 0, "sRGB": 0, "clip": 0, REFUSED: 0, FAULT: 0}
        row = rows.setdefault(ending, start)
        row["number"] += 1
        row[what] += 1
        lines.append(f"{path.name}: {what}, {words}")
    found = [rows[ending] for ending in sorted(rows)]
    rest = [row for row in found if row[REFUSED] == row["number"]]
    others = {"files": f"others: {', '.join(row['files'] for row in rest)}"}
    others |= {key: sum(row[key] for row in rest) for key in ("number", REFUSED)}
    sheet.write([*(row for row in found if row not in rest), *([others] if rest else [])], lines)
    return int(any(row[FAULT] for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
