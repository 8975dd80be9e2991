"""Which rays are shot, in torch: the random numbers, the draw and the record of sdf/kernels.py, bit for bit."""

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from reconstruct.sdf.kernels import ATTEMPTS, LEAST_ERROR, NO_WEIGHT, PATIENCE, WRONG

MOST_WRONG = 60  # as in kernels.record
_WORD, _SIGN = 1 << 64, 1 << 63
_STEP_SEED, _STEP_A, _STEP_B = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # splitmix64


def hash_uniform(seed: int, a: int, b: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Uniform numbers in [0, 1) from three integers: kernels.hash_uniform; of 24 bits where there is no float64."""
    x = b * _signed(_STEP_B) + _signed(seed * _STEP_SEED + a * _STEP_A)
    x = (x ^ _shifted(x, 30)) * _signed(_STEP_A)
    x = (x ^ _shifted(x, 27)) * _signed(_STEP_B)
    x = x ^ _shifted(x, 31)
    if x.device.type == "mps":
        return _shifted(x, 40).float() / 2**24
    return _shifted(x, 11).double() / 2**53


def draw_rays(
    confidence: Float[Tensor, "photos pixels"],
    error: Float[Tensor, "photos pixels"],
    wrong: UInt8[Tensor, "photos pixels"],
    seed: int,
    iteration: int,
    n_rays: int,
) -> tuple[Int[Tensor, " rays"], Int[Tensor, " rays"], Float[Tensor, " rays"]]:
    """Photo, pixel and weight of each ray; every second ray prefers a large last error. See kernels.draw_rays."""
    n_photos, n_pixels = confidence.shape
    number = torch.arange(n_rays, device=confidence.device)
    photo, pixel = torch.zeros_like(number), torch.zeros_like(number)
    weight = torch.zeros(n_rays, dtype=hash_uniform(0, 0, number[:1]).dtype, device=number.device)
    is_open = torch.ones_like(number, dtype=torch.bool)
    for attempt in range(ATTEMPTS):
        turn = iteration * 16 + attempt
        new_photo = (hash_uniform(seed, turn, 3 * number) * n_photos).long()
        new_pixel = (hash_uniform(seed, turn, 3 * number + 1) * n_pixels).long()
        photo = torch.where(is_open, new_photo, photo)
        pixel = torch.where(is_open, new_pixel, pixel)
        at = (photo, pixel)
        weight = confidence[at].to(weight.dtype) / (1 + wrong[at].to(weight.dtype) / PATIENCE)
        chance = weight * torch.where(number % 2 == 1, error[at].to(weight.dtype), 1.0)
        is_open = is_open & (chance <= hash_uniform(seed, turn, 3 * number + 2))
    return photo, pixel, weight


def record(
    photo: Int[Tensor, " rays"],
    pixel: Int[Tensor, " rays"],
    weight: Float[Tensor, " rays"],
    misses: Float[Tensor, " rays"],
    error: Float[Tensor, "photos pixels"],
    wrong: UInt8[Tensor, "photos pixels"],
) -> None:
    """Note in the running tables how far each ray was from its label, in order: kernels.record.

    A table's entry that was drawn several times is changed once per round, so that the order is kept.
    """
    shot = ((weight >= NO_WEIGHT) & (misses >= 0)).nonzero()[:, 0]
    entry, miss = photo[shot] * error.shape[1] + pixel[shot], misses[shot]
    order = entry.sort(stable=True)
    first = torch.searchsorted(order.values, order.values)  # where the run of equal entries begins
    repeat = torch.arange(len(shot), device=shot.device) - first
    errors, wrongs = error.view(-1), wrong.view(-1)
    for turn in range(int(repeat.max()) + 1 if len(shot) else 0):
        chosen = order.indices[repeat == turn]
        at, seen = entry[chosen], miss[chosen]
        errors[at] = (0.5 * (errors[at].to(seen.dtype) + seen)).clamp(min=LEAST_ERROR).to(error.dtype)
        again = (wrongs[at].int() + 1).clamp(max=MOST_WRONG)
        wrongs[at] = torch.where(seen > WRONG, again, 0).to(wrong.dtype)


def _signed(word: int) -> int:
    """The 64-bit pattern of an unsigned number as torch's signed integers hold it."""
    return (word + _SIGN) % _WORD - _SIGN


def _shifted(x: Tensor, bits: int) -> Tensor:
    """Logical shift to the right."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)
