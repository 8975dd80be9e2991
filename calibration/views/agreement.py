"""Whether views see one object at one place."""

from collections.abc import Sequence

from calibration.calibrated_views import CalibratedViews
from capture.photos.photo import PhotoStack


def agree(views: CalibratedViews, stacks: Sequence[PhotoStack]) -> CalibratedViews:
    """TODO"""
    return views
