"""What is wrong with a picture of a hand, while there is still time to do something about it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from scipy import ndimage

from handavatar.capture.own_finder import SeenCrop
from handavatar.capture.tracking import DARK

Kind = Literal["none", "border", "small", "dark", "bright", "blur", "unsure"]
ADVICE: dict[Kind, tuple[str, str]] = {
    "none": ("no hand is seen", "hold one bare hand, whole, before the camera"),
    "border": ("the hand leaves the picture", "move to the middle, or step back"),
    "small": ("the hand is too small", "come closer to the camera"),
    "dark": ("the hand is too dark", "more light, from the front"),
    "bright": ("the skin is overexposed", "less light, or turn away from the lamp"),
    "blur": ("the hand is blurred", "move more slowly, or give the camera time to focus"),
    "unsure": ("the fingers cannot be told", "turn the hand a little, so that they are seen"),
}
"""What is found, and what to do about it."""
# Of the hand's extent by the picture's shorter side.
_SMALL = 0.25
# Of the hand's points: as many beyond the picture, or as near its border as this share of its side.
_BEYOND, _NEAR_BORDER = 0.02, 0.005
# Of the hand's pixels by brightness, 0 to 255: nine tenths of them are darker than this, or more
# than this share has a channel at its end.
_DARK, _FULL, _MOST_FULL = 60.0, 250, 0.25
# Share of the picture's slopes that another blur takes away: less, and it was blurred before.
_SHARP = 0.25
# Pixels along the longer side of the hand at which blur is judged, at most.
_JUDGED_SIDE = 224
_BLUR = 5
"""Pixels over which a picture is blurred again."""


@dataclass(frozen=True)
class Warning:
    """What is wrong.

    Attributes:
        kind: a key of ``ADVICE``.
    """

    kind: Kind

    @property
    def found(self) -> str:
        """What is wrong, for people."""
        return ADVICE[self.kind][0]

    @property
    def remedy(self) -> str:
        """What to do about it."""
        return ADVICE[self.kind][1]


def find_warnings(
    image: UInt8[np.ndarray, "height width 3"],
    seen: SeenCrop,
    places: Float[np.ndarray, "points 2"],
    is_unsure: bool,
) -> list[Warning]:
    """What is wrong with a picture in which a hand is, the worst first.

    Args:
        image: sRGB.
        seen: what the tracker saw.
        places: of the fitted hand's skin, pixels of the picture.
        is_unsure: whether the hand does not fit what was seen.
    """
    height, width = image.shape[:2]
    size = np.array([width, height])
    edge = _NEAR_BORDER * size
    is_inside = ((places >= edge) & (places <= size - edge)).all(-1)
    found: list[Kind] = []
    if 1 - is_inside.mean() > _BEYOND:
        found.append("border")
    if seen.extent < _SMALL * min(width, height):
        found.append("small")
    pixels = hand_pixels(image, seen)
    if len(pixels):
        if float(np.quantile(pixels.mean(-1), 0.9)) < _DARK:
            found.append("dark")
        if float((pixels.max(-1) >= _FULL).mean()) > _MOST_FULL:
            found.append("bright")
    if "dark" not in found and sharpness(image, seen) < _SHARP:
        found.append("blur")
    if is_unsure:
        found.append("unsure")
    return [Warning(kind) for kind in found]


def warnings_without_hand(image: UInt8[np.ndarray, "height width 3"]) -> list[Warning]:
    """What is wrong with a picture in which no hand is seen."""
    is_dark = float(image.mean()) < DARK
    return [Warning("none"), *([Warning("dark")] if is_dark else [])]


def hand_pixels(
    image: UInt8[np.ndarray, "height width 3"], seen: SeenCrop
) -> UInt8[np.ndarray, "pixels 3"]:
    """Colours of the picture where the tracker sees the hand."""
    height, width = image.shape[:2]
    x, y = np.floor(seen.hand).astype(int).reshape(-1, 2).T
    is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return image[y[is_inside], x[is_inside]]


def sharpness(image: UInt8[np.ndarray, "height width 3"], seen: SeenCrop) -> float:
    """Share of the slopes about a hand that another blur would take away, in [0, 1].

    A sharp picture loses much by it and a blurred one little, whatever its contrast. Of rows and
    columns the less: motion blurs one of them.

    Args:
        image: sRGB.
        seen: where the hand is.

    Source: Crete, Dolmiere, Ladret, Nicolas, "The blur effect", SPIE 6492, 2007.
    """
    height, width = image.shape[:2]
    low = np.clip(np.floor(seen.points.min(0)), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(seen.points.max(0)), 0, [width, height]).astype(int)
    if (high - low).min() < 4 * _BLUR:
        return 0.0
    piece = Image.fromarray(image[low[1] : high[1], low[0] : high[0]]).convert("L")
    piece = piece.reduce(max(1, round(max(piece.size) / _JUDGED_SIDE)))
    grey = np.asarray(piece, dtype=np.float32)
    shares = []
    for axis in range(2):
        slopes = np.abs(np.diff(grey, axis=axis))
        again = np.abs(np.diff(ndimage.uniform_filter1d(grey, _BLUR, axis=axis), axis=axis))
        # Edges alone: elsewhere there is only the sensor's noise, which is always sharp.
        is_edge = slopes >= np.quantile(slopes, 0.95)
        lost = np.maximum(slopes - again, 0)[is_edge].sum()
        shares.append(float(lost / max(float(slopes[is_edge].sum()), 1e-6)))
    return min(shares)
