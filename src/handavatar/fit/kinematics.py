"""How points of a posed hand move with what a fit may change: joints, wrist, shape, focal length.

A pose is changed from the right: joint ``b`` with rotation ``R`` becomes ``R exp(turn)``. So a turn
of one size means the same angle whatever the pose, which axis-angle vectors do not. Turns of 16
bones (radians) and the shift of the wrist (metres) are the 51 unknowns of a frame, in this order.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import BONE_PARENTS, NUM_BONES, HandPose, bone_transforms
from handavatar.hand.rig import ShapedHand

NUM_UNKNOWNS = 3 * NUM_BONES + 3
"""Of one frame."""
Interpolate = Callable[[Float[Tensor, "vertices channels"]], Float[Tensor, "points channels"]]
"""Takes values of a mesh's vertices to some points of it."""


def moved_pose(pose: HandPose, change: Float[Tensor, "*batch 51"]) -> HandPose:
    """The pose after a change: every joint turned from the right, the wrist shifted."""
    turns = change[..., :-3].unflatten(-1, (NUM_BONES, 3))
    turned = matrix_from_axis_angle(pose.rotations) @ matrix_from_axis_angle(turns)
    return HandPose(axis_angle_from_matrix(turned), pose.translation + change[..., -3:])


def pose_difference(start: HandPose, end: HandPose) -> Float[Tensor, "*batch 51"]:
    """The change that moves one pose to another; inverse of :func:`moved_pose`."""
    between = matrix_from_axis_angle(start.rotations).mT @ matrix_from_axis_angle(end.rotations)
    turns = axis_angle_from_matrix(between).flatten(-2)
    return torch.cat([turns, end.translation - start.translation], dim=-1)


