"""CalibratedViews: the calibrations of several views of one object in one world, and their file.

The file is calibration.json as Calibration writes it, for the first view; those of the others follow in
`further_views`, those of further object poses in `lies`. A reader that knows one view finds the first.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct, field

from calibration.calibration import Calibration, CalibrationFile, calibration_document
from capture.files.atomic import write_json
from capture.files.schema import LONGEST_NAME, Text, as_type, check_numbers, read_as, refused
from capture.session.capture import MOST_OBJECT_POSES, MOST_VIEWS


@dataclass(frozen=True, eq=False)
class CalibratedView:
    """One place of the tripod."""

    name: str  # of the view's folder; "" where there is one view
    calibration: Calibration


@dataclass(frozen=True, eq=False)
class CalibratedViews:
    """Views in one world frame (that of their board), in order; and the object poses in which it was laid anew."""

    views: tuple[CalibratedView, ...]  # at least one
    left_out: tuple[tuple[str, str], ...] = ()  # views that are not used: name, and the sentence that says why
    object_poses: tuple["CalibratedViews", ...] = ()  # each in the frame of its own board
    name: str = ""  # of an object pose

    @property
    def first(self) -> Calibration:
        """The first view's calibration."""
        return self.views[0].calibration

    def every(self) -> tuple[CalibratedView, ...]:
        """Return all views, those of further object poses last."""
        return (*self.views, *(view for one in self.object_poses for view in one.every()))

    def with_calibrations(self, calibrations: Sequence[Calibration]) -> "CalibratedViews":
        """Return the same views with other calibrations, in their order."""
        pairs = zip(self.views, calibrations, strict=True)
        return replace(self, views=tuple(replace(view, calibration=one) for view, one in pairs))

    def changed(self, change: Callable[[Calibration], Calibration]) -> "CalibratedViews":
        """Return the same views, those of all object poses included, each with its calibration changed."""
        views = self.with_calibrations([change(view.calibration) for view in self.views])
        return replace(views, object_poses=tuple(one.changed(change) for one in self.object_poses))

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
    object_poses = [{"lie": one.name} | _document(one) for one in views.object_poses]
    more = {"further_views": further, "left_out": left_out, "lies": object_poses}
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
    """The content of calibration.json, of all views and object poses."""

    further_views: Annotated[tuple[_View, ...], Meta(max_length=MOST_VIEWS)] = ()
    left_out: Annotated[tuple[_LeftOut, ...], Meta(max_length=MOST_VIEWS)] = ()
    object_poses: "Annotated[tuple[_ObjectPose, ...], Meta(max_length=MOST_OBJECT_POSES)]" = field(
        name="lies", default=()
    )

    def __post_init__(self) -> None:
        CalibrationFile.__post_init__(self)
        for k, one in enumerate(self.further_views):
            if (one.units, one.ground.offset) != (self.units, self.ground.offset):
                needed = "the unit and the ground of the first view, which all share"
                raise refused(f"further_views[{k}].ground", one.ground, needed)
        names = [view.view for view in (self, *self.further_views)]
        if len(set(names)) < len(names):
            raise refused("further_views", names, "a name of its own for each view")
        for k, one in enumerate(self.object_poses):
            if one.object_poses:
                raise refused(f"lies[{k}].lies", one.object_poses, "no object poses of an object pose")

    def views(self, document: Mapping[str, Any], name: str = "") -> CalibratedViews:
        """Return the views; `document` is the same content in JSON's types."""
        pairs = zip((self, *self.further_views), (document, *document.get("further_views", ())), strict=True)
        object_poses = zip(self.object_poses, document.get("lies", ()), strict=True)
        return CalibratedViews(
            tuple(CalibratedView(one.view, one.calibration(own)) for one, own in pairs),
            tuple((one.view, one.reason) for one in self.left_out),
            tuple(one.views(own, one.name) for one, own in object_poses),
            name,
        )


class _ObjectPose(_Views, kw_only=True):
    name: ViewName = field(name="lie")
