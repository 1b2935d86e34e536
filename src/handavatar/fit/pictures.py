"""What one frame shows, ready to be compared with: details of colour, distance to the outline."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_dilation
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, normalize, pad

from handavatar.geometry.cameras import Camera
from handavatar.render.silhouette import known_distance

_MOST_BORDER_POINTS = 240
_DRAWN_SIDE = 144
"""Pixels: 1 to 2 mm each on a hand."""
_BAND_RATIO = 2.5
"""Of the two blurs of a band."""
_DARKEST = 0.02
"""Of colours in [0, 1]: noise has more to say in darker ones."""
_HAND, _KNOWN, _OUTLINE = 1, 2, 4
"""Bits of a pixel's marks."""
_LEAST_SHARE = 0.03
"""Of the hand's pixels under a blur."""


@dataclass(frozen=True, eq=False)
class FramePicture:
    """One frame as a fit sees it, in few bytes: a fit holds those of all frames.

    Attributes:
        camera: of this picture.
        pixels: sRGB, levels to 255 or in [0, 1].
        gain: of the channels.
        marks: bits of each pixel: belongs to the hand, is known, has an outline.
        distance: pixels from the outline of the hand, negative inside.
        border: points on the outline, where both of its sides are known, pixels.
        border_normals: unit, away from the hand.
    """

    camera: Camera
    pixels: UInt8[Tensor, "height width 3"] | Float[Tensor, "height width 3"]
    gain: Float[Tensor, "3"]
    marks: UInt8[Tensor, "height width"]
    distance: Float[Tensor, "height width"]
    border: Float[Tensor, "border 2"]
    border_normals: Float[Tensor, "border 2"]

    @staticmethod
    def of(
        camera: Camera,
        pixels: UInt8[Tensor, "height width 3"] | Float[Tensor, "height width 3"],
        coverage: Float[Tensor, "height width"],
        known: Bool[Tensor, "height width"],
        gain: Float[Tensor, "3"],
    ) -> "FramePicture":
        """Of a picture, how much of each pixel is hand, and what is known.

        Args:
            camera: of the picture.
            pixels: sRGB, levels to 255 or in [0, 1].
            coverage: of each pixel by the hand, in [0, 1].
            known: false where neither is known.
            gain: of the channels.
        """
        distance, has_outline = known_distance(coverage, known)
        distance = blur(distance[..., None], 1.0)[..., 0]
        border, normals = _border_of(distance, known)
        hand = (coverage > 0.9) & known
        marks = _HAND * hand.byte() + _KNOWN * known.byte() + _OUTLINE * has_outline.byte()
        return FramePicture(camera, pixels, gain, marks, distance, border, normals)

    @property
    def num_bytes(self) -> int:
        """That it holds."""
        return sum(each.nbytes for each in vars(self).values() if isinstance(each, Tensor))

    @property
    def color(self) -> Float[Tensor, "height width 3"]:
        """SRGB in [0, 1], divided by the frame's gain."""
        values = self.pixels if self.pixels.is_floating_point() else self.pixels.float() / 255
        return values / self.gain

    @property
    def hand(self) -> Bool[Tensor, "height width"]:
        """Pixels that belong to the hand, known ones alone."""
        return (self.marks & _HAND) > 0

    @property
    def known(self) -> Bool[Tensor, "height width"]:
        """Pixels of which anything is known."""
        return (self.marks & _KNOWN) > 0

    @property
    def has_outline(self) -> Bool[Tensor, "height width"]:
        """Where the outline that is nearest was seen."""
        return (self.marks & _OUTLINE) > 0

    def is_known(self, pixels: Float[Tensor, "points 2"]) -> Bool[Tensor, "points"]:
        """Whether anything is known of the pixels of these points; not beyond the picture."""
        return _holds(self.known, pixels)

    def sees_outline(self, pixels: Float[Tensor, "points 2"]) -> Bool[Tensor, "points"]:
        """Whether the outline that is nearest to these points was seen."""
        return _holds(self.has_outline, pixels)

    def band(self, sigma: float) -> "PictureBand":
        """Details of about one size: the colours' logarithm blurred, less the same blurred more.

        Both among the hand's own pixels, so that no background leaks in.

        Args:
            sigma: of the finer blur, pixels.
        """
        weight = self.hand.to(self.color)[..., None]
        values = torch.cat([self.color.clamp_min(_DARKEST).log() * weight, weight], dim=-1)
        fine, coarse = (_mean_of(blur(values, each)) for each in (sigma, _BAND_RATIO * sigma))
        return PictureBand(
            torch.cat([fine - coarse, self.distance[..., None]], -1).permute(2, 0, 1)
        )


