"""What an avatar's fields say of its skin in many poses, for pictures without fields to learn."""

import copy
import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import MORE_GESTURES, gesture
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.field.anchors import nearest_anchors
from handavatar.field.occupancy import HandCodes
from handavatar.geometry.meshes import vertex_normals
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import FINGER_BONES, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import (
    GESTURES,
    interpolate_rotations,
    resolve_penetration,
    sample_poses,
)
from handavatar.jobs.progress import SILENT, Progress

NUM_POINTS = 2048
"""Vertices, drawn anew in every pose, whose light is looked up."""
OUTLINE = 0.15
"""Occupancy where a ray that grazes the skin turns opaque: it passes several samples like that."""
_REACH = 4e-3
"""Metres off the mesh, to both sides, within which the field's surface is looked for."""
_HALVINGS = 6
_TURN = 0.45
"""Standard deviation of the wrist's turn about each axis, radians, away from the capture's view."""
_ANYWHERE = 5
"""Every so many turns the wrist takes any orientation."""
_OUTLINES = 3
"""The outline, which takes half of the time, is looked for in every so many poses."""
_TRACED_LIFTS = 3
"""Where light is traced, which takes seconds, shadows are lifted in every so many poses."""
_TURNS = 4
"""Orientations of the wrist in each pose of the fingers; one, where light is traced."""


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """The fields on the skin.

    Attributes:
        rotations: of the poses, axis-angle; the hands stand at the origin.
        rest_vertices: of the personal hand before subdivision, what the pose adds included, metres.
        rest_joints: metres.
        surface: how far outside each of these vertices the field's outline lies, along the normal,
            metres; NaN where it is not found, as between fingers that touch, or not looked for.
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
    avatar: HandAvatar, count: int, generator: torch.Generator, light: int | None = None
) -> Float[Tensor, "count turns bones 3"]:
    """Poses as hands take them, each turned in the light in a few ways.

    Every other one is random, the others lie on the way from one gesture to another. The wrist is
    about where the capture had it, and sometimes anywhere.

    Args:
        avatar: whose joints and capture.
        count: poses of the fingers.
        generator: draws them.
        light: of several clips, the one whose wrist it is; None as the avatar is shown.
    """
    rig = avatar.base_rig
    fingers = sample_poses(rig, count, generator)
    names = [*GESTURES, *MORE_GESTURES]
    for number in range(1, count, 2):
        first, second = torch.randint(len(names), (2,), generator=generator).tolist()
        keys = torch.stack([gesture(rig, names[first]), gesture(rig, names[second])])
        fingers[number] = interpolate_rotations(keys, torch.rand(1, generator=generator))[0]
    fingers = resolve_penetration(rig, fingers)
    turns = 1 if is_traced(avatar) else _TURNS
    total = count * turns
    near = _TURN * torch.randn(total, 3, generator=generator)
    angle = math.pi * torch.rand(total, 1, generator=generator)
    axis = torch.nn.functional.normalize(torch.randn(total, 3, generator=generator), dim=-1)
    is_anywhere = (torch.arange(total) % _ANYWHERE == _ANYWHERE - 1)[:, None]
    away = matrix_from_axis_angle(torch.where(is_anywhere, angle * axis, near))
    start = matrix_from_axis_angle(start_of(avatar.view(Edit(light=light))).rotations[0])
    wrists = axis_angle_from_matrix(start @ away).view(count, turns, 1, 3)
    return torch.cat([wrists, fingers[:, None, 1:].expand(-1, turns, -1, -1)], dim=2)


@torch.no_grad()
def sample_field(
    avatar: HandAvatar,
    rotations: Float[Tensor, "poses turns bones 3"],
    generator: torch.Generator,
    progress: Progress = SILENT,
    num_points: int = NUM_POINTS,
    light: int | None = None,
) -> FieldSamples:
    """Looks up the fields on the hand in every pose.

    Args:
        avatar: on the CPU; of its own edit only the light plays a part.
        rotations: of the poses; those in a row differ in the wrist alone, and what surrounds a
            place of the skin is looked up for all of them at once.
        generator: draws points and lifted fingers.
        progress: told how many poses are done.
        num_points: drawn per pose.
        light: that shines, of several; None is the one in which the avatar is shown.

    Returns:
        All turns of the first pose, all of the second, and so on.
    """
    plain = copy.copy(avatar)
    plain.edit = Edit(light=avatar.light_of(Edit(light=light)))
    rows: list[tuple[Tensor, ...]] = []
    for number, turned in enumerate(rotations):
        rows += _in_pose(plain, turned, number, num_points, generator)
        progress(number + 1, len(rotations))
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    return FieldSamples(rotations.flatten(0, 1), *columns)


def _in_pose(
    avatar: HandAvatar,
    turns: Float[Tensor, "turns bones 3"],
    number: int,
    num_points: int,
    generator: torch.Generator,
) -> list[tuple[Tensor, ...]]:
    """A row of :class:`FieldSamples` for each turn."""
    pose = HandPose(turns[0], torch.zeros(3))
    own = avatar.coarse_personal(pose)
    rest = own.rest_vertices + avatar.coarse_rig.pose_offsets(turns[0])
    state = avatar.prepare(pose)
    vertices = state.posed.vertices
    surface = torch.full_like(rest[:, 0], torch.nan)
    if number % _OUTLINES == 1:
        surface = _outline(avatar, state.codes, vertices)
    points = torch.randperm(len(vertices), generator=generator)[:num_points]
    near = nearest_anchors(state.anchors, vertices[points])
    around = avatar.occupancy(state.codes, vertices[points]).soft_parts
    fingers = list(FINGER_BONES.values())
    chosen = torch.randperm(len(fingers), generator=generator)[: 1 + (number % 3 == 0)]
    lifted = torch.zeros(NUM_BONES, dtype=torch.bool)
    if not is_traced(avatar) or number % _TRACED_LIFTS == 0:
        for finger in chosen.tolist():
            lifted[list(fingers[finger])] = True
    bones = tuple(lifted.nonzero()[:, 0].tolist())
    rows: list[tuple[Tensor, ...]] = []
    for which, rotations in enumerate(turns):
        turn = matrix_from_axis_angle(rotations[0]) @ matrix_from_axis_angle(turns[0, 0]).T
        normals = near.interpolated(state.anchor_normals) @ turn.T
        lights = []
        for lift in dict.fromkeys(((), bones)):
            traced = state.light
            if is_traced(avatar) and (lift or which > 0):
                traced = avatar.prepare(HandPose(rotations, torch.zeros(3)), lift).light
            seen = Edit(lifted_bones=lift).of_directed(around)
            light = avatar.illumination(
                rotations,
                near,
                seen,
                normals,
                near.interpolated(traced),
                avatar.light_of(),
            )
            lights.append(light)
        rows.append((rest, own.rest_joints, surface, points, lights[0], lifted, lights[-1]))
    return rows


def is_traced(avatar: HandAvatar) -> bool:
    """Whether the light of an avatar is traced to the posed mesh."""
    return avatar.illumination.chosen.num_directions > 0


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
