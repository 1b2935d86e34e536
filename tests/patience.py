"""How long tests wait for what must come: no core may be idle."""

import time
from collections.abc import Callable

PATIENCE = 240.0
"""Seconds."""


def until(happens: Callable[[], bool]) -> None:
    """Waits until something happens, and fails if it does not."""
    end = time.monotonic() + PATIENCE
    while not happens():
        assert time.monotonic() < end
        time.sleep(0.01)
