import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibration.pose import Pose

vectors = st.tuples(*[st.floats(-500, 500)] * 3).map(np.array)
angles = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
poses = st.builds(lambda r, t: Pose(Rotation.from_rotvec(r).as_matrix(), t), angles, vectors)


@settings(deadline=None)
@given(poses, vectors)
def test_a_pose_and_its_inverse_cancel(pose, point):
    assert np.allclose(pose.inverse().apply(pose.apply(point)), point, atol=1e-9)


@settings(deadline=None)
@given(poses, poses, vectors)
def test_a_product_applies_its_right_factor_first(c_from_b, b_from_a, point):
    # Rounding of float64 at lengths up to 1000.
    assert np.allclose((c_from_b @ b_from_a).apply(point), c_from_b.apply(b_from_a.apply(point)), atol=1e-9)


def test_the_translation_of_world_from_camera_is_the_camera_centre():
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([10.0, 20.0, 300.0]))
    assert np.array_equal(pose.apply(np.zeros(3)), [10, 20, 300])


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1, -1]), 1.01 * np.eye(3), np.full((3, 3), np.nan)])
def test_a_mirror_a_scaling_and_nan_are_no_rotations(matrix):
    with pytest.raises(ValueError):
        Pose(matrix, np.zeros(3))
