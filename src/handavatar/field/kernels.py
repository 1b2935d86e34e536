"""What may decode pairs of parts, by name."""

from functools import cache
from importlib.util import find_spec
from typing import Literal

import torch

from handavatar.errors import ArgumentError

Precision = Literal["tf32x3", "tf32", "bf16"]
"""Of the factors of matrix products; sums and everything else have 32 bits. Three products of
19-bit factors (``tf32x3``) are nearly as good as one of 32-bit factors, which tensor cores lack and
Triton compiles for minutes."""
Kernel = Literal["auto", "torch", "triton", "triton-tf32", "triton-bf16"]
"""Torch's operations, or :mod:`handavatar.field.fused` with long or shorter factors; ``auto`` is
``triton`` where that runs, else ``torch``."""
PRECISIONS: dict[Kernel, Precision] = {
    "triton": "tf32x3",
    "triton-tf32": "tf32",
    "triton-bf16": "bf16",
}
SHORTER: tuple[Kernel, ...] = ("triton-tf32", "triton-bf16")
"""Kernels whose answers are for finding out where to look."""


def chosen_kernel(name: Kernel, device: torch.device | str) -> Kernel:
    """What decodes pairs on a device; never ``auto``.

    Raises:
        ArgumentError: if Triton is asked for where it is missing or there is no NVIDIA GPU.
    """
    if name == "torch":
        return name
    is_cuda = torch.device(device).type == "cuda"
    if name == "auto":
        return "triton" if is_cuda and _has_triton() and _has_tensor_cores() else "torch"
    if not _has_triton():
        raise ArgumentError(
            "kernel",
            f"{name}: there is no package 'triton' here; it comes with torch's builds for CUDA",
            "",
            "use `kernel='torch'`",
        )
    if not is_cuda:
        raise ArgumentError(
            "kernel", f"{name} needs a CUDA device, found {device}", "", "use `kernel='torch'`"
        )
    return name


def settled_kernel(name: Kernel, device: torch.device | str) -> Kernel:
    """What ``auto`` stands for on a device; every other name is taken as it is."""
    return chosen_kernel(name, device) if name == "auto" else name


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None


@cache
def _has_tensor_cores() -> bool:
    """Of the kind that multiplies factors of 19 bits (compute capability 8.0)."""
    return torch.cuda.get_device_capability() >= (8, 0)
