"""Being told to stop, and stopping at the end of a step instead of amid one."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Interrupted(KeyboardInterrupt):
    """Training was told to stop and has saved a checkpoint."""


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Turns the first SIGINT or SIGTERM into a wish to stop; the second one kills."""
    received: list[int] = []
    watched = (signal.SIGINT, signal.SIGTERM)

    def note(number: int, _: Any) -> None:
        received.append(number)
        for watched_number, handler in zip(watched, before, strict=True):
            signal.signal(watched_number, handler)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False  # Signals are the caller's business.
        return
    before = [signal.signal(number, note) for number in watched]
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in zip(watched, before, strict=True):
            signal.signal(number, handler)
