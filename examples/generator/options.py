"""What a generated capture looks like: one frozen dataclass per thing on or around the table. Lengths in mm."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Shape = Literal["table", "chair", "vase", "figurine", "relief", "tower", "boxes", "ball", "bowl", "disc"]
Paint = Literal["plain", "two-tone", "spots"]
Texture = Literal["wood", "cloth", "stone", "plain"]


@dataclass(frozen=True)
class Thing:
    """The object."""

    shape: Shape = "figurine"
    """A built-in shape; --mesh takes a file instead."""
    mesh: Path | None = None
    """A mesh file that trimesh reads, z up; its vertex colours are its albedo unless --albedo says otherwise."""
    size: float | None = None
    """Longest side in mm; as the shape or file has it unless given (a file's unit is taken to be mm)."""
    turn: float = 20.0
    """Degrees about the vertical."""
    albedo: tuple[float, float, float] | None = None
    """Share of light that is sent back, red green blue."""
    paint: Paint = "plain"
    """plain: one colour; two-tone, spots: a second, darker one."""
    gloss: float = 0.0
    """Strength of the highlight: 0 matt, 0.5 paint or plastic (4 % at normal incidence), 1 lacquer (8 %)."""
    roughness: float = 0.35
    """Of the highlight: 0.1 a small bright one, 0.6 a wide dim one."""


@dataclass(frozen=True)
class Table:
    """What the object stands on, and the printed board."""

    board: str = "charuco:5x7:30:22:DICT_4X4_50"
    """As `shadowgraph run --board` takes it."""
    board_stays: bool = False
    """The board lies beside the object in all photos; otherwise it is taken away before."""
    table: Texture = "wood"
    """What the table top looks like."""


@dataclass(frozen=True)
class Phone:
    """The camera on the tripod."""

    width: int = 1008
    """Pixels; the height follows as 3:4."""
    focal: float = 35.0
    """Focal length for 35 mm film."""
    elevation: float = 40.0
    """Degrees above the table, seen from the object."""
    azimuth: float = -70.0
    """Degrees from the board's x axis."""
    distance: float | None = None
    """From what it looks at; unless given, so that object and board fill the picture well."""
    distortion: tuple[float, float] = (-0.06, 0.04)
    """OpenCV's k1 and k2."""


@dataclass(frozen=True)
class Flashlight:
    """The light in the hand, one position per photo."""

    photos: int = 36
    """How many."""
    reach: tuple[float, float] = (400.0, 900.0)
    """Shortest and longest distance from the object."""
    height: tuple[float, float] = (20.0, 75.0)
    """Lowest and highest degrees above the table."""
    around: tuple[float, float] = (0.0, 360.0)
    """First and last degrees around the object; 0 is from behind the camera."""
    radius: float = 2.5
    """Of the round emitter: its size makes the penumbra; 0 is a point."""
    beam: float = 45.0
    """Degrees off the beam's axis at which it is half as strong."""
    aim_error: float = 8.0
    """Degrees by which the hand misses the object."""


@dataclass(frozen=True)
class Exposure:
    """From light to files."""

    exposure: float = 0.8
    """Pixel value of a white sheet that faces the light at mean distance; above 1.5 much is clipped."""
    ambient: float = 0.02
    """Room light in the dark photos as a share of the flashlight's at mean distance."""
    indirect: bool = True
    """One bounce of light between table and object."""
    noise: float = 1.0
    """Sensor noise; 1 is 1.4 % of a mid-grey pixel, 0 none."""
    lens_blur: float = 0.4
    """Sigma in px."""
    jpeg: int = 92
    """JPEG quality."""
    samples: int = 8
    """Rays per pixel; fewer are faster and grainier in half shadows and indirect light."""
    moved: tuple[int, ...] = ()
    """Photos (1 is the first) in which the tripod stood a little elsewhere; they are marked unusable."""
    moved_mm: float = 4.0
    """How far."""
    novel: int = 0
    """Pictures without noise under further lights, into gt/novel, to test relighting."""


@dataclass(frozen=True)
class Setup:
    """Everything about one capture."""

    thing: Thing = field(default_factory=Thing)
    table: Table = field(default_factory=Table)
    phone: Phone = field(default_factory=Phone)
    flashlight: Flashlight = field(default_factory=Flashlight)
    exposure: Exposure = field(default_factory=Exposure)
    seed: int = 0
    """Of everything random."""
