"""Capsules around the bones: where they are, and what they hide."""

import math

import pytest
import torch

from handavatar.export.capsules import REACH, Capsules, fit_capsules, occlusion_by_bones
from handavatar.geometry.meshes import vertex_normals
from handavatar.geometry.rotations import apply_rigid, matrix_from_axis_angle, rigid_transform
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import Rig


@pytest.fixture(scope="module")
def capsules(rig: Rig) -> Capsules:
    return fit_capsules(rig.shaped())


def test_every_bone_has_a_capsule_and_the_palm_one_to_each_finger(capsules: Capsules) -> None:
    assert capsules.bones.tolist() == [0] * 5 + list(range(1, NUM_BONES))
    assert float(capsules.radii.min()) > 3e-3 and float(capsules.radii.max()) < 30e-3
    lengths = capsules.ends.diff(dim=1).norm(dim=-1)[:, 0]
    assert float(lengths.min()) > 5e-3


def test_the_skin_lies_on_its_bone_s_capsules(rig: Rig, capsules: Capsules) -> None:
    hand = rig.shaped()
    owner = rig.skin_weights.argmax(-1)
    ends = capsules.posed(hand.posed(HandPose.flat()).world_from_bone)
    shares = torch.linspace(0, 1, 101)
    axis = ends[:, :1] + shares[:, None] * ends.diff(dim=1)
    radii = capsules.radii[:, :1] + shares * capsules.radii.diff(dim=1)
    gap = (hand.rest_vertices[:, None, None] - axis).norm(dim=-1) - radii
    own = gap.amin(-1).masked_fill(capsules.bones != owner[:, None], math.inf).amin(-1)
    # Of a hand's flesh: a palm is no set of cones.
    assert float(own.abs().mean()) < 2.5e-3


def test_occlusion_is_that_of_the_slow_loop(rig: Rig, capsules: Capsules) -> None:
    generator = torch.Generator().manual_seed(2)
    posed = rig.shaped().posed(HandPose(sample_poses(rig, 1, generator)[0], torch.zeros(3)))
    ends = capsules.posed(posed.world_from_bone)
    chosen = torch.randperm(rig.num_vertices, generator=generator)[:20]
    points = posed.vertices[chosen]
    normals = vertex_normals(posed.vertices, rig.faces)[chosen]
    found = occlusion_by_bones(ends, capsules.radii, capsules.bones, points, normals)
    shares = torch.linspace(0, 1, 20001, dtype=torch.float64)
    for row, point in enumerate(points.double()):
        near, filled = [0.0] * NUM_BONES, [0.0] * NUM_BONES
        for number, bone in enumerate(capsules.bones.tolist()):
            start, end = ends[number].double()
            places = start + shares[:, None] * (end - start)
            distances = (places - point).norm(dim=-1)
            at = int(distances.argmin())
            first, second = capsules.radii[number].tolist()
            distance, radius = float(distances[at]), first + float(shares[at]) * (second - first)
            cosine = float((places[at] - point) @ normals[row].double()) / distance
            near[bone] = max(near[bone], math.exp(-max(distance - radius, 0) / REACH))
            filled[bone] = max(filled[bone], min(1, (radius / distance) ** 2) * max(cosine, 0))
        # The loop's axis has gaps of a micrometre.
        torch.testing.assert_close(found[row, 0], torch.tensor(near), atol=1e-3, rtol=0)
        torch.testing.assert_close(found[row, 1], torch.tensor(filled), atol=1e-3, rtol=0)


def test_occlusion_does_not_depend_on_where_the_hand_is(rig: Rig, capsules: Capsules) -> None:
    hand = rig.shaped()
    ends = capsules.posed(hand.posed(HandPose.flat()).world_from_bone)
    normals = vertex_normals(hand.rest_vertices, rig.faces)
    here = occlusion_by_bones(ends, capsules.radii, capsules.bones, hand.rest_vertices, normals)
    turn = matrix_from_axis_angle(torch.tensor([0.4, -1.0, 0.7]))
    moved = rigid_transform(turn, torch.tensor([0.2, -0.1, 0.4]))
    there = occlusion_by_bones(
        apply_rigid(moved, ends.flatten(0, 1)).view_as(ends),
        capsules.radii,
        capsules.bones,
        apply_rigid(moved, hand.rest_vertices),
        normals @ turn.T,
    )
    torch.testing.assert_close(here, there, atol=1e-3, rtol=0)


def test_what_is_far_or_behind_hides_nothing(capsules: Capsules) -> None:
    ends = torch.tensor([[[0.0, 0, 0], [0.02, 0, 0]]])
    radii = torch.tensor([[0.01, 0.01]])
    points = torch.tensor([[0.01, 0.03, 0.0], [0.01, 0.03, 0.0], [0.01, 1.0, 0.0]])
    normals = torch.tensor([[0.0, -1, 0], [0.0, 1, 0], [0.0, -1, 0]])
    near, filled = occlusion_by_bones(ends, radii, torch.tensor([4]), points, normals)[:, :, 4].T
    assert filled.tolist() == pytest.approx([1 / 9, 0, 1e-4], abs=1e-6)
    assert near.tolist() == pytest.approx([math.exp(-0.02 / REACH)] * 2 + [0], abs=1e-6)