def _mean_of(total: Float[Tensor, "height width 4"]) -> Float[Tensor, "height width 3"]:
    share = total[..., 3:]
    return torch.where(share > _LEAST_SHARE, total[..., :3] / share.clamp_min(_LEAST_SHARE), 0.0)


@dataclass(frozen=True, eq=False)
class PictureBand:
    """Channels to be read between the pixels: three of details, and the distance to the outline."""

    channels: Float[Tensor, "4 height width"]

    def sample(
        self, pixels: Float[Tensor, "points 2"]
    ) -> tuple[Float[Tensor, "points 4"], Float[Tensor, "points 4 2"]]:
        """Bilinear values and slopes over one pixel; beyond the picture its border goes on."""
        return sample_with_slope(self.channels, pixels)


def _holds(
    picture: Bool[Tensor, "height width"], pixels: Float[Tensor, "points 2"]
) -> Bool[Tensor, "points"]:
    """What a picture says at image positions; no beyond it."""
    height, width = picture.shape
    column, row = pixels.floor().long().unbind(-1)
    is_inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return is_inside & picture[row.clamp(0, height - 1), column.clamp(0, width - 1)]


def _border_of(
    distance: Float[Tensor, "height width"], known: Bool[Tensor, "height width"]
) -> tuple[Float[Tensor, "border 2"], Float[Tensor, "border 2"]]:
    """Evenly chosen points where the distance crosses zero, and the normals there."""
    values = distance.numpy()
    found = [np.zeros((0, 2))]
    for axis in (0, 1):
        first = values[:-1] if axis == 0 else values[:, :-1]
        second = values[1:] if axis == 0 else values[:, 1:]
        row, column = np.nonzero((first < 0) != (second < 0))
        begin, end = first[row, column], second[row, column]
        along = begin / (begin - end)
        point = np.stack([column + 0.5, row + 0.5], axis=-1)
        point[:, 1 - axis] += along
        found.append(point)
    points = torch.from_numpy(np.concatenate(found)).float()
    # Where what is known ends, the outline may go on: that end is none of the hand's.
    height, width = known.shape
    near_unknown = binary_dilation(~known.numpy(), iterations=2, border_value=1)
    index = points.floor().long().clamp_min(0)
    rows, columns = index[:, 1].clamp_max(height - 1), index[:, 0].clamp_max(width - 1)
    points = points[~torch.from_numpy(near_unknown)[rows, columns]]
    points = points[:: max(1, len(points) // _MOST_BORDER_POINTS)]
    _, slopes = sample_with_slope(distance[None], points)
    return points, normalize(slopes[:, 0], dim=-1)


def drawing_camera(camera: Camera) -> Camera:
    """The same view with few pixels, for what is drawn again at every step.

    Outlines are still points on edges, and are compared at the picture's own resolution.
    """
    scale = _DRAWN_SIDE / max(camera.width, camera.height)
    if scale >= 1:
        return camera
    return camera.resized(round(scale * camera.width), round(scale * camera.height))


def sample_with_slope(
    channels: Float[Tensor, "channels height width"], pixels: Float[Tensor, "points 2"]
) -> tuple[Float[Tensor, "points channels"], Float[Tensor, "points channels 2"]]:
    """Bilinear values at image positions, and central differences over one pixel."""
    size = pixels.new_tensor([channels.shape[2], channels.shape[1]])
    steps = pixels.new_tensor([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    grid = (pixels + steps[:, None]) / size * 2 - 1
    values = grid_sample(channels[None], grid[None], padding_mode="border", align_corners=False)
    middle, right, left, below, above = values[0].permute(1, 2, 0)
    return middle, torch.stack([right - left, below - above], dim=-1)


def blur(
    image: Float[Tensor, "height width channels"], sigma: float
) -> Float[Tensor, "height width channels"]:
    """Gaussian blur; the border is repeated."""
    if sigma <= 0:
        return image
    reach = max(1, round(3 * sigma))
    offsets = torch.arange(-reach, reach + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (offsets / sigma).square())
    kernel = kernel / kernel.sum()
    planes = image.permute(2, 0, 1)[:, None]
    planes = conv2d(
        pad(planes, (0, 0, reach, reach), mode="replicate"), kernel[None, None, :, None]
    )
    planes = conv2d(pad(planes, (reach, reach, 0, 0), mode="replicate"), kernel[None, None, None])
    return planes[:, 0].permute(1, 2, 0)
