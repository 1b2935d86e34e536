"""Hand poses: the bone tree, joint rotations and the placement of the wrist."""

from dataclasses import dataclass, replace
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.errors import ArgumentError
from handavatar.geometry.rotations import (
    axis_angle_from_matrix,
    left_jacobian,
    matrix_from_axis_angle,
    rigid_transform,
)
from handavatar.geometry.tensors import require_tensor

BONE_NAMES: tuple[str, ...] = (
    "wrist",
    "index1",
    "index2",
    "index3",
    "middle1",
    "middle2",
    "middle3",
    "little1",
    "little2",
    "little3",
    "ring1",
    "ring2",
    "ring3",
    "thumb1",
    "thumb2",
    "thumb3",
)
BONE_PARENTS: tuple[int, ...] = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
NUM_BONES = len(BONE_NAMES)
FINGER_BONES: dict[str, tuple[int, ...]] = {
    finger: tuple(i for i, name in enumerate(BONE_NAMES) if name.startswith(finger))
    for finger in ("thumb", "index", "middle", "ring", "little")
}
CONNECTED_PAIRS: tuple[tuple[int, int], ...] = tuple(
    (parent, bone) for bone, parent in enumerate(BONE_PARENTS) if parent >= 0
)


@dataclass(frozen=True, eq=False)
class HandPose:
    """Joint rotations and wrist placement of one hand, or of a batch of hands.

    Attributes:
        rotations: axis-angle in radians per bone in the order of ``BONE_NAMES``, relative to the
            parent bone; the wrist's is relative to the world. Zero is the flat hand.
        translation: metres; the posed wrist joint lies at the rest wrist joint plus this.

    Raises:
        ArgumentError: if one is no tensor of floats of this shape.
    """

    rotations: Float[Tensor, "*batch bones 3"]
    translation: Float[Tensor, "*batch 3"]

    def __post_init__(self) -> None:
        """Refuses what is no pose."""
        require_tensor("HandPose.rotations", self.rotations, (NUM_BONES, 3), is_batch=True)
        require_tensor("HandPose.translation", self.translation, (3,), is_batch=True)
        if self.rotations.shape[:-2] != self.translation.shape[:-1]:
            raise ArgumentError(
                "HandPose.translation",
                f"a tensor of shape {tuple(self.translation.shape)}",
                f"one place for each hand of rotations {tuple(self.rotations.shape)}",
            )

    @staticmethod
    def flat(device: torch.device | str = "cpu") -> "HandPose":
        """The zero pose at the origin."""
        return HandPose(torch.zeros(NUM_BONES, 3, device=device), torch.zeros(3, device=device))

    def to(self, device: torch.device | str) -> "HandPose":
        """The same pose on another device."""
        return replace(
            self, rotations=self.rotations.to(device), translation=self.translation.to(device)
        )

    def moved_to(
        self, target_from_source: Float[Tensor, "*batch 4 4"], wrist: Float[Tensor, "3"]
    ) -> "HandPose":
        """The same hand in other axes.

        Args:
            target_from_source: rigid; the pose is given in the source's axes.
            wrist: rest wrist joint, metres: about it the hand turns, not about the origin.
        """
        turn = target_from_source[..., :3, :3]
        first = turn @ matrix_from_axis_angle(self.rotations[..., 0, :])
        rotations = torch.cat(
            [axis_angle_from_matrix(first)[..., None, :], self.rotations[..., 1:, :]], dim=-2
        )
        place = (turn @ (self.translation + wrist)[..., None])[..., 0]
        return HandPose(rotations, place + target_from_source[..., :3, 3] - wrist)


def bone_transforms(
    rotations: Float[Tensor, "*batch bones 3"], rest_joints: Float[Tensor, "*shape bones 3"]
) -> Float[Tensor, "*batch bones 4 4"]:
    """``world_from_bone`` G_b of every bone: its joint as origin, rest axes turned by the pose.

    Args:
        rotations: axis-angle, radians, relative to the parent bone.
        rest_joints: joint positions in the zero pose, metres.

    Source: paper appendix A, the bone-transform equation.
    Departs: the printed chain multiplies absolute joint positions; only offsets from the parent
        joint compose, as in MANO.
    """
    joints = rest_joints.expand(*rotations.shape[:-2], -1, -1)
    parents, order, levels = _kinematic_indices(rotations.device)
    before = torch.cat([torch.zeros_like(joints[..., :1, :]), joints], dim=-2)
    offsets = joints - before.index_select(-2, parents)
    parent_from_bone = rigid_transform(matrix_from_axis_angle(rotations), offsets)
    world_from_bone = parent_from_bone[..., :1, :, :]
    for bones, carriers in levels:
        placed = world_from_bone.index_select(-3, carriers) @ parent_from_bone.index_select(
            -3, bones
        )
        world_from_bone = torch.cat([world_from_bone, placed], dim=-3)
    return world_from_bone.index_select(-3, order)


