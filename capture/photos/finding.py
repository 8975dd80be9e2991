"""Finding: one fault of one photo; kept in a folder for later invocations."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from capture.files.atomic import read_json, write_json

KEPT = "findings.json"


@dataclass(frozen=True)
class Finding:
    """One fault of one photo: what was measured, the limit, and whether the photo has to be left out."""

    photo: Path
    kind: str  # "unreadable" | "copy" | "another size" |
    # "flash off" | "over-exposed" | "exposure changed" | "white balance changed" | "ambient light" |
    # "blurred" | "camera moved" | "camera moved from board" | "another scene" | "covered" | "registered" |
    # "framed otherwise" | "board from elsewhere" | "board not in this view" | "zoom stated" |
    # "view not compared"
    text: str
    value: float
    limit: float
    drop: bool
    homography: tuple[float, ...] | None = None  # of a "registered" photo, row by row: from the pixels of the common
    # view to its own, px of the stack that was checked; of capture.checks.framing: from the board's photo to the photos
    role: str = "lit"  # of the photo, as its folder or its picture tells; of one that cannot be read, if nothing tells

    @property
    def called(self) -> str:
        """The photo's name; with its folder's, unless it is one under the flashlight."""
        return self.photo.name if self.role == "lit" else f"{self.photo.parent.name}/{self.photo.name}"

    def row(self) -> dict[str, str]:
        """Return the photo, its role and the reason, as a calibration's residuals list photos that are left out."""
        return {"photo": self.photo.name, "role": self.role, "reason": f"{self.kind}: {self.text}"}


def grouped(findings: Sequence[Finding]) -> str:
    """Return what is wrong with several photos in one sentence part; photos with one fault stand together."""
    names: dict[str, list[str]] = {}
    for one in findings:
        names.setdefault(f"{one.kind}, {one.text}".rstrip("."), []).append(one.called)
    return "; ".join(f"{', '.join(some)}: {text}" for text, some in names.items())


def keep_findings(folder: Path, findings: Sequence[Finding]) -> None:
    """Write what was found into a folder, for `kept_findings`."""
    write_json(folder / KEPT, [asdict(finding) | {"photo": str(finding.photo)} for finding in findings])


def kept_findings(folder: Path, photos: Sequence[Path]) -> tuple[Finding, ...] | None:
    """What was found in these photos by an earlier invocation; None where that is not known."""
    by_name = {str(photo): photo for photo in photos}
    try:
        rows = read_json(folder / KEPT)
        for row in rows:
            row["photo"] = by_name[row["photo"]]
            row["homography"] = row["homography"] and tuple(map(float, row["homography"]))
        return tuple(Finding(**row) for row in rows)
    except (OSError, ValueError, KeyError, TypeError):
        return None
