"""How sure a mean is: of differences between two methods on the same poses or pictures."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy import stats
from torch import Tensor

from handavatar.errors import HandAvatarError


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
        HandAvatarError: if there are fewer than two samples.
    """
    if len(samples) < 2:
        raise HandAvatarError(
            f"a confidence interval needs two samples or more, found {len(samples)}: "
            "take more poses, pictures or seeds"
        )
    values = samples.double()
    mean = float(values.mean())
    quantile = float(stats.t.ppf((1 + level) / 2, len(values) - 1))
    reach = quantile * float(values.std()) / len(values) ** 0.5
    return Interval(mean, mean - reach, mean + reach)


def time_blocks(
    times: Float[Tensor, "frames"], seconds: float = 1.0, least: int = 4
) -> Int[Tensor, "frames"]:
    """Cuts frames into contiguous blocks of time: neighbours are not independent.

    A block ends where the next frame is more than ``seconds`` later than the block's first. Where
    that makes fewer than ``least`` blocks, so many of nearly as many frames each are cut instead.

    Args:
        times: seconds, in any order.
        seconds: length of a block.
        least: number of blocks, as far as there are frames.

    Returns:
        The number of each frame's block, in time order from 0.
    """
    order = times.double().argsort(stable=True)
    blocks = torch.zeros(len(times), dtype=torch.long)
    number, first = -1, -float("inf")
    for place in order.tolist():
        time = float(times[place].double())
        if time > first + seconds - 1e-9:
            number, first = number + 1, time
        blocks[place] = number
    least = min(least, len(times))
    if number + 1 < least:
        blocks[order] = torch.arange(len(times)) * least // len(times)
    return blocks


def block_interval(
    samples: Float[Tensor, "frames"],
    blocks: Int[Tensor, "frames"],
    level: float = 0.95,
    draws: int = 4000,
) -> Interval | None:
    """Block bootstrap of the mean over frames: whole blocks are drawn, with replacement.

    Deterministic. Where blocks are few, as they are in a short recording, the interval is still
    somewhat too narrow.

    Args:
        samples: one per frame; for a comparison the paired differences. NaN where a frame has none.
        blocks: of each frame, from :func:`time_blocks`.
        level: of confidence, percentiles on either side.
        draws: of the bootstrap.

    Returns:
        None if fewer than two blocks have a sample.
    """
    has = torch.isfinite(samples)
    samples, blocks = samples[has].double(), blocks[has]
    _, number = blocks.unique(return_inverse=True)
    count = int(number.max()) + 1 if len(number) else 0
    if count < 2:
        return None
    sums = samples.new_zeros(count).index_add_(0, number, samples)
    sizes = samples.new_zeros(count).index_add_(0, number, torch.ones_like(samples))
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randint(count, (draws, count), generator=generator)
    means = sums[drawn].sum(1) / sizes[drawn].sum(1)
    tail = (1 - level) / 2
    low, high = means.quantile(torch.tensor([tail, 1 - tail], dtype=means.dtype)).tolist()
    return Interval(float(samples.mean()), low, high)
