"""What held-out shadow rays said of refined lights."""

from dataclasses import dataclass

SIGMAS = 1.64  # of its noise by which the held-out error must fall: chance alone does that once in twenty times


@dataclass(frozen=True)
class Verdict:
    """Mean |T - label| of held-out shadow rays, with the surface settled under either set of lights."""

    calibrated: float
    refined: float
    noise: float  # one sigma of the difference, from how it varies between photos

    @property
    def is_accepted(self) -> bool:
        """Whether the refined lights explain shadows that no solve has seen better, by more than noise."""
        return self.calibrated - self.refined > SIGMAS * self.noise

    def sentence(self) -> str:
        """What was decided, and by which numbers."""
        numbers = (
            f"shadow rays that were held out are off by {100 * self.refined:.3g} % with them and by "
            f"{100 * self.calibrated:.3g} % with the calibrated ones, noise {100 * self.noise:.2g} %"
        )
        return f"refined lights {'accepted' if self.is_accepted else 'rejected'}: {numbers}"
