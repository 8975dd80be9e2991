"""Choose frames of a clip of a moving flashlight as photos: sharp ones, well spread over the directions of the light.

The light's direction shows in the ground's shading: the log brightness of coarse cells, relative to each cell's usual
one, is a smooth field, fitted robustly so that object, shadows and a hand in view do not count. Frames are chosen so
that these fields differ most. A clip is read once, forwards; only coarse cells of at most MOST_CANDIDATES frames are
stored.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from capture.decode.video import frames_of, read_clip
from capture.errors import CaptureError
from capture.files.names import frame_path
from capture.photos.photo import decode_srgb, smaller
from capture.session.roles import BLACK, CELL_PX, DARK, EVEN, THUMBNAIL_PX, cells_of, evenness

SLOT_S = 0.2  # one candidate, the sharpest frame, per slot: a hand moves the light by some centimetres in this time
LOOKS_PER_SLOT = 3  # examined frames: shake comes and goes at a few hertz
MOST_CANDIDATES = 600  # longer clips have longer slots
TOUCHED_S = 0.5  # at both ends: pressing the button shakes the camera
SHARPNESS_PX = 960  # long side on which sharpness is measured: blur of one pixel of film still shows
LOCAL_S = 1.5  # to either side: sharpness is compared with the local median, because light and shadows change it, too
BLURRED = 0.7  # of that median
SAME_ROOM = 0.15  # log brightness: cells this close to the room-lit picture are lit by the room
ROOM_SHARE = 0.4  # of the cells: an arm may hide the others while the object is placed
BRIGHT = 0.5  # log brightness above the smooth field: the mark of a hand or of the flashlight itself in view
BRIGHT_SHARE = 0.06  # of the cells that may be so bright
SHADOWED = 0.3  # log brightness below the field from which a cell is likely in shadow
FIT_ROUNDS = 6  # of reweighting: the field settles to 1 %
SAME_LIGHT = 0.04  # root mean square between two fields of log brightness: nearer ones are duplicates
DARK_FRAMES = 5  # averaged, so that their noise does not enter every photo
FEWEST_DARK, FEWEST_ROOM = 3, 3  # slots: a shorter time in the dark, or in room light, is a light that moves
BOARD_FRAMES = 12  # of a clip of the board
FEWEST_FRAMES = 4


@dataclass(frozen=True)
class _Candidates:
    """The sharpest frame of every slot."""

    times: Float[np.ndarray, " n"]
    sharpness: Float[np.ndarray, " n"]  # Laplacian energy over squared brightness
    cells: Float[np.ndarray, "n cells"]  # linear brightness
    columns: int  # cells in a row

    def take(self, which: Bool[np.ndarray, " n"] | Int[np.ndarray, " k"]) -> "_Candidates":
        """Return some of them."""
        chosen = (values[which] for values in (self.times, self.sharpness, self.cells))
        return _Candidates(*chosen, self.columns)

    def log_cells(self) -> Float[np.ndarray, "n cells"]:
        """Return the logarithm of the cells' brightness."""
        return np.log(self.cells + BLACK)

    def local_sharpness(self) -> Float[np.ndarray, " n"]:
        """Return the sharpness over the median of the neighbouring frames."""
        near = np.abs(self.times[:, None] - self.times) <= LOCAL_S
        return self.sharpness / np.array([max(np.median(self.sharpness[row]), 1e-12) for row in near])


def choose_frames(clip: Path, count: int) -> tuple[dict[str, tuple[Path, ...]], str]:
    """Choose at most `count` frames under the flashlight, the board's frame at the start and frames without light.

    Returns:
        the frames by role (board, lit, dark), and a sentence on them.

    Raises:
        CaptureError: the clip cannot be read, or shows no moving flashlight.
    """
    every = _candidates(clip)
    even = np.array([evenness(cells) >= EVEN for cells in every.cells])
    n_room = len(even) if even.all() else int(np.argmin(even))
    rest = every.take(np.arange(n_room, len(even)))
    is_lit = ~even[n_room:] & ~_lit_by_room(rest, every.cells[:n_room])
    if is_lit.sum() < FEWEST_FRAMES:
        raise _no_light(clip, len(even), int(is_lit.sum()))
    level = np.median(rest.cells, axis=1)
    usual = float(np.percentile(level[is_lit], 75))
    is_dark = level < DARK * usual
    lit = rest.take(is_lit & ~is_dark & (rest.local_sharpness() >= BLURRED))
    if len(lit.times) < FEWEST_FRAMES:
        raise _no_light(clip, len(even), len(lit.times))
    fields, strange = _light_fields(lit)
    keep = strange <= BRIGHT_SHARE
    if keep.sum() >= FEWEST_FRAMES:
        lit, fields = lit.take(keep), fields[keep]
    chosen = _spread(fields, lit.local_sharpness(), count)
    room = every.take(np.arange(n_room))
    board = room.times[[np.argmax(room.sharpness)]] if n_room >= FEWEST_ROOM else np.zeros(0)
    dark = rest.times[is_dark] if is_dark.sum() >= FEWEST_DARK else np.zeros(0)
    dark = dark[np.linspace(0, len(dark) - 1, min(len(dark), DARK_FRAMES)).round().astype(int)]
    note = f"{clip.name}: {len(chosen)} frames chosen of {len(every.times)} examined, spread by the light's direction"
    note += ", the board in room light at its start" if len(board) else ""
    note += f", {len(dark)} with the light off" if len(dark) else ""
    times = {"board": board, "lit": lit.times[chosen], "dark": dark}
    return {role: tuple(frame_path(clip, t) for t in some) for role, some in times.items()}, note


