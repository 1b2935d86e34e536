"""What a tracker's landmarks are on the rig: the same as in the fit to landmarks alone."""

from dataclasses import replace

import torch
from made_frames import calm_poses, pose_at

from handavatar.capture.fitted_hand import HandFit, HandModel
from handavatar.fit.kinematics import Skeleton
from handavatar.fit.landmarks import landmark_rest, offset_tolerances
from handavatar.fit.shape import fixed_shape
from handavatar.hand.rig import Rig


def test_landmarks_lie_where_the_first_fit_has_them(rig: Rig) -> None:
    poses, shape = calm_poses(rig, 3), torch.linspace(-1.0, 1.0, 10)
    fit = HandFit(
        poses.rotations, poses.translation, shape, torch.tensor(7.0), offsets=torch.zeros(21, 3)
    )
    hand, space = rig.shaped(shape), fixed_shape(rig)
    generator = torch.Generator().manual_seed(1)
    for offsets in (torch.zeros(21, 3), 0.005 * torch.randn(21, 3, generator=generator)):
        expected = HandModel(rig).landmarks(replace(fit, offsets=offsets))
        rest = landmark_rest(hand, space, offsets.flatten())
        for frame in range(3):
            skeleton = Skeleton.of(hand, pose_at(poses, frame), space.joint_directions)
            torch.testing.assert_close(
                skeleton.padded(63).positions(rest), expected[frame], rtol=0, atol=1e-6
            )


def test_tolerances_are_those_of_the_first_fit(rig: Rig) -> None:
    expected = HandModel(rig).offset_tolerance.repeat_interleave(3)
    assert torch.equal(offset_tolerances(), expected)
