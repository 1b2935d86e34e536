"""A tracked pose is pulled onto its mask, and only there."""

import inspect

import pytest
import torch
from conftest import bent_pose, camera_above
from torch import Tensor

from handavatar.alignment import aligned_pose
from handavatar.avatar import HandAvatar
from handavatar.hand.pose import HandPose
from handavatar.render.rasterize import rasterize

SIZE = 96


@torch.no_grad()
def _mask(avatar: HandAvatar, pose: HandPose) -> Tensor:
    posed = avatar.coarse_personal(pose).posed(pose)
    return rasterize(posed.vertices, posed.rig.faces, camera_above(SIZE)).mask


def _overlap(a: Tensor, b: Tensor) -> float:
    return int((a & b).sum()) / int((a | b).sum())


def _aligned(avatar: HandAvatar, pose: HandPose, mask: Tensor, steps: int = 8) -> HandPose:
    return aligned_pose(avatar.coarse_personal, pose, camera_above(SIZE), mask.float(), steps)


def test_a_moved_and_bent_pose_is_pulled_back_onto_the_mask(small_avatar: HandAvatar) -> None:
    true = bent_pose(1)
    mask = _mask(small_avatar, true)
    rotations = true.rotations.clone()
    rotations[1, 1] += 0.06  # The index finger points aside: 5 mm at its tip.
    moved = HandPose(rotations, true.translation + torch.tensor([0.003, 0.0, -0.003]))
    before = {name: value.clone() for name, value in small_avatar.state_dict().items()}
    found = _aligned(small_avatar, moved, mask)

    overlap = [_overlap(_mask(small_avatar, pose), mask) for pose in (moved, found)]
    # Pixels are 2.6 mm wide: the picture tells a third of one.
    assert overlap[0] < 0.92 and overlap[1] > 0.965
    error = (found.translation - true.translation)[[0, 2]].norm()
    assert float(error) < 0.5 * 0.003 * 2**0.5
    for name, value in small_avatar.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert all(parameter.grad is None for parameter in small_avatar.parameters())
    assert not found.rotations.requires_grad and not found.translation.requires_grad


@pytest.mark.parametrize("steps", [0, 3])
def test_it_never_ends_farther_from_the_mask_than_it_began(
    small_avatar: HandAvatar, steps: int
) -> None:
    pose = bent_pose(1)
    mask = _mask(small_avatar, pose)
    found = _aligned(small_avatar, pose, mask, steps)
    assert _overlap(_mask(small_avatar, found), mask) >= 1.0


def test_a_mask_far_away_or_empty_changes_little(small_avatar: HandAvatar) -> None:
    pose = bent_pose(0)
    empty = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    assert _aligned(small_avatar, pose, empty) is pose
    corner = empty.clone()
    corner[:6, :6] = True
    found = _aligned(small_avatar, pose, corner)
    assert float((found.rotations - pose.rotations).abs().max()) < 0.5
    assert float((found.translation - pose.translation).norm()) < 0.05


def test_it_is_given_no_colours() -> None:
    """What is not handed over cannot be used: mask and camera, but neither frame nor image."""
    names = list(inspect.signature(aligned_pose).parameters)
    assert names == ["hand_of", "pose", "camera", "coverage", "steps", "start", "known"]
