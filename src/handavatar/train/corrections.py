"""Per-frame corrections of tracked poses, learned with the avatar."""

import torch
from torch import Tensor, nn

from handavatar.hand.pose import NUM_BONES, HandPose

ROTATION_SCALE = 0.3
"""Radians per unit of the trained rotations: a frame is visited seldom, and Adam's first step after
a pause is some thirty times its learning rate."""
TRANSLATION_SCALE = 0.02
"""Metres per unit of the trained translations."""


class PoseCorrections(nn.Module):
    """Small changes of rotations (radians) and translation (metres) for each training frame.

    Departs: the authors never correct a pose, and the geometry wrinkles to compensate
        (paper, limitations).
    """

    def __init__(self, num_frames: int) -> None:
        """Starts at no correction."""
        super().__init__()
        self.rotations = nn.Parameter(torch.zeros(num_frames, NUM_BONES, 3))
        self.translations = nn.Parameter(torch.zeros(num_frames, 3))

    def forward(self, frame: int, pose: HandPose) -> HandPose:
        """The corrected pose of a frame, by its number among the training frames."""
        return HandPose(
            pose.rotations + ROTATION_SCALE * self.rotations[frame],
            pose.translation + TRANSLATION_SCALE * self.translations[frame],
        )

    def penalty(self, frame: int) -> Tensor:
        """Grows with the correction: 1 at about 6 degrees or 5 mm in one component."""
        rotation = ROTATION_SCALE * self.rotations[frame]
        translation = TRANSLATION_SCALE * self.translations[frame]
        return 100 * rotation.square().sum() + 4e4 * translation.square().sum()
