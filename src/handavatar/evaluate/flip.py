"""LDR-FLIP: where a person who flips between two pictures would see them differ, and how much.

A perceptual metric without learnt weights: colours are filtered as the eye filters them at a
viewing distance, compared in a space of even steps, and weighed up where edges or points differ.

Source: Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images".
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, pad

from handavatar.geometry.colors import linear_from_srgb

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
"""A display of 0.7 m and 3840 pixels, seen from 0.7 m: the metric's own default."""

# Contrast sensitivity of the achromatic, red-green and blue-yellow channel: sums of two Gaussians.
_SENSITIVITY = (
    (1.0, 0.0047, 0.0, 1e-5),
    (1.0, 0.0053, 0.0, 1e-5),
    (34.1, 0.04, 13.5, 0.025),
)
_COLOR_EXPONENT = 0.7
_FEATURE_EXPONENT = 0.5
_FEATURE_WIDTH = 0.082
"""Degrees that an edge or a point is wide."""
# Errors up to this share of the largest take this share of the range.
_KNEE, _KNEE_VALUE = 0.4, 0.95

_XYZ_FROM_RGB = torch.tensor(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ],
    dtype=torch.float64,
)


def flip_map(
    rendered: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Float[Tensor, "height width"]:
    """Difference per pixel, in [0, 1]; 0 where nothing differs.

    Args:
        rendered: sRGB in [0, 1].
        truth: the same; the two may be swapped.
        pixels_per_degree: of the eye's field of view.
    """
    first, second = (_opponent(linear_from_srgb(image.double())) for image in (rendered, truth))
    color = _color_difference(first, second, pixels_per_degree)
    feature = _feature_difference(first[0], second[0], pixels_per_degree)
    return color ** (1 - feature)


def _white() -> Tensor:
    return _XYZ_FROM_RGB.sum(1)


def _opponent(rgb: Float[Tensor, "height width 3"]) -> Float[Tensor, "3 height width"]:
    """YCxCz: a linear space of brightness, red-green and blue-yellow."""
    x, y, z = (rgb @ _XYZ_FROM_RGB.T / _white()).unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def _from_opponent(values: Float[Tensor, "3 height width"]) -> Float[Tensor, "height width 3"]:
    y = (values[0] + 16) / 116
    xyz = torch.stack([y + values[1] / 500, y, y - values[2] / 200], dim=-1) * _white()
    return xyz @ torch.linalg.inv(_XYZ_FROM_RGB).T


def _hunt_lab(rgb: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """CIELAB whose chroma grows with lightness, as it does to the eye (Hunt)."""
    relative = rgb @ _XYZ_FROM_RGB.T / _white()
    edge = 6 / 29
    root = relative.clamp_min(1e-12) ** (1 / 3)
    bent = torch.where(relative > edge**3, root, relative / (3 * edge**2) + 4 / 29)
    x, y, z = bent.unbind(-1)
    lightness = 116 * y - 16
    chroma = 0.01 * lightness
    return torch.stack([lightness, chroma * 500 * (x - y), chroma * 200 * (y - z)], dim=-1)


def _hyab(
    first: Float[Tensor, "*pixels 3"], second: Float[Tensor, "*pixels 3"]
) -> Float[Tensor, "*pixels"]:
    """Lightness by its absolute difference, colours by their Euclidean distance."""
    difference = first - second
    return difference[..., 0].abs() + difference[..., 1:].square().sum(-1).sqrt()


def _color_difference(
    first: Float[Tensor, "3 height width"],
    second: Float[Tensor, "3 height width"],
    pixels_per_degree: float,
) -> Float[Tensor, "height width"]:
    seen = [
        _hunt_lab(_from_opponent(_as_the_eye_sees(image, pixels_per_degree)).clamp(0, 1))
        for image in (first, second)
    ]
    error = _hyab(*seen) ** _COLOR_EXPONENT
    # Green against blue is the farthest that two sRGB colours can be apart.
    green, blue = _hunt_lab(torch.eye(3, dtype=error.dtype)[1:])
    largest = float(_hyab(green, blue)) ** _COLOR_EXPONENT
    knee = _KNEE * largest
    below = _KNEE_VALUE / knee * error
    above = _KNEE_VALUE + (error - knee) / (largest - knee) * (1 - _KNEE_VALUE)
    return torch.where(error < knee, below, above)


def _as_the_eye_sees(
    image: Float[Tensor, "3 height width"], pixels_per_degree: float
) -> Float[Tensor, "3 height width"]:
    widest = max(spread for _, b1, _, b2 in _SENSITIVITY for spread in (b1, b2))
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * pixels_per_degree)
    degrees = torch.arange(-radius, radius + 1, dtype=image.dtype) / pixels_per_degree
    squared = degrees[:, None].square() + degrees.square()
    kernels = []
    for a1, b1, a2, b2 in _SENSITIVITY:
        kernel = a1 * math.sqrt(math.pi / b1) * torch.exp(-(math.pi**2) * squared / b1)
        kernel = kernel + a2 * math.sqrt(math.pi / b2) * torch.exp(-(math.pi**2) * squared / b2)
        kernels.append(kernel / kernel.sum())
    padded = pad(image[None], (radius,) * 4, mode="replicate")
    return conv2d(padded, torch.stack(kernels)[:, None], groups=3)[0]


def _feature_difference(
    first: Float[Tensor, "height width"],
    second: Float[Tensor, "height width"],
    pixels_per_degree: float,
) -> Float[Tensor, "height width"]:
    """How differently strong edges and points are, in [0, 1]; the stronger difference counts."""
    largest = torch.zeros_like(first)
    spread = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    radius = math.ceil(3 * spread)
    places = torch.arange(-radius, radius + 1, dtype=first.dtype)
    bell = torch.exp(-(places[:, None].square() + places.square()) / (2 * spread**2))
    for profile in (-places, places.square() / spread**2 - 1):
        kernel = profile * bell
        # Both signs sum to one: a step of full height answers with one.
        positive, negative = kernel.clamp_min(0), kernel.clamp_max(0)
        kernel = positive / positive.sum() - negative / negative.sum()
        kernels = torch.stack([kernel, kernel.T])[:, None]
        strengths = []
        for image in (first, second):
            brightness = pad((image[None, None] + 16) / 116, (radius,) * 4, mode="replicate")
            strengths.append(conv2d(brightness, kernels)[0].square().sum(0).sqrt())
        largest = torch.maximum(largest, (strengths[0] - strengths[1]).abs())
    return (largest / math.sqrt(2)) ** _FEATURE_EXPONENT
