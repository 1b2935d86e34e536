"""A pose in numbers that shapes may depend on linearly."""

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import NUM_BONES

NUM_POSE_FEATURES = 9 * (NUM_BONES - 1)


def pose_features(rotations: Float[Tensor, "*batch bones 3"]) -> Float[Tensor, "*batch 135"]:
    """Entries of the finger bones' rotation matrices minus identity: zero in the zero pose."""
    matrices = matrix_from_axis_angle(rotations[..., 1:, :])
    return (matrices - torch.eye(3).to(matrices)).flatten(-3)
