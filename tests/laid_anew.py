"""A finished run of one camera that photographed two object poses, from the same place of the object's frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from fake_run import Truth, fields_of, mesh_of
from scipy.spatial.transform import Rotation

from calibration.calibrated_views import CalibratedView, CalibratedViews, save_views
from calibration.calibration import Calibration
from calibration.pose import Pose
from reconstruct.fields import FurtherView, save_fields


def turned_by(own: Calibration) -> tuple[Pose, CalibratedViews]:
    """object_from_world of the object laid anew, and the pose turned_1 that sees it as this calibration does."""
    motion = Pose(Rotation.from_euler("z", 40, degrees=True).as_matrix(), np.array([80.0, -30.0, 0.0]))
    back = motion.inverse()  # the same camera and lights, in another object pose's world
    lights = tuple(replace(x, position=back.apply(np.array(x.position))) for x in own.lights)
    turned = replace(own, world_from_camera=back @ own.world_from_camera, lights=lights, side_views=())
    return motion, CalibratedViews((CalibratedView("turned_1", turned),), name="turned_1")


def laid_anew(folder: Path, truth: Truth) -> Path:
    """Write the run; the views are view_1 and turned_1, and told in the object's frame they are the same."""
    folder.mkdir()
    own, (motion, pose) = truth.calibration, turned_by(truth.calibration)
    save_views(CalibratedViews((CalibratedView("view_1", own),), object_poses=(pose,)), folder / "calibration.json")
    fields = replace(fields_of(truth), view="view_1")
    place = pose.first.world_from_camera
    there = FurtherView("turned_1", fields.albedo, fields.camera, place, object_from_world=motion)
    save_fields(replace(fields, further=(there,)), folder / "fields.safetensors")
    mesh_of(fields).export(folder / "mesh.ply")
    return folder
