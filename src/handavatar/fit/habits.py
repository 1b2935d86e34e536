"""What hands can do, and what they mostly do: limits and habits of joints, as residuals."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.geometry.rotations import matrix_from_axis_angle, skew
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
    angles, slopes = _angles_and_slopes(rig, rotations)
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
    full = slopes[:, :, :, None, :] * eye.to(angles)
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


def _angles_and_slopes(
    rig: Rig, rotations: Float[Tensor, "frames bones 3"]
) -> tuple[Float[Tensor, "frames bones 3"], Float[Tensor, "frames bones 3 3"]]:
    """Flexion, abduction and twist, and how each moves with each joint's own turn from the right.

    Without automatic differentiation, which takes ten times as long for so few numbers.
    """
    axes = rig.joint_axes.to(rotations)
    turned = axes @ matrix_from_axis_angle(rotations)
    m = turned @ axes.mT
    spins = skew(torch.eye(3).to(rotations))
    moved = turned[..., None, :, :] @ spins @ axes.mT[:, None]
    least = torch.finfo(m.dtype).tiny
    across = (m[..., 0, 0].square() + m[..., 0, 1].square()).clamp_min(least)

    def turning(
        up: tuple[int, int], along: tuple[int, int], sign: float
    ) -> Float[Tensor, "frames bones 3"]:
        """Of the angle whose tangent is one element by another, times the sign."""
        a, b = m[(..., *up)][..., None], m[(..., *along)][..., None]
        squared = (a.square() + b.square()).clamp_min(least)
        return sign * (b * moved[(..., *up)] - a * moved[(..., *along)]) / squared

    # The first row has unit length, so that the sine of the abduction is its last element.
    abducting = moved[..., 0, 2] / across.sqrt()[..., None]
    slopes = torch.stack(
        [turning((1, 2), (2, 2), -1.0), abducting, turning((0, 1), (0, 0), -1.0)], dim=2
    )
    return angles_from_rotations(rig, rotations), slopes
