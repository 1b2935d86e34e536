"""What hands can do, and what they mostly do: limits and habits of joints, as residuals."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES, NUM_BONES
from handavatar.hand.pose_sampling import JOINT_LIMITS, angles_from_rotations, limit_bounds
from handavatar.hand.rig import Rig

_OUTSIDE = math.radians(4)
"""How far joints go beyond their limits."""
_FIXED = math.radians(2.5)
"""How far a hinge turns about an axis that it does not have: the rig's axes are nobody's own."""
_SPREAD = math.radians(15)
"""How far fingers are spread from where they point at rest."""
_BEND = math.radians(60)
"""How far joints are bent."""
_FOLLOWING = 0.55
"""By how much the last joint of a long finger bends when its middle joint does."""
_FOLLOWS = math.radians(12)


def habit_residuals(
    rig: Rig, rotations: Float[Tensor, "frames bones 3"]
) -> tuple[Float[Tensor, "frames residuals"], Float[Tensor, "frames residuals 48"]]:
    """What speaks against poses, in standard deviations, and how it moves with the joints' turns.

    Args:
        rig: for the axes of its joints.
        rotations: axis-angle, radians.

    Returns:
        Residuals, and their derivatives by turns from the right (``R exp(turn)``).
    """
    with torch.enable_grad():
        turns = torch.zeros_like(rotations).requires_grad_()
        turned = matrix_from_axis_angle(rotations) @ matrix_from_axis_angle(turns)
        angles = angles_from_rotations(rig, axis_angle_from_matrix(turned))
        sums = [angles[..., number].sum() for number in range(3)]
        slopes = [torch.autograd.grad(total, turns, retain_graph=True)[0] for total in sums]
        angles = angles.detach()
    least, greatest = limit_bounds(angles)
    width = greatest - least
    is_fixed = width < math.radians(1)
    sigma = torch.where(is_fixed, _FIXED, _BEND)
    spreading = torch.zeros(NUM_BONES, 3, dtype=torch.bool)
    spreading[[BONE_NAMES.index(name) for name in JOINT_LIMITS], 1] = True
    sigma = torch.where(spreading & ~is_fixed, _SPREAD, sigma)
    below, above = (least - angles).relu(), (angles - greatest).relu()
    outside = torch.where(is_fixed, 0.0, above - below) / _OUTSIDE
    is_outside = (outside != 0).to(angles)
    usual = angles / sigma
    # Bending has no middle that hands come back to, but a range.
    per_angle = torch.cat([outside[:, 1:], usual[:, 1:]], dim=1).flatten(1)
    eye = torch.eye(NUM_BONES)[None, :, None, :, None]
    full = torch.stack(slopes, dim=2)[:, :, :, None, :] * eye.to(angles)
    moved_outside = full * (is_outside / _OUTSIDE)[..., None, None]
    moved_usual = full / sigma[..., None, None]
    moved = torch.cat([moved_outside[:, 1:], moved_usual[:, 1:]], dim=1)
    moved = moved.flatten(3).flatten(1, 2)
    following, moved_following = [], []
    for finger in ("index", "middle", "ring", "little"):
        _, middle, last = FINGER_BONES[finger]
        following.append((angles[:, last, 0] - _FOLLOWING * angles[:, middle, 0]) / _FOLLOWS)
        slope = full[:, last, 0] - _FOLLOWING * full[:, middle, 0]
        moved_following.append(slope.flatten(1) / _FOLLOWS)
    return (
        torch.cat([per_angle, torch.stack(following, 1)], dim=1),
        torch.cat([moved, torch.stack(moved_following, 1)], dim=1),
    )
