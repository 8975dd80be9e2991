"""What a generated capture looks like: one frozen dataclass per thing on or around the table. Lengths in mm."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

Shape = Literal[
    "table", "chair", "vase", "figurine", "relief", "tower", "boxes", "ball", "bowl", "disc", "rock", "mug", "carton",
    "saucer", "slipper", "spectacles", "pair",
]  # fmt: skip
Paint = Literal["plain", "two-tone", "spots", "grain", "print"]
Texture = Literal["wood", "cloth", "stone", "plain", "checked", "felt", "newspaper", "white", "black"]
Optics = Literal["even", "led", "two-leds"]


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
    """plain: one colour; two-tone, spots, print: a second, darker one; grain: stripes as of wood."""
    gloss: float = 0.0
    """Strength of the highlight: 0 matt, 0.5 paint or plastic (4 % at normal incidence), 1 lacquer (8 %)."""
    roughness: float = 0.35
    """Of the highlight: 0.1 a small bright one, 0.6 a wide dim one."""


@dataclass(frozen=True)
class Table:
    """What the object stands on, and the printed board."""

    board: str = "charuco:5x7:30:22:DICT_4X4_50"
    """As `shadowgraph run --board` takes it; paper:A4, paper:letter or card is a blank one."""
    board_stays: bool = False
    """The board lies beside the object in all photos; otherwise it is taken away before."""
    on_board: bool = False
    """The object stands on the board, as on a blank sheet. Needs --board-stays."""
    table: Texture = "wood"
    """What the table top looks like."""
    varnish: float = 0.0
    """Strength of the table's gloss: 0 matt, 0.5 varnish (4 % at normal incidence)."""
    varnish_roughness: float = 0.25
    """Of that gloss: 0.1 a mirror, 0.4 silk."""
    wavy: float = 0.0
    """The printed sheet does not lie flat: height of its waves in mm."""
    wall: float = 0.0
    """A wall this many mm behind the object, seen from the camera; 0 is none."""
    edge: float = 0.0
    """The table ends this many mm behind the object, and a floor lies 740 mm lower; 0 is a table without end."""
    edge_turn: float = 0.0
    """Degrees by which that edge is turned, seen from above; at 0 it lies across the camera's view."""


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
    aim_off: float = 0.0
    """Degrees by which it misses in the same way each time, because of how the phone is held."""
    optics: Optics = "even"
    """even: the smooth beam of --beam; led: a hot centre, a ring, colour that changes with the angle (--beam is not
    used); two-leds: two of these side by side, a warmer and a colder one."""
    sweep: float = 0.0
    """Way in mm that the hand goes during an exposure, at most."""


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
    llvm: bool = False
    """Render with compiled code: some 5 times faster, other grain. Needs LLVM 15 or newer on the machine."""
    moved: tuple[int, ...] = ()
    """Photos (1 is the first) in which the tripod stood a little elsewhere; they are marked unusable."""
    moved_mm: float = 4.0
    """How far."""
    novel: int = 0
    """Pictures without noise under further lights, into gt/novel, to test relighting."""


@dataclass(frozen=True)
class Pipeline:
    """What a camera app makes of the light, instead of locked exposure and plain sRGB."""

    pipeline: bool = False
    """The phone's picture pipeline; the others here are its strengths."""
    metering: float = 0.5
    """Share of a change in brightness that auto exposure evens out; 0 is locked exposure."""
    white_balance: float = 0.03
    """Drift per photo of red and blue against green, one sigma."""
    vignetting: float = 0.08
    """Light that the corners lack, as a share."""
    lift: float = 0.7
    """Stops by which dark regions are lifted (HDR): the picture's base layer, not its detail."""
    s_curve: float = 0.35
    """Strength of the contrast curve, 0 to 1."""
    denoise: float = 0.03
    """Noise reduction: differences in brightness (pixel value 0 to 1) that it smooths away."""
    sharpen: float = 0.8
    """Strength of the sharpening, which leaves halos."""
    pipeline_jpeg: int = 85
    """JPEG quality of the pipeline's files (colour at half size)."""


