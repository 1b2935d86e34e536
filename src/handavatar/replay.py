"""CUDA graphs: what a function starts on a GPU, recorded once and then started as one.

Preparing a pose is two hundred operations of microseconds each: Python takes longer to start them
than a GPU to do them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

Result = TypeVar("Result")
_WARM_UPS = 3
"""Runs before recording, in which libraries choose their kernels and take their memory."""


@dataclass(frozen=True, eq=False)
class _Recorded(Generic[Result]):
    graph: torch.cuda.CUDAGraph
    inputs: tuple[Tensor, ...]
    result: Result
    objects: tuple[object, ...]
    values: tuple[object, ...]


class Replay(Generic[Result]):
    """Remembers what one function does on a GPU; a copy remembers nothing.

    The function must be one of tensors, without gradient, whose shapes and steps depend on nothing
    but what its caller names.
    """

    def __init__(self) -> None:
        """Nothing recorded yet."""
        self._recorded: _Recorded[Result] | None = None
        self._lock = Lock()

    def __deepcopy__(self, memo: dict[int, Any]) -> "Replay[Result]":
        """As new: a graph reads the memory that it was recorded with."""
        return Replay()

    def __reduce__(self) -> tuple[type["Replay[Result]"], tuple[()]]:
        """As new in another process, too."""
        return Replay, ()

    @torch.no_grad()
    def __call__(
        self,
        function: Callable[..., Result],
        inputs: tuple[Tensor, ...],
        copied: Callable[[Result], Result],
        objects: tuple[object, ...],
        values: tuple[object, ...],
    ) -> Result:
        """The function's result; recorded anew when what it depends on is not what it was.

        Args:
            function: of the inputs, on a GPU.
            inputs: of the same shapes every time.
            copied: makes a result of its own out of one that the next call overwrites.
            objects: what the function reads besides; other ones, equal or not, are other inputs.
                Tensors among them may change their numbers in place.
            values: likewise, but compared.
        """
        # Tensors that move keep their identity.
        values += tuple(item.data_ptr() for item in objects if isinstance(item, Tensor))
        with self._lock:
            known = self._recorded
            if known is None or not _is_same(known, objects, values):
                known = self._recorded = _record(function, inputs, objects, values)
            for own, given in zip(known.inputs, inputs, strict=True):
                own.copy_(given)
            known.graph.replay()
            return copied(known.result)


def _is_same(
    known: _Recorded[Result], objects: tuple[object, ...], values: tuple[object, ...]
) -> bool:
    return (
        known.values == values
        and len(known.objects) == len(objects)
        and all(own is given for own, given in zip(known.objects, objects, strict=True))
    )


def _record(
    function: Callable[..., Result],
    inputs: tuple[Tensor, ...],
    objects: tuple[object, ...],
    values: tuple[object, ...],
) -> _Recorded[Result]:
    own = tuple(given.detach().clone() for given in inputs)
    aside = torch.cuda.Stream()
    aside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(aside):
        for _ in range(_WARM_UPS):
            function(*own)
    torch.cuda.current_stream().wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    # Other threads may go on with their own work.
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        result = function(*own)
    return _Recorded(graph, own, result, objects, values)
