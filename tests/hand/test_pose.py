"""Bone transforms and skinning: laws, and the slow loop over bones and vertices."""

import pytest
import torch
from torch import Tensor

from handavatar.geometry.rotations import apply_rigid, matrix_from_axis_angle, rigid_transform
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import (
    BONE_NAMES,
    BONE_PARENTS,
    CONNECTED_PAIRS,
    FINGER_BONES,
    NUM_BONES,
    HandPose,
    bone_transforms,
    linear_blend_skinning,
    skinning_jacobian,
)
from handavatar.hand.rig import ShapedHand


def _poses(count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return 0.6 * torch.randn(count, NUM_BONES, 3, generator=generator, dtype=dtype)


def _joints(dtype: torch.dtype = torch.float64) -> Tensor:
    rig = load_open_hand("778")
    return (rig.joint_regressor @ rig.template_vertices).to(dtype)


def _transforms_slowly(rotations: Tensor, joints: Tensor) -> Tensor:
    """Product over the chain of ancestors, each a rotation about its own joint."""
    result = []
    for bone in range(NUM_BONES):
        chain = [bone]
        while BONE_PARENTS[chain[0]] >= 0:
            chain.insert(0, BONE_PARENTS[chain[0]])
        total = torch.eye(4, dtype=rotations.dtype)
        for ancestor in chain:
            shift, turn, back = (torch.eye(4, dtype=rotations.dtype) for _ in range(3))
            shift[:3, 3], back[:3, 3] = joints[ancestor], -joints[ancestor]
            turn[:3, :3] = matrix_from_axis_angle(rotations[ancestor])
            total = total @ shift @ turn @ back
        place = torch.eye(4, dtype=rotations.dtype)
        place[:3, 3] = joints[bone]
        result.append(total @ place)
    return torch.stack(result)


def test_bone_transforms_agree_with_turning_about_every_joint_in_turn() -> None:
    joints = _joints()
    for rotations in _poses(3):
        torch.testing.assert_close(
            bone_transforms(rotations, joints), _transforms_slowly(rotations, joints)
        )


def test_the_zero_pose_puts_every_bone_at_its_joint() -> None:
    joints = _joints()
    transforms = bone_transforms(torch.zeros(NUM_BONES, 3, dtype=torch.float64), joints)
    torch.testing.assert_close(transforms[:, :3, 3], joints)
    torch.testing.assert_close(
        transforms[:, :3, :3], torch.eye(3, dtype=torch.float64).expand(NUM_BONES, 3, 3)
    )


def test_turning_a_joint_moves_only_what_hangs_on_it() -> None:
    joints = _joints()
    still, turned = torch.zeros(2, NUM_BONES, 3, dtype=torch.float64)
    turned[BONE_NAMES.index("ring2")] = torch.tensor([0.3, 0.2, -0.5])
    moved = (bone_transforms(turned, joints) - bone_transforms(still, joints)).abs().amax((1, 2))
    assert [BONE_NAMES[b] for b in (moved > 1e-9).nonzero()[:, 0]] == ["ring2", "ring3"]


def test_skinning_agrees_with_a_loop_over_vertices_and_bones() -> None:
    rig = load_open_hand("778")
    joints, rotations = _joints(), _poses(1)[0]
    world_from_bone = bone_transforms(rotations, joints)
    rest, weights = rig.template_vertices.double(), rig.skin_weights.double()
    found = linear_blend_skinning(rest, weights, world_from_bone, joints)
    for index in range(0, rig.num_vertices, 37):
        expected = torch.zeros(3, dtype=torch.float64)
        for bone in range(NUM_BONES):
            bone_from_rest = torch.eye(4, dtype=torch.float64)
            bone_from_rest[:3, 3] = -joints[bone]
            vertex = torch.cat([rest[index], torch.ones(1, dtype=torch.float64)])
            moved = world_from_bone[bone] @ bone_from_rest @ vertex
            expected += weights[index, bone] * moved[:3]
        torch.testing.assert_close(found[index], expected)


def test_the_zero_pose_returns_the_rest_hand() -> None:
    rig = load_open_hand("778")
    posed = rig.shaped().posed(HandPose.flat())
    torch.testing.assert_close(posed.vertices, rig.template_vertices, atol=1e-7, rtol=0)


def test_the_wrist_moves_the_whole_hand_rigidly() -> None:
    rig = load_open_hand("778")
    hand = rig.shaped(torch.randn(10, generator=torch.Generator().manual_seed(1)))
    rotations = _poses(1, torch.float32)[0]
    rotations[0] = 0
    still = hand.posed(HandPose(rotations, torch.zeros(3)))
    turn, shift = torch.tensor([0.4, -1.1, 0.3]), torch.tensor([0.1, 0.2, 0.7])
    rotations = torch.cat([turn[None], rotations[1:]])
    moved = hand.posed(HandPose(rotations, shift))
    world_from_still = moved.world_from_bone[0] @ torch.linalg.inv(still.world_from_bone[0])
    expected = apply_rigid(world_from_still, still.vertices)
    torch.testing.assert_close(moved.vertices, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(moved.joints[0], hand.rest_joints[0] + shift)


def test_a_batch_of_poses_equals_one_at_a_time() -> None:
    hand = load_open_hand("778").shaped()
    rotations = _poses(4, torch.float32)
    translation = torch.randn(4, 3, generator=torch.Generator().manual_seed(2))
    together = hand.posed(HandPose(rotations, translation)).vertices
    for index in range(4):
        alone = hand.posed(HandPose(rotations[index], translation[index])).vertices
        torch.testing.assert_close(together[index], alone, atol=1e-6, rtol=0)


def test_the_gradient_of_skinning() -> None:
    generator = torch.Generator().manual_seed(3)
    rest = 0.1 * torch.randn(5, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(5, NUM_BONES, generator=generator, dtype=torch.float64)
    weights = weights / weights.sum(-1, keepdim=True)
    joints = _joints()

    def skinned(rotations: Tensor, rest: Tensor) -> Tensor:
        return linear_blend_skinning(rest, weights, bone_transforms(rotations, joints), joints)

    rotations = _poses(1)[0].requires_grad_()
    assert torch.autograd.gradcheck(skinned, (rotations, rest.requires_grad_()))
    # At the flat hand every angle is zero, the delicate point of Rodrigues' formula.
    flat = torch.zeros(NUM_BONES, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(skinned, (flat, rest))


@pytest.mark.parametrize("size", [0.0, 0.4, 2.5])
def test_the_skinning_jacobian_is_that_of_automatic_differentiation(size: float) -> None:
    hand = load_open_hand("778").shaped()
    generator = torch.Generator().manual_seed(5)
    rotations = size * torch.randn(NUM_BONES, 3, generator=generator, dtype=torch.float64)
    rest, joints = hand.rest_vertices[::9].double(), hand.rest_joints.double()
    weights = hand.rig.skin_weights[::9].double()

    def posed(values: Tensor) -> Tensor:
        return linear_blend_skinning(rest, weights, bone_transforms(values, joints), joints)

    transforms = bone_transforms(rotations, joints)
    found = skinning_jacobian(rest, weights, rotations, transforms, joints)
    torch.testing.assert_close(found, torch.func.jacfwd(posed)(rotations), rtol=1e-8, atol=1e-10)


def test_the_bone_tree_is_five_chains_on_a_wrist() -> None:
    assert all(parent < bone for bone, parent in enumerate(BONE_PARENTS))
    assert len(CONNECTED_PAIRS) == 15
    assert sorted(b for bones in FINGER_BONES.values() for b in bones) == list(range(1, 16))
    for first, second, third in FINGER_BONES.values():
        assert [BONE_PARENTS[b] for b in (first, second, third)] == [0, first, second]


def test_a_hand_in_other_axes_turns_about_its_own_wrist() -> None:
    """Wherever its rest wrist lies: vertices and pose move alike."""
    rig = load_open_hand("778")
    aside, hand = torch.tensor([0.1, -0.05, 0.2]), rig.shaped()
    hand = ShapedHand(rig, hand.rest_vertices + aside, hand.rest_joints + aside)
    generator = torch.Generator().manual_seed(0)
    pose = HandPose(
        0.3 * torch.randn(NUM_BONES, 3, generator=generator), torch.tensor([0.3, 0.1, 0.5])
    )
    turn = matrix_from_axis_angle(torch.tensor([0.4, -0.9, 0.2]))
    other = rigid_transform(turn, torch.tensor([0.2, 0.1, -0.3]))
    moved = hand.posed(pose.moved_to(other, hand.rest_joints[0])).vertices
    torch.testing.assert_close(
        moved, apply_rigid(other, hand.posed(pose).vertices), atol=1e-5, rtol=0
    )
