"""Square pieces of a picture: cut out, turned, resized, and their cameras."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from handavatar.geometry.cameras import Camera

_SURROUNDINGS = 1.9
MASK_SIDE = 448
"""Pixels along a side of the surroundings in which masks are found, at most."""
FINE_SIDE = 896
"""Pixels along a side of the surroundings from which pictures are stored, at most."""


@dataclass(frozen=True, eq=False)
class Window:
    """A square piece of a picture, resampled.

    A point of the picture lies in the window at ``(point - corner) * scale``, both in pixels
    counted from the corner of the first pixel. Beyond the picture its border is repeated.

    Attributes:
        image: sRGB.
        corner: upper left corner (x, y) in the picture.
        scale: window pixels per picture pixel.
        picture_size: width and height of the whole picture, pixels.
        principal_point: of the whole picture's camera, pixels; its middle if it is left out.
    """

    image: UInt8[np.ndarray, "side side 3"]
    corner: tuple[float, float]
    scale: float
    picture_size: tuple[int, int]
    principal_point: tuple[float, float] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Fills in what most cameras need not say."""
        if self.principal_point is None:
            width, height = self.picture_size
            object.__setattr__(self, "principal_point", (width / 2, height / 2))

    def from_picture(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Picture points in window pixels."""
        return (points - np.array(self.corner)) * self.scale

    def mirrored(self) -> "Window":
        """The window of the mirrored picture."""
        side = self.image.shape[0] / self.scale
        return replace(
            self,
            image=np.ascontiguousarray(self.image[:, ::-1]),
            corner=(self.picture_size[0] - self.corner[0] - side, self.corner[1]),
            principal_point=(
                self.picture_size[0] - self.principal_point[0],
                self.principal_point[1],
            ),
        )

    def camera(self, focal: float) -> Camera:
        """Of this window, at its own number of pixels.

        Args:
            focal: length, pixels of the whole picture.
        """
        pixels = self.image.shape[0]
        return window_camera(focal, self.principal_point, self.corner, pixels / self.scale, pixels)


def mirror_places(
    places: Float[np.ndarray, "points 2"], width: int
) -> Float[np.ndarray, "points 2"]:
    """Pixels of a picture in its mirror image, and back.

    Args:
        places: pixels.
        width: of the picture.
    """
    return places * np.array([-1.0, 1.0]) + np.array([float(width), 0.0])


def window_camera(
    focal: float,
    principal_point: tuple[float, float],
    corner: tuple[float, float],
    side: float,
    pixels: int,
) -> Camera:
    """The camera of a square piece of the picture, resized.

    Args:
        focal: of the picture, pixels.
        principal_point: of the picture, pixels.
        corner: upper left corner of the piece, pixels of the picture.
        side: of the piece, pixels of the picture.
        pixels: of the result.
    """
    scale = pixels / side
    center = [(at - start) * scale for at, start in zip(principal_point, corner, strict=True)]
    return Camera((focal * scale,) * 2, (center[0], center[1]), pixels, pixels, torch.eye(4))


def resampled(
    image: UInt8[np.ndarray, "height width 3"],
    picture_from_view: Float[np.ndarray, "2 2"],
    corner: Float[np.ndarray, "2"],
    side: int,
) -> UInt8[np.ndarray, "side side 3"]:
    """A square view of a picture; its border is repeated outside. Blurred first where it shrinks.

    Args:
        image: any picture.
        picture_from_view: turns and scales view pixels to picture pixels.
        corner: the view's upper left corner, picture pixels.
        side: of the view, pixels.
    """
    low = np.floor(np.min(_view_corners(picture_from_view, corner, side), axis=0)).astype(int) - 2
    high = np.ceil(np.max(_view_corners(picture_from_view, corner, side), axis=0)).astype(int) + 2
    rows = np.clip(np.arange(low[1], high[1]), 0, image.shape[0] - 1)
    columns = np.clip(np.arange(low[0], high[0]), 0, image.shape[1] - 1)
    piece = Image.fromarray(image[rows[:, None], columns[None, :]])
    shrink = math.sqrt(abs(float(np.linalg.det(picture_from_view))))
    factor = max(1, round(shrink))
    if factor > 1:
        piece = piece.reduce(factor)
    matrix = picture_from_view / factor
    shift = (corner - low) / factor
    coefficients = (*matrix[0], shift[0], *matrix[1], shift[1])
    view = piece.transform(
        (side, side), Image.Transform.AFFINE, coefficients, Image.Resampling.BILINEAR
    )
    # A copy, which may be written to.
    return np.array(view)


def resized(
    image: Float[Tensor, "height width channels"], side: int
) -> Float[Tensor, "side side channels"]:
    """A picture with another number of pixels; where it shrinks, means over those that were."""
    planes = image.permute(2, 0, 1)[None]
    found = torch.nn.functional.interpolate(
        planes, (side, side), mode="bilinear", antialias=True, align_corners=False
    )
    return found[0].permute(1, 2, 0)


def _view_corners(
    picture_from_view: Float[np.ndarray, "2 2"], corner: Float[np.ndarray, "2"], side: int
) -> Float[np.ndarray, "4 2"]:
    square = np.array([[0, 0], [side, 0], [0, side], [side, side]], dtype=float)
    return square @ picture_from_view.T + corner


def window_around(
    image: UInt8[np.ndarray, "height width 3"],
    landmarks: Float[np.ndarray, "21 2"],
    most: int = MASK_SIDE,
) -> Window:
    """The surroundings of a hand: room for the wrist and for its errors on every side.

    Args:
        image: the whole picture.
        landmarks: of the hand, pixels.
        most: pixels along a side; a larger hand is made smaller.
    """
    low, high = landmarks.min(0), landmarks.max(0)
    side = float((high - low).max()) * _SURROUNDINGS
    pixels = int(min(most, max(128, round(side))))
    corner = (low + high) / 2 - side / 2
    picture_from_view = np.eye(2) * (side / pixels)
    return Window(
        resampled(image, picture_from_view, corner, pixels),
        (float(corner[0]), float(corner[1])),
        pixels / side,
        (image.shape[1], image.shape[0]),
    )
