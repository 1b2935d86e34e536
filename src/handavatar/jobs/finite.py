"""Whether numbers are finite: asked of whatever is saved, before, and of whatever is read, after.

NaN spreads: one weight that holds it makes every picture black, and a checkpoint that holds it is
no way back. So nothing is written or taken that holds NaN or infinity; the error names it.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from handavatar.errors import ErrorKind, HandAvatarError

_LONGEST_NAME = 120


class NotFinite(HandAvatarError, FloatingPointError):
    """NaN or infinity where numbers are expected: what holds it, where, and what to do about it."""

    kind = ErrorKind.NUMERICAL

    def __init__(self, found: str, remedy: str = "") -> None:
        """The remedy is empty where only the caller knows."""
        super().__init__(found, "", remedy)


def find_not_finite(values: Mapping[str, object]) -> str | None:
    """Names the first of some values that is NaN or infinite.

    Args:
        values: by name: tensors, numbers, and lists and mappings of them; whole numbers, truth
            values, texts and None are always finite.

    Returns:
        Such as ``adam.3.exp_avg holds NaN at [0, 4] (2 of 128 values are not finite)``; None if
        all are finite.
    """
    tensors = [value for value in values.values() if isinstance(value, Tensor)]
    are_sound = _have_finite_sums(tensors)
    for name, value in values.items():
        if are_sound and isinstance(value, Tensor):
            continue
        found = _found_in(str(name)[:_LONGEST_NAME], value)
        if found is not None:
            return found
    return None


def require_finite(values: Mapping[str, object], where: str, remedy: str = "") -> None:
    """Refuses values that are not finite.

    Args:
        values: as of :func:`find_not_finite`.
        where: they are, or when: the begin of the message, such as ``checkpoint of step 100``.
        remedy: what to do about it.

    Raises:
        NotFinite: if one of them is NaN or infinite; it names the first one.
    """
    found = find_not_finite(values)
    if found is not None:
        raise NotFinite(f"{where}: {found}", remedy)


def _have_finite_sums(tensors: list[Tensor]) -> bool:
    """Whether tensors are finite for sure: asked of all at once, which a GPU answers once.

    A sum is finite only if all of its terms are. It may be infinite though they are not.
    """
    sums: dict[tuple[torch.device, torch.dtype], list[Tensor]] = {}
    for value in tensors:
        if value.is_floating_point() or value.is_complex():
            sums.setdefault((value.device, value.dtype), []).append(value.detach().sum())
    return all(bool(torch.stack(group).sum().isfinite()) for group in sums.values())


def _found_in(name: str, value: object) -> str | None:
    if isinstance(value, Tensor):
        return _found_in_tensor(name, value)
    if isinstance(value, float):
        return None if math.isfinite(value) else f"{name} is {_named(value)}"
    if isinstance(value, Mapping):
        return find_not_finite({f"{name}.{key}": item for key, item in value.items()})
    if isinstance(value, list | tuple):
        return find_not_finite({f"{name}.{number}": item for number, item in enumerate(value)})
    return None


def _named(value: object) -> str:
    return str(value).replace("nan", "NaN")


def _found_in_tensor(name: str, value: Tensor) -> str | None:
    if not (value.is_floating_point() or value.is_complex()) or value.numel() == 0:
        return None
    value = value.detach()
    places = (~value.isfinite()).nonzero()
    if len(places) == 0:
        return None
    where = places[0].tolist()
    at = f" at {where}" if where else ""
    return (
        f"{name} holds {_named(value[tuple(where)].item())}{at} "
        f"({len(places)} of {value.numel()} values are not finite)"
    )
