"""Read every file of a folder as a photo or clip: what each is, or the sentence that refuses it.

    python benchmarks/read_files.py [FOLDER...] [--table FILE]

One row for each file: size, linear or sRGB, clipped share, mean colour, exposure, CPU seconds; examples/spot unless a
folder is given. Exit code 1 if any file ends in anything but a picture or a sentence.
"""

import sys
import time
from pathlib import Path

from one_run import SPOT
from sheet import Sheet, parser_of, table

from capture.decode.video import read_clip
from capture.errors import CaptureError
from capture.files.names import is_clip_name
from capture.photos.photo import read_photo


def describe(path: Path) -> tuple[str, bool]:
    """What the file turned out to be, and whether that is as it should be."""
    try:
        if is_clip_name(path):
            clip = read_clip(path)
            return f"clip {clip.width} x {clip.height}, {clip.duration_s:.1f} s", True
        photo = read_photo(path)
    except CaptureError as error:
        return f"refused: {str(error).replace(str(path), path.name)}", True
    except Exception as error:  # noqa: BLE001  whatever else is raised is what this script looks for
        return f"FAULT: {error!r}", False
    height, width = photo.clipped.shape
    mean = " ".join(f"{value:.3f}" for value in photo.rgb.mean((0, 1)))
    words = [f"{width} x {height}", "linear" if photo.is_linear else "sRGB", f"{photo.clipped.mean():.1%} clipped"]
    return ", ".join([*words, f"mean {mean}", f"exposure {photo.exposure.relative() or 'unknown'}"]), True


def main() -> int:
    """Read all, write the table."""
    parser = parser_of(__doc__)
    parser.add_argument("folders", nargs="*", type=Path, default=[SPOT])
    options = parser.parse_args()
    sheet, rows, all_well = Sheet("Files read", options.table, "no randomness"), [], True
    for folder in options.folders:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            start = time.process_time()
            words, is_well = describe(path)
            all_well &= is_well
            rows.append([str(path.relative_to(folder.parent)), words, time.process_time() - start])
    sheet.write(table(["file", "what it is", "CPU s"], rows))
    return 0 if all_well else 1


if __name__ == "__main__":
    sys.exit(main())
