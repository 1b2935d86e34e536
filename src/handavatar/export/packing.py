"""Arrays of numbers in one run of bytes, and an index that says where each lies."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_KINDS = ("f4", "i2", "u2", "u4", "i1", "u1")
_ALIGNMENT = 4


@dataclass(frozen=True, eq=False)
class Packed:
    """An array as it is stored.

    Attributes:
        values: of a kind that browsers have typed arrays of.
        scale: what a reader multiplies by; None leaves the numbers as they are.
    """

    values: np.ndarray
    scale: float | None = None

    def read(self) -> Tensor:
        """The numbers that a reader gets."""
        values = torch.from_numpy(self.values.astype(np.float32))
        return values if self.scale is None else values * self.scale


def quantised(values: Float[Tensor, "*shape"], kind: str) -> Packed:
    """Signed integers of a kind, the largest of which stands for the largest magnitude.

    Args:
        values: finite.
        kind: ``i1`` or ``i2``.
    """
    most = {"i1": 127, "i2": 32767}[kind]
    scale = float(values.abs().max().clamp_min(1e-12)) / most
    return Packed((values / scale).round().numpy().astype(kind), scale)


def packed_bytes(arrays: dict[str, Packed]) -> tuple[list[dict[str, Any]], bytes]:
    """The arrays one behind the other, little-endian, each at a multiple of four bytes.

    Returns:
        For each its ``name``, ``kind`` (such as ``f4``), ``start`` in bytes, ``count`` of numbers
        and, where there is one, ``scale``; and all the bytes.

    Raises:
        ValueError: for a kind that browsers have no array of.
    """
    index: list[dict[str, Any]] = []
    content = b""
    for name, array in arrays.items():
        values = np.ascontiguousarray(array.values)
        kind = values.dtype.newbyteorder("<").str[1:]
        if kind not in _KINDS:
            raise ValueError(f"{name}: found {values.dtype}, expected one of {', '.join(_KINDS)}")
        entry: dict[str, Any] = {
            "name": name, "kind": kind, "start": len(content), "count": values.size
        }  # fmt: skip
        if array.scale is not None:
            entry["scale"] = array.scale
        index.append(entry)
        content += values.astype("<" + kind).tobytes()
        content += bytes(-len(content) % _ALIGNMENT)
    return index, content
