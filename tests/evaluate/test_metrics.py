import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

from handavatar.evaluate.metrics import (
    PSNR_CEILING,
    REGION_MARGIN,
    JudgedFrame,
    albedo_psnr,
    dilated,
    exposed,
    mask_iou,
    masked_psnr,
    masked_scores,
    masked_ssim,
    mean_color,
    mean_color_masked_psnr,
    mean_mask_iou,
    paper_scores,
    psnr,
    quantised,
    shading_correlation,
    ssim,
    ssim_map,
    worst_mean,
    zone_scores,
)


def blobs(seed: int, height: int = 48, width: int = 40, channels: int = 3) -> Tensor:
    """A smooth random picture in [0, 1]."""
    noise = np.random.default_rng(seed).normal(size=(height, width, channels))
    smooth = gaussian_filter(noise, (2, 2, 0))
    return torch.from_numpy((smooth - smooth.min()) / np.ptp(smooth)).float()


def disc(radius: float, height: int = 48, width: int = 40) -> Tensor:
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return (x - width / 2) ** 2 + (y - height / 2) ** 2 < radius**2


def frame(seed: int, noise: float = 0.1, radius: float = 10) -> JudgedFrame:
    truth, mask = blobs(seed), disc(radius)
    generator = torch.Generator().manual_seed(seed)
    rendered = (truth + noise * torch.randn(truth.shape, generator=generator)).clamp(0, 1)
    return JudgedFrame(rendered * mask[..., None], mask, truth, mask.float())


def test_psnr_equals_skimage_and_is_bounded() -> None:
    a, b = blobs(0), blobs(1)
    expected = peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1)
    assert psnr(a, b) == pytest.approx(expected, abs=1e-5)
    assert psnr(a, a) == PSNR_CEILING
    assert psnr(torch.zeros(4, 3), torch.full((4, 3), 0.1)) == pytest.approx(20)


@pytest.mark.parametrize("shape", [(48, 40), (11, 11), (64, 13)])
def test_ssim_equals_skimage(shape: tuple[int, int]) -> None:
    a, b = blobs(0, *shape), blobs(1, *shape)
    for other in (b, (a + 0.05 * b).clamp(0, 1)):
        expected, full = structural_similarity(
            a.double().numpy(),
            other.double().numpy(),
            channel_axis=-1,
            data_range=1,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            full=True,
        )
        assert float(ssim(other.double(), a.double())) == pytest.approx(expected, abs=1e-9)
        inner = torch.from_numpy(full[5:-5, 5:-5].mean(-1))
        assert torch.allclose(ssim_map(other.double(), a.double()), inner, atol=1e-9)
        # float32: squares cancel down to variances of order 1e-3
        assert float(ssim(other, a)) == pytest.approx(expected, abs=1e-4)


def test_ssim_refuses_pictures_smaller_than_its_window() -> None:
    with pytest.raises(ValueError, match="11 x 11"):
        ssim(torch.zeros(10, 30, 3), torch.zeros(10, 30, 3))


def test_ssim_is_differentiable() -> None:
    a, b = blobs(0, 11, 12, 1).double().requires_grad_(), blobs(1, 11, 12, 1).double()
    assert torch.autograd.gradcheck(lambda image: ssim(image, b), [a])


def test_mask_iou() -> None:
    a = torch.tensor([True, True, False, False])
    assert mask_iou(a, a) == 1
    assert mask_iou(a, ~a) == 0
    assert mask_iou(a, torch.tensor([True, False, True, False])) == pytest.approx(1 / 3)
    assert mask_iou(a & ~a, a & ~a) == 1


def test_dilation_reaches_as_far_as_its_radius() -> None:
    mask = torch.zeros(31, 31, dtype=torch.bool)
    mask[15, 15] = True
    y, x = torch.meshgrid(torch.arange(31), torch.arange(31), indexing="ij")
    expected = (x - 15) ** 2 + (y - 15) ** 2 <= 64
    assert torch.equal(dilated(mask, 8.0), expected)
    assert not bool(dilated(mask & ~mask, 8.0).any())


def test_quantised_values_survive_a_file() -> None:
    image = torch.tensor([[-0.1, 0.0, 0.4999, 0.5001, 1.0, 1.3]])
    assert (quantised(image) * 255).tolist() == [[0, 0, 127, 128, 255, 255]]
    assert torch.equal(quantised(quantised(image)), quantised(image))


def test_paper_protocol_is_skimage_on_8_bit_pictures_with_black_background() -> None:
    frames = [frame(0), frame(1, noise=0.3)]
    ratios, similarities = [], []
    for judged in frames:
        truth = (judged.truth * judged.truth_mask[..., None] * 255).round().byte().numpy()
        rendered = (judged.rendered * 255).round().byte().numpy()
        ratios.append(peak_signal_noise_ratio(truth, rendered))
        similarities.append(
            structural_similarity(
                truth,
                rendered,
                channel_axis=-1,
                gaussian_weights=True,
                sigma=1.5,
                use_sample_covariance=False,
            )
        )
    scores = paper_scores(frames)
    assert scores.psnr == pytest.approx(np.mean(ratios), abs=1e-4)
    assert scores.ssim == pytest.approx(np.mean(similarities), abs=1e-4)
    assert scores.hand_share == pytest.approx(float(disc(10).float().mean()))


