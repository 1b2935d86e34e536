"""The decoder learns where the hand ends in the pictures, and nothing else moves."""

from dataclasses import replace

import pytest
import torch
from conftest import (
    assert_teaches_the_decoder_alone,
    assert_teaching_repeats,
    avatar_of_the_prior,
    lit_frame,
)

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Frame
from handavatar.geometry.cameras import pixel_centers, rays_through_pixels
from handavatar.train.border import BORDER_REACH, border_pixels, fit_border

SETTINGS = RenderSettings(num_samples=24, smallest_weight=1e-6, stop=1e-5)
FRAMES = [lit_frame(index, "train") for index in range(2)]


@torch.no_grad()
def _error(avatar: HandAvatar, frame: Frame) -> float:
    codes = avatar.occupancy.encode(avatar.parts, avatar.personal(frame.pose).posed(frame.pose))
    x, y = border_pixels(frame.alpha, 2000, torch.Generator()).unbind(-1)
    rays = rays_through_pixels(frame.camera, pixel_centers(frame.camera)[y, x])
    return float((avatar.alpha(codes, rays, SETTINGS) - frame.alpha[y, x]).abs().mean())


@pytest.mark.slow
def test_the_outline_moves_onto_the_border_of_the_mask() -> None:
    avatar = avatar_of_the_prior()
    errors = [_error(avatar, frame) for frame in FRAMES]
    assert_teaches_the_decoder_alone(
        avatar, lambda: fit_border(avatar, FRAMES, 40, SETTINGS, seed=0)
    )
    for frame, error in zip(FRAMES, errors, strict=True):
        assert _error(avatar, frame) < 0.85 * error


def test_the_same_seed_gives_the_same_bits_and_no_steps_change_nothing() -> None:
    assert_teaching_repeats(
        lambda avatar, steps, seed: fit_border(avatar, FRAMES, steps, SETTINGS, seed)
    )


def test_masks_without_a_border_teach_nothing() -> None:
    avatar = avatar_of_the_prior()
    before = {n: v.clone() for n, v in avatar.state_dict().items()}
    empty = [replace(FRAMES[0], coverage=torch.zeros_like(FRAMES[0].coverage))]
    fit_border(avatar, empty, 3, SETTINGS, seed=0)
    assert all(torch.equal(before[name], value) for name, value in avatar.state_dict().items())


def test_border_pixels_lie_beside_the_border_and_nowhere_else() -> None:
    mask = torch.zeros(40, 40)
    mask[10:30, 10:30] = 1
    generator = torch.Generator().manual_seed(0)
    x, y = border_pixels(mask, 5000, generator).unbind(-1)
    outside = torch.maximum((x - 19.5).abs(), (y - 19.5).abs()) - 10
    assert float(outside.min()) > -4 and float(outside.max()) < 4
    # Four pixels on either side of twenty: about 8 times 80, corners aside, each once.
    assert 560 < len(x) < 720 and len(torch.unique(x * 40 + y)) == len(x)
    assert len(border_pixels(mask, 100, generator)) == 100
    assert len(border_pixels(torch.zeros(9, 9), 10, generator)) == 0


def test_where_knowledge_ends_there_is_no_border() -> None:
    """A bar that goes on where nothing is known: its two sides are borders, its end is none."""
    coverage, known = torch.zeros(40, 40), torch.ones(40, 40, dtype=torch.bool)
    coverage[10:30, :20] = 1.0
    known[:, 20:] = False
    pixels = border_pixels(coverage, 10_000, torch.Generator().manual_seed(0), known)
    x, y = pixels.unbind(-1)
    assert len(pixels) > 100 and int(x.max()) < 20
    sides = torch.minimum((y + 0.5 - 10).abs(), (y + 0.5 - 30).abs())
    assert float(sides.max()) <= BORDER_REACH
