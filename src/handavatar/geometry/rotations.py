"""Axis-angle, rotation matrices and rigid transforms.

One convention: right-handed rotations acting on column vectors, angles in radians,
``target_from_source`` matrices, so that products read by touching names.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

_SMALL_ANGLE_SQUARED = 1e-8


def skew(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Cross-product matrices: ``skew(a) @ b == cross(a, b)``."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return rows.reshape(*vectors.shape[:-1], 3, 3)


def matrix_from_axis_angle(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula, smooth (value and gradient) at zero rotation.

    Args:
        axis_angle: rotation axis times angle, radians.

    Returns:
        Rotation matrices.

    Source: paper appendix A, the function R of the bone-transform equation.
    """
    squared = (axis_angle * axis_angle).sum(-1)
    is_small = squared < _SMALL_ANGLE_SQUARED
    safe = torch.where(is_small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    # Below the threshold the Taylor series is exact to float64 rounding of its second term.
    sine_ratio = torch.where(is_small, 1 - squared / 6, angle.sin() / angle)
    cosine_ratio = torch.where(is_small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    cross = skew(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return (
        identity
        + sine_ratio[..., None, None] * cross
        + cosine_ratio[..., None, None] * (cross @ cross)
    )


def left_jacobian(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """What a small change of the axis-angle turns by: ``R(a + d) = R(left_jacobian(a) @ d) R(a)``.

    Args:
        axis_angle: rotation axis times angle, radians.

    Returns:
        Matrices from changes of axis-angle to rotations, both in radians, to first order.
    """
    squared = (axis_angle * axis_angle).sum(-1)
    # Angle less sine cancels earlier than what Rodrigues' formula needs.
    is_small = squared < 1e-4
    safe = torch.where(is_small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(is_small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    second = torch.where(is_small, 1 / 6 - squared / 120, (angle - angle.sin()) / (safe * angle))
    cross = skew(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def axis_angle_from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Inverse of :func:`matrix_from_axis_angle`, angles in [0, pi].

    Goes through the unit quaternion with the largest component kept positive, which stays
    accurate at 0 and at pi.
    """
    quaternion = quaternion_from_matrix(matrix)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = xyz.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    is_small = sine < 1e-7
    ratio = torch.where(
        is_small, torch.full_like(sine, 2.0), angle / sine.clamp_min(torch.finfo(sine.dtype).tiny)
    )
    return ratio * xyz


def rotations_between(
    first: Float[Tensor, "*batch 3 3"],
    second: Float[Tensor, "*batch 3 3"],
    share: Float[Tensor, "*parts"] | float,
) -> Float[Tensor, "*batch 3 3"]:
    """Rotations part of the shortest way from one to another.

    Args:
        first: where ``share`` is 0.
        second: where it is 1.
        share: of the way, as it is multiplied with axis-angle vectors.
    """
    turn = axis_angle_from_matrix(first.transpose(-1, -2) @ second)
    return first @ matrix_from_axis_angle(share * turn)


def nearest_rotations(
    rotations: Float[Tensor, "*n 3"], reference: Float[Tensor, "*#n 3"]
) -> Float[Tensor, "*n 3"]:
    """The same rotations as the axis-angle vectors nearest to others: a half turn has two."""
    angle = rotations.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(rotations.dtype).tiny)
    other = rotations - 2 * math.pi * (rotations / angle)
    is_nearer = (other - reference).norm(dim=-1) < (rotations - reference).norm(dim=-1)
    return torch.where(is_nearer[..., None], other, rotations)


def mean_rotation(rotations: Float[Tensor, "rotations 3"]) -> Float[Tensor, "3"]:
    """The rotation that is nearest to all, in the sum of squared differences of their matrices.

    Args:
        rotations: axis-angle, at least one.

    Returns:
        Axis-angle, at most half a turn.
    """
    left, _, right = torch.linalg.svd(matrix_from_axis_angle(rotations.double()).mean(0))
    flip = torch.ones(3, dtype=torch.float64, device=rotations.device)
    flip[2] = torch.linalg.det(left @ right).sign()
    return axis_angle_from_matrix(left @ torch.diag(flip) @ right).to(rotations)


def quaternion_from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (w, x, y, z) with w >= 0."""
    m = matrix
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # Four equivalent forms, one per largest component; the best conditioned is taken.
    squares = torch.stack(
        [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1
    )
    a, b, c = (
        m[..., 2, 1] - m[..., 1, 2],
        m[..., 0, 2] - m[..., 2, 0],
        m[..., 1, 0] - m[..., 0, 1],
    )
    d, e, f = (
        m[..., 1, 0] + m[..., 0, 1],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 2, 1] + m[..., 1, 2],
    )
    forms = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], -1),
            torch.stack([a, squares[..., 1], d, e], -1),
            torch.stack([b, d, squares[..., 2], f], -1),
            torch.stack([c, e, f, squares[..., 3]], -1),
        ],
        dim=-2,
    )
    best = squares.argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    quaternion = torch.nn.functional.normalize(forms.gather(-2, index)[..., 0, :], dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def matrix_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z), which need not have length 1."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def rigid_transform(
    rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Homogeneous matrices from a rotation and a translation."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 0, 3] = 1
    return torch.cat([top, bottom], dim=-2)


def invert_rigid(transform: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Inverse of rigid transforms (rotation and translation only)."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    translation = -(rotation @ transform[..., :3, 3:])[..., 0]
    return rigid_transform(rotation, translation)


def mirror_rigid(transform: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Rigid transforms between mirrored axes: x is turned round on both sides."""
    flip = transform.new_tensor([-1.0, 1.0, 1.0, 1.0])
    return flip[:, None] * transform * flip


def apply_rigid(
    target_from_source: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "*batch points 3"]
) -> Float[Tensor, "*batch points 3"]:
    """Points given in the source frame, returned in the target frame."""
    rotation = target_from_source[..., :3, :3]
    return points @ rotation.transpose(-1, -2) + target_from_source[..., None, :3, 3]
