"""CalibratedViews: the calibrations of several views of one object in one world, and their file.

The file is calibration.json as Calibration writes it, for the first view; those of the others follow in
`further_views`, those of further lies of the object in `lies`. A reader that knows one view finds the first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from calibration.calibration import Calibration, CalibrationFile, calibration_document
from capture.files.atomic import write_json
from capture.files.schema import LONGEST_NAME, Text, as_type, check_numbers, read_as, refused
from capture.session.capture import MOST_LIES, MOST_VIEWS


@dataclass(frozen=True, eq=False)
class CalibratedView:
    """One place of the tripod."""

    name: str  # of the view's folder; "" where there is one view
    calibration: Calibration


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
    check_numbers(document, str(path))
    as_type(document, _Views, str(path))
    write_json(path, document)


def load_views(path: Path) -> CalibratedViews:
    """Return the views in a JSON file written by save_views or save_calibration.

    Raises:
        CalibrationError: no such file, or a field is missing, of the wrong kind, or impossible; names the field.
    """
    found, document = read_as(path, _Views)
    return found.views(document)


def _document(views: CalibratedViews) -> dict[str, Any]:
    document, *further = (
        ({"view": view.name} if view.name else {}) | calibration_document(view.calibration) for view in views.views
    )
    left_out = [{"view": name, "reason": reason} for name, reason in views.left_out]
    lies = [{"lie": lie.name} | _document(lie) for lie in views.lies]
    more = {"further_views": further, "left_out": left_out, "lies": lies}
    return document | {name: entries for name, entries in more.items() if entries}


ViewName = Annotated[
    str,
    Meta(
        pattern=r"\A(?!\.{1,2}(/|\Z))[^/\0]*(?<!\A)(/(?!\.{1,2}\Z)[^/\0]+)?\Z|\A\Z",
        max_length=LONGEST_NAME,
        description="the name of a folder",
    ),
]  # or of two of them, as turned_1/view_2; "" where there is one view


class _LeftOut(Struct):
    view: ViewName
    reason: Text


class _View(CalibrationFile, kw_only=True):
    view: ViewName = ""


class _Views(_View, kw_only=True):
    """The content of calibration.json, of all views and lies."""

    further_views: Annotated[tuple[_View, ...], Meta(max_length=MOST_VIEWS)] = ()
    left_out: Annotated[tuple[_LeftOut, ...], Meta(max_length=MOST_VIEWS)] = ()
    lies: "Annotated[tuple[_Lie, ...], Meta(max_length=MOST_LIES)]" = ()

    def __post_init__(self) -> None:
        CalibrationFile.__post_init__(self)
        for k, one in enumerate(self.further_views):
            if (one.units, one.ground.offset) != (self.units, self.ground.offset):
                needed = "the unit and the ground of the first view, which all share"
                raise refused(f"further_views[{k}].ground", one.ground, needed)
        names = [view.view for view in (self, *self.further_views)]
        if len(set(names)) < len(names):
            raise refused("further_views", names, "a name of its own for each view")
        for k, lie in enumerate(self.lies):
            if lie.lies:
                raise refused(f"lies[{k}].lies", lie.lies, "no lies of a lie")

    def views(self, document: Mapping[str, Any], name: str = "") -> CalibratedViews:
        """Return the views; `document` is the same content in JSON's types."""
        pairs = zip((self, *self.further_views), (document, *document.get("further_views", ())), strict=True)
        lies = zip(self.lies, document.get("lies", ()), strict=True)
        return CalibratedViews(
            tuple(CalibratedView(one.view, one.calibration(own)) for one, own in pairs),
            tuple((one.view, one.reason) for one in self.left_out),
            tuple(lie.views(own, lie.lie) for lie, own in lies),
            name,
        )


class _Lie(_Views, kw_only=True):
    lie: ViewName
