"""How exposure and white balance drift: a gain per picture and channel, from the background.

A camera that stands still sees the same wall in every picture. What changes of the wall, and in all
of it alike, is the camera.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from handavatar.capture.tracking import Glance, TrackedHand

_STEPS = np.arange(256) / 255
_LINEAR = np.where(_STEPS <= 0.04045, _STEPS / 12.92, ((_STEPS + 0.055) / 1.055) ** 2.4)
_LINEAR = _LINEAR.astype(np.float32)
# Around the landmarks, in units of the hand's extent: skin, sleeve and shadow.
_ROOM = 0.35
_FEWEST_VIEWS = 3
# Light intensities: below is noise, above a channel may be clipped.
_DARKEST, _BRIGHTEST = 0.01, 0.85
# What an automatic camera does between pictures, as a deviation of the logarithm; and of how many
# pixels of a background one says something of its own.
_EXPECTED_DRIFT = 0.15
_PIXELS_ALIKE = 50
_DISPLAY_EXPONENT = 1 / 2.2


def exposure_gains(
    glances: Sequence[Glance],
    hands: Sequence[TrackedHand],
    picture_size: tuple[int, int],
) -> Float[np.ndarray, "hands 3"]:
    """By which factor each picture's stored values are larger than those of the average picture.

    The background's light is compared, pixel by pixel, with its median over all pictures; the
    median of these ratios is the picture's. It is drawn towards one as far as the ratios disagree
    or are few. Light is stored as nearly a power of its intensity, so a factor of the light is a
    factor of the stored values as well; the result is the latter.

    Args:
        glances: the whole pictures, small.
        hands: where the hand is; pictures without one are not asked.
        picture_size: width and height of the pictures that the hands' landmarks count in.

    Returns:
        One row of red, green and blue per hand; its geometric mean over the hands is one.
    """
    by_index = {glance.index: glance for glance in glances}
    found = [by_index.get(hand.index) for hand in hands]
    if not found or any(glance is None for glance in found):
        return np.ones((len(hands), 3))
    light = np.stack([_LINEAR[glance.image] for glance in found if glance is not None])
    walls = np.stack([_is_wall(hand, light.shape[1:3], picture_size) for hand in hands])
    light[~walls] = np.nan
    is_seen = walls.sum(0) >= min(_FEWEST_VIEWS, len(hands))
    if not is_seen.any():
        return np.ones((len(hands), 3))
    values = light[:, is_seen]
    plate = np.nanmedian(values, axis=0)
    ratios = np.full(values.shape, np.nan)
    is_sound = (values > _DARKEST) & (values < _BRIGHTEST) & (plate > _DARKEST)
    is_sound &= plate < _BRIGHTEST
    np.log(values / np.maximum(plate, _DARKEST), out=ratios, where=is_sound)
    logarithms = np.array([[_shrunk(channel) for channel in picture.T] for picture in ratios])
    logarithms -= logarithms.mean(0)
    return np.exp(_DISPLAY_EXPONENT * logarithms)


def _shrunk(ratios: Float[np.ndarray, "pixels"]) -> float:
    """Median of the finite values, drawn towards zero as far as it is unsure."""
    ratios = ratios[np.isfinite(ratios)]
    if len(ratios) == 0:
        return 0.0
    middle = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - middle))) + 0.01
    variance = spread**2 / max(1e-3, len(ratios) / _PIXELS_ALIKE)
    return middle * _EXPECTED_DRIFT**2 / (_EXPECTED_DRIFT**2 + variance)


def _is_wall(
    hand: TrackedHand, shape: tuple[int, ...], picture_size: tuple[int, int]
) -> Bool[np.ndarray, "height width"]:
    """Pixels of a glance that show neither hand nor forearm."""
    scale = np.array([shape[1] / picture_size[0], shape[0] / picture_size[1]])
    points = hand.landmarks * scale
    low, high = points.min(0), points.max(0)
    room = _ROOM * float((high - low).max())
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    is_near = (x > low[0] - room) & (x < high[0] + room)
    is_near &= (y > low[1] - room) & (y < high[1] + room)
    away = points[0] - points[[5, 9, 13, 17]].mean(0)
    away = away / max(float(np.linalg.norm(away)), 1e-6)
    along = (x - points[0, 0]) * away[0] + (y - points[0, 1]) * away[1]
    across = np.abs((x - points[0, 0]) * away[1] - (y - points[0, 1]) * away[0])
    is_forearm = (along > 0) & (across < room + 0.3 * along)
    return ~is_near & ~is_forearm
