"""Stored colours and light."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def linear_from_srgb(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Light intensities of stored sRGB values in [0, 1]."""
    return torch.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Stored sRGB values of light intensities, which are clipped to [0, 1]."""
    values = values.clamp(0, 1)
    bright = 1.055 * values.clamp(min=1e-8) ** (1 / 2.4) - 0.055
    return torch.where(values <= 0.0031308, 12.92 * values, bright)


def eight_bits(values: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """Values in [0, 1] as pictures store them; outside they saturate."""
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)
