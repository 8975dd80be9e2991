"""The layers of the scene, one draw_* function each: calibration and meshes become objects of a viser scene.

The page draws the world in its own axes, scaled so that the camera stands CAMERA_DISTANCE units from the ground it
looks at: viser's clipping planes, shadow maps and handles are made for a few units, not for hundreds of millimetres.
A Host is the server, whose scene all browsers share, or one browser, which then has a scene of its own.
"""

from dataclasses import dataclass

import numpy as np
import viser
import viser.transforms
from jaxtyping import Float

from calibration.calibration import Calibration
from calibration.light import Light
from capture.photos.photo import decode_srgb
from reconstruct.mesh.glb import write_glb
from reconstruct.stored_run.ply import Triangles

Host = viser.ViserServer | viser.ClientHandle

CAMERA_DISTANCE = 5.0  # page units
GROUND_SIZE = 200.0  # page units: past the horizon of every view, short of the far plane
BULB_RADIUS = 0.07  # page units
SIGMAS_SHOWN = 2.0  # half axes of an uncertainty ellipsoid, in standard deviations: 95 % along each axis
LAMP_RADIUS = 1.6 * BULB_RADIUS  # at least
LEAST_HALO = 1e-4  # page units: an ellipsoid must not be flat
FRUSTUM_DEPTH = 0.4  # page units
HULL_COLOUR, HULL_OPACITY = (126, 168, 255), 0.3
BLACK, WHITE = (0, 0, 0), (255, 255, 255)
FROM_BELOW = ((200, 190, 180), 2.0)  # colour and strength of what a table in daylight throws back
BY_NIGHT = ((90, 85, 80), 0.7)  # so that what the lamp does not reach is neither black nor flat
CLAY = (200, 160, 120)  # of a mesh without colours: the ground is grey
FIRST_FOV = float(np.radians(55.0))  # vertical
FIRST_TURN, FLATTER = np.radians(42.0), (1.0, 1.0, 0.6)  # the first view stands beside the camera, lower: it is seen
FIRST_FARTHEST = 1.7 * CAMERA_DISTANCE  # shows most lights; farther, the object is small
FIRST_RAISED = 0.3 * CAMERA_DISTANCE

AMBER, GREY, CHOSEN, PLAIN = (255, 184, 77), (120, 124, 134), (255, 92, 56), (196, 200, 208)


