"""Albedo of the surfaces: the object's per vertex, the table's grain, the printed board. Linear, 0 to 1."""

import cv2
import numpy as np
import trimesh
from jaxtyping import Float
from scipy import fft
from trimesh.visual import ColorVisuals

from calibration.board.board import AnyBoard, Blank
from capture.photos.photo import decode_srgb

from .options import Thing

DEFAULT_ALBEDO = (0.62, 0.48, 0.36)
DARKER = 0.35  # the second colour of a painted object
TABLE_COLOURS = {  # brightness-weighted reflectance of common surfaces
    "wood": (0.42, 0.28, 0.17),
    "cloth": (0.38, 0.38, 0.40),
    "stone": (0.50, 0.49, 0.46),
    "plain": (0.55, 0.54, 0.52),
    "checked": (0.60, 0.30, 0.28),
    "felt": (0.10, 0.16, 0.12),
    "newspaper": (0.62, 0.60, 0.55),
    "white": (0.80, 0.79, 0.77),
    "black": (0.045, 0.045, 0.05),
}
CONTRAST = {  # of the texture
    "wood": 0.35, "cloth": 0.3, "stone": 0.4, "plain": 0.04,
    "checked": 0.2, "felt": 0.25, "newspaper": 0.06, "white": 0.03, "black": 0.15,
}  # fmt: skip
GRAIN = {  # sizes in texels, along and across, and strength of what is added up
    "wood": (((160, 3), 1.0), ((40, 1), 0.6), ((300, 30), 0.8)),
    "cloth": (((1, 1), 1.0), ((6, 1), 0.5), ((1, 6), 0.5), ((60, 60), 0.3)),
    "stone": (((1, 1), 1.0), ((5, 5), 0.6), ((25, 25), 0.5)),
    "plain": (((1, 1), 1.0), ((80, 80), 0.5)),
}
GRAIN |= {"checked": GRAIN["cloth"], "felt": GRAIN["stone"]}
GRAIN |= {name: GRAIN["plain"] for name in ("newspaper", "white", "black")}
TEXELS = 2048
CHECK, COLUMN, LINE = 24, 52, 4  # texels (mm): squares of the cloth, columns and lines of the newspaper
INK, PAPER = 0.04, 0.82  # reflectance of a laser print; a card is as white
DOTS_PER_MM = 6
MARGIN_MM = 15.0  # white paper around the print


def albedo_of(mesh: trimesh.Trimesh, thing: Thing) -> Float[np.ndarray, "vertices 3"]:
    """Return the object's diffuse albedo at every vertex: as given, the file's colours, or a default; then painted."""
    colour = np.tile(thing.albedo or DEFAULT_ALBEDO, (len(mesh.vertices), 1)).astype(float)
    look = mesh.visual
    if thing.albedo is None and thing.mesh is not None and isinstance(look, ColorVisuals) and look.kind == "vertex":
        colour = decode_srgb(np.asarray(look.vertex_colors)[:, :3]).astype(float)
    if thing.paint == "plain":
        return colour
    low, high = mesh.bounds
    place = (mesh.vertices - low) / (high - low).max()
    if thing.paint == "grain":
        rings = 60 * np.hypot(place[:, 1] - 0.8, 0.5 * place[:, 2] + 0.2) + np.sin(6 * place[:, 0])
        return colour * (0.75 + 0.25 * np.sin(rings))[:, None]
    if thing.paint == "two-tone":
        is_second = place[:, 2] < 0.45 * place[:, 2].max() + 0.04 * np.sin(14 * place[:, 0])
    elif thing.paint == "print":
        is_second = (np.floor(place * [7, 7, 9]) @ [1, 2, 3]) % 4 < 1
    else:
        wave = 19.0
        is_second = np.sin(wave * place[:, 0]) * np.sin(wave * place[:, 1] + 1) * np.sin(wave * place[:, 2] + 2) > 0.25
    return np.where(is_second[:, None], DARKER * colour, colour)


