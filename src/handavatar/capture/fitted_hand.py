"""The rig as it is fitted to a video: landmarks and single vertices, linear in the shape.

Camera axes (OpenCV, the camera's centre as origin), metres.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.landmarks import LANDMARK_BONES, LANDMARK_ROWS
from handavatar.hand.pose import (
    NUM_BONES,
    HandPose,
    bone_transforms,
    linear_blend_skinning,
)
from handavatar.hand.rig import Rig


@dataclass(frozen=True, eq=False)
class HandFit:
    """A hand in every frame, in camera axes.

    Attributes:
        rotations: as in :class:`HandPose`.
        translation: as in :class:`HandPose`, metres.
        shape_coefficients: of the rig.
        log_focal: natural logarithm of the focal length in pixels.
        offsets: from the rig's joints and fingertips to what the tracker means by its landmarks,
            metres in the rest axes of the bone.
    """

    rotations: Float[Tensor, "frames bones 3"]
    translation: Float[Tensor, "frames 3"]
    shape_coefficients: Float[Tensor, "shapes"]
    log_focal: Float[Tensor, ""]
    offsets: Float[Tensor, "21 3"]

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return float(self.log_focal.exp())

    def pose(self, frame: int) -> HandPose:
        """The pose in one frame, wrist rotation brought to at most half a turn."""
        rotations = axis_angle_from_matrix(matrix_from_axis_angle(self.rotations[frame]))
        return HandPose(rotations, self.translation[frame])

    def chosen(self, frames: Int[Tensor, "chosen"]) -> "HandFit":
        """The same of some frames; they may repeat."""
        return replace(self, rotations=self.rotations[frames], translation=self.translation[frames])


class HandModel:
    """A rig as the fit needs it: landmarks and single vertices, linear in the shape."""

    def __init__(self, rig: Rig) -> None:
        """Precomputes what is linear in the shape.

        Args:
            rig: with a vertex set ``fingertips`` (thumb to little).
        """
        self.rig = rig
        tips = rig.vertex_sets["fingertips"]
        rows = list(LANDMARK_ROWS)
        self.landmark_bones = torch.tensor(LANDMARK_BONES)
        self._tip_landmarks = torch.tensor(
            [rows.index(NUM_BONES + finger) for finger in range(len(tips))]
        )
        joint_directions = torch.einsum("bv,vcs->bcs", rig.joint_regressor, rig.shape_directions)
        points = torch.cat(
            [rig.joint_regressor @ rig.template_vertices, rig.template_vertices[tips]]
        )
        directions = torch.cat([joint_directions, rig.shape_directions[tips]])
        self._joints, self._joint_directions = points[:NUM_BONES], joint_directions
        self._landmarks, self._landmark_directions = points[rows], directions[rows]
        sizes = {"cmc": 0.008, "mcp": 0.006, "tip": 0.004}
        parts = ["wrist"] + ["cmc", "mcp", "ip", "tip"] + ["mcp", "pip", "dip", "tip"] * 4
        self.offset_tolerance = torch.tensor([sizes.get(part, 0.003) for part in parts])
        self.offset_tolerance[0] = 0.010

    def joints(self, shape: Float[Tensor, "shapes"]) -> Float[Tensor, "16 3"]:
        """Rest joints, metres."""
        return self._joints + self._joint_directions @ shape

    def landmarks(self, fit: HandFit) -> Float[Tensor, "frames 21 3"]:
        """Where the tracker's landmarks are on the hand: metres, camera axes."""
        joints = self.joints(fit.shape_coefficients)
        transforms = bone_transforms(fit.rotations, joints)[:, self.landmark_bones]
        rest = self._landmarks + self._landmark_directions @ fit.shape_coefficients + fit.offsets
        if self.rig.pose_directions.numel():
            # Of the fingertips alone: joints follow from the shape.
            added = self.rig.pose_offsets(fit.rotations, self.rig.vertex_sets["fingertips"])
            rest = rest.repeat(len(added), 1, 1).index_add(1, self._tip_landmarks, added)
        local = rest - joints[self.landmark_bones]
        turned = (transforms[..., :3, :3] @ local[..., None])[..., 0]
        return turned + transforms[..., :3, 3] + fit.translation[:, None]

    def vertices(
        self, fit: HandFit, chosen: Int[Tensor, "frames pairs"]
    ) -> Float[Tensor, "frames pairs 3"]:
        """Single posed vertices of every frame: metres, camera axes."""
        rig, shape = self.rig, fit.shape_coefficients
        joints = self.joints(shape)
        transforms = bone_transforms(fit.rotations, joints)
        rotation = transforms[..., :3, :3]
        shift = transforms[..., :3, 3] - (rotation @ joints[..., None])[..., 0]
        motion = torch.cat([rotation.flatten(-2), shift], dim=-1)
        per_vertex = rig.skin_weights[chosen] @ motion
        rest = (rig.template_vertices + rig.shape_directions @ shape)[chosen]
        if rig.pose_directions.numel():
            # Of all vertices: gathering each frame's directions of the chosen ones takes longer.
            added = rig.pose_offsets(fit.rotations)
            rest = rest + added.gather(1, chosen[..., None].expand(-1, -1, 3))
        blended = per_vertex[..., :9].unflatten(-1, (3, 3))
        return (blended @ rest[..., None])[..., 0] + per_vertex[..., 9:] + fit.translation[:, None]

    @torch.no_grad()
    def all_vertices(self, fit: HandFit) -> Float[Tensor, "frames vertices 3"]:
        """All posed vertices: metres, camera axes."""
        joints = self.joints(fit.shape_coefficients)
        rest = self.rig.template_vertices + self.rig.shape_directions @ fit.shape_coefficients
        frames = len(fit.rotations)
        posed = linear_blend_skinning(
            rest.expand(frames, -1, -1) + self.rig.pose_offsets(fit.rotations),
            self.rig.skin_weights,
            bone_transforms(fit.rotations, joints),
            joints.expand(frames, -1, -1),
        )
        return posed + fit.translation[:, None]


def projected(
    points: Float[Tensor, "*n 3"], focal: Float[Tensor, ""], principal_point: tuple[float, float]
) -> Float[Tensor, "*n 2"]:
    """Pixels of points in camera axes."""
    center = points.new_tensor(principal_point)
    return points[..., :2] / points[..., 2:].clamp_min(0.02) * focal + center
