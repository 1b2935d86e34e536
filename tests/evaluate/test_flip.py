import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from handavatar.evaluate.flip import PIXELS_PER_DEGREE, flip_map
from handavatar.evaluate.metrics import JudgedFrame, masked_flip


def picture(seed: int, blur: float = 2.0, size: tuple[int, int] = (60, 72)) -> Tensor:
    noise = np.random.default_rng(seed).normal(size=(*size, 3))
    smooth = gaussian_filter(noise, (blur, blur, 0))
    return torch.from_numpy((smooth - smooth.min()) / np.ptp(smooth)).float()


@pytest.mark.parametrize("pixels_per_degree", [PIXELS_PER_DEGREE, 25.0])
def test_the_map_agrees_with_nvidias_own_program(pixels_per_degree: float) -> None:
    library = pytest.importorskip("flip_evaluator")
    truth = picture(0)
    worse = truth + 0.1 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    tests = [worse.clamp(0, 1), picture(1), torch.zeros_like(truth), 0.9 * truth]
    for test in tests:
        expected, mean, _ = library.evaluate(
            truth.numpy(),
            test.numpy(),
            "LDR",
            applyMagma=False,
            parameters={"ppd": pixels_per_degree},
        )
        found = flip_map(test, truth, pixels_per_degree)
        # Its arithmetic has 32 bits; the square root of tiny features widens their rounding.
        assert np.abs(found.numpy() - expected[..., 0]).max() < 2e-4
        assert float(found.mean()) == pytest.approx(mean, abs=1e-5)


def test_equal_pictures_do_not_differ_and_the_farthest_colors_do_wholly() -> None:
    assert float(flip_map(picture(0), picture(0)).max()) == 0
    green, blue = torch.eye(3)[1:, None, None].expand(2, 40, 40, 3)
    assert float((flip_map(green, blue) - 1).abs().max()) < 1e-9


def test_the_map_is_symmetric_and_grows_with_the_difference() -> None:
    truth, other = picture(0), picture(1)
    torch.testing.assert_close(flip_map(truth, other), flip_map(other, truth))
    means = [float(flip_map(truth.lerp(other, share), truth).mean()) for share in (0.1, 0.3, 1.0)]
    assert means == sorted(means) and means[0] > 0


def test_a_frame_is_judged_where_its_hand_is() -> None:
    truth = picture(0, size=(80, 80))
    mask = torch.zeros(80, 80, dtype=torch.bool)
    mask[20:40, 20:40] = True
    # Both pictures are put on black outside the mask, so nothing differs far from it.
    rendered = torch.where(mask[..., None], 0.8 * truth, 0.0)
    frame = JudgedFrame(rendered, mask, truth, mask.float())
    whole = flip_map(*frame.on_black())
    assert masked_flip(frame) == pytest.approx(float(whole[frame.region()].mean()))
    assert masked_flip(frame) > float(whole.mean()) > 0
