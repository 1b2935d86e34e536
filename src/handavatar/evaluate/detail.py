"""How much fine detail a picture has, and whether it lies where it belongs.

Detail is what a blur of 1.5 pixels takes away, in brightness, inside the hand. PSNR rewards blur;
these two figures do not.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d, pad

from handavatar.evaluate.metrics import JudgedFrame, depth_inside

DETAIL_SIGMA = 1.5
"""Pixels of the blur."""
DETAIL_DEPTH = 4 / 256
"""Of the picture's width: nearer to a border than this, detail is that of the outline."""
_LUMA = (0.2126, 0.7152, 0.0722)


def detail_ratio(
    rendered: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"],
) -> float | None:
    """Strength of the rendered detail over that of the truth; below 1 the rendering is blurred.

    Args:
        rendered: sRGB in [0, 1].
        truth: the same.
        mask: known pixels that show the hand in both; it is eroded by ``DETAIL_DEPTH`` here.

    Returns:
        Standard deviation over standard deviation; None where the mask holds less than two pixels
        away from its border, or the truth has no detail at all.
    """
    found = _details(rendered, truth, mask)
    if found is None:
        return None
    ours, true = (float(values.std(correction=0)) for values in found)
    return ours / true if true > 1e-9 else None


def detail_correlation(
    rendered: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"],
) -> float | None:
    """Pearson correlation of the two details: 1 if they lie in the same places, 0 if anywhere.

    Args and None as of :func:`detail_ratio`; 0 where the rendering has no detail.
    """
    found = _details(rendered, truth, mask)
    if found is None:
        return None
    ours, true = (values - values.mean() for values in found)
    if float(true.norm()) <= 1e-9 * math.sqrt(len(true)):
        return None
    norm = float(ours.norm() * true.norm())
    return float(ours @ true) / norm if norm > 1e-12 else 0.0


def frame_detail(frame: JudgedFrame) -> tuple[float | None, float | None]:
    """Ratio and correlation of a judged frame, where both of its known masks lie."""
    rendered, truth = frame.on_black()
    both = frame.seen_mask & frame.truth_mask
    return detail_ratio(rendered, truth, both), detail_correlation(rendered, truth, both)


def detail_of(
    image: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"],
    sigma: float = DETAIL_SIGMA,
) -> Float[Tensor, "height width"]:
    """Brightness less its Gaussian blur, inside the mask alone; zero outside.

    The blur is a weighted mean over pixels of the mask: what lies outside does not leak in.

    Args:
        image: sRGB in [0, 1].
        mask: where the image means something.
        sigma: of the blur, pixels.
    """
    luma = image.double() @ torch.tensor(_LUMA, dtype=torch.float64, device=image.device)
    luma = torch.where(mask, luma, torch.zeros_like(luma))
    blurred, weight = _blurred(torch.stack([luma, mask.to(luma)]), sigma)
    return torch.where(mask, luma - blurred / weight.clamp_min(1e-12), torch.zeros_like(luma))


def _details(
    rendered: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"],
) -> tuple[Float[Tensor, "pixels"], Float[Tensor, "pixels"]] | None:
    inside = depth_inside(mask) > DETAIL_DEPTH * mask.shape[1]
    if int(inside.sum()) < 2:
        return None
    return detail_of(rendered, mask)[inside], detail_of(truth, mask)[inside]


def _blurred(
    values: Float[Tensor, "channels height width"], sigma: float
) -> Float[Tensor, "channels height width"]:
    radius = math.ceil(4 * sigma)
    places = torch.arange(-radius, radius + 1, dtype=values.dtype, device=values.device)
    weights = torch.exp(-0.5 * (places / sigma).square())
    weights = weights / weights.sum()
    padded = pad(values[:, None], (radius,) * 4)
    rows = conv2d(padded, weights[None, None, :, None])
    return conv2d(rows, weights[None, None, None, :])[:, 0]
