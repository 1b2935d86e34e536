"""What a rendered hand is measured by.

Images are display values (sRGB) in [0, 1] with channels last. All protocols put both pictures on
black and round them to 8 bit first, as a file on disk would hold them.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import conv2d

from handavatar.errors import HandAvatarError
from handavatar.evaluate.flip import flip_map

PSNR_CEILING = 100.0
"""Decibels given to equal pictures, whose ratio is infinite: means stay finite, JSON valid."""

REGION_MARGIN = 8.0
"""Pixels around both masks that the masked protocol judges too; in pictures wider than 256, as much
of the picture as in these."""

CORE_DEPTH = 6 / 256
"""Of the picture's width: deeper inside both masks lies the core, where no outline is judged."""

_WINDOW_SIGMA = 1.5
_WINDOW_RADIUS = 5
_LUMINANCE_CONSTANT = 0.01**2
_CONTRAST_CONSTANT = 0.03**2


def psnr(
    rendered: Float[Tensor, "*pixels channels"], truth: Float[Tensor, "*pixels channels"]
) -> float:
    """Peak signal-to-noise ratio in decibels for a peak of 1; for a region, index both alike.

    Source: paper Sec. 4.1, PSNR.
    """
    error = float((rendered.double() - truth.double()).square().mean())
    return min(-10 * math.log10(error), PSNR_CEILING) if error > 0 else PSNR_CEILING


def ssim_map(
    rendered: Float[Tensor, "height width channels"], truth: Float[Tensor, "height width channels"]
) -> Float[Tensor, "inner_height inner_width"]:
    """Structural similarity around each pixel whose 11 x 11 window fits in the image.

    Gaussian window of 1.5 pixels, population covariance, mean over the channels. The map is 10
    pixels smaller than the image, in both directions. Differentiable.

    Raises:
        ValueError: if the image is smaller than the window.

    Source: paper Sec. 4.1, SSIM (Wang et al. 2004); window and borders as in the authors' code.
    """
    smallest = 2 * _WINDOW_RADIUS + 1
    if min(rendered.shape[:2]) < smallest:
        raise ValueError(
            f"SSIM needs an image of at least {smallest} x {smallest} pixels, "
            f"found {rendered.shape[1]} x {rendered.shape[0]}"
        )
    a, b = rendered.movedim(-1, 0), truth.movedim(-1, 0)
    mean_a, mean_b, square_a, square_b, product = (
        _window_mean(value) for value in (a, b, a * a, b * b, a * b)
    )
    variances = square_a - mean_a.square() + square_b - mean_b.square()
    covariance = product - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + _LUMINANCE_CONSTANT) / (
        mean_a.square() + mean_b.square() + _LUMINANCE_CONSTANT
    )
    structure = (2 * covariance + _CONTRAST_CONSTANT) / (variances + _CONTRAST_CONSTANT)
    return (luminance * structure).mean(0)


def ssim(
    rendered: Float[Tensor, "height width channels"], truth: Float[Tensor, "height width channels"]
) -> Float[Tensor, ""]:
    """Mean of :func:`ssim_map`."""
    return ssim_map(rendered, truth).mean()


def mask_iou(first: Bool[Tensor, "*pixels"], second: Bool[Tensor, "*pixels"]) -> float:
    """Intersection over union of two masks, or of what two fields hold; 1 if both are empty.

    Source: paper Sec. 4.1, IoU.
    """
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 1.0


def dilated(mask: Bool[Tensor, "height width"], radius: float) -> Bool[Tensor, "height width"]:
    """All pixels within the radius (pixels, Euclidean) of the mask."""
    if not bool(mask.any()):
        return mask
    distance = distance_transform_edt(~mask.cpu().numpy())
    return torch.from_numpy(distance <= radius).to(mask.device)


def quantised(image: Float[Tensor, "*pixels channels"]) -> Float[Tensor, "*pixels channels"]:
    """The nearest 8-bit values, still in [0, 1].

    Departs: the authors' code truncates, which darkens by half a level; files are rounded.
    """
    return (image.clamp(0, 1) * 255).round() / 255


