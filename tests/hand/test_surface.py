"""Hands from fields: closed, with a flat wrist, the same as dense, finite on bad input."""

from dataclasses import replace

import pytest
import torch
import trimesh
from torch import Tensor

from handavatar.field.occupancy import PairOccupancy
from handavatar.geometry.extraction import ExtractedSurface, extract_surface, num_components
from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.detail import subdivided
from handavatar.hand.parts import Parts, divide_into_parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import PosedHand, Rig, RigError
from handavatar.hand.surface import extract_hand
from handavatar.train.prior import load_prior


@pytest.fixture(scope="module")
def prior() -> PairOccupancy:
    field = PairOccupancy()
    load_prior(field)
    return field


def test_points_of_a_part_reach_a_centimetre_into_its_neighbours(rig: Rig, parts: Parts) -> None:
    """Half of them are its own; the others lie on it and around it."""
    hand = rig.shaped()
    vertices, labels = hand.rest_vertices, parts.vertex_labels
    for bone in range(NUM_BONES):
        corners = parts.corner_indices[bone]
        places = (vertices[corners] * parts.barycentric[bone][..., None]).sum(-2)
        away = torch.cdist(places, vertices[labels == bone]).amin(-1)
        half = len(places) // 2
        has_own = (labels[corners] == bone).any(-1)
        assert bool(has_own[:half].all())
        # On faces of the neighbours alone; their corners lie within the centimetre, their middles
        # are a face's width nearer or farther.
        assert float((~has_own[half:]).float().mean()) > 0.05
        assert float(away[half:].max()) < 0.022


def _fist(rig: Rig) -> PosedHand:
    return rig.shaped().posed(HandPose(gesture_rotations(rig, "fist"), torch.zeros(3)))


def _surface(
    prior: PairOccupancy, parts: Parts, hand: PosedHand, resolution: int = 24
) -> ExtractedSurface:
    with torch.no_grad():
        codes = prior.encode(parts, hand)
        return extract_hand(
            lambda points: prior(codes, points).whole, codes.boxes, hand, resolution
        )


def _assert_closed(surface: ExtractedSurface) -> None:
    assert len(surface.faces) > 100
    assert bool(torch.isfinite(surface.vertices).all())
    solid = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0


def test_a_hand_is_closed_in_one_piece_and_ends_flat_at_the_wrist(
    rig: Rig, parts: Parts, prior: PairOccupancy
) -> None:
    hand = rig.shaped().posed(HandPose(torch.zeros(NUM_BONES, 3), torch.tensor([0.1, 0.2, 0.3])))
    with torch.no_grad():
        codes = prior.encode(parts, hand)
    # Moved towards the forearm the field goes on beyond the wrist, where it must be cut.
    shift = 0.005 * hand.world_from_bone[0, :3, :3] @ codes.boxes.cut_normal

    def moved(points: Tensor) -> Tensor:
        return prior(codes, points - shift).whole

    with torch.no_grad():
        surface = extract_hand(moved, codes.boxes, hand, 64)
    _assert_closed(surface)
    assert num_components(surface) == 1
    boxes = parts.boxes(hand, 0.0)
    local = apply_rigid(boxes.bone_from_world[0], surface.vertices)
    beyond = (local - boxes.cut_point) @ boxes.cut_normal
    # The cut is a plane: found exactly by linear interpolation, and nothing lies beyond.
    assert float(beyond.max()) < 0.01 * surface.voxel
    assert int((beyond > -0.01 * surface.voxel).sum()) > 100


def test_a_prior_is_extracted_adaptively_as_densely(
    rig: Rig, parts: Parts, prior: PairOccupancy
) -> None:
    hand = _fist(rig)
    with torch.no_grad():
        codes = prior.encode(parts, hand)

    def logits(points: Tensor) -> Tensor:
        return torch.special.logit(prior(codes, points).whole, eps=1e-6)

    lower, upper = hand.vertices.amin(0) - 0.005, hand.vertices.amax(0) + 0.005
    dense = extract_surface(logits, lower, upper, 32, coarsest=32)
    adaptive = extract_surface(logits, lower, upper, 32, coarsest=8, seeds=hand.vertices)
    assert adaptive.num_evaluations < 0.6 * dense.num_evaluations
    assert len(adaptive.faces) == len(dense.faces)
    # Chunks of other points round differently in the last bits of float32.
    for ours, theirs in zip(adaptive.vertices.T, dense.vertices.T, strict=True):
        torch.testing.assert_close(ours.sort().values, theirs.sort().values, atol=1e-7, rtol=0)


