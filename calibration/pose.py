"""Rigid transforms, named right to left like the product: world_from_camera.apply(p_camera) is p_world."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

ROTATION_ATOL = 1e-6  # float64 products of a few rotations stay far below; a scaled or sheared matrix does not


@dataclass(frozen=True, eq=False)
class Pose:
    """A rotation and a translation, b_from_a: x_b = rotation @ x_a + translation."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def __post_init__(self):
        orthonormal = np.allclose(self.rotation @ self.rotation.T, np.eye(3), rtol=0, atol=ROTATION_ATOL)
        if not orthonormal or np.linalg.det(self.rotation) < 0:
            raise ValueError("Pose.rotation is not a rotation matrix")
        if not np.isfinite(self.translation).all():
            raise ValueError("Pose.translation is not finite")

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Pose)
            and np.array_equal(self.rotation, other.rotation)
            and np.array_equal(self.translation, other.translation)
        )

    __hash__ = None  # type: ignore[assignment]  # holds arrays

    @staticmethod
    def from_matrix(matrix: Float[np.ndarray, "4 4"]) -> "Pose":
        """Return the pose of a 4x4 homogeneous matrix.

        Raises:
            ValueError: it contains no rotation, or a translation that is not finite.
        """
        return Pose(np.array(matrix[:3, :3], float), np.array(matrix[:3, 3], float))

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Return the 4x4 homogeneous matrix."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    def inverse(self) -> "Pose":
        """Return a_from_b."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: "Pose") -> "Pose":
        """Return c_from_a = c_from_b @ b_from_a."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Transform points of frame a to frame b."""
        return points @ self.rotation.T + self.translation

    def rotate(self, directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Rotate directions of frame a to frame b."""
        return directions @ self.rotation.T