def choose_board_frames(clip: Path) -> tuple[Path, ...]:
    """Choose sharp frames of a clip of the board, or without light, whose pictures differ most, in their order.

    Raises:
        CaptureError: the clip cannot be read.
    """
    every = _candidates(clip)
    sharp = every.take(every.local_sharpness() >= BLURRED)
    logs = sharp.log_cells()
    chosen = _spread(logs - logs.mean(1, keepdims=True), sharp.local_sharpness(), BOARD_FRAMES)
    return tuple(frame_path(clip, t) for t in sharp.times[chosen])


def _no_light(clip: Path, n_all: int, n_lit: int) -> CaptureError:
    return CaptureError(
        f"{clip} shows a moving flashlight in {n_lit} of {n_all} examined frames, {FEWEST_FRAMES} were needed. "
        "Film in a dark room from a tripod, and move the flashlight slowly around the object."
    )


def _candidates(clip: Path) -> _Candidates:
    """Find the sharpest frame of every slot of the clip, without its ends."""
    length = read_clip(clip).duration_s
    slot = max(SLOT_S, length / MOST_CANDIDATES)
    found: list[tuple[float, float, np.ndarray]] = []
    columns = 0
    for time_s, frame in frames_of(clip, slot / LOOKS_PER_SLOT):
        grey = smaller(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), SHARPNESS_PX)
        thumbnail = smaller(grey, THUMBNAIL_PX)
        columns = thumbnail.shape[1] // CELL_PX
        energy = float((cv2.Laplacian(grey, cv2.CV_32F) ** 2).mean()) / max(float(grey.mean()), 1.0) ** 2
        is_new = not found or time_s >= found[-1][0] // slot * slot + slot
        if is_new or energy > found[-1][1]:
            entry = (time_s, energy, cells_of(decode_srgb(thumbnail)))
            found = [*found, entry] if is_new else [*found[:-1], entry]
        if len(found) > 2 * MOST_CANDIDATES:  # the container does not state the clip's length
            found = [max(pair, key=lambda c: c[1]) for pair in zip(found[::2], found[1::2], strict=False)]
            slot *= 2
    if found and found[-1][0] > 4 * TOUCHED_S:
        end = found[-1][0] - TOUCHED_S
        found = [entry for entry in found if TOUCHED_S <= entry[0] <= end]
    if not found:
        raise CaptureError(f"{clip} has no frame that can be decoded. Copy it again from the phone, or remove it.")
    times, energies, cells = zip(*found, strict=True)
    return _Candidates(np.array(times), np.array(energies), np.stack(cells), columns)


def _lit_by_room(frames: _Candidates, room: Float[np.ndarray, "k cells"]) -> Bool[np.ndarray, " n"]:
    """Return which frames are lit by the room: their unoccluded cells are as bright as in the room-lit start."""
    if not len(room):
        return np.zeros(len(frames.times), bool)
    usual = np.log(np.median(room, axis=0) + BLACK)
    return (np.abs(frames.log_cells() - usual) < SAME_ROOM).mean(1) >= ROOM_SHARE


def _light_fields(lit: _Candidates) -> tuple[Float[np.ndarray, "n cells"], Float[np.ndarray, " n"]]:
    """Fit each frame's smooth field of log brightness, mean 0; return also the share of cells far brighter than it."""
    logs = lit.log_cells()
    logs = logs - np.median(logs, axis=1, keepdims=True)
    change = logs - np.percentile(logs, 70, axis=0)
    rows = logs.shape[1] // lit.columns
    v, u = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, lit.columns), indexing="ij")
    u, v = u.ravel(), v.ravel()
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 1)
    fields = np.median(change, axis=1, keepdims=True) + np.zeros_like(change)
    for _ in range(FIT_ROUNDS):
        off = change - fields
        weight = np.where(off < -SHADOWED, 0.1, 1.0) / np.maximum(np.abs(off), 0.1 * SHADOWED)
        normal = np.einsum("nc,ca,cb->nab", weight, basis, basis) + 1e-6 * np.eye(6)
        fields = np.linalg.solve(normal, np.einsum("nc,nc,ca->na", weight, change, basis)[..., None])[..., 0] @ basis.T
    strange = (change - fields > BRIGHT).mean(1)
    return fields - fields.mean(1, keepdims=True), strange


def _spread(
    fields: Float[np.ndarray, "n cells"], sharpness: Float[np.ndarray, " n"], count: int
) -> Int[np.ndarray, " k"]:
    """Return ascending indices of at most `count` fields far from one another: farthest points, from the sharpest."""
    chosen = [int(np.argmax(sharpness))]
    nearest = _distances(fields, chosen[0])
    while len(chosen) < min(count, len(fields)):
        farthest = int(np.argmax(nearest))
        if nearest[farthest] < SAME_LIGHT:
            break
        nearest = np.minimum(nearest, _distances(fields, farthest))
        chosen.append(farthest)
    return np.array(sorted(chosen))


def _distances(fields: Float[np.ndarray, "n cells"], index: int) -> Float[np.ndarray, " n"]:
    return np.sqrt(((fields - fields[index]) ** 2).mean(1))
