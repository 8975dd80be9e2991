"""CalibratedViews: the calibrations of several views of one object in one world, and their file.

The file is calibration.json as Calibration writes it, for the first view; those of the others follow in
`further_views`, those of further lies of the object in `lies`. A reader that knows one view finds the first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration, calibration_document, calibration_of
from capture.files.atomic import write_json
from capture.files.json_field import JsonField, read_document
from capture.session.capture import MOST_LIES, MOST_VIEWS


@dataclass(frozen=True, eq=False)
class CalibratedView:
    """One place of the tripod."""

    name: str  # of the view's folder; "" where there is one view
    calibration: Calibration

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"] | None:
        """Covariance of the camera's turn (rad) about the world's axes and of its place (mm); None: not known.

        With turn w and shift c the pose becomes exp(w) rotation, translation + c. Errors of the table's height and
        slopes, which all views share, are not in it: residuals' camera_height_sigma_mm has them.
        """
        stored = self.calibration.residuals.get("pose_covariance")
        return None if stored is None else np.array(stored, float)


@dataclass(frozen=True, eq=False)
class CalibratedViews:
    """Views in one world frame (that of their board), in order; and the lies in which the object was laid anew."""

    views: tuple[CalibratedView, ...]  # at least one
    left_out: tuple[tuple[str, str], ...] = ()  # views that are not used: name, and the sentence that says why
    lies: tuple["CalibratedViews", ...] = ()  # each in the frame of its own board
    name: str = ""  # of a lie

    @property
    def first(self) -> Calibration:
        """The first view's calibration."""
        return self.views[0].calibration

    def every(self) -> tuple[CalibratedView, ...]:
        """Return all views, those of the lies last."""
        return (*self.views, *(view for lie in self.lies for view in lie.every()))

    def with_calibrations(self, calibrations: Sequence[Calibration]) -> "CalibratedViews":
        """Return the same views with other calibrations, in their order."""
        pairs = zip(self.views, calibrations, strict=True)
        return replace(self, views=tuple(replace(view, calibration=one) for view, one in pairs))

    @staticmethod
    def of(calibration: Calibration, name: str = "") -> "CalibratedViews":
        """Return the views of a capture of one view."""
        return CalibratedViews((CalibratedView(name, calibration),))


def save_views(views: CalibratedViews, path: Path) -> None:
    """Write the calibrations as JSON, whole or not at all.

    Raises:
        CalibrationError: load_views would refuse it; names the field. Nothing is written.
    """
    document = _document(views)
    _views(JsonField(document, str(path)))
    write_json(path, document)


def load_views(path: Path) -> CalibratedViews:
    """Return the views in a JSON file written by save_views or save_calibration.

    Raises:
        CalibrationError: no such file, or a field is missing, of the wrong kind, or impossible; names the field.
    """
    return _views(read_document(path))


def _document(views: CalibratedViews) -> dict[str, Any]:
    document, *further = (
        ({"view": view.name} if view.name else {}) | calibration_document(view.calibration) for view in views.views
    )
    left_out = [{"view": name, "reason": reason} for name, reason in views.left_out]
    lies = [{"lie": lie.name} | _document(lie) for lie in views.lies]
    more = {"further_views": further, "left_out": left_out, "lies": lies}
    return document | {name: entries for name, entries in more.items() if entries}


def _views(document: JsonField) -> CalibratedViews:
    first = calibration_of(document)
    views = [CalibratedView(_name(document.get("view", "")), first)]
    for field in document.get("further_views", []).entries(MOST_VIEWS):
        found = calibration_of(field)
        if (found.unit, found.ground_height) != (first.unit, first.ground_height):
            raise field["ground"].refuse("the unit and the ground of the first view, which all share, were")
        views.append(CalibratedView(_name(field["view"]), found))
    names = [view.name for view in views]
    if len(set(names)) < len(names):
        raise document["further_views"].refuse("a name of its own for each view was")
    left_out = [(_name(one["view"]), one["reason"].text()) for one in document.get("left_out", []).entries(MOST_VIEWS)]
    lies = []
    for field in document.get("lies", []).entries(MOST_LIES):
        if isinstance(field.value, dict) and field.value.get("lies"):
            raise field["lies"].refuse("no lies of a lie were")
        lies.append(replace(_views(field), name=_name(field["lie"])))
    return CalibratedViews(tuple(views), tuple(left_out), tuple(lies))


def _name(field: JsonField) -> str:
    """Return the name of a view: a folder's, or two of them, as turned_1/view_2."""
    parts = field.text().split("/")
    if parts == [""]:
        return ""
    if len(parts) > 2:
        raise field.refuse("the name of a folder was")
    return "/".join(JsonField(part, field.file, field.name, field.advice).file_name() for part in parts)