def exposed(
    color: Float[Tensor, "*pixels 3"], gain: Float[Tensor, "3"]
) -> Float[Tensor, "*pixels 3"]:
    """A rendered picture as the camera exposed this frame: in sRGB, saturated at 1.

    Args:
        color: rendered, sRGB.
        gain: by how much the frame is brighter than the capture's average, in the same encoding.
    """
    return (color * gain.to(color)).clamp(0, 1)


def depth_inside(mask: Bool[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Distance of each pixel of the mask from the nearest one outside of it, pixels; 0 outside.

    The picture's edge is no border: what lies beyond it is not known.
    """
    if bool(mask.all()):
        return torch.full(mask.shape, math.inf, device=mask.device)
    depth = distance_transform_edt(mask.cpu().numpy())
    return torch.from_numpy(depth).float().to(mask.device)


@dataclass(frozen=True, eq=False)
class JudgedFrame:
    """A picture of the avatar beside the photograph of the same moment.

    Attributes:
        rendered: the avatar on black.
        rendered_mask: where the avatar covers at least half of the pixel.
        truth: the photograph.
        truth_coverage: how much of each pixel of the photograph the hand covers, in [0, 1]. Its
            outline goes through pixels; black beside it is mixed in by as much.
        known: false where nothing is known of the photograph; such pixels are black in both
            pictures and count in no figure. All are known if it is left out.
    """

    rendered: Float[Tensor, "height width 3"]
    rendered_mask: Bool[Tensor, "height width"]
    truth: Float[Tensor, "height width 3"]
    truth_coverage: Float[Tensor, "height width"]
    known: Bool[Tensor, "height width"] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Everything is known where nothing else is said."""
        if self.known is None:
            object.__setattr__(self, "known", torch.ones_like(self.rendered_mask))

    @property
    def truth_mask(self) -> Bool[Tensor, "height width"]:
        """Where the photograph is known to show more hand than background."""
        return (self.truth_coverage > 0.5) & self.known

    @property
    def seen_mask(self) -> Bool[Tensor, "height width"]:
        """The rendered mask where the photograph is known."""
        return self.rendered_mask & self.known

    def on_black(self) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]:
        """Both pictures as they are compared: the hand on black, 8 bit; what is unknown is black.

        What the file holds at an unknown pixel, be it no number at all, is not looked at.
        """
        truth = self.truth * self.truth_coverage[..., None]
        rendered, truth = (
            torch.where(self.known[..., None], image, torch.zeros_like(image))
            for image in (self.rendered, truth)
        )
        return quantised(rendered), quantised(truth)

    def region(self) -> Bool[Tensor, "height width"]:
        """The known pixels of the union of both masks and ``REGION_MARGIN`` around it.

        Raises:
            ValueError: if neither picture shows a hand.
        """
        union = self.seen_mask | self.truth_mask
        if not bool(union.any()):
            raise HandAvatarError("neither the photograph nor the rendering shows a hand")
        margin = REGION_MARGIN * max(1.0, union.shape[1] / 256)
        return dilated(union, margin) & self.known

    def core(self) -> Bool[Tensor, "height width"]:
        """Pixels deeper than ``CORE_DEPTH`` inside both masks: no outline is judged there.

        What is unknown is inside of neither. May be empty.
        """
        both = self.seen_mask & self.truth_mask
        return depth_inside(both) > CORE_DEPTH * both.shape[1]

    def painted(
        self, color: Float[Tensor, "3"], coverage: Float[Tensor, "height width"]
    ) -> "JudgedFrame":
        """The same photograph beside one flat colour.

        Args:
            color: in [0, 1].
            coverage: how much of each pixel is painted.
        """
        return replace(self, rendered=color * coverage[..., None], rendered_mask=coverage > 0.5)


@dataclass(frozen=True)
class PaperScores:
    """Means over the frames of all known pixels, on black; the background inflates them.

    Attributes:
        psnr: decibels.
        ssim: at most 1.
        hand_share: share of the known pixels that show the hand.
    """

    psnr: float
    ssim: float
    hand_share: float


@dataclass(frozen=True)
class MaskedScores:
    """Means over the frames, inside ``JudgedFrame.region``.

    Attributes:
        psnr: decibels.
        ssim: at most 1.
        flip: :func:`flip_map`, in [0, 1]; 0 is equal.
        worst5_psnr: mean over the worst 5 % of the frames, at least one.
    """

    psnr: float
    ssim: float
    flip: float
    worst5_psnr: float


def paper_scores(frames: Sequence[JudgedFrame]) -> PaperScores:
    """Protocol ``paper``: the whole picture.

    Source: paper Sec. 4.1; background, 8 bit and averaging as in the authors' code.
    """
    return PaperScores(
        psnr=_mean([region_psnr(frame, frame.known) for frame in frames]),
        ssim=_mean([_mean_similarity(frame, frame.known) for frame in frames]),
        hand_share=_mean([float(frame.truth_mask[frame.known].float().mean()) for frame in frames]),
    )


def masked_scores(frames: Sequence[JudgedFrame]) -> MaskedScores:
    """Protocol ``masked``: the hand and ``REGION_MARGIN`` around it."""
    ratios = [masked_psnr(frame) for frame in frames]
    return MaskedScores(
        psnr=_mean(ratios),
        ssim=_mean([masked_ssim(frame) for frame in frames]),
        flip=_mean([masked_flip(frame) for frame in frames]),
        worst5_psnr=worst_mean(ratios, 0.05),
    )


def masked_psnr(frame: JudgedFrame) -> float:
    """Decibels over the pixels of the frame's region."""
    return region_psnr(frame, frame.region())


def region_psnr(frame: JudgedFrame, region: Bool[Tensor, "height width"]) -> float:
    """Decibels over some pixels of a frame, as the pictures are compared; at least one."""
    rendered, truth = frame.on_black()
    return psnr(rendered[region], truth[region])


def core_psnr(frame: JudgedFrame) -> float | None:
    """Decibels over the frame's core; None where it has none."""
    core = frame.core()
    return region_psnr(frame, core) if bool(core.any()) else None


def masked_ssim(frame: JudgedFrame) -> float:
    """Mean of the similarity map over the region, as far as its windows fit in the image."""
    return _mean_similarity(frame, frame.region())


def _mean_similarity(frame: JudgedFrame, region: Bool[Tensor, "height width"]) -> float:
    inner = slice(_WINDOW_RADIUS, -_WINDOW_RADIUS)
    similarity = ssim_map(*frame.on_black())
    region = region[inner, inner]
    return float(similarity[region].mean()) if bool(region.any()) else float(similarity.mean())


def masked_flip(frame: JudgedFrame) -> float:
    """Mean of the FLIP map over the frame's region."""
    return float(flip_map(*frame.on_black())[frame.region()].mean())


def mean_mask_iou(frames: Sequence[JudgedFrame]) -> float:
    """Mean over the frames of the masks' intersection over union."""
    return _mean([mask_iou(frame.seen_mask, frame.truth_mask) for frame in frames])


@dataclass(frozen=True)
class ZoneScores:
    """The core of the hand apart from its border.

    Attributes:
        core_psnr: decibels, mean over the frames that have a core; None if none has one.
        border_psnr: decibels over the rest of the region, mean over the frames that have one.
        core_share: share of the region's pixels that lie in the core, all frames together.
        border_error_share: share of the squared error that lies in the border, all frames
            together; 0 if there is no error.
    """

    core_psnr: float | None
    border_psnr: float | None
    core_share: float
    border_error_share: float


def zone_scores(frames: Sequence[JudgedFrame]) -> ZoneScores:
    """The masked protocol's region, cut into core and border."""
    borders, pixels, errors = [], [0, 0], [0.0, 0.0]
    for frame in frames:
        rendered, truth = frame.on_black()
        error = (rendered.double() - truth.double()).square().sum(-1)
        core = frame.core()
        border = frame.region() & ~core
        if bool(border.any()):
            borders.append(region_psnr(frame, border))
        for place, zone in enumerate((core, border)):
            pixels[place] += int(zone.sum())
            errors[place] += float(error[zone].sum())
    cores = [value for value in map(core_psnr, frames) if value is not None]
    return ZoneScores(
        core_psnr=_mean(cores) if cores else None,
        border_psnr=_mean(borders) if borders else None,
        core_share=pixels[0] / sum(pixels),
        border_error_share=errors[1] / sum(errors) if sum(errors) > 0 else 0.0,
    )


def worst_mean(values: Sequence[float], share: float) -> float:
    """Mean of the lowest share of the values, at least one."""
    count = max(1, math.ceil(share * len(values) - 1e-9))
    return _mean(sorted(values)[:count])


def mean_color(
    pictures: Iterable[tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]],
) -> Float[Tensor, "3"]:
    """Mean colour of all hand pixels, in [0, 1].

    Args:
        pictures: each with its mask; none is held longer than it takes.
    """
    return torch.cat([image[mask] for image, mask in pictures]).mean(0)