def table_top(name: str, rng: np.random.Generator) -> Float[np.ndarray, "texels texels 3"]:
    """Return a square picture of the table's albedo."""
    grain = np.zeros((TEXELS, TEXELS), np.float32)
    rows, columns = fft.fftfreq(TEXELS), fft.rfftfreq(TEXELS)
    for (along, across), strength in GRAIN[name]:
        noise = fft.rfft2(rng.standard_normal((TEXELS, TEXELS), np.float32))
        fall = [np.exp(-2 * (np.pi * sigma * f) ** 2) for sigma, f in ((across, rows), (along, columns))]
        smooth = fft.irfft2(noise * fall[0][:, None] * fall[1]).astype(np.float32)
        grain += strength * smooth / smooth.std()
    grain = np.clip(1 + CONTRAST[name] * grain / grain.std() / 2, 0.2, 1.8) * _pattern(name, rng)
    return (grain[..., None] * np.array(TABLE_COLOURS[name])).clip(0, 0.95).astype(np.float32)


def _pattern(name: str, rng: np.random.Generator) -> Float[np.ndarray, "texels texels"] | float:
    """Return by how much the woven squares of a cloth, or the print of a newspaper, darken the table top."""
    texel = np.arange(TEXELS)
    if name == "checked":
        dark = np.where(texel // CHECK % 2, 0.55, 1.0)
        return dark[:, None] * dark
    if name != "newspaper":
        return 1.0
    words = cv2.resize(
        rng.uniform(size=(TEXELS // LINE, TEXELS // 6)), (TEXELS, TEXELS), interpolation=cv2.INTER_NEAREST
    )
    is_ink = (texel % LINE < LINE / 2)[:, None] & (texel % COLUMN < COLUMN - 5) & (words > 0.25)
    return np.where(is_ink, 0.35, 1.0)


def sheet(
    board: AnyBoard,
) -> tuple[Float[np.ndarray, "height width 1"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the sheet, its top left corner in OpenCV's board frame (x right, y down) and its size, mm."""
    if isinstance(board, Blank):
        return np.full((2, 2, 1), PAPER, np.float32), np.zeros(2), np.array([board.long_mm, board.short_mm])
    square = round(board.square_mm * DOTS_PER_MM)
    if board.kind == "charuco":
        counts, first = (board.columns, board.rows), 0.0
        art = board.opencv().generateImage((counts[0] * square, counts[1] * square), marginSize=0)
    else:
        counts, first = (board.columns + 1, board.rows + 1), -board.square_mm
        dark = np.add.outer(np.arange(counts[1]), np.arange(counts[0])) % 2 == 0
        art = np.kron(np.where(dark, 0, 255), np.ones((square, square))).astype(np.uint8)
    margin = round(MARGIN_MM * square / board.square_mm)
    art = cv2.copyMakeBorder(art, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
    dot = board.square_mm / square
    size = dot * np.array(art.shape[::-1], float)
    return (INK + (PAPER - INK) * (art[..., None] / 255)).astype(np.float32), np.full(2, first - margin * dot), size


def outline(blank: Blank) -> Float[np.ndarray, "height width 1"]:
    """Return which parts of a rectangle's picture belong to a blank sheet or a card with rounded corners."""
    middle = np.array([blank.long_mm, blank.short_mm]) / 2
    counts = np.round(2 * middle * DOTS_PER_MM).astype(int)
    across, down = (np.abs((np.arange(n) + 0.5) / n - 0.5) * 2 * m for n, m in zip(counts, middle, strict=True))
    beyond = np.maximum(np.stack(np.meshgrid(across, down), -1) - (middle - blank.radius_mm), 0.0)
    return (np.linalg.norm(beyond, axis=-1) <= max(blank.radius_mm, 1e-9)).astype(np.float32)[..., None]
