"""Colours of a surface that is still being solved: those of the mean of the photos, before any albedo is known."""

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from scipy.spatial import KDTree
from torch import Tensor
from trimesh.visual import ColorVisuals

from calibration.posed_camera import PosedCamera
from capture.photos.photo import encode_srgb

WHITE_SHARE = 0.99  # of the pixels on the object are darker than what is drawn as BRIGHT
BRIGHT = 0.8  # linear
FACING = 0.2  # cosine between normal and line of sight from which a vertex takes the colour of its own pixel


class PhotoColours:
    """The mean of one camera's photos, and the colours that it gives to meshes."""

    def __init__(self, camera: PosedCamera, photos: Float[Tensor, "photos height width 3"] | None):
        """Average the photos, linear, on the camera's grid; shadow pictures alone (None) have no colours."""
        self._camera = camera
        self._mean = None if photos is None else photos.mean(0).numpy()

    def coloured(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """Give a mesh its colours per vertex, sRGB, and return it; without photos it stays as it is.

        Vertices that face the camera take the colour of their pixel; what hides them is not looked for. All others take
        that of the nearest vertex that does. The brightest one per cent is drawn as BRIGHT.

        Args:
            mesh: world frame, with normals.
        """
        if self._mean is None or not len(mesh.vertices):
            return mesh
        vertices = np.asarray(mesh.vertices, np.float64)
        towards = self._camera.centre - vertices
        cosine = (np.asarray(mesh.vertex_normals) * towards).sum(1) / np.linalg.norm(towards, axis=1)
        height, width = self._mean.shape[:2]
        column, row = np.round(self._camera.project_with_depth(vertices)[0]).T
        faces = np.flatnonzero((cosine > FACING) & (column >= 0) & (column < width) & (row >= 0) & (row < height))
        if len(faces):
            mesh.visual = ColorVisuals(mesh, vertex_colors=self._nearest(vertices, faces, row, column))
        return mesh

    def _nearest(
        self, vertices: np.ndarray, faces: np.ndarray, row: np.ndarray, column: np.ndarray
    ) -> UInt8[np.ndarray, "n 3"]:
        """Return the colour of each vertex: of its pixel, or that of the nearest of those which face the camera."""
        assert self._mean is not None
        seen = self._mean[row[faces].astype(np.int64), column[faces].astype(np.int64)]
        seen = encode_srgb(np.clip(seen * BRIGHT / max(float(np.quantile(seen, WHITE_SHARE)), 1e-6), 0, 1))
        return np.asarray(seen)[KDTree(vertices[faces]).query(vertices)[1]]
