"""Which pixels show the hand: a colour model of this video, then graph cuts.

Two Gaussian mixtures in OKLab, one of skin and one of everything else, are learned from some
thirty frames around the tracked landmarks. Their log-likelihood ratio starts GrabCut in every
frame. Last, the border moves to where the colours of its own neighbourhood change. The result holds
the forearm as well; where the hand ends is decided by the fitted rig.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage

from handavatar.capture.checks import CaptureError
from handavatar.capture.tracking import TrackedHand
from handavatar.capture.windows import Window, resampled

_FINGER_CHAINS = (
    (0, 1, 2, 3, 4),
    (5, 6, 7, 8),
    (9, 10, 11, 12),
    (13, 14, 15, 16),
    (17, 18, 19, 20),
)
_PALM = (0, 1, 2, 5, 9, 13, 17)
_CORE_RADIUS = 0.004
_HAND_RADIUS = 0.040
_BACKGROUND_MARGIN = 0.042
_FOREARM_HALF_ANGLE = 60.0
_HOLE_RADIUS = 0.004
_CUT_ROUNDS = 1
SURE = 4.0
"""Logarithm of a ratio of likelihoods from which on colour alone decides."""

SUBPIXELS = 3
"""Along each side of a pixel, where it is counted how much of it is covered."""

BACKGROUND, HAND, LIKELY_BACKGROUND, LIKELY_HAND = 0, 1, 2, 3
"""GrabCut's labels."""

# The last correction of the border, in pixels of the window; noise in 8-bit steps.
_BORDER_ROUNDS = 3
_BORDER_REACH = 6.0
_BORDER_GAP = 2.0
_BORDER_CIRCLE = 3.5
_BORDER_NOISE = 6.0
# Of the light on the skin at its border, as a share of it, one standard deviation: at least, and
# in that of the light within some pixels further in.
_LEAST_SHADING, _BORDER_SHADING, _MOST_SHADING = 0.04, 4.0, 0.3
_SPREAD_GAP = 5.0
_RIM = 3.0
_BORDER_SMOOTHING = 2.0
_BORDER_INERTIA = 0.03
# Brightness, and half of the two colour differences of ITU-R BT.601.
_LUMA_AND_COLOR = np.array(
    [[0.299, 0.587, 0.114], [-0.0844, -0.1656, 0.25], [0.25, -0.2094, -0.0406]], dtype=np.float32
)

