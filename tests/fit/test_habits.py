"""What hands can do and mostly do, as residuals."""

import math

import pytest
import torch

from handavatar.fit.habits import habit_residuals
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import BONE_NAMES, NUM_BONES
from handavatar.hand.pose_sampling import (
    JOINT_LIMITS,
    limit_bounds,
    limit_excess,
    rotations_from_angles,
    sample_poses,
)
from handavatar.hand.rig import Rig


def _energy(rig: Rig, rotations: torch.Tensor) -> torch.Tensor:
    return habit_residuals(rig, rotations)[0].square().sum(-1)


def _bent(rig: Rig, joint: str, flexion: float, abduction: float = 0.0) -> torch.Tensor:
    angles = torch.zeros(1, NUM_BONES, 3)
    angles[0, BONE_NAMES.index(joint), :2] = torch.tensor([flexion, abduction]).deg2rad()
    return rotations_from_angles(rig, angles)


def _inside(count: int, generator: torch.Generator) -> torch.Tensor:
    """Angles well within all limits: at a limit itself the slope has a kink."""
    part = 0.2 + 0.6 * torch.rand(count, NUM_BONES, 3, generator=generator, dtype=torch.float64)
    part[:, 0] = 0.5
    angles = torch.zeros_like(part)
    for _ in range(2):  # Limits of spreading narrow with the flexion, which comes first.
        least, greatest = limit_bounds(angles)
        angles = least + part * (greatest - least)
    return angles


def test_slopes_are_those_of_the_residuals(rig: Rig) -> None:
    generator = torch.Generator().manual_seed(2)
    rotations = rotations_from_angles(rig, _inside(2, generator))
    # A finger beyond its limits; not sideways, as the slope leaves out that limits of spreading
    # narrow with the bend.
    rotations[0, BONE_NAMES.index("ring2")] = _bent(rig, "ring2", -20)[0, 11].double()
    rotations[:, 0] = torch.randn(2, 3, generator=generator).double()
    jacobian = habit_residuals(rig, rotations)[1].unflatten(-1, (NUM_BONES, 3))
    step = 1e-6
    for bone in range(NUM_BONES):
        for axis in range(3):
            turns = torch.zeros(NUM_BONES, 3, dtype=torch.float64)
            turns[bone, axis] = step
            ends = []
            for sign in (1, -1):
                turned = matrix_from_axis_angle(rotations) @ matrix_from_axis_angle(sign * turns)
                ends.append(habit_residuals(rig, axis_angle_from_matrix(turned))[0])
            slope = (ends[0] - ends[1]) / (2 * step)
            torch.testing.assert_close(jacobian[:, :, bone, axis], slope, rtol=1e-4, atol=1e-4)


def test_natural_poses_are_cheap_and_broken_fingers_dear(rig: Rig) -> None:
    assert float(_energy(rig, torch.zeros(1, NUM_BONES, 3))) == pytest.approx(0, abs=1e-6)
    natural = sample_poses(rig, 200, torch.Generator().manual_seed(0))
    energies = _energy(rig, natural)
    # 45 angles (32 of them of joints that are mostly still) and four that follow: about one each.
    assert float(energies.median()) < 20 and float(energies.max()) < 60
    # 40 degrees backwards are 25 beyond the limit of -15, in units of 4: 39 at the least.
    assert float(_energy(rig, _bent(rig, "middle1", -40))) > (25 / 4) ** 2
    # The middle joint cannot go back at all: 40 degrees are 100.
    assert float(_energy(rig, _bent(rig, "middle2", -40))) > 100
    assert float(_energy(rig, _bent(rig, "middle2", 40))) < 5


def test_where_the_wrist_points_is_no_habit(rig: Rig) -> None:
    rotations = sample_poses(rig, 4, torch.Generator().manual_seed(1))
    turned = rotations.clone()
    turned[:, 0] = torch.tensor([0.3, -2.0, 1.0])
    first, second = habit_residuals(rig, rotations), habit_residuals(rig, turned)
    torch.testing.assert_close(first[0], second[0])
    assert not second[1][..., :3].any()


def test_limits_are_those_of_the_sampler(rig: Rig) -> None:
    """A joint pays for what is beyond its limits exactly where these say that it is."""
    for joint in JOINT_LIMITS:
        inside = math.degrees(0.9 * math.radians(JOINT_LIMITS[joint].flexion[1]))
        beyond = JOINT_LIMITS[joint].flexion[1] + 8
        for flexion in (inside, beyond):
            rotations = _bent(rig, joint, flexion)
            excess = float(limit_excess(rig, rotations).sum())
            residuals = habit_residuals(rig, rotations)[0][0, : 3 * (NUM_BONES - 1)]
            # The first 45 are what is outside, in units of 4 degrees; fixed axes pay elsewhere.
            assert float(residuals.abs().sum()) == pytest.approx(excess / math.radians(4), abs=2e-3)
