"""Keeps processes ordinary ones, which leave the cores to others."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


def is_ordinary() -> bool:
    """Whether this thread shares the cores with others as threads usually do; true off Linux."""
    return not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) == os.SCHED_OTHER


def make_ordinary() -> None:
    """Makes this thread an ordinary one, where it may have become another."""
    if not is_ordinary():
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def ordinary_afterwards() -> Iterator[None]:
    """An ordinary thread once the block has ended.

    SVT-AV1, started by root, makes the thread that encodes a real-time one of the highest priority
    and leaves it so. Whatever this thread starts later inherits that: browsers and trainings, for
    which everything else on the machine stands still, the kernel's own work included.
    """
    try:
        yield
    finally:
        make_ordinary()