def mean_color_masked_psnr(
    colors: Sequence[Float[Tensor, "3"]], frames: Sequence[JudgedFrame]
) -> float:
    """The baseline that knows the true mask and nothing else: one colour painted into it.

    Args:
        colors: :func:`mean_color` of the training frames, as each of the frames is exposed.
        frames: to be judged; what was rendered plays no part.

    Returns:
        The masked protocol's PSNR, decibels.
    """
    return _mean(
        [
            masked_psnr(frame.painted(color, frame.truth_coverage))
            for color, frame in zip(colors, frames, strict=True)
        ]
    )


def albedo_psnr(
    albedos: Sequence[Float[Tensor, "height width 3"]],
    truths: Sequence[Float[Tensor, "height width 3"]],
    masks: Sequence[Bool[Tensor, "height width"]],
) -> float:
    """Decibels over all hand pixels of a subject, after one scale per colour channel.

    A brighter albedo under a dimmer light is the same picture; the scale with the least squared
    error, one for the whole subject, takes that freedom away. Not clamped to [0, 1].

    Args:
        albedos: predicted, of one subject.
        truths: true, in the same encoding.
        masks: pixels where both are defined.
    """
    predicted, true = _pooled(albedos, masks), _pooled(truths, masks)
    squares = predicted.square().sum(0)
    scale = (predicted * true).sum(0) / squares.clamp_min(torch.finfo(squares.dtype).tiny)
    return psnr(predicted * scale, true)


