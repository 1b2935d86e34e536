"""Tensors that a caller hands in: refused by name where they enter, and not where they break."""

import math
from numbers import Real

import torch
from torch import Tensor

from handavatar.errors import ArgumentError


def require_tensor(
    name: str,
    value: object,
    shape: tuple[int, ...],
    dtype: torch.dtype | None = None,
    is_batch: bool = False,
) -> None:
    """Refuses what is no tensor, or one of another type or shape.

    What the numbers are is not looked at: a GPU would have to be waited for.

    Args:
        name: of the argument, or of the class and its field, as in ``HandPose.rotations``.
        value: that a caller gave.
        shape: it must have; -1 is any length.
        dtype: it must have; by default any of floating point.
        is_batch: whether further axes may come before those of ``shape``.

    Raises:
        ArgumentError: what it is, what was expected, and how to convert it.
    """
    kind = "floats" if dtype is None else str(dtype).removeprefix("torch.")
    sizes = ", ".join("any" if size < 0 else str(size) for size in shape)
    expected = f"a torch.Tensor of {kind}, ({'..., ' if is_batch else ''}{sizes})"
    convert = ".float()" if dtype is None else f".to({dtype})"
    if not isinstance(value, Tensor):
        is_array = type(value).__module__ == "numpy"
        make = "torch.from_numpy" if is_array else "torch.as_tensor"
        raise ArgumentError(name, _type(value), expected, f"hand in {make}(...){convert}")
    if not (value.is_floating_point() if dtype is None else value.dtype == dtype):
        found = f"a tensor of {str(value.dtype).removeprefix('torch.')}"
        raise ArgumentError(name, found, expected, f"convert it: {convert}")
    ends = value.shape[max(value.ndim - len(shape), 0) :] if is_batch else value.shape
    if len(ends) != len(shape) or any(
        0 <= size != found for size, found in zip(shape, ends, strict=True)
    ):
        raise ArgumentError(name, f"a tensor of shape {tuple(value.shape)}", expected)


def require_type(name: str, value: object, kind: type) -> None:
    """Refuses what is no instance of a class.

    Args:
        name: of the argument.
        value: that a caller gave.
        kind: the class.

    Raises:
        ArgumentError: what it is, and what was expected.
    """
    if not isinstance(value, kind):
        raise ArgumentError(name, _type(value), f"a {kind.__name__}")


def is_finite_number(value: object) -> bool:
    """Whether this is a real number, not NaN, not endless.

    Args:
        value: that a caller gave.
    """
    return isinstance(value, Real) and math.isfinite(value)


def _type(value: object) -> str:
    kind = type(value)
    shape = getattr(value, "shape", None)
    shown = kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
    return f"{shown} of shape {tuple(shape)}" if isinstance(shape, tuple) else shown