def test_masked_protocol_ignores_what_is_far_from_both_hands() -> None:
    judged = frame(2)
    alone = masked_psnr(judged)
    y, x = torch.meshgrid(torch.arange(48), torch.arange(40), indexing="ij")
    far = (x - 20) ** 2 + (y - 24) ** 2 > (10 + REGION_MARGIN + 1) ** 2
    assert bool(far.any())
    spoilt = JudgedFrame(
        judged.rendered + far[..., None].float(),
        judged.rendered_mask,
        judged.truth,
        judged.truth_coverage,
    )
    assert masked_psnr(spoilt) == alone
    assert paper_scores([spoilt]).psnr < paper_scores([judged]).psnr - 3


def test_the_margin_is_the_same_share_of_larger_pictures() -> None:
    truth, mask = blobs(4, 512, 512), disc(60, 512, 512)
    judged = JudgedFrame(truth * mask[..., None], mask, truth, mask.float())
    assert torch.equal(judged.region(), dilated(mask, 2 * REGION_MARGIN))


def test_black_background_inflates_the_papers_psnr_by_the_regions_share() -> None:
    judged = frame(3)
    share = float(judged.region().float().mean())
    inflation = paper_scores([judged]).psnr - masked_psnr(judged)
    assert inflation == pytest.approx(-10 * math.log10(share), abs=1e-4)


def test_a_hand_in_the_wrong_place_counts_in_both_places() -> None:
    truth, mask = blobs(4, 64, 64), disc(6, 64, 64)
    moved = mask.roll(24, 1)
    judged = JudgedFrame(truth * moved[..., None], moved, truth, mask.float())
    assert torch.equal(judged.region(), dilated(mask | moved, REGION_MARGIN))
    assert masked_psnr(judged) < 15
    assert mean_mask_iou([judged]) == 0


def test_masked_ssim_is_the_mean_of_the_map_over_the_region() -> None:
    judged = frame(5)
    region = judged.region()
    similarity = ssim_map(*judged.on_black())
    chosen = [
        float(similarity[y - 5, x - 5])
        for y, x in region.nonzero().tolist()
        if 5 <= y < 43 and 5 <= x < 35
    ]
    assert masked_ssim(judged) == pytest.approx(np.mean(chosen), abs=1e-5)


def test_unknown_pixels_count_in_no_figure() -> None:
    judged, known = frame(6), torch.ones(48, 40, dtype=torch.bool)
    known[:, 24:] = False
    generator = torch.Generator().manual_seed(0)
    scribble = torch.where(known[..., None], judged.truth, torch.rand(48, 40, 3))
    covered = torch.where(known, judged.truth_coverage, torch.rand(48, 40, generator=generator))
    scribble[0, 30] = math.nan
    clean = replace(judged, known=known)
    spoilt = replace(clean, truth=scribble, truth_coverage=covered)
    assert paper_scores([clean]) == paper_scores([spoilt])
    assert masked_scores([clean]) == masked_scores([spoilt])
    assert zone_scores([clean]) == zone_scores([spoilt])
    assert mean_mask_iou([clean]) == mean_mask_iou([spoilt])
    # Nor does it matter what the avatar does there.
    elsewhere = replace(clean, rendered=torch.where(known[..., None], clean.rendered, 1.0))
    assert masked_scores([elsewhere]) == masked_scores([clean])
    assert paper_scores([elsewhere]) == paper_scores([clean])
    # But what is known counts.
    assert masked_psnr(clean) != masked_psnr(judged)
    assert paper_scores([clean]).hand_share == pytest.approx(
        float(judged.truth_mask[:, :24].float().mean())
    )


def test_the_core_is_deep_inside_both_masks_and_the_border_the_rest_of_the_region() -> None:
    mask = disc(60, 256, 256)
    truth = torch.full((256, 256, 3), 0.5)
    shifted = mask.roll(10, 1)
    judged = JudgedFrame(truth * shifted[..., None], shifted, truth, mask.float())
    core = judged.core()
    brute = ~dilated(~(mask & shifted), 6.0)
    assert torch.equal(core, brute) and bool(core.any())
    scores = zone_scores([judged])
    assert scores.core_psnr == PSNR_CEILING
    assert scores.border_error_share == 1
    assert scores.core_share == pytest.approx(int(core.sum()) / int(judged.region().sum()))
    # An error of the core alone.
    darker = judged.rendered - 0.1 * core[..., None]
    scores = zone_scores([replace(judged, rendered=darker, rendered_mask=shifted)])
    assert scores.core_psnr is not None and scores.core_psnr == pytest.approx(20, abs=0.2)
    both = zone_scores([judged, replace(judged, rendered=darker)])
    assert both.core_psnr == pytest.approx((scores.core_psnr + PSNR_CEILING) / 2)
    assert 0 < both.border_error_share < 1


