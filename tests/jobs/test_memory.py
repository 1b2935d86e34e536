"""Memory that is given back."""

import sys
from pathlib import Path

import pytest
import torch

from handavatar.jobs.memory import return_free_memory, tidy


def _resident() -> float:
    """Megabytes of this process."""
    line = Path("/proc/self/status").read_text().partition("VmRSS:")[2]
    return int(line.split()[0]) / 1e3


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc is asked")
def test_what_is_free_between_small_pieces_is_given_back() -> None:
    return_free_memory()
    before, kept = _resident(), []
    for _ in range(100):
        large = [torch.ones(300_000) for _ in range(4)]
        kept.append(torch.ones(20_000))
        del large
    return_free_memory()
    # 8 MB are kept; 1.2 MB of each round are free.
    assert _resident() - before < 30


def test_pieces_come_one_by_one() -> None:
    pieces = tidy(iter(range(70)))
    assert next(pieces) == 0 and list(pieces) == list(range(1, 70))
