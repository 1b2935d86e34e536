"""Runs the same function on several pieces of work, a thread each.

The fields work on pieces that fit into a core's cache; torch's own threads split single
operations on such pieces too finely to gain anything. Pieces are independent, so the result does
not depend on the number of threads.
"""

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

import torch

from handavatar.jobs.memory import tidy
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import heed, heeds, stop_point

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def step_back(steps: int) -> None:
    """Leaves the cores to other threads, on Linux: elsewhere a priority is the whole process's.

    Args:
        steps: of the thread's priority, as of ``nice``; each adds to the last.
    """
    if sys.platform == "linux":
        os.nice(steps)


def mapped(
    function: Callable[[Piece], Result],
    pieces: Iterable[Piece],
    count: int | None = None,
    progress: Progress = SILENT,
    tidies: bool = False,
) -> list[Result]:
    """``function`` of every piece, in order, without gradient; each begins at a stop point.

    Args:
        function: of one piece.
        pieces: of the work.
        count: of threads; by default as many as torch has.
        progress: told how many pieces are done.
        tidies: whether free memory is given back now and then, as :func:`tidy` does.

    Raises:
        Interrupted: if the command was told to stop.
    """
    does_heed = heeds()

    def without_gradient(number: int) -> Result:
        # Gradient mode and inner threads belong to the thread, not to the process.
        torch.set_num_threads(1)
        heed(does_heed)
        stop_point()
        with torch.no_grad():
            return function(work[number])

    # Of a sequence, each piece when its turn comes: it may be made then.
    work = pieces if isinstance(pieces, Sequence) else list(pieces)
    before = torch.get_num_threads()
    count = before if count is None else count
    results: list[Result] = []
    kept = tidy if tidies else iter
    if count == 1 or len(work) == 1:
        with torch.no_grad():
            for piece in kept(work):
                stop_point()
                results.append(function(piece))
                progress(len(results), len(work))
        return results
    try:
        for result in kept(_pool(count).map(without_gradient, range(len(work)))):
            results.append(result)
            progress(len(results), len(work))
        return results
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch's own operations on one thread.

    Sums then do not depend on how many there are, and for small tensors, waiting for a second one
    costs up to fifty times the work.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@cache
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="field")
