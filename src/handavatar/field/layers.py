"""Building blocks: positional encoding, multilayer perceptron, PointNet."""

import math
from itertools import pairwise
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn


def positional_encoding(
    positions: Float[Tensor, "*batch 3"], num_frequencies: int
) -> Float[Tensor, "*batch channels"]:
    """``[x, sin(2^k pi x), cos(2^k pi x)]`` for k below ``num_frequencies``.

    Args:
        positions: normalised to [-1, 1] or less; the finest wavelength is then ``2^(2 - k_max)``.
        num_frequencies: number of octaves.

    Returns:
        ``3 + 6 * num_frequencies`` channels.

    Source: paper Sec. 3.1 and 3.3, the function P.
    Departs: the authors encode metres without the factor pi, so that their finest wavelength is
        longer than the hand; here coordinates are normalised before they are encoded.
    """
    octaves = 2.0 ** torch.arange(num_frequencies, dtype=positions.dtype, device=positions.device)
    phases = (positions[..., None, :] * (math.pi * octaves)[:, None]).flatten(-2)
    return torch.cat([positions, phases.sin(), phases.cos()], dim=-1)


def _relu_layer(width_in: int, width_out: int) -> nn.Linear:
    """A layer whose ReLU outputs keep the variance of its inputs."""
    layer = nn.Linear(width_in, width_out)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    nn.init.zeros_(layer.bias)
    return layer


class MLP(nn.Module):
    """Fully connected layers with ReLU between them; depth counts the hidden layers.

    Departs: the paper names no activation and the authors use Softplus with beta 100 in places;
        ReLU differs from it by at most 0.007 per unit and costs nothing.
    """

    def __init__(self, width_in: int, width: int, depth: int, width_out: int) -> None:
        """Widths in units; ``depth`` hidden layers (paper appendix, table of MLPs)."""
        super().__init__()
        widths = [width_in] + [width] * depth
        self.hidden = nn.ModuleList(_relu_layer(a, b) for a, b in pairwise(widths))
        self.output = nn.Linear(width, width_out)

    def forward(self, inputs: Float[Tensor, "*batch width_in"]) -> Float[Tensor, "*batch width"]:
        """Applies the layers to the last axis."""
        for layer in self.hidden:
            inputs = layer(inputs).relu()
        return self.output(inputs)


class SkipMLP(nn.Module):
    """Four hidden layers whose second one is joined by the input again.

    The MLP of the pair decoder: 64 -> width -> (width - 64, input) -> width -> width -> 1.
    """

    def __init__(self, width_in: int, width: int, width_out: int) -> None:
        """Widths in units; the join is scaled by 1/sqrt(2) to keep the variance."""
        super().__init__()
        self.layers = nn.ModuleList(
            [
                _relu_layer(width_in, width),
                _relu_layer(width, width - width_in),
                _relu_layer(width, width),
                _relu_layer(width, width),
            ]
        )
        self.output = nn.Linear(width, width_out)

    def forward(self, inputs: Float[Tensor, "*batch width_in"]) -> Float[Tensor, "*batch width"]:
        """Applies the layers to the last axis."""
        first, second, third, fourth = self.layers
        values = second(first(inputs).relu()).relu()
        values = torch.cat([values, inputs], dim=-1) / math.sqrt(2)
        return self.output(fourth(third(values).relu()).relu())


class ResidualBlock(nn.Module):
    """Pre-activated residual block with a linear shortcut; starts as the shortcut alone."""

    def __init__(self, width_in: int, width_out: int) -> None:
        """Widths of the input and of everything after it."""
        super().__init__()
        self.inner = nn.Linear(width_in, width_out)
        self.outer = nn.Linear(width_out, width_out)
        self.shortcut = nn.Linear(width_in, width_out, bias=False)
        nn.init.zeros_(self.outer.weight)

    def forward(self, inputs: Float[Tensor, "*batch width_in"]) -> Float[Tensor, "*batch width"]:
        """Applies the block to the last axis."""
        return self.outer(self.inner(inputs.relu()).relu()) + self.shortcut(inputs)

    def of_set(
        self,
        features: Float[Tensor, "*batch points width"],
        pooled: Float[Tensor, "*batch width"],
    ) -> Float[Tensor, "*batch points out"]:
        """The block on every ``[feature, pooled]``, with the pooled half computed once per set."""
        width = features.shape[-1]
        own, common = self.inner.weight.split(width, dim=1)
        shared = nn.functional.linear(pooled.relu(), common, self.inner.bias)
        # In place: none of these products is needed by its own gradient.
        hidden = (features.relu() @ own.T).add_(shared[..., None, :]).relu_()
        own, common = self.shortcut.weight.split(width, dim=1)
        out = self.outer(hidden)
        out += features @ own.T
        out += (pooled @ common.T)[..., None, :]
        return out


class PointNet(nn.Module):
    """Residual PointNet: four blocks, each but the last followed by a maximum over the points.

    Source: paper appendix, figure of the PointNet structure; ``is_pooled`` is its last MaxPool,
        kept for the part encoder (N_out = 1) and dropped in the pair decoder (N_out = 2).
    """

    def __init__(self, width_in: int, width: int = 64, is_pooled: bool = True) -> None:
        """Features per point in and out; ``is_pooled`` ends with one feature per set."""
        super().__init__()
        self.is_pooled = is_pooled
        self.input = nn.Linear(width_in, 2 * width)
        self.blocks = nn.ModuleList(ResidualBlock(2 * width, width) for _ in range(4))
        self.output = nn.Linear(width, width)

    def forward(self, points: Float[Tensor, "*batch points width_in"]) -> Tensor:
        """``(*batch, width)`` if pooled, else ``(*batch, points, width)``."""
        features = self.blocks[0](self.input(points))
        for block in self.set_blocks:
            pooled = features.amax(-2, keepdim=True).expand_as(features)
            features = block(torch.cat([features, pooled], dim=-1))
        if self.is_pooled:
            features = features.amax(-2)
        return self.output(features.relu())

    def factorised(self, points: Float[Tensor, "*batch points width_in"]) -> Tensor:
        """The same, with what all points of a set share computed once: two fifths less work."""
        features = self.blocks[0](self.input(points))
        for block in self.set_blocks:
            features = block.of_set(features, features.amax(-2))
        if self.is_pooled:
            features = features.amax(-2)
        return self.output(features.relu())

    @property
    def set_blocks(self) -> list[ResidualBlock]:
        """The blocks that see a maximum over the points beside each of them."""
        return cast(list[ResidualBlock], list(self.blocks)[1:])
