"""Bones point where they did, whichever hand takes the pose."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from mano_files import write_mano

from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.mano import read_mano
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import BONE_PARENTS, FINGER_BONES, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import rotations_from_angles, sample_poses
from handavatar.hand.retargeting import (
    chain_rotations,
    local_rotations,
    palm_frame,
    rest_frames,
    retarget,
)
from handavatar.hand.rig import Rig


def random_matrices(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return matrix_from_axis_angle(torch.randn(count, NUM_BONES, 3, generator=generator).double())


def other_rest() -> Rig:
    """The open hand at rest in a pose of its own, wrist included: fingers apart, thumb out."""
    rig = load_open_hand("778")
    angles = torch.zeros(NUM_BONES, 3)
    for bones, spread in zip(FINGER_BONES.values(), (0.3, 0.2, 0.05, -0.1, -0.2), strict=True):
        angles[bones[0], 1] = spread
        angles[list(bones), 0] = 0.15
    rotations = rotations_from_angles(rig, angles)
    rotations[0] = torch.tensor([0.1, -0.2, 0.3])
    pose = HandPose(rotations, torch.zeros(3))
    posed = rig.shaped().posed(pose)
    axes = rig.joint_axes @ posed.world_from_bone[:, :3, :3].mT
    # Joints are regressed as they were posed: one vertex for each lies there.
    vertices = torch.cat([posed.vertices, posed.joints])
    regressor = torch.cat([torch.zeros(NUM_BONES, rig.num_vertices), torch.eye(NUM_BONES)], dim=1)
    count = NUM_BONES
    return replace(
        rig,
        template_vertices=vertices,
        joint_regressor=regressor,
        skin_weights=torch.cat([rig.skin_weights, torch.eye(count)]),
        shape_directions=torch.cat([rig.shape_directions, torch.zeros(count, 3, 10)]),
        joint_axes=axes,
        pose_directions=torch.zeros(rig.num_vertices + count, 3, 0),
    )


def test_chains_and_local_rotations_are_inverse() -> None:
    rotations = random_matrices(5)
    torch.testing.assert_close(local_rotations(chain_rotations(rotations)), rotations)
    bone = 9
    expected = rotations[:, 0] @ rotations[:, 7] @ rotations[:, 8] @ rotations[:, 9]
    assert BONE_PARENTS[bone] == 8
    torch.testing.assert_close(chain_rotations(rotations)[:, bone], expected)


def test_the_palms_frame_is_that_of_the_rest_axes_in_the_open_hand() -> None:
    """By construction of the open hand: fingers -x, back +y, thumb side +z."""
    frames = rest_frames(load_open_hand())
    torch.testing.assert_close(frames[0], torch.eye(3).double(), atol=1e-5, rtol=0)
    identity = torch.eye(3).double().expand(NUM_BONES, 3, 3)
    torch.testing.assert_close(frames @ frames.mT, identity, atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(NUM_BONES).double())


def test_a_palms_frame_turns_with_the_palm() -> None:
    points = torch.randn(4, 3, generator=torch.Generator().manual_seed(1)).double()
    turn = random_matrices(1)[0, 0]
    torch.testing.assert_close(palm_frame(*(points @ turn.T)), palm_frame(*points) @ turn.T)


def test_a_hand_takes_its_own_poses_as_they_are() -> None:
    frames, rotations = rest_frames(load_open_hand()), random_matrices(3)
    torch.testing.assert_close(retarget(rotations, frames, frames), rotations, atol=1e-6, rtol=0)


@pytest.mark.parametrize("is_to", [True, False])
def test_bones_point_where_they_did(is_to: bool) -> None:
    """Joint to joint in the world, between hands whose rest poses differ by up to 0.3 rad."""
    source, target = load_open_hand("778"), other_rest()
    if not is_to:
        source, target = target, source
    rotations = sample_poses(source, 8, torch.Generator().manual_seed(2))
    rotations[:, 0] = torch.tensor([0.5, 1.0, -0.7])
    carried = retarget(
        matrix_from_axis_angle(rotations.double()), rest_frames(source), rest_frames(target)
    )
    poses = [rotations, axis_angle_from_matrix(carried).float()]
    joints = [
        rig.shaped().posed(HandPose(pose, torch.zeros(8, 3))).joints
        for rig, pose in zip((source, target), poses, strict=True)
    ]
    for bones in FINGER_BONES.values():
        for bone, child in pairwise(bones):
            first, second = (
                torch.nn.functional.normalize(joint[:, child] - joint[:, bone], dim=-1)
                for joint in joints
            )
            # Both rigs' twist axes lie along the bones to within two thousandths.
            assert float((first - second).norm(dim=-1).max()) < 5e-3
    # And the rest pose of one is no longer that of the other: it did something.
    assert float((poses[0] - poses[1]).abs().max()) > 0.1


def test_a_mano_file_made_of_the_open_hand_gives_its_vertices_back(tmp_path: Path) -> None:
    """Vertices agree, though its fingertips are defined elsewhere: last bones bend as they did."""
    mano = read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl", posedirs=np.zeros((778, 3, 135)))).rig
    open_hand = load_open_hand("778")
    rotations = sample_poses(mano, 6, torch.Generator().manual_seed(3))
    carried = retarget(
        matrix_from_axis_angle(rotations.double()), rest_frames(mano), rest_frames(open_hand)
    )
    theirs = mano.shaped().posed(HandPose(rotations, torch.zeros(6, 3)))
    place = theirs.joints[:, 0]
    ours = open_hand.shaped().posed(HandPose(axis_angle_from_matrix(carried).float(), place))
    rest = mano.template_vertices - mano.shaped().rest_joints[0]
    same = torch.cdist(rest, open_hand.template_vertices).argmin(1)
    error = (theirs.vertices - ours.vertices[:, same]).norm(dim=-1)
    assert float(error.max()) < 1e-4
