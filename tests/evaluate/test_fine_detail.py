"""Detail: blurred pictures have less of it, and none of the figures sees beyond the mask."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from handavatar.evaluate.detail import (
    DETAIL_DEPTH,
    detail_correlation,
    detail_of,
    detail_ratio,
    frame_detail,
)
from handavatar.evaluate.metrics import JudgedFrame, depth_inside


def noise(seed: int, sigma: float = 1.0, size: int = 128) -> Tensor:
    values = np.random.default_rng(seed).normal(size=(size, size, 3))
    return torch.from_numpy(0.5 + 0.1 * gaussian_filter(values, (sigma, sigma, 0))).float()


def disc(radius: float, size: int = 128) -> Tensor:
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (x - size / 2) ** 2 + (y - size / 2) ** 2 < radius**2


def test_detail_is_brightness_less_its_blur() -> None:
    image, mask = noise(0), torch.ones(128, 128, dtype=torch.bool)
    luma = image.double().numpy() @ np.array([0.2126, 0.7152, 0.0722])
    expected = luma - gaussian_filter(luma, 1.5)
    found = detail_of(image, mask).numpy()
    assert np.abs(found - expected)[8:-8, 8:-8].max() < 1e-5


def test_the_mask_does_not_leak_and_a_flat_hand_has_no_detail() -> None:
    mask = disc(40)
    flat = torch.where(mask[..., None], 0.7, 0.0).expand(-1, -1, 3)
    assert float(detail_of(flat, mask).abs().max()) < 1e-12
    image = noise(1)
    scribbled = torch.where(mask[..., None], image, torch.rand(128, 128, 3))
    assert torch.equal(detail_of(image, mask), detail_of(scribbled, mask))


def test_equal_pictures_blurred_ones_and_strangers() -> None:
    truth, mask = noise(2), disc(50)
    assert detail_ratio(truth, truth, mask) == pytest.approx(1)
    assert detail_correlation(truth, truth, mask) == pytest.approx(1)
    blurred = torch.from_numpy(gaussian_filter(truth.numpy(), (1.5, 1.5, 0)))
    ratio = detail_ratio(blurred, truth, mask)
    correlation = detail_correlation(blurred, truth, mask)
    assert ratio is not None and ratio < 0.5
    assert correlation is not None and correlation > 0.7
    stranger = noise(3)
    ratio = detail_ratio(stranger, truth, mask)
    assert ratio is not None and 0.9 < ratio < 1.1
    assert abs(detail_correlation(stranger, truth, mask) or 0) < 0.1
    # Brightness and contrast: the one has no part, the other is the ratio.
    assert detail_ratio(0.2 + 0.5 * truth, truth, mask) == pytest.approx(0.5, abs=1e-5)


def test_figures_are_those_of_the_eroded_mask() -> None:
    truth, ours, mask = noise(4), noise(5), disc(50)
    inside = depth_inside(mask) > DETAIL_DEPTH * 128
    a, b = (detail_of(image, mask)[inside].numpy() for image in (ours, truth))
    assert detail_ratio(ours, truth, mask) == pytest.approx(a.std() / b.std())
    assert detail_correlation(ours, truth, mask) == pytest.approx(np.corrcoef(a, b)[0, 1])


def test_what_cannot_be_told_is_none() -> None:
    truth = noise(6)
    empty = torch.zeros(128, 128, dtype=torch.bool)
    assert detail_ratio(truth, truth, empty) is None
    assert detail_correlation(truth, truth, empty) is None
    flat = torch.full_like(truth, 0.5)
    assert detail_ratio(truth, flat, disc(50)) is None
    assert detail_correlation(truth, flat, disc(50)) is None
    assert detail_ratio(flat, truth, disc(50)) == pytest.approx(0, abs=1e-9)
    assert detail_correlation(flat, truth, disc(50)) == 0


def test_a_frame_is_judged_where_both_hands_are_known() -> None:
    truth, mask, known = noise(7), disc(50), torch.ones(128, 128, dtype=torch.bool)
    known[:, :60] = False
    ours = noise(8)
    frame = JudgedFrame(ours, mask, truth, mask.float(), known)
    scribble = torch.where(known[..., None], truth, torch.rand(128, 128, 3))
    spoilt = JudgedFrame(ours, mask, scribble, mask.float() * known, known)
    assert frame_detail(frame) == frame_detail(spoilt)
    assert frame_detail(frame) != frame_detail(JudgedFrame(ours, mask, truth, mask.float()))
