"""The distributions from which the bed draws captures: what stands on kitchen tables, and how people photograph it.

Lengths in mm, angles in degrees. Each distribution stands once, with the reason for its range. A capture follows from
its kind and seed alone.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

# isort: split
from examples.generator.options import Exposure, Flashlight, Further, Hand, Phone, Pipeline, Setup, Table, Thing

PICTURES = 1  # raised with every change of the generator that changes the bed's pictures
NEAR_MM = 300.0  # camera nearer than this: "close"; beyond: "far"
FOCUS_MM = 150.0  # phones focus no nearer
ARM_MM = 700.0  # a tripod stands within an arm's reach of the thing
SIZE_MM = (30.0, 250.0)  # log-uniform: a coin to a shoe
FILL = (0.24, 0.48)  # of the picture's width: as people frame things
SQUARES_MM = (8, 10, 12, 15, 20, 25, 30)  # boards that are sold or printed
BOARD_SHARE = 0.08  # square over the width of table in the picture: 5 x 7 squares are then seen whole
SOLIDS = {  # built in: the range of sizes in which there are such things
    "mug": (80, 130), "bowl": (90, 220), "carton": (60, 250), "saucer": (110, 180), "disc": (30, 60),
    "slipper": (110, 250), "spectacles": (110, 150), "pair": (50, 200), "boxes": (50, 200), "figurine": (30, 200),
}  # fmt: skip
MESHES = 0.5  # share of things from files, among which each is as likely
COLOURS = ((0.55, 0.12, 0.10), (0.12, 0.25, 0.50), (0.60, 0.48, 0.12), (0.18, 0.40, 0.20), (0.55, 0.53, 0.50))


@dataclass(frozen=True)
class Material:
    """Ranges of albedo (a factor to the colour), gloss and roughness, and the paints that occur."""

    colours: tuple[tuple[float, float, float], ...]
    shade: tuple[float, float]
    gloss: tuple[float, float]
    roughness: tuple[float, float]
    paints: tuple[str, ...] = ("plain",)


MATERIALS = {  # what things are made of, with measured ranges of reflectance of such surfaces
    "print": Material(COLOURS, (0.7, 1.2), (0.1, 0.4), (0.35, 0.5)),  # filament: silky
    "wood": Material(((0.50, 0.33, 0.19), (0.28, 0.17, 0.10)), (0.8, 1.2), (0.0, 0.25), (0.3, 0.5), ("grain",)),
    "glaze": Material(((0.75, 0.73, 0.68), *COLOURS[1:4]), (0.8, 1.1), (0.5, 0.8), (0.1, 0.2)),  # ceramic
    "plaster": Material(((0.78, 0.76, 0.72),), (0.85, 1.05), (0.0, 0.0), (0.5, 0.5)),
    "dark plastic": Material(((0.06, 0.06, 0.065), (0.09, 0.05, 0.05)), (0.7, 1.4), (0.3, 0.6), (0.2, 0.4)),
    "paint": Material(COLOURS, (0.8, 1.2), (0.2, 0.5), (0.2, 0.4), ("two-tone", "spots", "print")),  # toys, boxes
}
TABLES = {"felt": 0.14, "cloth": 0.38, "checked": 0.30, "newspaper": 0.5, "wood": 0.29, "white": 0.8, "black": 0.045}
# ... and their mean albedo: a person exposes longer where the picture is dark
HEIGHTS = {"all": (15.0, 72.0), "low": (10.0, 40.0), "high": (40.0, 78.0)}  # of the light's path; one in four each
FAULTS = ("arm", "shaken", "no_flash", "moved")  # bad photos; half of the captures have one to three
ROOM = (0.01, 0.1)  # log-uniform share of the flashlight's: curtains drawn to a lamp in the next room


@dataclass(frozen=True)
class Draw:
    """One capture: how it is rendered, and the factors by which results are told apart."""

    seed: int
    kind: str
    setup: Setup
    factors: dict[str, str]

    def key(self) -> str:
        """Return the name of its rendering: a hash of everything that changes the pictures."""
        told = asdict(self.setup)
        told["exposure"].pop("llvm")  # other grain only
        told["thing"]["mesh"] = self.setup.thing.mesh and self.setup.thing.mesh.stem
        return hashlib.sha256(json.dumps([PICTURES, told], sort_keys=True).encode()).hexdigest()[:16]


def draw(seed: int, kind: str, meshes: list[Path]) -> Draw:
    """Draw one capture.

    Args:
        kind: "close" or "far".
        meshes: files of things; none: built-in solids only.
    """
    rng = np.random.default_rng([seed, *kind.encode()])
    thing, phone, names = _framed(kind, meshes, rng)
    width = 36.0 / phone.focal * float(phone.distance or 0)  # of the table in the picture's middle
    square = max((s for s in SQUARES_MM if s <= BOARD_SHARE * width), default=SQUARES_MM[0])
    is_phone, has_wall = rng.random() < 0.5, rng.random() < 0.3  # half of the captures: a camera app's own pictures
    top = str(rng.choice(list(TABLES)))
    behind = max(0.75 * float(thing.size or 0) + 60, 150)  # the thing does not touch the wall
    table = Table(
        board=f"charuco:5x7:{square}:{0.72 * square:g}:DICT_4X4_50",
        table=top,  # pyright: ignore[reportArgumentType]
        varnish=float(rng.uniform(0.2, 0.5)) if top == "wood" and rng.random() < 0.4 else 0.0,
        wavy=float(rng.uniform(0, 0.027 * square)) if is_phone else 0.0,  # a sheet of office paper: .8 mm at 30 mm
        wall=float(rng.uniform(behind, behind + 250)) if has_wall else 0.0,
    )
    light, path = _path(is_phone, rng)
    exposure, has_room = _exposed(TABLES[top], light, rng)
    hand, moved, bad = _mishaps(light.photos, rng)
    setup = Setup(
        thing,
        table,
        phone,
        light,
        Exposure(exposure=exposure[0], ambient=exposure[1], samples=4, moved=moved),
        Pipeline(pipeline=is_phone),
        hand,
        Further(board_photos=int(rng.integers(4, 9))),
        seed=seed,
    )
    names |= {"table": top, "pictures": "phone" if is_phone else "clean", "wall": "wall" if has_wall else "open"}
    names |= {"room light": has_room, "lights": path, "bad photos": bad}
    names["photos"] = "16-24" if light.photos < 25 else "25-40"
    return Draw(seed, kind, setup, names)


def _framed(kind: str, meshes: list[Path], rng: np.random.Generator) -> tuple[Thing, Phone, dict[str, str]]:
    """Draw thing and camera until the camera is as near as the kind says and a tripod can stand there."""
    while True:
        mesh = meshes[rng.integers(len(meshes))] if meshes and rng.random() < MESHES else None
        shape = str(rng.choice(list(SOLIDS)))
        low, high = SIZE_MM if mesh else SOLIDS[shape]
        size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        focal = float(rng.choice([24.0, 26.0, 28.0, 35.0, 52.0]))  # main lenses of phones, and twice that
        distance = max(size * focal / (36.0 * rng.uniform(*FILL)), FOCUS_MM)
        if distance <= ARM_MM and (distance < NEAR_MM) == (kind == "close"):
            break
    name = str(rng.choice(list(MATERIALS)))
    made = MATERIALS[name]
    colour = np.array(made.colours[rng.integers(len(made.colours))]) * rng.uniform(*made.shade)
    thing = Thing(
        shape=shape,  # pyright: ignore[reportArgumentType]
        mesh=mesh,
        size=size,
        turn=float(rng.uniform(0, 360)),
        albedo=tuple(float(c) for c in np.clip(colour, 0.03, 0.85)),  # pyright: ignore[reportArgumentType]
        paint=str(rng.choice(made.paints)),  # pyright: ignore[reportArgumentType]
        gloss=float(rng.uniform(*made.gloss)),
        roughness=float(rng.uniform(*made.roughness)),
    )
    phone = Phone(
        width=640,
        focal=focal,
        elevation=float(rng.uniform(32, 60)),  # a person who stands or sits at the table
        azimuth=float(rng.uniform(-110, -50)),
        distance=distance,
        distortion=(float(rng.uniform(-0.07, 0.05)), float(rng.uniform(-0.03, 0.05))),  # of phones, after their own
    )
    sizes = "30-60" if size < 60 else "60-120" if size < 120 else "120-250"
    return thing, phone, {"object": mesh.stem if mesh else shape, "material": name, "size": sizes}


def _path(is_phone: bool, rng: np.random.Generator) -> tuple[Flashlight, str]:
    """Draw how the hand leads the light: 300 to 1000 mm from the thing, in one movement a quarter nearer or farther."""
    middle = float(np.exp(rng.uniform(np.log(400), np.log(800))))
    path = str(rng.choice(["all", "all", "low", "high"]))
    side = float(rng.uniform(220, 300)) if rng.random() < 0.15 else 360.0  # some do not reach all around
    optics = str(rng.choice(["led", "led", "two-leds", "even"])) if is_phone else "even"
    light = Flashlight(
        photos=int(rng.integers(16, 41)),
        reach=(0.75 * middle, 1.25 * middle),
        height=HEIGHTS[path],
        around=(-side / 2, side / 2),
        beam=float(rng.uniform(38, 52)),  # half-strength angles of phone LEDs behind their lens
        aim_error=float(rng.uniform(3, 8)),  # 30 to 60 mm at arm's length
        aim_off=float(rng.uniform(0, 10)) if is_phone else 0.0,
        optics=optics,  # pyright: ignore[reportArgumentType]
        sweep=float(rng.uniform(0, 6)) if is_phone else 0.0,  # way of a hand in a thirtieth of a second
    )
    return light, path


def _exposed(albedo: float, light: Flashlight, rng: np.random.Generator) -> tuple[tuple[float, float], str]:
    """Draw exposure and room light: locked so that the nearest light does not blind the table."""
    nearest = (light.reach[0] / np.mean(light.reach)) ** 2
    exposure = float(rng.uniform(0.9, 1.3) * nearest * min((0.5 / albedo) ** 0.5, 2.0))
    has_room = rng.random() < 0.5
    room = float(np.exp(rng.uniform(*np.log(ROOM)))) if has_room else 0.004
    return (exposure, room), "none" if not has_room else "weak" if room < 0.05 else "strong"


def _mishaps(count: int, rng: np.random.Generator) -> tuple[Hand, tuple[int, ...], str]:
    """Draw bad photos, a tap on the tripod and a hand that stayed; never in the first photo."""
    bad = int(rng.integers(1, 4)) if rng.random() < 0.5 else 0
    spots = [int(i) for i in rng.choice(np.arange(2, count + 1), bad + 2, replace=False)]
    what = [str(w) for w in rng.choice(FAULTS, bad)]
    happened = {name: tuple(spots[i] for i in range(bad) if what[i] == name) for name in FAULTS}
    moved = happened.pop("moved")
    is_tapped, is_twice = rng.random() < 0.15, rng.random() < 0.1
    hand = Hand(**happened, tapped=(spots[-1],) if is_tapped else (), twice=(spots[-2],) if is_twice else ())
    names = (["bad"] if bad else []) + (["tapped"] if is_tapped else [])
    return hand, moved, " and ".join(names) or "none"