def linear_blend_skinning(
    rest_vertices: Float[Tensor, "*batch vertices 3"],
    skin_weights: Float[Tensor, "vertices bones"],
    world_from_bone: Float[Tensor, "*batch bones 4 4"],
    rest_joints: Float[Tensor, "*batch bones 3"],
) -> Float[Tensor, "*batch vertices 3"]:
    """Posed vertices: weighted sum of the bones' rigid motions from rest.

    Source: paper appendix A, the skinning equation; ``G_b(0)^-1`` is a shift by the rest joint.
    """
    rotation = world_from_bone[..., :3, :3]
    shift = world_from_bone[..., :3, 3] - (rotation @ rest_joints[..., None])[..., 0]
    motion = torch.cat([rotation.flatten(-2), shift], dim=-1)
    per_vertex = skin_weights @ motion
    blended = per_vertex[..., :9].unflatten(-1, (3, 3))
    return (blended @ rest_vertices[..., None])[..., 0] + per_vertex[..., 9:]


def skinning_jacobian(
    rest_vertices: Float[Tensor, "vertices 3"],
    skin_weights: Float[Tensor, "vertices bones"],
    rotations: Float[Tensor, "bones 3"],
    world_from_bone: Float[Tensor, "bones 4 4"],
    rest_joints: Float[Tensor, "bones 3"],
) -> Float[Tensor, "vertices 3 bones 3"]:
    """How posed vertices move with the joint rotations, metres per radian.

    Bone ``j`` carries what it and the bones behind it carry around its own joint; so no automatic
    differentiation is needed, and threads may share the work.

    Args:
        rest_vertices: as for :func:`linear_blend_skinning`.
        skin_weights: as there.
        rotations: axis-angle, radians.
        world_from_bone: of these rotations, from :func:`bone_transforms`.
        rest_joints: metres.

    Returns:
        For each component of a vertex, its change with each component of each axis-angle.
    """
    turned, joints = world_from_bone[:, :3, :3], world_from_bone[:, :3, 3]
    parents = turned[list(BONE_PARENTS)].clone()
    parents[0] = torch.eye(3, dtype=turned.dtype, device=turned.device)
    axes = parents @ left_jacobian(rotations)
    arms = rest_vertices[:, None] - rest_joints
    weighted = (turned @ arms[..., None])[..., 0] + joints
    weighted = weighted * skin_weights[..., None]
    behind = turned.new_tensor(_BEHIND)
    lever = torch.einsum("jb,vbc->vjc", behind, weighted)
    lever = lever - (skin_weights @ behind.T)[..., None] * joints
    turning = axes.mT[None].expand(len(lever), -1, -1, -1)
    return torch.linalg.cross(turning, lever[:, :, None]).permute(0, 3, 1, 2)


def _chain(bone: int) -> list[int]:
    """A bone and those before it, up to the wrist."""
    return [] if bone < 0 else [bone, *_chain(BONE_PARENTS[bone])]


_BEHIND = [[float(j in _chain(b)) for b in range(NUM_BONES)] for j in range(NUM_BONES)]
"""Row ``j``: one for bone ``j`` itself and for those that hang on it."""


@cache
def _kinematic_indices(
    device: torch.device,
) -> tuple[Int[Tensor, "bones"], Int[Tensor, "bones"], list[tuple[Tensor, Tensor]]]:
    """Indices for walking along all fingers at once.

    Returns:
        Each bone's parent, counted from 1, 0 for none; where each bone stands once bones are
        ordered by their distance from the wrist; and for each distance after it the bones, and
        where their parents stand.
    """
    ordered = sorted(range(NUM_BONES), key=lambda bone: (len(_chain(bone)), bone))
    place = [ordered.index(bone) for bone in range(NUM_BONES)]
    levels = []
    for depth in range(2, len(_chain(ordered[-1])) + 1):
        bones = [bone for bone in ordered if len(_chain(bone)) == depth]
        carriers = [place[BONE_PARENTS[bone]] for bone in bones]
        levels.append((torch.tensor(bones, device=device), torch.tensor(carriers, device=device)))
    parents = torch.tensor([parent + 1 for parent in BONE_PARENTS], device=device)
    return parents, torch.tensor(place, device=device), levels
