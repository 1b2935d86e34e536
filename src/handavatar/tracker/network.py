"""The network: one crop in; points in three dimensions with expected errors, and a mask, out."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu

INPUT_SIDE = 128
"""Pixels along a side of the picture that the network sees."""
MAP_SIDE = 32
"""Places along a side of its heat maps and of its mask."""
OTHER, HAND, FOREARM = 0, 1, 2
"""What a pixel shows."""
NUM_CLASSES = 3
_WIDTHS = (32, 64, 128, 192, 256)
_MAP_WIDTH = 64
_USUAL_ERROR = 0.05
_PER_POINT = 3
"""Numbers told of each point beside its place: its depth, and the logarithms of both errors."""


@dataclass(frozen=True, eq=False)
class Told:
    """What the network says of crops.

    Attributes:
        places: right and down, as shares of the crop's side.
        place_errors: expected, of each of both, as shares of the side.
        depths: behind the wrist's joint, in units of the hand's size.
        depth_errors: expected.
        classes: logits of other, hand and forearm.
        is_hand: logit of there being a hand.
        is_right: logit of its being a right one.
    """

    places: Float[Tensor, "crops points 2"]
    place_errors: Float[Tensor, "crops points"]
    depths: Float[Tensor, "crops points"]
    depth_errors: Float[Tensor, "crops points"]
    classes: Float[Tensor, "crops classes rows columns"]
    is_hand: Float[Tensor, "crops"]
    is_right: Float[Tensor, "crops"]


class _Block(nn.Module):
    """Two convolutions around which the input passes."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _convolution(width, width), _convolution(width, width)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return relu(x + self.second(relu(self.first(x), inplace=True)), inplace=True)


class HandNetwork(nn.Module):
    """A pyramid of residual blocks, heat maps at a quarter of the resolution, and their means.

    Where a point is, is the mean place of its heat map; its depth and its errors are told by the
    mean of the features under the same weights, so by what is seen where the point is.
    """

    def __init__(self, num_points: int) -> None:
        """Draws weights.

        Args:
            num_points: whose places are told.
        """
        super().__init__()
        self.num_points = num_points
        a, b, c, d, e = _WIDTHS
        self.stem = _convolution(3, a, 2)
        self.quarter = nn.Sequential(
            _convolution(a, b, 2), nn.ReLU(), _convolution(b, b), nn.ReLU()
        )
        self.eighth = nn.Sequential(_convolution(b, c, 2), nn.ReLU(), _Block(c), _Block(c))
        self.sixteenth = nn.Sequential(_convolution(c, d, 2), nn.ReLU(), _Block(d), _Block(d))
        self.whole = nn.Sequential(_convolution(d, e, 2), nn.ReLU(), _Block(e))
        self.from_whole = nn.Conv2d(e, d, 1)
        self.from_sixteenth = nn.Conv2d(d, c, 1)
        self.merged_eighth = _Block(c)
        self.from_eighth = nn.Conv2d(c, _MAP_WIDTH, 1)
        self.from_quarter = nn.Conv2d(b, _MAP_WIDTH, 1)
        self.merged_quarter = nn.Sequential(_convolution(_MAP_WIDTH, _MAP_WIDTH), nn.ReLU())
        self.maps = nn.Conv2d(_MAP_WIDTH, num_points + NUM_CLASSES, 1)
        self.at_point = nn.Parameter(torch.zeros(num_points, _MAP_WIDTH, _PER_POINT))
        self.context = nn.Linear(e, _PER_POINT * num_points)
        self.verdict = nn.Linear(e, 2)
        nn.init.zeros_(self.context.weight)
        nn.init.zeros_(self.context.bias)
        # As the pictures: CPUs and GPUs are fastest with channels last.
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                module.weight.data = module.weight.data.contiguous(
                    memory_format=torch.channels_last
                )

    def forward(self, crops: Float[Tensor, "crops 3 side side"]) -> Told:
        """Looks at crops.

        Args:
            crops: sRGB in [0, 1], ``INPUT_SIDE`` pixels a side.
        """
        crops = crops.contiguous(memory_format=torch.channels_last)
        quarter = self.quarter(relu(self.stem((crops - 0.5) * 4), inplace=True))
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        whole = self.whole(sixteenth)
        up = sixteenth + _doubled(self.from_whole(whole))
        up = self.merged_eighth(relu(eighth + _doubled(self.from_sixteenth(up))))
        up = self.merged_quarter(relu(self.from_quarter(quarter) + _doubled(self.from_eighth(up))))
        maps = self.maps(up).float()
        pooled = whole.mean((2, 3)).float()
        count = self.num_points
        weights = maps[:, :count].flatten(2).softmax(-1)
        steps = (torch.arange(MAP_SIDE, device=crops.device).float() + 0.5) / MAP_SIDE
        places = torch.stack([steps.repeat(MAP_SIDE), steps.repeat_interleave(MAP_SIDE)], dim=-1)
        seen = weights @ up.flatten(2).mT.float()
        # What the whole picture says is added to what is seen at the point.
        values = torch.einsum("cpw,pwv->cpv", seen, self.at_point)
        values = values + self.context(pooled).float().unflatten(1, (count, _PER_POINT))
        depth, log_place_error, log_depth_error = values.unbind(-1)
        is_hand, is_right = self.verdict(pooled).float().unbind(-1)
        return Told(
            weights @ places,
            log_place_error.clamp(-4, 4).exp() * _USUAL_ERROR,
            depth,
            log_depth_error.clamp(-4, 4).exp() * _USUAL_ERROR,
            maps[:, count:],
            is_hand,
            is_right,
        )


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs)
    )


def _doubled(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h2 w2"]:
    return interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