def shading_correlation(
    illuminations: Sequence[Float[Tensor, "height width"]],
    shadings: Sequence[Float[Tensor, "height width"]],
    masks: Sequence[Bool[Tensor, "height width"]],
) -> float:
    """Pearson correlation of illumination and true shading over all hand pixels of a subject.

    Zero where one of them is constant.

    Args:
        illuminations: predicted.
        shadings: true, in the same encoding.
        masks: pixels where both are defined.
    """
    predicted, true = (
        _pooled([value[..., None] for value in values], masks)[:, 0]
        for values in (illuminations, shadings)
    )
    predicted, true = predicted - predicted.mean(), true - true.mean()
    norm = float(predicted.norm() * true.norm())
    return float(predicted @ true) / norm if norm > 1e-12 else 0.0


def _pooled(
    values: Sequence[Float[Tensor, "height width channels"]],
    masks: Sequence[Bool[Tensor, "height width"]],
) -> Float[Tensor, "points channels"]:
    return torch.cat([value[mask] for value, mask in zip(values, masks, strict=True)]).double()


def _mean(values: Sequence[float]) -> float:
    if not values:
        raise HandAvatarError("there is no frame to judge", "", "choose another split or capture")
    return math.fsum(values) / len(values)


def _window_mean(
    values: Float[Tensor, "channels height width"],
) -> Float[Tensor, "channels inner_height inner_width"]:
    """Gaussian-weighted mean of every whole window, one direction after the other."""
    steps = torch.arange(-_WINDOW_RADIUS, _WINDOW_RADIUS + 1, device=values.device)
    weights = torch.exp(-0.5 * (steps.to(values.dtype) / _WINDOW_SIGMA).square())
    weights = weights / weights.sum()
    rows = conv2d(values[:, None], weights[None, None, None, :])
    return conv2d(rows, weights[None, None, :, None])[:, 0]
