"""The surface that leaves: one rest shape for all poses, four bones a vertex, seams split."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.hand.skin_refinement import strongest_bones
from handavatar.render.chart import charted

NUM_SHAPE_POSES = 64
"""Poses whose personal rest shapes are averaged."""


@torch.no_grad()
def average_hand(avatar: HandAvatar, count: int = NUM_SHAPE_POSES) -> ShapedHand:
    """The personal hand with the one rest shape that serves all poses, at most four bones a vertex.

    An avatar's rest shape depends a little on the pose, and so do a rig's pose blend shapes; an
    engine's skinning knows neither. This is their mean over random poses; from what it is in a
    pose, it differs by 0.2 mm on average for the demonstration's avatar.

    Args:
        avatar: on the CPU.
        count: poses to average over; always the same ones.
    """
    generator = torch.Generator().manual_seed(0)
    rotations = sample_poses(avatar.base_rig, count, generator)
    vertices = torch.zeros_like(avatar.rig.template_vertices)
    joints = vertices.new_zeros(len(avatar.rig.joint_axes), 3)
    for turned in rotations:
        hand = avatar.personal(HandPose(turned, torch.zeros(3)))
        vertices = vertices + (hand.rest_vertices + avatar.rig.pose_offsets(turned)) / count
        joints = joints + hand.rest_joints / count
    rig = replace(
        avatar.rig,
        skin_weights=strongest_bones(avatar.rig.skin_weights),
        pose_directions=vertices.new_zeros(len(vertices), 3, 0),
    )
    return ShapedHand(rig, vertices, joints)


def textured_hand(avatar: HandAvatar) -> ShapedHand:
    """:func:`average_hand` with a chart that can carry a texture.

    Args:
        avatar: on the CPU.
    """
    hand = average_hand(avatar)
    return replace(hand, rig=charted(avatar.base_rig, hand.rig, avatar.rounds))


@torch.no_grad()
def rest_shape_error(avatar: HandAvatar, hand: ShapedHand, count: int = 20) -> tuple[float, float]:
    """How far one rest shape puts the skin from where the avatar has it, over random poses.

    Args:
        avatar: on the CPU.
        hand: :func:`average_hand` of it.
        count: poses, others than those of the average.

    Returns:
        Mean distance of a vertex, and what 95 of 100 stay below; metres.
    """
    generator = torch.Generator().manual_seed(1)
    distances = []
    for turned in sample_poses(avatar.base_rig, count, generator):
        pose = HandPose(turned, torch.zeros(3))
        own = avatar.personal(pose).posed(pose).vertices
        distances.append((hand.posed(pose).vertices - own).norm(dim=-1))
    every = torch.cat(distances).sort().values
    return float(every.mean()), float(every[int(0.95 * (len(every) - 1))])


@dataclass(frozen=True, eq=False)
class Seamed:
    """A mesh whose vertices stand once for each place that they have in the texture.

    Attributes:
        sources: the rig's vertex of each.
        places: texture coordinates (u, v) in [0, 1]; v points down in the picture.
        faces: of these vertices, wound as the rig's.
    """

    sources: Int[Tensor, "corners"]
    places: Float[Tensor, "corners 2"]
    faces: Int[Tensor, "faces 3"]


def split_at_seams(rig: Rig) -> Seamed:
    """Vertices of a rig, split where its texture chart has seams."""
    count = len(rig.uv_coordinates)
    keys = (rig.faces * count + rig.uv_faces).flatten()
    found, corners = torch.unique(keys, return_inverse=True)
    return Seamed(found // count, rig.uv_coordinates[found % count], corners.view(-1, 3))
