"""What goes wrong while one photographs: an arm in the picture, a shaken phone, a touched tripod. World frame, mm."""

import cv2
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from calibration.camera import Camera
from calibration.pose import Pose
from capture.errors import CaptureError

from .options import Setup
from .poses import Lamp, Viewpoint, nudged
from .shapes import Points, Solid, Values, ball, melted, mesh_of, rod

SKIN, SLEEVE = (0.47, 0.30, 0.22), (0.10, 0.13, 0.22)
CUFF_MM = 95.0  # from the palm
GAP_MM = 28.0  # between fingers and object
OVER_TABLE_MM = 55.0  # the palm's middle
AGAIN_MM = 2.0  # a hand that stays is still not quite still
FULL_WIDTH = 1008  # px, to which lengths in px refer
ROLL_SHARE = 0.4  # of a tap's turn
TAP_SHIFT_MM = 0.3
SHAKE_STEPS = 24

Picture = Float[np.ndarray, "height width 3"]


def refuse_impossible(setup: Setup) -> None:
    """Check the settings that name photos.

    Raises:
        CaptureError: a photo that there is not.
    """
    count, hand = setup.flashlight.photos, setup.hand
    for name in ("arm", "shaken", "no_flash", "tapped", "twice"):
        wrong = [i for i in getattr(hand, name) if not 1 <= i <= count]
        if wrong:
            raise CaptureError(
                f"--{name.replace('_', '-')} {wrong[0]}: there are photos 1 to {count}. Name one of them."
            )
    if 1 in hand.twice:
        raise CaptureError("--twice 1: before photo 1 there is none. Name a later photo.")


def fault(setup: Setup, photo: int) -> str | None:
    """Return why a photo should be left out."""
    hand = setup.hand
    faults = {
        "the flashlight did not fire": hand.no_flash,
        "an arm in the picture, and its shadow": hand.arm,
        "camera shaken during the exposure": hand.shaken,
        "camera moved": setup.exposure.moved,
    }
    return next((why for why, photos in faults.items() if photo in photos), None)


def views(fixed: Viewpoint, setup: Setup) -> list[Viewpoint]:
    """Return the camera of each photo: a tap shifts it for good, and --moved for one photo."""
    rng, current, out = setup.stream("tripod"), fixed, []
    for photo in range(1, setup.flashlight.photos + 1):
        if photo in setup.hand.tapped:
            current = tapped(current, setup.hand.tapped_px, rng)
        is_moved = photo in setup.exposure.moved
        out.append(nudged(current, setup.exposure.moved_mm, rng) if is_moved else current)
    return out


def tapped(view: Viewpoint, pixels: float, rng: np.random.Generator) -> Viewpoint:
    """Return the view of a camera that was turned so far that the picture shifts by `pixels` at 1008 px width."""
    camera, pose = view.camera, view.world_from_camera
    angle = pixels * camera.width / FULL_WIDTH / camera.fx
    way = rng.uniform(0, 2 * np.pi)
    turn = angle * np.array([np.cos(way), np.sin(way), ROLL_SHARE * rng.standard_normal()])
    shift = TAP_SHIFT_MM * rng.standard_normal(3)
    return Viewpoint(camera, Pose(pose.rotation @ Rotation.from_rotvec(turn).as_matrix(), pose.translation + shift))


def held(lamps: list[Lamp], setup: Setup) -> list[Lamp]:
    """Return the flashlights as the hand holds them: in one place for two photos, and in motion."""
    rng, out = setup.stream("hand"), []
    for photo, lamp in enumerate(lamps, 1):
        again = AGAIN_MM * rng.standard_normal(3)
        if photo in setup.hand.twice:
            lamp = Lamp(out[-1].position + again, out[-1].axis)
        way = rng.standard_normal(3)
        length = setup.flashlight.sweep * rng.uniform(0.2, 1)
        out.append(Lamp(lamp.position, lamp.axis, length * way / np.linalg.norm(way)))
    return out


def shaken(linear: Picture, camera: Camera, pixels: float, rng: np.random.Generator) -> Picture:
    """Return the picture of a camera that turned during the exposure, in an arc `pixels` long at 1008 px width.

    A turn moves the pixels by K R K^-1; the lens's distortion is the same before and after for so small a turn.
    """
    way = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(way), np.sin(way), 0.2 * rng.standard_normal()])
    bend = np.array([-along[1], along[0], 0.0]) * rng.uniform(-0.6, 0.6)
    angle = pixels * camera.width / FULL_WIDTH / camera.fx
    k, out = camera.matrix(), np.zeros_like(linear, np.float32)
    for t in np.linspace(-0.5, 0.5, SHAKE_STEPS):
        turn = Rotation.from_rotvec(angle * (t * along + (t * t - 0.08) * bend)).as_matrix()
        home = k @ turn @ np.linalg.inv(k)
        size = (linear.shape[1], linear.shape[0])
        out += cv2.warpPerspective(linear, home, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out / SHAKE_STEPS


def arm(view: Viewpoint, thing: trimesh.Trimesh, rng: np.random.Generator) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return a hand and sleeve that reach into the picture from a side, and their albedo per vertex."""
    right = view.world_from_camera.rotation[:, 0] * [1, 1, 0]
    right *= rng.choice([-1.0, 1.0]) / np.linalg.norm(right)
    mesh = mesh_of(Solid(_hand, (-85, -55, -35), (420, 60, 160)), cells=160)
    colour = np.where(mesh.vertices[:, :1] > CUFF_MM, SLEEVE, SKIN)
    middle = thing.bounds.mean(0)
    width = np.abs((thing.vertices - middle) @ right).max()
    away = width + GAP_MM + 80  # the fingers are 80 mm long
    place = np.eye(4)
    place[:3, :3] = np.stack([right, np.cross([0, 0, 1], right), [0, 0, 1]], 1)
    place[:3, 3] = middle + away * right
    place[2, 3] = OVER_TABLE_MM
    normals = np.array(mesh.vertex_normals) @ place[:3, :3].T
    mesh.apply_transform(place)
    mesh.vertex_normals = normals
    return mesh, colour


def _hand(p: Points) -> Values:
    """Palm at the origin, fingers towards -x, sleeve towards +x and up."""
    fingers = [rod(p, (-20, y, 0), (-72 + abs(y - 4) * 0.7, 1.15 * y, -12), 8.5) for y in (-27, -9, 9, 27)]
    fingers.append(rod(p, (0, -30, -4), (-38, -46, -14), 9.5))
    palm = [rod(p, (-15, y, 0), (25, 0.6 * y, 2), 14.0) for y in (-22, 0, 22)]
    forearm = [rod(p, (20, 0, 2), (150, 0, 40), 24.0)]
    sleeve = rod(p, (120, 0, 32), (420, 0, 120), 37.0)
    return np.minimum(melted([*palm, *fingers, *forearm, ball(p, (5, 0, 2), 20)], 10.0), sleeve)
