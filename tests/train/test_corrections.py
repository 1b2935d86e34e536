"""Pose corrections: start at nothing, belong to one frame each, cost what they say."""

import math

import torch

from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.train.corrections import PoseCorrections


def _pose() -> HandPose:
    generator = torch.Generator().manual_seed(0)
    return HandPose(torch.randn(NUM_BONES, 3, generator=generator), torch.ones(3))


def test_they_start_at_no_correction() -> None:
    corrections, pose = PoseCorrections(3), _pose()
    corrected = corrections(1, pose)
    assert torch.equal(corrected.rotations, pose.rotations)
    assert torch.equal(corrected.translation, pose.translation)
    assert float(corrections.penalty(1).detach()) == 0


def test_each_frame_has_its_own_and_a_step_moves_no_other() -> None:
    corrections, pose = PoseCorrections(3), _pose()
    target = HandPose(pose.rotations + 0.1, pose.translation - 0.01)
    corrections.set(2, pose, target)
    assert torch.equal(corrections(0, pose).rotations, pose.rotations)
    moved = corrections(2, pose)
    torch.testing.assert_close(moved.rotations, target.rotations)
    torch.testing.assert_close(moved.translation, target.translation)

    optimizer = torch.optim.Adam(corrections.parameters(), lr=0.01)
    for frame in (2, 1, 1):
        optimizer.zero_grad(set_to_none=True)
        corrections(frame, pose).rotations.sum().backward()
        optimizer.step()
    moved = [float(value.detach().mean()) for value in corrections.rotations]
    # Adam's steps are its learning rate; momentum carries no frame on that is not seen.
    torch.testing.assert_close(torch.tensor(moved), torch.tensor([0.0, -0.02, 0.09]))


def test_the_penalty_is_one_at_six_degrees_or_five_millimetres() -> None:
    corrections = PoseCorrections(2)
    with torch.no_grad():
        corrections.rotations[0][3, 0] = math.radians(5.73)
        corrections.translations[1][2] = 0.005
    for frame in (0, 1):
        torch.testing.assert_close(corrections.penalty(frame), torch.tensor(1.0), atol=1e-3, rtol=0)
