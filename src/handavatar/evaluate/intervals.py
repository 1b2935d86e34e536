"""How sure a mean is: of differences between two methods on the same poses or pictures."""

from dataclasses import dataclass

from jaxtyping import Float
from scipy import stats
from torch import Tensor


@dataclass(frozen=True)
class Interval:
    """A mean with the borders of its confidence interval.

    Attributes:
        mean: of the samples, in their unit.
        low: lower border.
        high: upper border.
    """

    mean: float
    low: float
    high: float

    def of_difference(self) -> str:
        """As tables print a difference: signed, with its borders in brackets."""
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def mean_interval(samples: Float[Tensor, "samples"], level: float = 0.95) -> Interval:
    """Student's interval of the mean of independent samples, two-sided.

    Args:
        samples: at least two; for a comparison the paired differences.
        level: of confidence.

    Raises:
        ValueError: if there are fewer than two samples.
    """
    if len(samples) < 2:
        raise ValueError(
            f"a confidence interval needs two samples or more, found {len(samples)}: "
            "take more poses, pictures or seeds"
        )
    values = samples.double()
    mean = float(values.mean())
    quantile = float(stats.t.ppf((1 + level) / 2, len(values) - 1))
    reach = quantile * float(values.std()) / len(values) ** 0.5
    return Interval(mean, mean - reach, mean + reach)
