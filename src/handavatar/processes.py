"""Several processes that share one work: started by ``torchrun``, or one alone."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed

from handavatar.errors import HandAvatarError

_OF_TORCHRUN = ("RANK", "MASTER_ADDR", "MASTER_PORT")


class ProcessesError(HandAvatarError):
    """An environment that speaks of several processes, but does not say where they are."""


@dataclass(frozen=True)
class Processes:
    """This process among those that work together.

    Attributes:
        rank: of this one, from 0.
        count: of all of them.
        device: where this one computes, such as ``cpu`` or ``cuda:1``.
    """

    rank: int
    count: int
    device: str

    @property
    def is_first(self) -> bool:
        """Whether this one writes files and reports."""
        return self.rank == 0

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any process; all must ask, and all get the same answer."""
        if self.count == 1:
            return flag
        value = torch.tensor(float(flag), device=self.device)
        torch.distributed.all_reduce(value, torch.distributed.ReduceOp.MAX)
        return bool(value)

    def average(self, values: Iterable[torch.Tensor]) -> None:
        """Gives every process the mean of all processes' values; in place.

        Args:
            values: the same tensors, in the same order, in all of them.
        """
        if self.count == 1:
            return
        held = list(values)
        flat = torch.cat([value.flatten() for value in held])
        torch.distributed.all_reduce(flat)
        for value, mean in zip(
            held, (flat / self.count).split([v.numel() for v in held]), strict=True
        ):
            value.copy_(mean.view_as(value))

    def wait(self) -> None:
        """Until all processes are here."""
        self.any(False)


ALONE = Processes(0, 1, "cpu")
"""One process that shares nothing."""


def is_first_process() -> bool:
    """Whether this process is alone, or the one of ``torchrun``'s that reports."""
    return os.environ.get("WORLD_SIZE", "1") == "1" or os.environ.get("RANK", "0") == "0"


def _count() -> int:
    """How many processes ``torchrun`` started; 1 if it did not."""
    said = os.environ.get("WORLD_SIZE", "1")
    if said == "1":
        return 1
    missing = [name for name in _OF_TORCHRUN if name not in os.environ]
    if missing or not said.isascii() or not said.isdigit() or int(said) < 1:
        raise ProcessesError(
            f"the environment says WORLD_SIZE={said[:20]}, as torchrun sets it, but "
            + (f"not {', '.join(missing)}" if missing else "that is no count of processes")
            + "\nto work alone: unset WORLD_SIZE; to work together: start it with torchrun"
        )
    return int(said)


@contextmanager
def joined_processes(device: str) -> Iterator[Processes]:
    """Joins the processes that ``torchrun`` started; alone if it did not.

    Args:
        device: ``cpu``; or ``cuda``, of which every process on a machine takes another one.

    Raises:
        ProcessesError: the environment speaks of several processes that torchrun did not start.
    """
    count = _count()
    if count == 1:
        yield Processes(0, 1, device)
        return
    own = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if device == "cuda" else device
    if own.startswith("cuda"):
        torch.cuda.set_device(own)
    torch.distributed.init_process_group("nccl" if own.startswith("cuda") else "gloo")
    try:
        yield Processes(torch.distributed.get_rank(), torch.distributed.get_world_size(), own)
    finally:
        torch.distributed.destroy_process_group()
