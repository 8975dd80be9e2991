"""Backdrop: shows the computed picture in the scene itself, for the visitor who asked for it."""

import math
import threading
from collections.abc import Callable

import numpy as np
import trimesh
import viser
from scipy.ndimage import minimum_filter

from calibration.camera import Camera
from calibration.pose import Pose
from viewer.display.layers import PageScale
from viewer.relighting.worker import Rendering, Viewpoint

NEARER = 0.99  # of the depth that the browser gets: the picture hides the browser's own surface and ground
FARTHEST = 160.0  # page units: what viser's 24 bits of depth hold
OUTLINE = 400  # of the width: by so much the picture's object hides the edge of the browser's own
JPEG_QUALITY = 90
STILL = 1e-4  # page units and quaternion: a smaller change is no move


class Backdrop:
    """Follows the browsers' cameras and shows a picture to the one that moved last, until it moves again."""

    def __init__(self, server: viser.ViserServer, moved: Callable[[], None]):
        """Wait for `follow`.

        Args:
            moved: a visitor looks from elsewhere; called in viser's threads.
        """
        self._server, self._moved = server, moved
        self._lock = threading.Lock()
        self._is_on = self._is_shown = False
        self._client: viser.ClientHandle | None = None
        self._seen: np.ndarray | None = None
        server.on_client_connect(lambda client: client.camera.on_update(lambda _: self._camera_moved(client)) and None)

    def follow(self, is_on: bool) -> None:
        """Start to follow the cameras, or stop and remove the picture."""
        self._is_on = is_on
        if is_on and self._client is None:
            self._client = next(iter(self._server.get_clients().values()), None)
        if not is_on:
            self.clear()

    def place(self, scale: PageScale) -> Viewpoint | None:
        """Return the camera of the visitor who moved last, world; None while there is no visitor."""
        client = self._client
        return None if client is None else viewpoint_of(client.camera, scale)

    def show(self, rendering: Rendering, scale: PageScale) -> None:
        """Show the picture behind the scene, unless the visitor has moved on."""
        client, depth = self._client, rendering.view.maps.depth.numpy()
        if client is None or not self._is_on:
            return
        near = np.where(np.isfinite(depth), NEARER * scale.factor * depth, FARTHEST)
        near = minimum_filter(near, 1 + 2 * math.ceil(near.shape[1] / OUTLINE))[..., None]
        with self._lock:
            self._is_shown = True
            client.scene.set_background_image(
                rendering.picture, "jpeg", jpeg_quality=JPEG_QUALITY, depth=np.minimum(near, FARTHEST)
            )

    def clear(self) -> None:
        """Show the browser's own drawing again."""
        with self._lock:
            client, was_shown = self._client, self._is_shown
            self._is_shown = False
            if was_shown and client is not None:
                client.scene.set_background_image(None)

    def _camera_moved(self, client: viser.ClientHandle) -> None:
        camera = client.camera
        now = np.array([*camera.position, *camera.wxyz, camera.fov, camera.image_width, camera.image_height])
        if client is self._client and self._seen is not None and np.allclose(now, self._seen, rtol=0, atol=STILL):
            return
        if client is not self._client:
            self.clear()
        self._client, self._seen = client, now
        if self._is_on:
            self.clear()
            self._moved()


def viewpoint_of(camera: viser.CameraHandle, scale: PageScale) -> Viewpoint | None:
    """Return a browser's camera in the world; None where its numbers make no camera: a client may send anything."""
    numbers = np.array([*camera.position, *camera.wxyz, camera.fov], dtype=np.float64)
    width, height = int(camera.image_width), int(camera.image_height)
    if not np.isfinite(numbers).all() or not 0.01 < camera.fov < 3.1 or not (16 <= width < 2**14 > height >= 16):
        return None
    length = 0.5 * height / np.tan(0.5 * camera.fov)
    pinhole = Camera(width, height, length, length, 0.5 * (width - 1), 0.5 * (height - 1))
    rotation = trimesh.transformations.quaternion_matrix(camera.wxyz)[:3, :3]
    return Viewpoint(pinhole, Pose(rotation, scale.to_world(np.asarray(camera.position, dtype=np.float64))))
