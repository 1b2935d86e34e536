"""What an avatar's fields say of its skin in many poses, for pictures without fields to learn."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.field.anchors import nearest_anchors
from handavatar.field.occupancy import HandCodes
from handavatar.geometry.meshes import vertex_normals
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import FINGER_BONES, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import resolve_penetration, sample_poses

NUM_POINTS = 2048
"""Vertices, drawn anew in every pose, whose light is looked up."""
OUTLINE = 0.15
"""Occupancy where a ray that grazes the skin turns opaque: it passes several samples like that."""
_REACH = 4e-3
"""Metres off the mesh, to both sides, within which the field's surface is looked for."""
_HALVINGS = 6
_TURN = 0.45
"""Standard deviation of the wrist's turn about each axis, radians, away from the capture's view."""
_ANYWHERE = 4
"""Every so many poses the wrist takes any orientation."""
_TRACED_LIFTS = 3
"""Where light is traced, which takes seconds, shadows are lifted in every so many poses."""


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """The fields on the skin.

    Attributes:
        rotations: of the poses, axis-angle; the hands stand at the origin.
        rest_vertices: of the personal hand before subdivision, what the pose adds included, metres.
        rest_joints: metres.
        surface: how far outside each of these vertices the field's outline lies, along the normal,
            metres; NaN where it is not found, as between fingers that touch.
        points: vertices of the fine mesh whose light is known.
        light: illumination there.
        lifted: bones whose shadow is lifted in another look at the same pose.
        lifted_light: illumination in that look.
    """

    rotations: Float[Tensor, "poses bones 3"]
    rest_vertices: Float[Tensor, "poses coarse 3"]
    rest_joints: Float[Tensor, "poses bones 3"]
    surface: Float[Tensor, "poses coarse"]
    points: Int[Tensor, "poses points"]
    light: Float[Tensor, "poses points"]
    lifted: Bool[Tensor, "poses bones"]
    lifted_light: Float[Tensor, "poses points"]

    def chosen(self, which: Bool[Tensor, "poses"]) -> "FieldSamples":
        """Some of the poses."""
        return FieldSamples(**{name: value[which] for name, value in vars(self).items()})


def sampled_poses(
    avatar: HandAvatar, count: int, generator: torch.Generator
) -> Float[Tensor, "count bones 3"]:
    """Random poses as hands take them, turned in the light about as the capture's hand was."""
    fingers = resolve_penetration(avatar.base_rig, sample_poses(avatar.base_rig, count, generator))
    near = _TURN * torch.randn(count, 3, generator=generator)
    angle = math.pi * torch.rand(count, 1, generator=generator)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    is_anywhere = (torch.arange(count) % _ANYWHERE == _ANYWHERE - 1)[:, None]
    turns = matrix_from_axis_angle(torch.where(is_anywhere, angle * axis, near))
    start = matrix_from_axis_angle(start_of(avatar.info.get("view")).rotations[0])
    wrists = axis_angle_from_matrix(start @ turns)
    return torch.cat([wrists[:, None], fingers[:, 1:]], dim=1)


@torch.no_grad()
def sample_field(
    avatar: HandAvatar,
    rotations: Float[Tensor, "poses bones 3"],
    generator: torch.Generator,
    tell: Callable[[int], None] = lambda number: None,
    num_points: int = NUM_POINTS,
) -> FieldSamples:
    """Looks up the fields on the hand in every pose.

    Args:
        avatar: on the CPU; its own edit plays no part.
        rotations: of the poses.
        generator: draws points and lifted fingers.
        tell: called with the number of every pose that is done.
        num_points: drawn per pose.
    """
    plain = copy.copy(avatar)
    plain.edit = Edit()
    rows = []
    for number, turned in enumerate(rotations):
        rows.append(_in_pose(plain, turned, number, num_points, generator))
        tell(number)
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    return FieldSamples(rotations, *columns)


def _in_pose(
    avatar: HandAvatar,
    rotations: Float[Tensor, "bones 3"],
    number: int,
    num_points: int,
    generator: torch.Generator,
) -> tuple[Tensor, ...]:
    pose = HandPose(rotations, torch.zeros(3))
    own = avatar.coarse_personal(pose)
    state = avatar.prepare(pose)
    vertices = state.posed.vertices
    surface = _outline(avatar, state.codes, vertices)
    points = torch.randperm(len(vertices), generator=generator)[:num_points]
    near = nearest_anchors(state.anchors, vertices[points])
    around = avatar.occupancy(state.codes, vertices[points]).soft_parts
    normals = near.interpolated(state.anchor_normals)
    fingers = torch.randperm(len(FINGER_BONES), generator=generator)[: 1 + (number % 3 == 0)]
    is_traced = avatar.illumination.chosen.num_directions > 0
    lifted = torch.zeros(NUM_BONES, dtype=torch.bool)
    if not is_traced or number % _TRACED_LIFTS == 0:
        bones_of = list(FINGER_BONES.values())
        for finger in fingers.tolist():
            lifted[list(bones_of[finger])] = True
    bones = tuple(lifted.nonzero()[:, 0].tolist())
    looks = [(Edit(), state.light)]
    if bones:
        traced = avatar.prepare(pose, bones).light if is_traced else state.light
        looks.append((Edit(lifted_bones=bones), traced))
    lights = [
        avatar.illumination(
            rotations, near, edit.of_directed(around), normals, near.interpolated(light)
        )
        for edit, light in looks
    ]
    rest = own.rest_vertices + avatar.coarse_rig.pose_offsets(rotations)
    return rest, own.rest_joints, surface, points, lights[0], lifted, lights[-1]


def _outline(
    avatar: HandAvatar, codes: HandCodes, vertices: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "coarse"]:
    """Where along its normal each vertex of the coarse mesh meets the field's outline, metres."""
    rig = avatar.rig
    count = avatar.base_rig.num_vertices
    normals = vertex_normals(rig.sealed(vertices), rig.sealed_faces)[:count]

    def is_inside(offsets: Float[Tensor, "coarse"]) -> Bool[Tensor, "coarse"]:
        places = vertices[:count] + offsets[:, None] * normals
        return avatar.occupancy(codes, places).whole > OUTLINE

    inner, outer = (vertices.new_full((count,), side * _REACH) for side in (-1, 1))
    is_found = is_inside(inner) & ~is_inside(outer)
    for _ in range(_HALVINGS):
        middle = (inner + outer) / 2
        inside = is_inside(middle)
        inner, outer = torch.where(inside, middle, inner), torch.where(inside, outer, middle)
    return torch.where(is_found, (inner + outer) / 2, torch.nan)
