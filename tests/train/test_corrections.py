"""Pose corrections: start at nothing, belong to one frame each, cost what they say."""

import math

import torch

from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.train.corrections import ROTATION_SCALE, TRANSLATION_SCALE, PoseCorrections


def _pose() -> HandPose:
    generator = torch.Generator().manual_seed(0)
    return HandPose(torch.randn(NUM_BONES, 3, generator=generator), torch.ones(3))


def test_they_start_at_no_correction() -> None:
    corrections, pose = PoseCorrections(3), _pose()
    corrected = corrections(1, pose)
    assert torch.equal(corrected.rotations, pose.rotations)
    assert torch.equal(corrected.translation, pose.translation)
    assert float(corrections.penalty(1).detach()) == 0


def test_each_frame_has_its_own() -> None:
    corrections, pose = PoseCorrections(3), _pose()
    with torch.no_grad():
        corrections.rotations[2, 4, 1] = 0.1 / ROTATION_SCALE
        corrections.translations[2, 0] = -0.01 / TRANSLATION_SCALE
    assert torch.equal(corrections(0, pose).rotations, pose.rotations)
    moved = corrections(2, pose)
    torch.testing.assert_close(moved.rotations[4, 1], pose.rotations[4, 1] + 0.1)
    torch.testing.assert_close(moved.translation[0], pose.translation[0] - 0.01)
    moved.rotations.sum().backward()
    gradient = corrections.rotations.grad
    assert gradient is not None and bool(gradient[2].all()) and not bool(gradient[:2].any())


def test_the_penalty_is_one_at_six_degrees_or_five_millimetres() -> None:
    corrections = PoseCorrections(2)
    with torch.no_grad():
        corrections.rotations[0, 3, 0] = math.radians(5.73) / ROTATION_SCALE
        corrections.translations[1, 2] = 0.005 / TRANSLATION_SCALE
    for frame in (0, 1):
        torch.testing.assert_close(corrections.penalty(frame), torch.tensor(1.0), atol=1e-3, rtol=0)
