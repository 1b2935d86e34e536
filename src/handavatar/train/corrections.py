"""Per-frame corrections of tracked poses."""

import torch
from torch import Tensor, nn

from handavatar.hand.pose import NUM_BONES, HandPose


class PoseCorrections(nn.Module):
    """Small changes of rotations (radians) and translation (metres) for each training frame.

    One parameter per frame: Adam leaves alone the frames that a step does not see.

    Departs: the authors never correct a pose, and the geometry wrinkles to compensate
        (paper, limitations).
    """

    def __init__(self, num_frames: int) -> None:
        """Starts at no correction."""
        super().__init__()
        self.rotations = nn.ParameterList([torch.zeros(NUM_BONES, 3) for _ in range(num_frames)])
        self.translations = nn.ParameterList([torch.zeros(3) for _ in range(num_frames)])

    def forward(self, frame: int, pose: HandPose) -> HandPose:
        """The corrected pose of a frame, by its number among the training frames."""
        return HandPose(
            pose.rotations + self.rotations[frame], pose.translation + self.translations[frame]
        )

    @torch.no_grad()
    def set(self, frame: int, pose: HandPose, corrected: HandPose) -> None:
        """Makes :meth:`forward` turn the first pose into the second."""
        self.rotations[frame].copy_(corrected.rotations - pose.rotations)
        self.translations[frame].copy_(corrected.translation - pose.translation)

    def penalty(self, frame: int) -> Tensor:
        """Grows with the correction: 1 at about 6 degrees or 5 mm in one component."""
        rotation, translation = self.rotations[frame], self.translations[frame]
        return 100 * rotation.square().sum() + 4e4 * translation.square().sum()