def test_a_hand_without_a_core_has_no_figure_for_it() -> None:
    thin = torch.zeros(256, 256, dtype=torch.bool)
    thin[100:104] = True
    big = torch.rand(256, 256, 3, generator=torch.Generator().manual_seed(0))
    scores = zone_scores([JudgedFrame(big, thin, big, thin.float())])
    assert (scores.core_psnr, scores.core_share, scores.border_error_share) == (None, 0, 1)


def test_exposure_multiplies_what_was_rendered_and_saturates() -> None:
    color = torch.tensor([[0.2, 0.4, 0.9]])
    gain = torch.tensor([0.5, 1.0, 1.5])
    assert exposed(color, gain).tolist() == [pytest.approx([0.1, 0.4, 1.0])]


def test_worst_share_takes_at_least_one_and_rounds_up() -> None:
    assert worst_mean([3.0, 1.0, 2.0], 0.05) == 1
    assert worst_mean([float(value) for value in range(20)], 0.05) == 0
    assert worst_mean([float(value) for value in range(21)], 0.05) == 0.5
    frames = [frame(0, noise=0.01), frame(1, noise=0.3)]
    assert masked_scores(frames).worst5_psnr == min(masked_psnr(judged) for judged in frames)


def test_no_frames_and_frames_without_a_hand_are_refused() -> None:
    with pytest.raises(ValueError, match="no frame"):
        paper_scores([])
    empty = torch.zeros(48, 40, dtype=torch.bool)
    with pytest.raises(ValueError, match="shows a hand"):
        masked_psnr(JudgedFrame(blobs(0), empty, blobs(0), empty.float()))


def test_the_mean_color_is_the_best_single_color() -> None:
    images, masks = [blobs(0), blobs(1)], [disc(10), disc(14)]
    color = mean_color(zip(images, masks, strict=True))
    pixels = torch.cat([images[0][masks[0]], images[1][masks[1]]])
    assert torch.allclose(color, pixels.mean(0))
    judged = JudgedFrame(torch.zeros(48, 40, 3), masks[1], images[0], masks[0].float())
    best = mean_color_masked_psnr([color], [judged])
    assert best > mean_color_masked_psnr([color + 0.1], [judged])
    plain = torch.ones(48, 40, 3) * torch.tensor([0.2, 0.4, 0.6])
    judged = JudgedFrame(plain, masks[0], plain, masks[0].float())
    assert mean_color_masked_psnr([plain[0, 0]], [judged]) == PSNR_CEILING


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(0.3, 3)] * 3))
def test_albedo_is_judged_up_to_one_scale_per_channel(scale: tuple[float, float, float]) -> None:
    truths, masks = [blobs(0), blobs(1)], [disc(10), disc(14)]
    noisy = [truth + 0.05 * blobs(7) for truth in truths]
    scaled = [albedo * torch.tensor(scale) for albedo in noisy]
    expected = albedo_psnr(noisy, truths, masks)
    assert albedo_psnr(scaled, truths, masks) == pytest.approx(expected, abs=1e-3)
    assert albedo_psnr([truth * 0.5 for truth in truths], truths, masks) > 80


def test_albedo_scale_is_one_for_the_subject_not_one_per_frame() -> None:
    truths, masks = [blobs(0), blobs(1)], [disc(10), disc(14)]
    uneven = [truths[0] * 0.5, truths[1] * 1.5]
    assert albedo_psnr(uneven, truths, masks) < 20


def test_shading_correlation_is_pearsons() -> None:
    shadings, masks = [blobs(0)[..., 0], blobs(1)[..., 0]], [disc(10), disc(14)]
    guesses = [shadings[0] + 0.2 * blobs(5)[..., 0], shadings[1] + 0.2 * blobs(6)[..., 0]]
    pooled = [
        torch.cat([value[mask] for value, mask in zip(values, masks, strict=True)]).numpy()
        for values in (guesses, shadings)
    ]
    expected = np.corrcoef(*pooled)[0, 1]
    assert shading_correlation(guesses, shadings, masks) == pytest.approx(expected, abs=1e-6)
    stretched = [0.3 + 2 * guess for guess in guesses]
    assert shading_correlation(stretched, shadings, masks) == pytest.approx(expected, abs=1e-6)
    assert shading_correlation([-s for s in shadings], shadings, masks) == pytest.approx(-1)
    flat = [torch.ones(48, 40)] * 2
    assert shading_correlation(flat, shadings, masks) == 0
