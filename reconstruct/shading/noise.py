"""Noise of a photo's pixels."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Noise:
    """One sigma of a pixel value I: sqrt(floor^2 + (share * I)^2), linear; `share` is the light model's error."""

    floor: float
    share: float

    def sigma(self, value: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Return one sigma at a linear pixel value."""
        return (self.floor**2 + (self.share * value) ** 2).sqrt()


DEFAULT_NOISE = Noise(1e-3, 0.01)