def test_a_pose_far_outside_all_limits_stays_finite(
    rig: Rig, parts: Parts, prior: PairOccupancy
) -> None:
    rotations = 20 * torch.randn(NUM_BONES, 3, generator=torch.Generator().manual_seed(0))
    hand = rig.shaped().posed(HandPose(rotations, torch.tensor([5.0, -3.0, 2.0])))
    assert bool(torch.isfinite(hand.vertices).all())
    _assert_closed(_surface(prior, parts, hand))


@pytest.mark.parametrize("sigma", [-10.0, 10.0])
def test_a_shape_of_ten_sigma_stays_finite(
    sigma: float, rig: Rig, parts: Parts, prior: PairOccupancy
) -> None:
    hand = rig.shaped(torch.full((10,), sigma)).posed(HandPose.flat())
    assert bool(torch.isfinite(hand.vertices).all())
    _assert_closed(_surface(prior, parts, hand))


def test_a_pose_that_is_no_number_is_refused(rig: Rig, parts: Parts, prior: PairOccupancy) -> None:
    hand = rig.shaped().posed(HandPose(torch.full((NUM_BONES, 3), torch.nan), torch.zeros(3)))
    with pytest.raises(ValueError, match="found a box with sides"):
        _surface(prior, parts, hand)


def test_faces_without_area_do_no_harm(rig: Rig, prior: PairOccupancy) -> None:
    """Every seventh face collapses to an edge, as careless exports leave them."""
    extra = rig.faces[::7].clone()
    extra[:, 2] = extra[:, 1]
    damaged = replace(
        rig,
        faces=torch.cat([rig.faces, extra]),
        uv_faces=torch.cat([rig.uv_faces, rig.uv_faces[::7]]),
    )
    divided = divide_into_parts(damaged)
    hand = _fist(damaged)
    assert bool(torch.isfinite(divided.point_clouds(hand)).all())
    _assert_closed(_surface(prior, divided, hand))


def test_a_part_without_area_is_refused(rig: Rig) -> None:
    labels = rig.skin_weights.argmax(-1)
    vertices = rig.template_vertices.clone()
    vertices[labels == 3] = vertices[labels == 3][0]
    faces = labels[rig.faces].mode(-1).values == 3
    vertices[rig.faces[faces].unique()] = vertices[labels == 3][0]
    with pytest.raises(RigError, match=r"bone 3 have no area"):
        divide_into_parts(replace(rig, template_vertices=vertices))


def test_a_finer_hand_keeps_the_points_that_were_drawn_on_the_coarser(
    rig: Rig, parts: Parts
) -> None:
    fine = subdivided(rig, 1)
    divided = divide_into_parts(fine, drawn_on=rig)
    assert len(divided.vertex_labels) == fine.num_vertices
    assert torch.equal(divided.corner_indices, parts.corner_indices)
    flat = HandPose.flat()
    clouds = divided.point_clouds(fine.shaped().posed(flat))
    torch.testing.assert_close(clouds, parts.point_clouds(rig.shaped().posed(flat)))
    with pytest.raises(ValueError, match="no coarser level"):
        divide_into_parts(rig, drawn_on=fine)


def test_a_bone_without_skin_is_refused(rig: Rig) -> None:
    weights = rig.skin_weights.clone()
    weights[:, 5] += weights[:, 6]
    weights[:, 6] = 0
    with pytest.raises(RigError, match="bone 6 has the largest weight nowhere"):
        divide_into_parts(replace(rig, skin_weights=weights))


def test_a_mesh_without_one_open_wrist_is_refused(rig: Rig) -> None:
    holed = replace(rig, faces=rig.faces[10:], uv_faces=rig.uv_faces[10:])
    with pytest.raises(RigError, match=r"open-hand.*boundary"):
        _ = holed.sealed_faces


def test_a_chain_whose_joints_fall_together_stays_finite(
    rig: Rig, parts: Parts, prior: PairOccupancy
) -> None:
    """A regressor that puts all joints of a finger into one place: bones without length."""
    regressor = rig.joint_regressor.clone()
    regressor[1:4] = regressor[1]
    hand = _fist(replace(rig, joint_regressor=regressor))
    _assert_closed(_surface(prior, parts, hand))
