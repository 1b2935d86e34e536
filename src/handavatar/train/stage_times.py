"""Where the time of a repeated piece of work goes: seconds by stage, and what was done in them."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class StageTimes:
    """Adds up wall time by stage; two looks at the clock a stage, about a microsecond.

    On a GPU, which works behind the program's back, a stage's time is that of handing work over,
    and the stage that first needs a result pays for the wait.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        """Starts the clock.

        Args:
            clock: seconds, ever growing.
        """
        self._clock = clock
        self._begin = clock()
        self._seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts the block's time for this stage; stages do not nest."""
        begin = self._clock()
        try:
            yield
        finally:
            self._seconds[name] = self._seconds.get(name, 0.0) + self._clock() - begin

    @property
    def seconds(self) -> float:
        """Since the beginning."""
        return self._clock() - self._begin

    def shares(self) -> dict[str, float]:
        """Share of the time that each stage took, in [0, 1]; what is in none is ``other``."""
        total = max(self.seconds, 1e-9)
        shares = {name: seconds / total for name, seconds in self._seconds.items()}
        return {**shares, "other": max(1.0 - sum(shares.values()), 0.0)}
