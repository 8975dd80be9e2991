"""Rotations spread evenly over all of them, and small rigid motions."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from calibration.pose import Pose

PHI = 2**0.5  # the two irrational numbers of the spiral
PSI = 1.533751168755204288118041  # psi^4 = psi + 4


def even_rotations(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Return rotations on the Super-Fibonacci spiral [Alexa 2022, Super-Fibonacci Spirals: Fast, Low-Discrepancy
    Sampling of SO(3)]: 4096 leave no rotation farther than some 15 degrees from one of them.
    """
    s = np.arange(count) + 0.5
    small, large = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / PHI, 2 * np.pi * s / PSI
    quaternions = np.stack(
        [small * np.sin(alpha), small * np.cos(alpha), large * np.sin(beta), large * np.cos(beta)], 1
    )
    return Rotation.from_quat(quaternions).as_matrix()


def angle_between(a: Float[np.ndarray, "3 3"], b: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle of the rotation that brings one orientation to the other, rad."""
    return float(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1.0, 1.0)))


def stepped(pose: Pose, step: Float[np.ndarray, "6"], about: Float[np.ndarray, "3"]) -> Pose:
    """Return a motion followed by a small one: a turn (rotation vector, rad) about a point, then a shift."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return Pose(turn @ pose.rotation, turn @ (pose.translation - about) + about + step[3:])
