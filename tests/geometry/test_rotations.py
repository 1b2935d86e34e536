"""Rotations and rigid transforms: laws, scipy as reference, gradients at the delicate points."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from handavatar.geometry.rotations import (
    apply_rigid,
    axis_angle_from_matrix,
    invert_rigid,
    left_jacobian,
    matrix_from_axis_angle,
    mean_rotation,
    nearest_rotations,
    quaternion_from_matrix,
    rigid_transform,
    skew,
)


def _axis_angles(count: int = 200) -> torch.Tensor:
    """Random axes; angles from 0 to pi, both ends and tiny ones included."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    angles = math.pi * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    ends = [0, 1e-12, 1e-6, 1e-3, math.pi - 1e-6, math.pi]
    angles[:6, 0] = torch.tensor(ends, dtype=torch.float64)
    return axes * angles


def test_matrices_agree_with_scipy() -> None:
    axis_angles = _axis_angles()
    expected = torch.from_numpy(Rotation.from_rotvec(axis_angles.numpy()).as_matrix())
    torch.testing.assert_close(matrix_from_axis_angle(axis_angles), expected, atol=1e-12, rtol=0)


def test_axis_angles_return_at_zero_and_at_pi() -> None:
    axis_angles = _axis_angles()
    found = axis_angle_from_matrix(matrix_from_axis_angle(axis_angles))
    # At pi both axes are right.
    same = (found - axis_angles).norm(dim=-1)
    opposite = (found + axis_angles).norm(dim=-1)
    is_half_turn = axis_angles.norm(dim=-1) > math.pi - 1e-3
    assert float(torch.where(is_half_turn, torch.minimum(same, opposite), same).max()) < 1e-7


def test_rotations_keep_lengths_and_orientation() -> None:
    matrix = matrix_from_axis_angle(_axis_angles())
    identity = torch.eye(3, dtype=torch.float64).expand_as(matrix)
    torch.testing.assert_close(matrix @ matrix.transpose(-1, -2), identity, atol=1e-12, rtol=0)
    torch.testing.assert_close(matrix.det(), torch.ones(len(matrix), dtype=torch.float64))


def test_quaternions_agree_with_scipy() -> None:
    matrix = matrix_from_axis_angle(_axis_angles())
    expected = torch.from_numpy(Rotation.from_matrix(matrix.numpy()).as_quat(canonical=True))
    expected = expected[:, [3, 0, 1, 2]]
    found = quaternion_from_matrix(matrix)
    dot = (found * expected).sum(-1).abs()  # q and -q are the same rotation
    torch.testing.assert_close(dot, torch.ones_like(dot))
    assert float(found[:, 0].min()) >= 0


@pytest.mark.parametrize("angle", [0.0, 1e-9, 5e-5, 1e-3, 1.0, 3.1])
def test_the_gradient_is_right_at_every_angle(angle: float) -> None:
    axis = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    axis_angle = (angle * axis).requires_grad_()
    assert torch.autograd.gradcheck(matrix_from_axis_angle, (axis_angle,), eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.0099, 0.0101, 1.0, 3.0])
def test_the_left_jacobian_is_what_a_small_change_turns_by(angle: float) -> None:
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -0.7, 0.5]).double(), dim=0)

    def spin(change: torch.Tensor) -> torch.Tensor:
        turned = matrix_from_axis_angle(angle * axis + change)
        return turned @ matrix_from_axis_angle(angle * axis).T

    slope = torch.func.jacrev(spin)(torch.zeros(3).double())
    expected = torch.stack([slope[2, 1], slope[0, 2], slope[1, 0]])
    found = left_jacobian(angle * axis)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)


def test_skew_is_the_cross_product() -> None:
    a, b = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(1))
    product = (skew(a) @ b[..., None])[..., 0]
    torch.testing.assert_close(product, torch.linalg.cross(a, b))


def test_rigid_transforms_compose_and_invert() -> None:
    generator = torch.Generator().manual_seed(2)
    a, b = (
        rigid_transform(
            matrix_from_axis_angle(_axis_angles(7)[torch.randperm(7, generator=generator)]),
            torch.randn(7, 3, generator=generator, dtype=torch.float64),
        )
        for _ in range(2)
    )
    points = torch.randn(7, 11, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(apply_rigid(a @ b, points), apply_rigid(a, apply_rigid(b, points)))
    torch.testing.assert_close(apply_rigid(invert_rigid(a), apply_rigid(a, points)), points)
    torch.testing.assert_close(invert_rigid(a), torch.linalg.inv(a))


def test_nearest_rotations_mean_the_same_and_lie_nearer() -> None:
    given, reference = _axis_angles(), _axis_angles().roll(7, 0)
    found = nearest_rotations(given, reference)
    torch.testing.assert_close(matrix_from_axis_angle(found), matrix_from_axis_angle(given))
    assert bool(((found - reference).norm(dim=-1) <= (given - reference).norm(dim=-1)).all())
    assert bool((found != given).any()) and bool((found == given).all(-1).any())
    # A turn too small to see has its other vector a whole turn away, whatever the reference.
    tiny = torch.tensor([[1e-12, 0.0, 0.0]], dtype=torch.float64)
    assert torch.equal(nearest_rotations(tiny, torch.tensor([[-1.0, 0, 0]]).double()), tiny)
    # Nearest to none at all: at most half a turn.
    turned = torch.tensor([[0.0, 4.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    expected = torch.tensor([[0.0, 4.0 - 2 * math.pi, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(nearest_rotations(turned, torch.zeros(3)), expected)


def test_the_mean_of_turns_far_apart_is_a_rotation_and_the_nearest() -> None:
    """Three of them: the matrix in their middle is a mirror."""
    generator = torch.Generator().manual_seed(11)
    given = 2.2 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    matrices = matrix_from_axis_angle(given)
    assert float(torch.linalg.det(matrices.mean(0))) < 0

    def apart(rotations: torch.Tensor) -> torch.Tensor:
        each = matrix_from_axis_angle(rotations)[:, None] - matrices
        return each.square().sum((-1, -2, -3))

    least = float(apart(_axis_angles(5000)).min())
    assert float(apart(mean_rotation(given)[None])[0]) <= least + 1e-9


def test_the_mean_rotation_agrees_with_scipy() -> None:
    middle = Rotation.from_rotvec([1.5, -2.0, 1.6])
    generator = torch.Generator().manual_seed(1)
    turns = 0.5 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    given = (middle * Rotation.from_rotvec(turns.numpy())).as_rotvec()
    found = mean_rotation(torch.from_numpy(given))
    expected = torch.from_numpy(Rotation.from_rotvec(given).mean().as_rotvec())
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