@dataclass(frozen=True, eq=False)
class RestPoints:
    """Points of the skin in the zero pose.

    Attributes:
        positions: metres.
        skin_weights: as of a rig's vertices.
        directions: how they move with each shared shape unknown, metres; may have no columns.
    """

    positions: Float[Tensor, "points 3"]
    skin_weights: Float[Tensor, "points bones"]
    directions: Float[Tensor, "points 3 shapes"]

    @staticmethod
    def between(
        interpolate: Interpolate, hand: ShapedHand, directions: Float[Tensor, "vertices 3 shapes"]
    ) -> "RestPoints":
        """Points between the vertices of a rest hand.

        Args:
            interpolate: values of the vertices, at the points.
            hand: rest hand.
            directions: how its vertices move with the shape, metres.
        """
        return RestPoints(
            interpolate(hand.rest_vertices),
            interpolate(hand.rig.skin_weights),
            interpolate(directions.flatten(1)).unflatten(1, directions.shape[1:]),
        )


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The bones of one posed hand, and how they move with the shape.

    Attributes:
        world_from_bone: rigid transforms, translation of the wrist included.
        rest_joints: metres, zero pose.
        rest_directions: of the rest joints with each shape unknown.
        joint_directions: of the posed joints with each shape unknown.
    """

    world_from_bone: Float[Tensor, "bones 4 4"]
    rest_joints: Float[Tensor, "bones 3"]
    rest_directions: Float[Tensor, "bones 3 shapes"]
    joint_directions: Float[Tensor, "bones 3 shapes"]

    @staticmethod
    def of(
        hand: ShapedHand, pose: HandPose, joint_directions: Float[Tensor, "bones 3 shapes"]
    ) -> "Skeleton":
        """The skeleton of a rest hand in a pose.

        Args:
            hand: rest hand.
            pose: of the hand.
            joint_directions: how the rest joints move with the shape, metres per unit.
        """
        transforms = bone_transforms(pose.rotations, hand.rest_joints)
        transforms[:, :3, 3] += pose.translation
        moving = [joint_directions[0]]
        for bone in range(1, NUM_BONES):
            parent = BONE_PARENTS[bone]
            offset = joint_directions[bone] - joint_directions[parent]
            moving.append(moving[parent] + transforms[parent, :3, :3] @ offset)
        return Skeleton(transforms, hand.rest_joints, joint_directions, torch.stack(moving))

    def padded(self, num_shared: int) -> "Skeleton":
        """The same; the joints do not move with further shared unknowns, up to this number."""
        missing = num_shared - self.rest_directions.shape[-1]
        zeros = self.rest_directions.new_zeros(NUM_BONES, 3, missing)
        return replace(
            self,
            rest_directions=torch.cat([self.rest_directions, zeros], dim=-1),
            joint_directions=torch.cat([self.joint_directions, zeros], dim=-1),
        )

    def positions(self, points: RestPoints) -> Float[Tensor, "points 3"]:
        """Posed points, metres, world."""
        rotation, joints = self.world_from_bone[:, :3, :3], self.world_from_bone[:, :3, 3]
        shift = joints - (rotation @ self.rest_joints[..., None])[..., 0]
        motion = points.skin_weights @ torch.cat([rotation.flatten(1), shift], dim=1)
        blended = motion[:, :9].unflatten(1, (3, 3))
        return (blended @ points.positions[..., None])[..., 0] + motion[:, 9:]

    def jacobian(self, points: RestPoints) -> Float[Tensor, "points 3 unknowns"]:
        """How posed points move with the pose's 51 unknowns and then with the shape's.

        Linear blend skinning: bone ``j`` carries what hangs on it around its own joint.
        """
        rotation, joints = self.world_from_bone[:, :3, :3], self.world_from_bone[:, :3, 3]
        arms = points.positions[:, None] - self.rest_joints
        placed = torch.einsum("bij,pbj->pbi", rotation, arms) + joints
        behind = rotation.new_tensor(_BEHIND)
        weights = points.skin_weights
        lever = torch.einsum("jb,pbc->pjc", behind, weights[..., None] * placed)
        lever = lever - (weights @ behind.T)[..., None] * joints
        # Column i of a bone's rotation is the axis, in the world, of its turn i.
        turning = rotation.mT[None].expand(len(lever), -1, -1, -1)
        turning = torch.linalg.cross(turning, lever[:, :, None]).permute(0, 3, 1, 2).flatten(2)
        shifting = torch.eye(3).to(turning).expand(len(lever), 3, 3)
        parts = [turning, shifting]
        if points.directions.shape[-1]:
            blended = torch.einsum("pb,bij->pij", weights, rotation)
            from_bones = self.joint_directions - rotation @ self.rest_directions
            moving = blended @ points.directions
            parts.append(moving + torch.einsum("pb,bis->pis", weights, from_bones))
        return torch.cat(parts, dim=-1)


def _chain(bone: int) -> list[int]:
    return [] if bone < 0 else [bone, *_chain(BONE_PARENTS[bone])]


_BEHIND = [[float(j in _chain(b)) for b in range(NUM_BONES)] for j in range(NUM_BONES)]
"""Row ``j``: one for bone ``j`` itself and for those that hang on it."""


def pixel_jacobian(
    camera: Camera, positions: Float[Tensor, "points 3"]
) -> tuple[Float[Tensor, "points 2"], Float[Tensor, "points"], Float[Tensor, "points 2 3"]]:
    """Image positions (pixels), depths (metres), and how the first move with world positions."""
    pixels, depth = project(camera, positions)
    focal = positions.new_tensor(camera.focal)
    relative = (pixels - positions.new_tensor(camera.center)) / focal
    rotation = camera.camera_from_world[:3, :3]
    flat = rotation[:2] - relative[..., None] * rotation[2]
    return pixels, depth, focal[:, None] * flat / depth[:, None, None]


def rest_with_pose(hand: ShapedHand, pose: HandPose) -> ShapedHand:
    """The rest hand with what this pose's blend shapes add; hardly changes within a step."""
    if not hand.rig.pose_directions.numel():
        return hand
    return replace(hand, rest_vertices=hand.rest_vertices + hand.rig.pose_offsets(pose.rotations))
