"""Appearance on samples that stay: hidden poses."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import read_capture
from handavatar.field.shading import OrientedCues, TracedCues
from handavatar.hand.open_hand import load_open_hand
from handavatar.train.appearance import (
    SeenSamples,
    appearance_loss,
    find_seen_samples,
    samples_of_frames,
    with_hidden_poses,
)
from handavatar.train.prior import load_prior


@pytest.fixture
def avatar() -> HandAvatar:
    torch.manual_seed(0)
    rig, cues = load_open_hand(), TracedCues(6)
    avatar = HandAvatar(rig, torch.zeros(10), rounds=0, num_anchors=128, cues=cues)
    load_prior(avatar.occupancy)
    return avatar


@pytest.fixture
def seen(avatar: HandAvatar, tiny_capture: Path) -> SeenSamples:
    capture = read_capture(tiny_capture)
    frames = [capture.frame(index) for index in capture.split("train")]
    return find_seen_samples(avatar, frames, RenderSettings(num_samples=12), 2)


def test_a_share_of_the_frames_comes_without_its_pose(seen: SeenSamples) -> None:
    clips = torch.zeros(4000, dtype=torch.long)
    many = replace(seen, rotations=torch.ones(4000, 16, 3), clips=clips)
    hidden = with_hidden_poses(many, 0.3, torch.Generator().manual_seed(1))
    is_zero = (hidden.rotations == 0).flatten(1)
    assert bool((is_zero.all(-1) == is_zero.any(-1)).all())
    assert float(is_zero.all(-1).float().mean()) == pytest.approx(0.3, abs=0.03)
    again = with_hidden_poses(many, 0.3, torch.Generator().manual_seed(1))
    assert torch.equal(again.rotations, hidden.rotations)
    # Nothing is drawn where nothing is hidden: other methods keep their random numbers.
    generator = torch.Generator().manual_seed(1)
    before = generator.get_state()
    assert with_hidden_poses(seen, OrientedCues.pose_dropout, generator) is seen
    assert torch.equal(generator.get_state(), before)


def test_a_hidden_pose_changes_the_light_of_its_frame_alone(
    avatar: HandAvatar, seen: SeenSamples
) -> None:
    """What the loss sees: pixels of the other frames keep their value."""
    rotations = seen.rotations.clone()
    rotations[0] = 0
    shown = replace(seen, rotations=rotations)
    frame = seen.frames[seen.starts[:-1]]
    for number in range(len(rotations)):
        pixels = (frame == number).nonzero()[:, 0]
        losses = [float(appearance_loss(avatar, part, pixels)[1]) for part in (seen, shown)]
        assert (losses[0] == losses[1]) == (number > 0)


def test_samples_of_some_frames_are_those_of_these_alone(
    seen: SeenSamples,
) -> None:
    some = samples_of_frames(seen, [0, 2])
    is_some = (seen.frames == 0) | (seen.frames == 2)
    first = seen.frames[seen.starts[:-1]]
    of_pixels = (first == 0) | (first == 2)
    assert torch.equal(some.weights, seen.weights[is_some])
    assert torch.equal(some.neighbours.indices, seen.neighbours.indices[is_some])
    assert torch.equal(some.colors, seen.colors[of_pixels])
    assert torch.equal(some.starts.diff(), seen.starts.diff()[of_pixels])
    assert some.frames.unique().tolist() == [0, 1]
    assert torch.equal(some.rotations, seen.rotations[[0, 2]])
    whole = samples_of_frames(seen, range(len(seen.rotations)))
    assert all(torch.equal(value, seen.tensors()[n]) for n, value in whole.tensors().items())