_LMS_FROM_RGB = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_OKLAB_FROM_LMS = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def oklab_from_srgb(image: UInt8[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Perceptual colour (lightness, green-red, blue-yellow) of 8-bit sRGB."""
    steps = np.arange(256) / 255
    linear = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear[image] @ _LMS_FROM_RGB.T) @ _OKLAB_FROM_LMS.T


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """A density of colours.

    Attributes:
        weights: sum to 1.
        means: OKLab.
        precisions: inverse covariances.
    """

    weights: Float[np.ndarray, "parts"]
    means: Float[np.ndarray, "parts 3"]
    precisions: Float[np.ndarray, "parts 3 3"]

    def log_density(self, colors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """Natural logarithm of the density."""
        return np.logaddexp.reduce(self._log_parts(colors), axis=-1)

    def _log_parts(self, colors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n parts"]:
        parts = []
        for weight, mean, precision in zip(self.weights, self.means, self.precisions, strict=True):
            apart = colors - mean
            mahalanobis = ((apart @ precision) * apart).sum(-1)
            norm = 0.5 * np.linalg.slogdet(precision)[1] - 1.5 * np.log(2 * np.pi)
            parts.append(np.log(weight + 1e-12) + norm - 0.5 * mahalanobis)
        return np.stack(parts, axis=-1)


def fit_mixture(
    colors: Float[np.ndarray, "n 3"],
    num_parts: int,
    generator: np.random.Generator,
    rounds: int = 25,
) -> GaussianMixture:
    """Expectation maximisation from well separated starting points.

    Args:
        colors: at least a few dozen.
        num_parts: Gaussians of the mixture.
        generator: chooses the first starting point.
        rounds: of expectation and maximisation.
    """
    # Sensor noise and the 8-bit steps of dark colours: no Gaussian gets narrower than this.
    floor = np.eye(3) * 0.006**2
    means = [colors[generator.integers(len(colors))]]
    for _ in range(num_parts - 1):
        nearest = np.min([((colors - mean) ** 2).sum(-1) for mean in means], axis=0)
        means.append(colors[generator.choice(len(colors), p=nearest / nearest.sum())])
    spread = np.cov(colors.T) / num_parts + floor
    mixture = GaussianMixture(
        np.full(num_parts, 1 / num_parts),
        np.array(means),
        np.repeat(np.linalg.inv(spread)[None], num_parts, axis=0),
    )
    for _ in range(rounds):
        logs = mixture._log_parts(colors)
        shares = np.exp(logs - np.logaddexp.reduce(logs, axis=-1)[:, None])
        totals = shares.sum(0) + 1e-6
        centers = (shares.T @ colors) / totals[:, None]
        covariances = []
        for share, total, center in zip(shares.T, totals, centers, strict=True):
            apart = colors - center
            covariances.append((share[:, None] * apart).T @ apart / total + floor)
        mixture = GaussianMixture(
            totals / totals.sum(), centers, np.linalg.inv(np.array(covariances))
        )
    return mixture


@dataclass(frozen=True, eq=False)
class ColorModel:
    """Skin against everything else, in one video.

    Attributes:
        hand: colours on the hand.
        background: colours away from it.
    """

    hand: GaussianMixture
    background: GaussianMixture

    def log_ratio(
        self, image: UInt8[np.ndarray, "height width 3"]
    ) -> Float[np.ndarray, "height width"]:
        """How much likelier each pixel is to be hand: natural logarithm, within +-12.

        Colours are looked up on a grid of 64 steps per channel.
        """
        coarse = image >> 2
        keys = (
            (coarse[..., 0].astype(np.int32) << 12)
            | (coarse[..., 1].astype(np.int32) << 6)
            | coarse[..., 2]
        )
        used, where = np.unique(keys, return_inverse=True)
        colors = np.stack([used >> 12, (used >> 6) & 63, used & 63], axis=-1) * 4 + 2
        colors = oklab_from_srgb(colors.astype(np.uint8))
        return np.clip(self.ratio_of(colors), -12, 12)[where].reshape(keys.shape)

    def ratio_of(self, colors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """The same of OKLab colours, exact and without bounds."""
        return self.hand.log_density(colors) - self.background.log_density(colors)


@dataclass(frozen=True, eq=False)
class HandMask:
    """The hand and forearm in a window.

    Attributes:
        pixels: true on skin that belongs to the hand or the forearm.
        level: smooth, in [0, 1]; more than 0.5 on these pixels and nowhere else, so that its
            contour at 0.5 is the border to a fraction of a pixel.
        quality: agreement (intersection over union) of the graph cut with the colour model
            alone, in [0, 1].
    """

    pixels: Bool[np.ndarray, "side side"]
    level: Float[np.ndarray, "side side"]
    quality: float


@dataclass(frozen=True, eq=False)
class _Regions:
    """What the landmarks say of a window, before any colour."""

    core: Bool[np.ndarray, "side side"]
    near: Bool[np.ndarray, "side side"]
    forearm: Bool[np.ndarray, "side side"]
    far: Bool[np.ndarray, "side side"]
    pixels_per_metre: float


def learn_colors(hands: Sequence[TrackedHand], seed: int = 0, num_frames: int = 30) -> ColorModel:
    """Two mixtures from the surest frames of a video, spread over its length.

    Raises:
        CaptureError: the landmarks leave no background to learn from.
    """
    generator = np.random.default_rng(seed)
    chosen = sure_and_spread(hands, num_frames)
    inside: list[np.ndarray] = []
    outside: list[np.ndarray] = []
    for hand in chosen:
        regions = _regions(hand)
        image = hand.window.image
        for colors, region in ((inside, regions.core), (outside, regions.far)):
            pixels = image[region]
            if len(pixels):
                colors.append(generator.choice(pixels, min(len(pixels), 1500), axis=0))
    if not inside or not outside:
        raise CaptureError("the hand fills the picture", "record it with room on every side")
    return color_model(np.concatenate(inside), np.concatenate(outside), generator, True)


def color_model(
    inside: UInt8[np.ndarray, "n 3"],
    outside: UInt8[np.ndarray, "m 3"],
    generator: np.random.Generator,
    is_skin_elsewhere: bool,
) -> ColorModel:
    """Two mixtures from colours that are mostly skin and mostly something else.

    Args:
        inside: sRGB, on the hand.
        outside: sRGB, away from it.
        generator: of the mixtures' starting points.
        is_skin_elsewhere: whether what looks like skin away from the hand may be the hand's own and
            is to be left out.
    """
    hand_colors, other_colors = oklab_from_srgb(inside), oklab_from_srgb(outside)
    for _ in range(2):
        model = ColorModel(
            fit_mixture(hand_colors, 5, generator), fit_mixture(other_colors, 6, generator)
        )
        # Landmarks beside the finger put background among the seeds, an unseen second patch of
        # skin puts skin among the background: what contradicts the first model is left out.
        hand_colors = hand_colors[model.ratio_of(hand_colors) > -1]
        if is_skin_elsewhere:
            other_colors = other_colors[model.ratio_of(other_colors) < 3]
        if len(hand_colors) < 500 or len(other_colors) < 500:
            break
    return model


def find_mask(hand: TrackedHand, colors: ColorModel) -> HandMask:
    """The hand and forearm in one frame's window: colour model, then GrabCut.

    Raises:
        CaptureError: OpenCV is not installed.
    """
    regions = _regions(hand)
    ratio = ndimage.gaussian_filter(colors.log_ratio(hand.window.image), 1.0)
    allowed = regions.near | regions.forearm
    by_color = (ratio > 0) & allowed
    labels = np.full(ratio.shape, BACKGROUND, dtype=np.uint8)
    labels[allowed] = LIKELY_BACKGROUND
    labels[by_color] = LIKELY_HAND
    # Left to itself GrabCut fills the gaps between fingers; where colour is sure, it decides.
    labels[ratio < -SURE] = BACKGROUND
    labels[(ratio > SURE) & allowed] = HAND
    labels[regions.core & (ratio > 0)] = HAND
    cut = graph_cut(hand.window.image, labels)
    is_sure = labels == BACKGROUND
    level = settled_border(
        hand.window.image,
        cleaned_mask(cut, regions.core, regions.pixels_per_metre) & ~is_sure,
        without_rim(is_sure),
    )
    cleaned = cleaned_mask(level > 0.5, regions.core, regions.pixels_per_metre)
    level = np.where(cleaned == (level > 0.5), level, cleaned)
    reference = cleaned_mask(by_color, regions.core, regions.pixels_per_metre)
    union = (cleaned | reference) & regions.near
    agreement = (cleaned & reference & regions.near).sum() / max(1, int(union.sum()))
    return HandMask(cleaned, level, float(agreement))


def mask_coverage(
    level: Float[np.ndarray, "side side"],
    window_from_view: Float[np.ndarray, "2 2"],
    corner: Float[np.ndarray, "2"],
    size: int,
) -> Float[np.ndarray, "size size"]:
    """How much of each pixel of a view is hand, in [0, 1], by the contour of a level at 0.5.

    A level falls over several pixels, so its own values do not say how far the contour is.

    Args:
        level: of a :class:`HandMask`.
        window_from_view: turns and scales the view's pixels to those of the mask.
        corner: the view's upper left corner, pixels of the mask.
        size: side of the view, pixels.
    """
    fine = resampled(grey_picture(level), window_from_view / SUBPIXELS, corner, SUBPIXELS * size)
    return covered_shares(fine[..., 0] > 127, SUBPIXELS)


def covered_shares(
    fine: Bool[np.ndarray, "fine fine"], samples: int
) -> Float[np.ndarray, "side side"]:
    """How much of each pixel is true, in [0, 1].

    Args:
        fine: a mask of so many times the size.
        samples: along a side of a pixel.
    """
    side = len(fine) // samples
    return fine.reshape(side, samples, side, samples).mean(axis=(1, 3))


def grey_picture(values: np.ndarray) -> UInt8[np.ndarray, "height width 3"]:
    """Values in [0, 1] as a picture."""
    grey = (255 * values.astype(np.float32)).round().astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def pixels_per_metre(hand: TrackedHand) -> float:
    """Scale of a tracked hand: picture pixels per metre at its depth."""
    pairs = [(a, b) for chain in _FINGER_CHAINS for a, b in pairwise(chain)]
    pairs += [(0, 5), (0, 9), (0, 13), (0, 17)]
    first, second = np.array(pairs).T
    picture = np.linalg.norm(hand.landmarks[first] - hand.landmarks[second], axis=-1)
    world = hand.world_landmarks[first] - hand.world_landmarks[second]
    flat = np.linalg.norm(world[:, :2], axis=-1)
    return float(picture.sum() / max(1e-6, flat.sum()))


def settled_border(
    image: UInt8[np.ndarray, "side side 3"],
    mask: Bool[np.ndarray, "side side"],
    is_background: Bool[np.ndarray, "side side"],
) -> Float[np.ndarray, "side side"]:
    """The mask with its border where the picture changes from skin to what is beside it.

    Videos store colour coarsely: its edges lie some pixels beside those of brightness, and a model
    of the whole hand's colours follows them, fills the corners between fingers and thickens their
    lit sides. Here every pixel near the border is compared with the skin and the background of its
    own neighbourhood, brightness before colour; where the two look alike, its neighbours decide,
    or the mask as it was.

    Args:
        image: sRGB.
        mask: at most a few pixels wrong.
        is_background: what is certainly no skin.

    Returns:
        More than 0.5 on skin; falls smoothly across the border, in [0, 1].
    """
    return settled(image, mask, is_background)[0]


def without_rim(is_background: Bool[np.ndarray, "side side"]) -> Bool[np.ndarray, "side side"]:
    """What is sure to be background by its colour, but for its outermost pixels.

    Skin may cover these in part, and a model of whole pixels' colours knows no mixtures.
    """
    return depth_inside(is_background) > _RIM


def settled(
    image: UInt8[np.ndarray, "side side 3"],
    mask: Bool[np.ndarray, "side side"],
    is_background: Bool[np.ndarray, "side side"],
) -> tuple[Float[np.ndarray, "side side"], Float[np.ndarray, "side side"]]:
    """:func:`settled_border`, and how far the picture decides it.

    The second result is, at every pixel near the border, the contrast between the skin and the
    background of its neighbourhood, squared, as a share of itself and the noise: in [0, 1].
    """
    pixels = image.astype(np.float32) @ _LUMA_AND_COLOR.T
    level = mask.astype(np.float32)
    for _ in range(_BORDER_ROUNDS):
        depth = depth_inside(mask)
        height = depth_inside(~mask)
        skin = _local_mean(pixels, depth > _BORDER_GAP)
        spread = _local_spread(pixels[..., 0], depth > _SPREAD_GAP)
        beside = _local_mean(pixels, height > _BORDER_GAP)
        apart = skin - beside
        weighed = _without_shading(apart, skin, spread)
        contrast = (apart * weighed).sum(-1)
        clearness = contrast / (contrast + _BORDER_NOISE**2)
        share = (((pixels - beside) * weighed).sum(-1) / (contrast + 1e-6)).clip(0, 1)
        is_free = (depth <= _BORDER_REACH) & (height <= _BORDER_REACH) & ~is_background
        trust = np.where(is_free, clearness, 1.0)
        value = trust * np.where(is_free, share, mask) + _BORDER_INERTIA * mask
        weighed = np.stack([value, trust + _BORDER_INERTIA], axis=-1)
        smooth, weight = np.moveaxis(_blurred(weighed, _BORDER_SMOOTHING), -1, 0)
        smooth = smooth / weight
        level = np.where(is_free, smooth, mask).clip(0, 1)
        mask = level > 0.5
    return level, clearness


def _without_shading(
    apart: Float[np.ndarray, "side side 3"],
    skin: Float[np.ndarray, "side side 3"],
    spread: Float[np.ndarray, "side side"],
) -> Float[np.ndarray, "side side 3"]:
    """Differences of colours, less most of what a brighter or darker light on the skin makes of it.

    The lit side of a finger may be as bright as the wall behind it, and brighter than the skin next
    to it; it is skin by its hue. As noise and shading are expected, this is their covariance's
    inverse times the difference, in units of the noise.

    Args:
        apart: skin less what is beside it.
        skin: its colour.
        spread: of its brightness, one standard deviation.
    """
    share = np.maximum(_LEAST_SHADING, _BORDER_SHADING * spread / (skin[..., 0] + 1e-6))
    shading = (np.minimum(share, _MOST_SHADING) ** 2)[..., None]
    length = (skin**2).sum(-1, keepdims=True)
    along = (apart * skin).sum(-1, keepdims=True)
    return apart - skin * (shading * along / (_BORDER_NOISE**2 + shading * length))


def _local_spread(
    values: Float[np.ndarray, "side side"], is_used: Bool[np.ndarray, "side side"]
) -> Float[np.ndarray, "side side"]:
    """Standard deviation of the used pixels around each pixel."""
    powers = np.stack([values, values**2], axis=-1)
    mean, squared = np.moveaxis(_local_mean(powers, is_used), -1, 0)
    return np.sqrt((squared - mean**2).clip(0))


def _local_mean(
    values: Float[np.ndarray, "side side channels"], is_used: Bool[np.ndarray, "side side"]
) -> Float[np.ndarray, "side side channels"]:
    """Mean over the used pixels around each pixel; over a wider circle where none is near."""
    weighed = np.where(is_used[..., None], np.insert(values, values.shape[-1], 1.0, axis=-1), 0.0)
    weighed = weighed.astype(np.float32)
    total = _blurred(weighed, _BORDER_CIRCLE) + 1e-3 * _blurred(weighed, 3 * _BORDER_CIRCLE)
    return total[..., :-1] / (total[..., -1:] + 1e-12)


def _blurred(
    values: Float[np.ndarray, "side side channels"], sigma: float
) -> Float[np.ndarray, "side side channels"]:
    """Under a Gaussian that ends after four standard deviations; mirrored at the border."""
    cv2 = load_opencv()
    return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)


def depth_inside(mask: Bool[np.ndarray, "side side"]) -> Float[np.ndarray, "side side"]:
    """Distance of each pixel of the mask from the nearest one that is not of it, pixels."""
    cv2 = load_opencv()
    return cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def load_opencv() -> Any:
    """The package.

    Raises:
        CaptureError: if it is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise CaptureError(
            f"OpenCV cannot be loaded ({error})", "pip install 'handavatar[video]'"
        ) from error
    return cv2


def graph_cut(
    image: UInt8[np.ndarray, "side side 3"], labels: UInt8[np.ndarray, "side side"]
) -> Bool[np.ndarray, "side side"]:
    """GrabCut from labels; those that are not merely likely stay.

    Raises:
        CaptureError: OpenCV is not installed.
    """
    cv2 = load_opencv()
    if not (labels & 1).any() or (labels & 1).all():
        return (labels & 1).astype(bool)
    labels = labels.copy()
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)
    unused = (0, 0, 0, 0)
    picture = np.ascontiguousarray(image)
    cv2.grabCut(picture, labels, unused, *models, _CUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    return (labels & 1).astype(bool)


def cleaned_mask(
    mask: Bool[np.ndarray, "side side"],
    core: Bool[np.ndarray, "side side"],
    scale: float,
) -> Bool[np.ndarray, "side side"]:
    """The piece with the palm, without specks and pinholes.

    Args:
        mask: of the hand.
        core: pixels of the hand beyond doubt.
        scale: pixels per metre.
    """
    radius = max(1.0, 0.001 * scale)
    mask = grown(~grown(~mask, radius), radius)
    pieces, count = ndimage.label(mask)
    if count == 0:
        return mask
    overlap = np.bincount(pieces[core], minlength=count + 1)[1:]
    mask = pieces == 1 + int(overlap.argmax())
    holes, count = ndimage.label(~mask)
    areas = np.bincount(holes.ravel(), minlength=count + 1)
    limit = np.pi * (_HOLE_RADIUS * scale) ** 2
    is_small = areas < limit
    is_small[0] = False
    return mask | is_small[holes]


def grown(mask: Bool[np.ndarray, "side side"], radius: float) -> Bool[np.ndarray, "side side"]:
    """All pixels at most ``radius`` pixels from the mask."""
    if not mask.any():
        return mask
    return depth_inside(~mask) <= radius


def sure_and_spread(hands: Sequence[TrackedHand], count: int) -> list[TrackedHand]:
    """From each of ``count`` stretches of time, the frame whose landmarks agree best."""
    stretches = np.array_split(np.arange(len(hands)), min(count, len(hands)))
    return [
        hands[min(stretch, key=lambda i: float(hands[i].spread.mean()))] for stretch in stretches
    ]


def _regions(hand: TrackedHand) -> _Regions:
    scale = pixels_per_metre(hand) * hand.window.scale
    points = hand.window.from_picture(hand.landmarks)
    side = hand.window.image.shape[0]
    bones = _drawn_bones(points, side, _CORE_RADIUS * scale)
    palm = _drawn_polygon(points[list(_PALM)], side)
    inner_palm = ~grown(~palm, 0.008 * scale)
    forearm = forearm_cone(points, side)
    covered = bones | palm
    distance = depth_inside(~covered)
    return _Regions(
        core=bones | inner_palm,
        near=distance < _HAND_RADIUS * scale,
        forearm=forearm,
        far=(distance > _BACKGROUND_MARGIN * scale)
        & ~grown(forearm, 0.01 * scale)
        & inside_picture(hand.window),
        pixels_per_metre=scale,
    )


def inside_picture(window: Window) -> Bool[np.ndarray, "side side"]:
    """Pixels of a window that the camera saw."""
    side = window.image.shape[0]
    centers = (np.arange(side) + 0.5) / window.scale
    x, y = centers + window.corner[0], centers + window.corner[1]
    width, height = window.picture_size
    return ((y > 0) & (y < height))[:, None] & ((x > 0) & (x < width))[None, :]


def _drawn_bones(
    points: Float[np.ndarray, "21 2"], side: int, radius: float
) -> Bool[np.ndarray, "side side"]:
    canvas = Image.new("1", (side, side))
    draw = ImageDraw.Draw(canvas)
    for chain in _FINGER_CHAINS:
        line = [(float(x), float(y)) for x, y in points[list(chain)]]
        draw.line(line, fill=1, width=max(1, round(2 * radius)))
        for x, y in line:
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=1)
    return np.asarray(canvas)


def _drawn_polygon(
    points: Float[np.ndarray, "corners 2"], side: int
) -> Bool[np.ndarray, "side side"]:
    canvas = Image.new("1", (side, side))
    ImageDraw.Draw(canvas).polygon([(float(x), float(y)) for x, y in points], fill=1)
    return np.asarray(canvas)


def forearm_cone(points: Float[np.ndarray, "21 2"], side: int) -> Bool[np.ndarray, "side side"]:
    """Where the forearm may lie: a wide cone behind the wrist, away from the knuckles."""
    knuckles = points[[5, 9, 13, 17]].mean(0)
    away = points[0] - knuckles
    length = float(np.linalg.norm(away))
    away = away / max(length, 1e-6)
    # The apex lies inside the hand, so that the cone is already wrist-wide at the wrist.
    apex = points[0] - 0.5 * length * away
    y, x = np.mgrid[:side, :side] + 0.5
    dx, dy = x - apex[0], y - apex[1]
    along = dx * away[0] + dy * away[1]
    distance = np.hypot(dx, dy)
    cone = along > np.cos(np.radians(_FOREARM_HALF_ANGLE)) * distance
    return cone & (along > 0.3 * length)
