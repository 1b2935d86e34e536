"""A held-out frame's pose is pulled onto its mask, and only there."""

import inspect

import torch
from conftest import bent_pose, camera_above
from torch import Tensor

from handavatar.alignment import aligned_pose
from handavatar.avatar import HandAvatar
from handavatar.hand.pose import HandPose
from handavatar.render.rasterize import rasterize


@torch.no_grad()
def _mask(avatar: HandAvatar, pose: HandPose) -> Tensor:
    vertices = avatar.personal(pose).posed(pose).vertices
    return rasterize(vertices, avatar.rig.faces, camera_above(64)).mask


def _overlap(a: Tensor, b: Tensor) -> float:
    return int((a & b).sum()) / int((a | b).sum())


def _aligned(avatar: HandAvatar, pose: HandPose, mask: Tensor, steps: int) -> HandPose:
    return aligned_pose(avatar, pose, camera_above(64), mask, steps=steps, size=64)


def test_a_shifted_pose_is_pulled_back_onto_the_mask(small_avatar: HandAvatar) -> None:
    true = bent_pose(1)
    mask = _mask(small_avatar, true)
    shifted = HandPose(true.rotations, true.translation + torch.tensor([0.006, 0.0, -0.005]))
    before = {name: value.clone() for name, value in small_avatar.state_dict().items()}
    found = _aligned(small_avatar, shifted, mask, steps=15)

    overlap = [_overlap(_mask(small_avatar, pose), mask) for pose in (shifted, found)]
    assert overlap[1] > overlap[0] + 0.05
    # Of the 8 mm at least half; a pixel is 4 mm wide.
    assert float((found.translation - true.translation).norm()) < 0.004
    for name, value in small_avatar.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert all(parameter.grad is None for parameter in small_avatar.parameters())
    assert not found.rotations.requires_grad and not found.translation.requires_grad


def test_it_never_ends_farther_from_the_mask_than_it_began(small_avatar: HandAvatar) -> None:
    """The best trial is kept, and the first trial is the pose as it was."""
    pose = bent_pose(1)
    found = _aligned(small_avatar, pose, _mask(small_avatar, pose), steps=0)
    assert torch.equal(found.rotations, pose.rotations)
    assert torch.equal(found.translation, pose.translation)


def test_an_empty_mask_gives_a_finite_pose(small_avatar: HandAvatar) -> None:
    found = _aligned(small_avatar, bent_pose(0), torch.zeros(64, 64, dtype=torch.bool), steps=2)
    assert bool(torch.isfinite(found.rotations).all() & torch.isfinite(found.translation).all())


def test_it_is_given_no_colours() -> None:
    """What is not handed over cannot be used: mask and camera, but neither frame nor image."""
    names = list(inspect.signature(aligned_pose).parameters)
    assert names == ["avatar", "pose", "camera", "mask", "steps", "size"]
