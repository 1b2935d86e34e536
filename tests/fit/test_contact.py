"""Hands do not pass through themselves."""

import math
from dataclasses import replace

import pytest
import torch
from made_frames import camera_over, observed, points_on, pose_at

from handavatar.fit.contact import Balls, fill_with_balls, overlaps
from handavatar.fit.energy import EnergyOptions
from handavatar.fit.kinematics import Skeleton, moved_pose
from handavatar.fit.shape import ShapeSpace, fixed_shape
from handavatar.fit.solver import Descent, Look
from handavatar.geometry.meshes import is_inside
from handavatar.hand.pose import BONE_NAMES, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import (
    PENETRATION_LIMIT,
    PenetrationProbe,
    rotations_from_angles,
    sample_poses,
)
from handavatar.hand.rig import Rig, ShapedHand

_EXPECTED = 3e-3
_TOUCHING = 1e-5


@pytest.fixture(scope="module")
def balls(rig: Rig) -> Balls:
    """Its balls."""
    return fill_with_balls(rig)


def _found(
    balls: Balls, hand: ShapedHand, space: ShapeSpace, pose: HandPose
) -> tuple[torch.Tensor, torch.Tensor]:
    skeleton = Skeleton.of(hand, pose, space.joint_directions)
    return overlaps(balls, hand, space, skeleton)


def _energies(rig: Rig, balls: Balls, rotations: torch.Tensor) -> torch.Tensor:
    space, hand = fixed_shape(rig), rig.shaped()
    found = [_found(balls, hand, space, HandPose(one, torch.zeros(3)))[0] for one in rotations]
    return torch.stack([(depth / _EXPECTED).square().sum() for depth in found])


def _fist_through_the_palm(rig: Rig) -> torch.Tensor:
    angles = torch.zeros(NUM_BONES, 3)
    for finger in ("index", "middle", "ring", "little"):
        for joint, bend in zip("123", (40.0, 130.0, 90.0), strict=True):
            angles[BONE_NAMES.index(finger + joint), 0] = math.radians(bend)
    return rotations_from_angles(rig, angles[None])


def test_balls_lie_inside_and_all_fingers_have_some(rig: Rig, balls: Balls) -> None:
    vertices = rig.template_vertices
    middles = balls.middles(vertices)
    closed = rig.shaped().posed(HandPose(torch.zeros(16, 3), torch.zeros(3)))
    inside = is_inside(closed.sealed_vertices, rig.sealed_faces, middles)
    assert inside.float().mean() > 0.98
    bones = balls.near.positions(rig.skin_weights).argmax(-1)
    assert (torch.bincount(bones, minlength=NUM_BONES)[1:] >= 3).all()


def test_poses_that_hands_take_cost_nothing_and_fingers_in_the_palm_much(
    rig: Rig, balls: Balls
) -> None:
    rotations = sample_poses(rig, 200, torch.Generator().manual_seed(7))
    depths = PenetrationProbe(rig).depths(rotations)
    energies = _energies(rig, balls, rotations)
    possible, impossible = energies[depths < PENETRATION_LIMIT], energies[depths > 6e-3]
    assert len(impossible) >= 4
    assert possible.quantile(0.9) < 2
    assert impossible.median() > 10
    assert float(_energies(rig, balls, _fist_through_the_palm(rig))) > 100


def test_slopes_are_those_of_the_depths(rig: Rig, balls: Balls) -> None:
    space, hand = ShapeSpace.around(rig, 1.0, 4), rig.shaped()
    pose = HandPose(_fist_through_the_palm(rig)[0], torch.tensor([0.02, -0.01, 0.5]))
    generator = torch.Generator().manual_seed(1)
    direction = torch.nn.functional.normalize(torch.randn(51, generator=generator), dim=0)
    depth, jacobian = _found(balls, hand, space, pose)
    here = _all_depths(balls, hand, space, pose)
    # Some pairs just touch, whatever the pose: those that do not move against each other.
    jacobian = jacobian[depth > _TOUCHING]
    touching = here > _TOUCHING
    assert len(jacobian) == touching.sum() > 20
    step = 3e-3
    ends = [
        _all_depths(balls, hand, space, moved_pose(pose, sign * step * direction))
        for sign in (1, -1)
    ]
    slope = ((ends[0] - ends[1]) / (2 * step))[touching]
    torch.testing.assert_close(jacobian[:, :51] @ direction, slope, rtol=0.02, atol=2e-4)
    shapes = torch.randn(len(space.sigmas), generator=generator) * space.sigmas * 1e-2
    bigger = _all_depths(balls, space.shaped(hand, shapes), space, pose)[touching]
    smaller = _all_depths(balls, space.shaped(hand, -shapes), space, pose)[touching]
    torch.testing.assert_close(
        jacobian[:, 51:] @ shapes, (bigger - smaller) / 2, rtol=0.02, atol=2e-6
    )


def _all_depths(balls: Balls, hand: ShapedHand, space: ShapeSpace, pose: HandPose) -> torch.Tensor:
    """Of all pairs, also those that do not overlap: below zero."""
    wide = replace(balls, reach=balls.reach + 0.5)
    return _found(wide, hand, space, pose)[0] - 0.5


def test_a_finger_comes_out_of_the_palm_but_not_where_hands_may_pass_through(
    rig: Rig, balls: Balls
) -> None:
    """The same outline, seen from the back, whether fingers lie on the palm or in it."""
    hand, camera = rig.shaped(), camera_over(96)
    inside = HandPose(_fist_through_the_palm(rig), torch.zeros(1, 3))
    seen = observed(hand, pose_at(inside, 0), camera)

    def found(contact_error: float) -> float:
        points = points_on(hand)
        descent = Descent(
            observations=[seen],
            times=torch.zeros(1),
            tracked=inside,
            information=torch.diag(torch.tensor([300.0] * 48 + [1e4] * 3))[None],
            points_of=lambda shared, frame: points,
            shared_sigmas=points.space.sigmas,
            options=EnergyOptions(contact_error=contact_error),
            is_sequence=False,
            poses=inside,
            shared=torch.zeros(0),
            threads=1,
        )
        descent.step_poses(Look(0.7, 1.5), 12)
        return float(_energies(rig, balls, descent.poses.rotations))

    passing, stopped = found(math.inf), found(EnergyOptions().contact_error)
    assert passing > 10
    assert stopped < 0.5 * passing, (passing, stopped)
