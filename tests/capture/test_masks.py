"""The colour model against slow references, and a made hand that is cut out again."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_hands import made_hand
from scipy import ndimage
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from handavatar.capture.masks import (
    GaussianMixture,
    find_mask,
    fit_mixture,
    learn_colors,
    mask_coverage,
    oklab_from_srgb,
    pixels_per_metre,
    settled_border,
)
from handavatar.render.silhouette import signed_distance


def test_oklab_of_known_colours() -> None:
    colors = np.array([[255, 255, 255], [0, 0, 0], [255, 0, 0]], dtype=np.uint8)
    # From the definition of OKLab (B. Ottosson); white has no hue.
    expected = np.array([[1, 0, 0], [0, 0, 0], [0.62796, 0.22486, 0.12585]])
    assert np.allclose(oklab_from_srgb(colors), expected, atol=2e-4)


def test_the_density_equals_the_slow_reference() -> None:
    generator = np.random.default_rng(0)
    means = generator.normal(size=(2, 3))
    covariances = [np.diag([0.1, 0.2, 0.3]), np.eye(3) * 0.5 + 0.1]
    mixture = GaussianMixture(np.array([0.3, 0.7]), means, np.linalg.inv(np.array(covariances)))
    points = generator.normal(size=(20, 3))
    parts = [
        np.log(weight) + multivariate_normal(mean, covariance).logpdf(points)
        for weight, mean, covariance in zip((0.3, 0.7), means, covariances, strict=True)
    ]
    assert np.allclose(mixture.log_density(points), logsumexp(parts, axis=0))


def test_a_mixture_finds_two_clusters() -> None:
    generator = np.random.default_rng(0)
    centers = np.array([[0.3, 0.0, 0.1], [0.7, 0.1, 0.0]])
    share = np.repeat(centers, [300, 700], axis=0)
    mixture = fit_mixture(share + 0.02 * generator.normal(size=(1000, 3)), 2, generator)
    order = np.argsort(mixture.means[:, 0])
    assert np.allclose(mixture.means[order], centers, atol=0.005)
    assert np.allclose(mixture.weights[order], [0.3, 0.7], atol=0.01)


def _finger_with_coarse_color() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture whose colour lies three pixels beside its brightness; true and coloured mask."""
    y, x = np.mgrid[:96, :96] + 0.5
    true = np.hypot(x - 48, y - np.clip(y, 40, 96)) < 14
    true |= np.hypot(x - 48, y - 40) < 14
    to_yuv = np.array([[0.299, 0.587, 0.114], [-0.169, -0.331, 0.5], [0.5, -0.419, -0.081]])
    skin, wall = to_yuv @ [190.0, 140, 115], to_yuv @ [105.0, 112, 120]
    share = true.astype(float)
    beside = ndimage.gaussian_filter(np.roll(share, 3, axis=1), 2.5)
    shares = np.stack([share, beside, beside], axis=-1)
    yuv = shares * skin + (1 - shares) * wall
    image = (yuv @ np.linalg.inv(to_yuv).T).round().clip(0, 255).astype(np.uint8)
    return image, true, beside > 0.5


def test_the_border_settles_on_the_edge_of_brightness() -> None:
    image, true, coloured = _finger_with_coarse_color()
    settled = settled_border(image, coloured, np.zeros_like(true)) > 0.5

    def wrong(mask: np.ndarray) -> int:
        return int((mask ^ true).sum())

    # Three pixels too far on one side and too near on the other, along some 70 rows each.
    assert wrong(coloured) > 350
    assert wrong(settled) < 30
    # What is certainly background stays so, whatever it looks like.
    wall = np.zeros_like(true)
    wall[:50] = True
    assert not (settled_border(image, coloured & ~wall, wall) > 0.5)[:50].any()


def test_where_skin_and_wall_look_alike_the_border_stays() -> None:
    _, true, _ = _finger_with_coarse_color()
    grey = np.full((*true.shape, 3), 128, dtype=np.uint8)
    settled = settled_border(grey, true, np.zeros_like(true)) > 0.5
    # The smoothing may cut the corners where the finger leaves the picture.
    assert int((settled ^ true).sum()) < 12


def test_a_made_hand_is_cut_out_again() -> None:
    pytest.importorskip("cv2")
    made = [made_hand(number) for number in range(4)]
    colors = learn_colors([hand for hand, _ in made])
    hand, truth = made[2]
    found = find_mask(hand, colors)
    overlap = (found.pixels & truth).sum() / (found.pixels | truth).sum()
    assert overlap > 0.97
    assert found.quality > 0.9


def test_scale_is_focal_length_over_depth() -> None:
    hand, _ = made_hand(0)
    # 400 pixels at about half a metre; the hand's own depth range is a few per cent of that.
    assert pixels_per_metre(hand) == pytest.approx(800, rel=0.05)


def test_scale_does_not_depend_on_where_fingers_point() -> None:
    """Of a hand that is turned away by 70 degrees, before a camera without perspective."""
    hand, _ = made_hand(0)
    turn = np.radians(70)
    turned = hand.world_landmarks @ np.array(
        [[1, 0, 0], [0, np.cos(turn), np.sin(turn)], [0, -np.sin(turn), np.cos(turn)]]
    )
    seen = replace(hand, world_landmarks=turned, landmarks=800 * turned[:, :2] + 200)
    assert pixels_per_metre(seen) == pytest.approx(800)


@pytest.mark.parametrize(("wall", "least"), [(None, 0.985), ((120, 122, 127), 0.970)])
def test_the_lit_sides_of_fingers_belong_to_them(
    wall: tuple[int, int, int] | None, least: float
) -> None:
    """Lit from the side, blurred by the camera, before stripes and before a grey wall as bright.

    Brightness alone, towards the wall, had .973 and .950 here.
    """
    pytest.importorskip("cv2")
    hands, truths = [], []
    for number in range(4):
        hand, truth = made_hand(number)
        rise = np.gradient(ndimage.gaussian_filter(truth.astype(float), 4), axis=1)
        picture = hand.window.image.astype(float)
        skin = picture * (1 - 0.5 * np.clip(12 * rise, -0.45, 0.45))[..., None]
        if wall is not None:
            noise = np.random.default_rng(number).normal(0, 3, picture.shape)
            picture = np.array(wall) + noise
        share = ndimage.gaussian_filter(truth.astype(float), 0.8)[..., None]
        image = (share * skin + (1 - share) * picture).clip(0, 255).astype(np.uint8)
        hands.append(replace(hand, window=replace(hand.window, image=image)))
        truths.append(truth)
    found = find_mask(hands[2], learn_colors(hands)).pixels
    assert (found & truths[2]).sum() / (found | truths[2]).sum() > least


@pytest.mark.parametrize("size", [60, 112])
def test_a_soft_level_tells_how_far_its_contour_is(size: int) -> None:
    y, x = np.mgrid[:120, :120] + 0.5
    height = np.hypot(x - 58.3, y - 61.7) - 40
    level = 1 / (1 + np.exp(height / 3))  # Falls over a dozen pixels.
    scale = 120 / size
    coverage = mask_coverage(level, np.eye(2) * scale, np.zeros(2), size)
    found = signed_distance(torch.from_numpy(coverage)).numpy()
    y, x = scale * (np.mgrid[:size, :size] + 0.5)
    expected = (np.hypot(x - 58.3, y - 61.7) - 40) / scale
    near = np.abs(expected) < 8
    error = np.abs(found - expected)[near]
    assert error.max() < 1.0 and error.mean() < 0.25
    assert abs((found - expected)[near].mean()) < 0.1