@dataclass(frozen=True)
class Hand:
    """What goes wrong while one photographs; photos are counted from 1."""

    arm: tuple[int, ...] = ()
    """Photos with an arm in the picture; marked unusable."""
    shaken: tuple[int, ...] = ()
    """Photos in which the phone shook during the exposure; marked unusable."""
    shaken_px: float = 9.0
    """How far, at 1008 px width."""
    no_flash: tuple[int, ...] = ()
    """Photos in which the flashlight was off; marked unusable."""
    tapped: tuple[int, ...] = ()
    """Photos before which somebody touched the tripod: from there on the camera is a little off; usable."""
    tapped_px: float = 5.0
    """How far, at 1008 px width."""
    twice: tuple[int, ...] = ()
    """Photos with the flashlight where it was in the photo before; usable."""


@dataclass(frozen=True)
class Further:
    """Further photos beside board/ and photos/."""

    board_photos: int = 8
    """Hand-held photos of the board, besides the tripod's."""
    side_photos: int = 0
    """Hand-held photos of object and board in room light, into side/. The object then stands beside the board, which is
    taken away afterwards unless --board-stays."""
    light_photos: bool = False
    """The phone that holds the flashlight takes a photo, too, each time, into light/. Needs --board-stays."""
    dark_photos: int = 0
    """Photos from the tripod without the flashlight, into dark/."""


@dataclass(frozen=True)
class Around:
    """Several places of the tripod, and the object laid anew."""

    views: int = 1
    """Places of the tripod around the object, into view_1/, view_2/ and so on; the board stays beside the object."""
    apart: float | None = None
    """Degrees from one place to the next; evenly all around unless given."""
    object_poses: int = 0
    """Times that the object is laid on another side, into turned_1/ and so on."""
    pose_views: int = 1
    """Places of the tripod around each of these; of several each has its own folder, turned_1/view_1/ and so on."""
    pushed: float = 0.0
    """The object is pushed by so many mm before the last view."""
    fault_view: int = 0
    """What goes wrong by hand (--tapped, --moved, --arm ...) does so in this view alone; 0 is in all."""


@dataclass(frozen=True)
class Setup:
    """Everything about one capture."""

    thing: Thing = field(default_factory=Thing)
    table: Table = field(default_factory=Table)
    phone: Phone = field(default_factory=Phone)
    flashlight: Flashlight = field(default_factory=Flashlight)
    exposure: Exposure = field(default_factory=Exposure)
    pipeline: Pipeline = field(default_factory=Pipeline)
    hand: Hand = field(default_factory=Hand)
    further: Further = field(default_factory=Further)
    around: Around = field(default_factory=Around)
    hard: bool = False
    """A phone and a living room as they are: pipeline, LED beam, varnish, wall, wavy sheet, room light, hand movement.
    What is set by hand is kept."""
    seed: int = 0
    """Of everything random. An effect has random numbers of its own: switched on, it leaves the other things alone."""

    def stream(self, name: str) -> np.random.Generator:
        """Return the random numbers of one effect."""
        return np.random.default_rng([self.seed, *name.encode()])

    def has_places(self) -> bool:
        """Return whether the capture has several views or object poses, each in a folder of its own."""
        return self.around.views > 1 or self.around.object_poses > 0

    def is_beside(self) -> bool:
        """Return whether the object stands beside the board, not where the board was."""
        return not self.table.on_board and (self.table.board_stays or self.further.side_photos > 0)


def switched_on(setup: Setup) -> Setup:
    """Return the setup with every effect that `hard` means; those that differ from their defaults are kept."""
    if not setup.hard:
        return setup
    count = setup.flashlight.photos
    events = {"arm": (0.22,), "shaken": (0.36, 0.82), "no_flash": (0.93,), "tapped": (0.62,), "twice": (0.5,)}
    hand = {name: tuple(1 + int(share * count) for share in shares) for name, shares in events.items()}
    hard = {
        "table": {"varnish": 0.5, "wavy": 0.8, "wall": 340.0},
        "flashlight": {"optics": "two-leds", "aim_off": 10.0, "sweep": 6.0},
        "exposure": {"ambient": 0.06},
        "pipeline": {"pipeline": True},
        "hand": hand,
    }
    return replace(setup, **{group: _unless_set(getattr(setup, group), wanted) for group, wanted in hard.items()})


def _unless_set(group: Any, wanted: dict[str, Any]) -> Any:
    usual = {each.name: each.default for each in fields(group)}
    return replace(group, **{name: value for name, value in wanted.items() if getattr(group, name) == usual[name]})