@dataclass(frozen=True)
class PageScale:
    """Converts between world and page: page units per world length, and the ground point that the camera looks at."""

    factor: float
    centre: Float[np.ndarray, "3"]

    def to_page(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Convert world points to the page."""
        return world * self.factor


def page_scale(calibration: Calibration) -> PageScale:
    """Choose the scale from the camera alone, so that it does not change while lights and mesh come in."""
    pose = calibration.world_from_camera
    eye, forward = pose.translation, pose.rotation[:, 2]
    drop = calibration.ground_height - eye[2]
    distance = drop / forward[2] if forward[2] * drop > 0 else abs(drop) or 1.0
    return PageScale(CAMERA_DISTANCE / distance, eye + distance * forward)


def light_position(light: Light, scale: PageScale) -> Float[np.ndarray, "3"]:
    """Return where a light is drawn, page units: its position, or, of a directional one, that way from the centre."""
    *place, is_near = light.homogeneous()
    way = np.array(place)
    return scale.to_page(way) if is_near else scale.to_page(scale.centre) + CAMERA_DISTANCE * way


def first_view(calibration: Calibration, scale: PageScale) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Choose eye and target on the page, so that camera, ground and most lights are in view."""
    target = scale.to_page(scale.centre) + np.array([0.0, 0.0, FIRST_RAISED])
    back = _beside((calibration.world_from_camera.translation - scale.centre) * FLATTER, FIRST_TURN)
    return target + back * FIRST_FARTHEST, target


def _beside(way: Float[np.ndarray, "3"], turn: float) -> Float[np.ndarray, "3"]:
    """Return the unit vector of a direction that was turned about the vertical, rad."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([c * way[0] - s * way[1], s * way[0] + c * way[1], way[2]]) / np.linalg.norm(way)


def light_room(host: Host, has_lamp: bool) -> None:
    """Add ambient light: a faint one beside a lamp, else daylight and what the table reflects upwards."""
    host.scene.configure_default_lights(not has_lamp, cast_shadow=False)
    sky, (below, strength) = (WHITE, BY_NIGHT) if has_lamp else (BLACK, FROM_BELOW)
    host.scene.add_light_hemisphere(
        "/room", sky_color=sky, ground_color=below, intensity=strength, position=(0.0, 0.0, 1.0)
    )


def draw_ground(host: Host, calibration: Calibration, scale: PageScale) -> list[viser.SceneNodeHandle]:
    """Draw the ground plane, with lines every 10 and 50 mm, or every tenth and half of a scene unit."""
    cell = scale.factor * (10.0 if calibration.unit == "mm" else 0.1)
    centre = scale.to_page(scale.centre)
    corners = 0.5 * GROUND_SIZE * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    below = np.array([0, 0, 2e-3 * CAMERA_DISTANCE])  # no flicker with the grid, or with the mesh's base
    plane = host.scene.add_mesh_simple(
        "/ground/plane",
        corners,
        np.array([[0, 1, 2], [0, 2, 3]]),
        color=(150, 152, 158),
        side="double",
        cast_shadow=False,
        position=centre - below,
    )
    grid = host.scene.add_grid(
        "/ground/grid",
        GROUND_SIZE,
        GROUND_SIZE,
        cell_size=cell,
        section_size=5 * cell,
        cell_color=(140, 142, 149),
        section_color=(122, 125, 133),
        cell_thickness=0.5,
        section_thickness=0.7,
        fade_distance=4 * CAMERA_DISTANCE,
        shadow_opacity=0.0,
        position=centre * [0, 0, 1],
    )
    return [plane, grid]


def draw_camera(host: Host, calibration: Calibration, scale: PageScale, number: int = 0) -> viser.CameraFrustumHandle:
    """Draw the camera as a frustum; its `image` is the photo that is looked at.

    Args:
        number: of the view, where there are several.
    """
    camera, pose = calibration.camera, calibration.world_from_camera
    return host.scene.add_camera_frustum(
        f"/camera_{number}" if number else "/camera",
        2 * float(np.arctan(0.5 * camera.height / camera.fy)),
        camera.width / camera.height,
        scale=FRUSTUM_DEPTH,
        color=PLAIN,
        thickness=0.009,
        format="jpeg",
        wxyz=viser.transforms.SO3.from_matrix(pose.rotation).wxyz,
        position=scale.to_page(pose.translation),
        cast_shadow=False,
        receive_shadow=False,
    )


@dataclass(frozen=True)
class LightMarker:
    """The drawing of one light."""

    light: Light
    bulb: viser.IcosphereHandle
    halo: viser.IcosphereHandle  # its uncertainty

    def choose(self, is_chosen: bool) -> None:
        """Mark the light of the photo that is looked at."""
        self.bulb.color = CHOSEN if is_chosen else AMBER if self.light.used else GREY
        self.bulb.scale = 1.5 if is_chosen else 1.0

    def show(self, is_shown: bool, has_halo: bool) -> None:
        """Show or hide the light and its uncertainty; a light that was not used has none to show."""
        self.bulb.visible = is_shown
        self.halo.visible = has_halo and self.light.used and bool(np.any(self.light.sigma > 0))

    def remove(self) -> None:
        """Remove it from the page."""
        self.bulb.remove()
        self.halo.remove()


def draw_light(host: Host, index: int, light: Light, scale: PageScale) -> LightMarker:
    """Draw a light as a ball in an ellipsoid of two sigma; an unused one as a grey wire ball without ellipsoid."""
    place = light_position(light, scale)
    colour = AMBER if light.used else GREY
    bulb = host.scene.add_icosphere(
        f"/lights/{index}/bulb",
        BULB_RADIUS,
        colour,
        subdivisions=2 if light.used else 1,
        wireframe=not light.used,
        cast_shadow=False,
        receive_shadow=False,
        position=place,
    )
    reach = light.sigma * (scale.factor if light.position is not None else CAMERA_DISTANCE)
    a, b, c = np.maximum(SIGMAS_SHOWN * reach, LEAST_HALO).tolist()
    halo = host.scene.add_icosphere(
        f"/lights/{index}/uncertainty",
        1.0,
        colour,
        subdivisions=2,
        scale=(a, b, c),
        opacity=0.25,
        cast_shadow=False,
        receive_shadow=False,
        position=place,
    )
    return LightMarker(light, bulb, halo)


def draw_mesh(host: Host, mesh: Triangles, scale: PageScale, visible: bool) -> viser.MeshHandle | viser.GlbHandle:
    """Draw the growing surface: in the colours of the photos, or like clay where it has none."""
    if mesh.colours is not None and mesh.normals is not None:
        glb = write_glb(mesh.vertices, mesh.normals, decode_srgb(mesh.colours[:, :3]), mesh.faces)
        return host.scene.add_glb("/mesh", glb, scale=scale.factor, visible=visible)
    return host.scene.add_mesh_simple(
        "/mesh", mesh.vertices, mesh.faces, color=CLAY, side="double", scale=scale.factor, visible=visible
    )


def draw_hull(host: Host, hull: Triangles, scale: PageScale, visible: bool) -> viser.MeshHandle:
    """Draw the shadow hull, transparent: the space that no lit ground has proven empty."""
    return host.scene.add_mesh_simple(
        "/hull",
        hull.vertices,
        hull.faces,
        scale=scale.factor,
        color=HULL_COLOUR,
        opacity=HULL_OPACITY,
        side="double",
        cast_shadow=False,
        receive_shadow=False,
        visible=visible,
    )


@dataclass(frozen=True)
class LampMarker:
    """The drawing of the light that can be dragged."""

    handle: viser.TransformControlsHandle
    light: viser.PointLightHandle
    bulb: viser.IcosphereHandle
    host: Host

    def show(self, is_shown: bool) -> None:
        """Show or hide all of it, and let the lamp, or else daylight, light the surface."""
        self.handle.visible = self.light.visible = self.bulb.visible = is_shown
        light_room(self.host, has_lamp=is_shown)


def draw_lamp(host: Host, place: Float[np.ndarray, "3"], floor: float) -> LampMarker:
    """Draw a light with a handle at `place`, page units; it cannot be dragged below the height `floor`."""
    reach = 4 * CAMERA_DISTANCE
    handle = host.scene.add_transform_controls(
        "/lamp",
        0.9,
        line_width=4.0,
        disable_rotations=True,
        translation_limits=((-reach, reach), (-reach, reach), (floor + BULB_RADIUS, floor + reach)),
        position=place,
    )
    bulb = host.scene.add_icosphere("/lamp/bulb", LAMP_RADIUS, (255, 244, 214), cast_shadow=False, receive_shadow=False)
    # candela in three.js: a white surface at the camera's distance is two thirds of full white
    light = host.scene.add_light_point(
        "/lamp/light", color=(255, 236, 210), intensity=2 / 3 * np.pi * CAMERA_DISTANCE**2, cast_shadow=True
    )
    return LampMarker(handle, light, bulb, host)
