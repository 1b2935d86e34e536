"""How points of a posed hand move, against finite differences and the skinning itself."""

from dataclasses import replace

import pytest
import torch
from made_frames import calm_poses, camera_over, in_double, pose_at

from handavatar.fit.kinematics import (
    NUM_UNKNOWNS,
    RestPoints,
    Skeleton,
    moved_pose,
    pixel_jacobian,
    pose_difference,
    rest_with_pose,
)
from handavatar.fit.landmarks import landmark_rest
from handavatar.fit.shape import ShapeSpace
from handavatar.geometry.cameras import project
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import Rig, ShapedHand

STEP = 1e-5
"""Of central differences in float64: their error is about its square, 1e-10."""


def _pose(rig: Rig, seed: int = 3) -> HandPose:
    return pose_at(calm_poses(rig, 1, seed), 0)


def _double(pose: HandPose) -> HandPose:
    return HandPose(pose.rotations.double(), pose.translation.double())


def _space(rig: Rig) -> ShapeSpace:
    """Three numbers of a shape that moves joints as well."""
    generator = torch.Generator().manual_seed(2)
    around = ShapeSpace.around(rig, 0.5, 2)
    chosen = torch.randperm(around.directions.shape[-1], generator=generator)[:3]
    return ShapeSpace(
        around.directions[..., chosen].double(),
        around.joint_directions[..., chosen].double(),
        around.sigmas[chosen].double(),
    )


def _vertices(hand: ShapedHand, directions: torch.Tensor) -> RestPoints:
    return RestPoints(hand.rest_vertices, hand.rig.skin_weights, directions)


def test_positions_are_those_of_the_posed_hand(rig: Rig) -> None:
    generator = torch.Generator().manual_seed(5)
    # With pose blend shapes of about a millimetre, as MANO has them.
    blended = replace(rig, pose_directions=1e-3 * torch.randn(778, 3, 135, generator=generator))
    for source in (rig, blended):
        pose = _pose(source)
        hand = rest_with_pose(source.shaped(torch.linspace(-1, 1, 10)), pose)
        skeleton = Skeleton.of(hand, pose, torch.zeros(NUM_BONES, 3, 0))
        found = skeleton.positions(_vertices(hand, torch.zeros(778, 3, 0)))
        expected = source.shaped(torch.linspace(-1, 1, 10)).posed(pose).vertices
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)


def test_the_jacobian_is_the_slope_of_the_positions(rig: Rig) -> None:
    hand, pose, space = in_double(rig.shaped()), _double(_pose(rig)), _space(rig)

    def positions(change: torch.Tensor) -> torch.Tensor:
        shaped = space.shaped(hand, change[NUM_UNKNOWNS:])
        moved = moved_pose(pose, change[:NUM_UNKNOWNS])
        skeleton = Skeleton.of(shaped, moved, space.joint_directions)
        return skeleton.positions(_vertices(shaped, space.directions))

    skeleton = Skeleton.of(hand, pose, space.joint_directions)
    jacobian = skeleton.jacobian(_vertices(hand, space.directions))
    assert jacobian.shape == (778, 3, NUM_UNKNOWNS + 3)
    for unknown in range(NUM_UNKNOWNS + 3):
        change = torch.zeros(NUM_UNKNOWNS + 3, dtype=torch.float64)
        change[unknown] = STEP
        slope = (positions(change) - positions(-change)) / (2 * STEP)
        # A row of the rig's float32 weights sums to one within 6e-8; a shift counts it as one.
        torch.testing.assert_close(jacobian[..., unknown], slope, rtol=0, atol=1e-7)


def test_offsets_of_landmarks_turn_with_their_bones(rig: Rig) -> None:
    hand, pose, space = in_double(rig.shaped()), _double(_pose(rig)), _space(rig)
    num_shared = 3 + 63

    def positions(shared: torch.Tensor) -> torch.Tensor:
        shaped = space.shaped(hand, shared[:3])
        rest = landmark_rest(shaped, space, shared[3:])
        return Skeleton.of(shaped, pose, space.joint_directions).positions(_in_double(rest))

    rest = _in_double(landmark_rest(hand, space, torch.zeros(63)))
    skeleton = Skeleton.of(hand, pose, space.joint_directions).padded(num_shared)
    jacobian = skeleton.jacobian(rest)[..., NUM_UNKNOWNS:]
    for unknown in range(num_shared):
        change = torch.zeros(num_shared, dtype=torch.float64)
        change[unknown] = STEP
        slope = (positions(change) - positions(-change)) / (2 * STEP)
        torch.testing.assert_close(jacobian[..., unknown], slope, rtol=0, atol=1e-8)


def _in_double(rest: RestPoints) -> RestPoints:
    return RestPoints(rest.positions.double(), rest.skin_weights.double(), rest.directions.double())


def test_moving_and_difference_are_inverse(rig: Rig) -> None:
    start = calm_poses(rig, 5, 1)
    generator = torch.Generator().manual_seed(4)
    change = 0.4 * torch.randn(5, NUM_UNKNOWNS, generator=generator)
    torch.testing.assert_close(
        pose_difference(start, moved_pose(start, change)), change, rtol=0, atol=2e-6
    )
    end = calm_poses(rig, 5, 2)
    there = moved_pose(start, pose_difference(start, end))
    torch.testing.assert_close(
        rig.shaped().posed(there).vertices, rig.shaped().posed(end).vertices, rtol=0, atol=1e-6
    )
    assert not pose_difference(start, start)[:, -3:].any()


@pytest.mark.parametrize("size", [96, 256])
def test_the_pixel_jacobian_is_the_slope_of_the_projection(rig: Rig, size: int) -> None:
    camera = camera_over(size)
    camera = replace(camera, camera_from_world=camera.camera_from_world.double())
    points = rig.template_vertices[::50].double()
    pixels, depths, jacobian = pixel_jacobian(camera, points)
    expected, expected_depths = project(camera, points)
    assert torch.equal(pixels, expected) and torch.equal(depths, expected_depths)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = STEP
        slope = (project(camera, points + step)[0] - project(camera, points - step)[0]) / (2 * STEP)
        # Pixels per metre are some hundreds; third derivatives times the step squared are 1e-6.
        torch.testing.assert_close(jacobian[..., axis], slope, rtol=1e-7, atol=1e-5)
