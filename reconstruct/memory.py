"""How much memory a run will take, from the number and size of its photos: said before it begins.

Measured on runs of two cores (docs/reliability.md): the largest of three peaks, of reading full photos, of the solve,
and of the maps of the finished surface, which are as large as a photo.
"""

import psutil

from calibration.source import CALIBRATION_LONG_SIDE, LONG_SIDES

PROGRAM = 0.5e9  # bytes: interpreter, torch, compiled kernels, the grid of a draft
READING = 0.25e9  # bytes: before the solver is there
FINISHED = 0.85e9  # bytes: mesh and solved fields
PER_FULL_PIXEL = 90  # bytes, of the board's photo while its corners are found, and of the maps: a dozen float64
PER_STORED_PIXEL = 13  # bytes in each photo of the stack: three float32 and a flag
PER_RAY = 100  # bytes in each photo at the solver's size: labels, confidence, errors and what they are read from
PER_SOLVED_PIXEL = 2100  # bytes at the solver's size: grids grow with it, normals and rays


def predicted_memory(photos: int, width: int, height: int, preset: str) -> int:
    """Bytes that a run of the default solver will hold at its peak, of so many photos of that size, px."""
    longest = max(width, height)
    stored = _pixels(width, height, max(CALIBRATION_LONG_SIDE, LONG_SIDES[preset]) / longest)
    solved = _pixels(width, height, LONG_SIDES[preset] / longest)
    stack = PER_STORED_PIXEL * photos * stored
    reading = READING + stack + PER_FULL_PIXEL * width * height
    solving = PROGRAM + stack + PER_RAY * photos * solved + PER_SOLVED_PIXEL * solved
    mapping = FINISHED + PER_FULL_PIXEL * width * height
    return round(max(reading, solving, mapping))


def _pixels(width: int, height: int, scale: float) -> float:
    return width * height * min(1.0, scale) ** 2


def memory_sentence(photos: int, width: int, height: int, preset: str) -> str:
    """What the run will need and what this machine has; advice where that is not enough."""
    needed, free = predicted_memory(photos, width, height, preset), psutil.virtual_memory().available
    text = f"about {needed / 1e9:.2f} GB of memory will be needed, {free / 1e9:.2f} GB are free"
    if needed <= free:
        return text
    smaller = [name for name in LONG_SIDES if predicted_memory(photos, width, height, name) <= free]
    better = f"--preset {smaller[-1]}" if smaller else "fewer photos"
    return f"{text}: this machine may run out of it; {better} would do"
