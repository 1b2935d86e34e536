"""What may decode pairs of parts, by name."""

from importlib.util import find_spec
from typing import Literal

import torch

Precision = Literal["ieee", "tf32x3", "tf32", "bf16"]
"""Of the factors of matrix products; sums and everything else have 32 bits. Three products of
19-bit factors (``tf32x3``) are as good as one of 32-bit factors (``ieee``)."""
Kernel = Literal["torch", "triton", "triton-tf32", "triton-bf16"]
"""Torch's operations, or :mod:`handavatar.field.fused` with factors of 32 bits or shorter ones."""
PRECISIONS: dict[Kernel, Precision] = {
    "triton": "ieee",
    "triton-tf32": "tf32",
    "triton-bf16": "bf16",
}


def chosen_kernel(name: Kernel, device: torch.device | str) -> Kernel:
    """What decodes pairs on a device.

    Raises:
        ValueError: if Triton is asked for where it is missing or there is no NVIDIA GPU.
    """
    if name == "torch":
        return name
    if find_spec("triton") is None:
        raise ValueError(
            f"--kernel {name}: there is no package 'triton' here; it comes with torch's builds for "
            "CUDA; use --kernel torch"
        )
    if torch.device(device).type != "cuda":
        raise ValueError(
            f"--kernel {name}: needs a CUDA device, found {device}; use --kernel torch"
        )
    return name
