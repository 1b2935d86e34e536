"""Keeps a process to its share of a core, so that others keep the rest."""

import threading
import time
from collections.abc import Callable

_SAVED = 0.5
"""Seconds of a core that may be saved up while there is nothing to do."""
_ASLEEP = 1e-3, 0.1
"""Seconds between two looks whether to go on resting, at least and at most."""


class Share:
    """Of a core's time: what this process takes beyond it, its threads rest for afterwards.

    A low priority is not enough: it yields a busy core, but not what idle cores share with busy
    ones, such as caches, memory and heat.
    """

    def __init__(
        self,
        share: float,
        clock: Callable[[], float] = time.monotonic,
        own_clock: Callable[[], float] = time.process_time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Begins to count.

        Args:
            share: of a core, in the long run.
            clock: seconds.
            own_clock: seconds that the process has computed, all threads together.
            sleep: for so many seconds.
        """
        self._share = share
        self._clock = clock
        self._own_clock = own_clock
        self._sleep = sleep
        self._lock = threading.Lock()
        self._debt = 0.0
        self._seen = clock(), own_clock()

    def rest(self, is_over: Callable[[], bool]) -> None:
        """Sleeps until the process has taken no more than its share, or it is over.

        Args:
            is_over: asked every tenth of a second.
        """
        least, most = _ASLEEP
        while (owed := self._owed()) > 0 and not is_over():
            self._sleep(min(max(owed / self._share, least), most))

    def _owed(self) -> float:
        """Seconds of a core beyond the share."""
        with self._lock:
            now, own = self._clock(), self._own_clock()
            before, own_before = self._seen
            self._seen = now, own
            saved = max(self._debt - self._share * (now - before), -_SAVED)
            self._debt = saved + own - own_before
            return self._debt
