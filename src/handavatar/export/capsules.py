"""Capsules that stand for the bones of a hand where it shades itself.

A program that draws a hand sixty times a second cannot ask a field, or trace rays to a mesh, what
hides a place of the skin. The distance from a place to sixteen bones is a few dozen products.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.pose import FINGER_BONES, NUM_BONES
from handavatar.hand.rig import ShapedHand

REACH = 6e-3
"""Metres from a capsule's surface at which nearness has fallen to 1/e: the field's soft occupancy
fades over about that much."""
LEAST_RADIUS = 2e-3
_KNUCKLES = tuple(members[0] for members in FINGER_BONES.values())


@dataclass(frozen=True, eq=False)
class Capsules:
    """Cones with round ends around the bones, in the zero pose.

    Attributes:
        bones: that carry them, ascending; the wrist has one to each finger's first joint, every
            other bone one of its own.
        ends: of the axes, relative to the bone's joint, metres.
        radii: at both ends, metres.
    """

    bones: Int[Tensor, "capsules"]
    ends: Float[Tensor, "capsules 2 3"]
    radii: Float[Tensor, "capsules 2"]

    def posed(
        self, world_from_bone: Float[Tensor, "*batch bones 4 4"]
    ) -> Float[Tensor, "*batch capsules 2 3"]:
        """The ends of the axes in the world, metres."""
        return apply_rigid(world_from_bone[..., self.bones, :, :], self.ends)


def fit_capsules(hand: ShapedHand) -> Capsules:
    """Capsules that follow the skin of a hand in its zero pose.

    Axes run from joint to joint, the last of a finger to its tip; radii are what fits the distances
    of the bone's own vertices best (least squares, linear along the axis).
    """
    joints, owner = hand.rest_joints, hand.rig.skin_weights.argmax(-1)
    bones, ends, radii = [], [], []
    for bone in range(NUM_BONES):
        own = hand.rest_vertices[owner == bone] - joints[bone]
        targets = [joints[knuckle] - joints[0] for knuckle in _KNUCKLES]
        if bone > 0:
            (finger,) = (members for members in FINGER_BONES.values() if bone in members)
            is_last = bone == finger[-1]
            targets = [_tip(own) if is_last else joints[bone + 1] - joints[bone]]
        axes = torch.stack([torch.stack([torch.zeros_like(end), end]) for end in targets])
        share, distance = _along(own[:, None], axes)
        nearest = distance.argmin(-1)
        for number, axis in enumerate(axes):
            is_here = nearest == number
            bones.append(bone)
            ends.append(axis)
            radii.append(_radii(share[is_here, number], distance[is_here, number]))
    return Capsules(torch.tensor(bones), torch.stack(ends), torch.stack(radii))


def occlusion_by_bones(
    ends: Float[Tensor, "*batch capsules 2 3"],
    radii: Float[Tensor, "capsules 2"],
    bones: Int[Tensor, "capsules"],
    points: Float[Tensor, "*batch points 3"],
    normals: Float[Tensor, "*batch points 3"],
) -> Float[Tensor, "*batch points 2 bones"]:
    """How near each bone's flesh is to each point, and how much of what the point faces it fills.

    With ``d`` the distance from the point to the nearest place of the axis, in direction ``v``, and
    ``r`` the radius there, nearness is ``exp(-max(d - r, 0) / REACH)``, the cousin of soft
    occupancy; the filled share is ``min(1, (r / d)^2) max(0, n . v)``, the ambient occlusion by a
    ball. Of several capsules of one bone the greatest counts.

    Args:
        ends: of the axes, where the points are (metres).
        radii: at both ends, metres.
        bones: of the capsules.
        points: metres.
        normals: unit.
    """
    axes, from_point = ends[..., None, :, :, :], points[..., None, :]
    share, distance = _along(from_point, axes)
    radius = radii[:, 0] + share * (radii[:, 1] - radii[:, 0])
    nearest = axes[..., 0, :] + share[..., None] * (axes[..., 1, :] - axes[..., 0, :])
    distance = distance.clamp_min(1e-5)
    cosine = ((nearest - from_point) * normals[..., None, :]).sum(-1) / distance
    near = torch.exp(-(distance - radius).relu() / REACH)
    filled = (radius / distance).square().clamp(max=1) * cosine.relu()
    values = torch.stack([near, filled], dim=-2)
    found = values.new_zeros(*values.shape[:-1], NUM_BONES)
    return found.scatter_reduce(-1, bones.expand(values.shape), values, "amax")


def _along(
    points: Float[Tensor, "*batch #capsules 3"], axes: Float[Tensor, "*#batch capsules 2 3"]
) -> tuple[Float[Tensor, "*batch capsules"], Float[Tensor, "*batch capsules"]]:
    """How far along each axis the nearest place lies, in [0, 1], and the distance to it."""
    along = axes[..., 1, :] - axes[..., 0, :]
    offset = points - axes[..., 0, :]
    share = ((offset * along).sum(-1) / along.square().sum(-1)).clamp(0, 1)
    return share, (offset - share[..., None] * along).norm(dim=-1)


def _tip(own: Float[Tensor, "vertices 3"]) -> Float[Tensor, "3"]:
    """End of a last bone's axis: a radius short of its skin, straight ahead of its joint."""
    direction = torch.nn.functional.normalize(own.mean(0), dim=0)
    along = own @ direction
    radius = (own - along[:, None] * direction).norm(dim=-1).mean()
    return (along.max() - radius).clamp_min(LEAST_RADIUS) * direction


def _radii(
    share: Float[Tensor, "vertices"], distance: Float[Tensor, "vertices"]
) -> Float[Tensor, "2"]:
    if len(share) < 2:
        return distance.new_full((2,), LEAST_RADIUS)
    basis = torch.stack([1 - share, share], dim=-1)
    # A little of the mean, so that an end without vertices has a radius as well.
    pull = 1e-3 * len(share)
    normal = basis.T @ basis + pull * torch.eye(2)
    return torch.linalg.solve(normal, basis.T @ distance + pull * distance.mean()).clamp_min(
        LEAST_RADIUS
    )
