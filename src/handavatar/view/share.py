"""Keeps a thread to its share of a core, so that others keep the rest."""

import time
from collections.abc import Callable

_SAVED = 0.5
"""Seconds of a core that a thread may have saved up while it had nothing to do."""
_ASLEEP = 1e-3, 0.1
"""Seconds between two looks whether to go on resting, at least and at most."""


class Share:
    """Of one thread's time on a core: what it takes beyond its share, it rests for afterwards.

    A low priority is not enough: it yields a busy core, but not what idle cores share with busy
    ones, such as caches, memory and heat.
    """

    def __init__(
        self,
        share: float,
        clock: Callable[[], float] = time.monotonic,
        own_clock: Callable[[], float] = time.thread_time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Begins to count; for the thread that calls :meth:`rest`.

        Args:
            share: of a core, in the long run.
            clock: seconds.
            own_clock: seconds that the thread has computed.
            sleep: for so many seconds.
        """
        self._share = share
        self._clock = clock
        self._own_clock = own_clock
        self._sleep = sleep
        self._debt = 0.0
        self._seen = clock(), own_clock()

    def rest(self, is_over: Callable[[], bool]) -> None:
        """Sleeps until the thread has taken no more than its share, or it is over."""
        while self._owed() > 0 and not is_over():
            least, most = _ASLEEP
            self._sleep(min(max(self._debt / self._share, least), most))

    def _owed(self) -> float:
        """Seconds of a core beyond the share."""
        now, own = self._clock(), self._own_clock()
        before, own_before = self._seen
        self._seen = now, own
        self._debt = max(self._debt - self._share * (now - before), -_SAVED) + own - own_before
        return self._debt
