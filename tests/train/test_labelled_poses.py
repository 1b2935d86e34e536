"""The stream that the prior learns from: endless, the same everywhere, and true."""

import torch

from handavatar.geometry.meshes import distance_to_mesh, is_inside, winding_number
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.train.labelled_poses import (
    LABEL_SOFTNESS,
    PoseStream,
    TargetPose,
    training_points,
    training_targets,
)
from handavatar.train.stage_times import StageTimes

RIG = load_open_hand("778")
PARTS = divide_into_parts(RIG)


def _drawn(number: int, seed: int = 0) -> TargetPose:
    return PoseStream(RIG, RIG, PARTS, 0.012, 512, seed).drawn(number, StageTimes())


def test_a_hand_of_the_stream_is_the_same_whenever_it_is_drawn() -> None:
    first = _drawn(3)
    _drawn(4)
    again = _drawn(3)
    assert torch.equal(first.points, again.points)
    assert torch.equal(first.occupancy, again.occupancy)
    for other in (_drawn(4), _drawn(3, seed=1), _drawn(4, seed=2)):
        assert not torch.equal(first.posed.vertices, other.posed.vertices)


def test_targets_are_the_winding_numbers_sides_and_graded_by_the_distance() -> None:
    for number in range(4):
        sample = _drawn(number)
        vertices = sample.posed.sealed_vertices
        inside = is_inside(vertices, RIG.sealed_faces, sample.points)
        # Exactly: no target may lie on the other side of 1/2 than the label that judges.
        assert torch.equal(sample.occupancy > 0.5, inside)
        distance = distance_to_mesh(vertices, RIG.sealed_faces, sample.points)
        is_graded = (sample.occupancy > 1e-3) & (sample.occupancy < 1 - 1e-3)
        assert float(is_graded.float().mean()) > 0.4
        # Where skin touches skin the point's own surface may not be the nearest.
        nearest = torch.sigmoid((2 * inside.float() - 1) * distance / LABEL_SOFTNESS)
        error = (sample.occupancy - nearest).abs()
        assert float((error < 0.02).float().mean()) > 0.9


def test_most_points_lie_near_the_surface_and_some_anywhere() -> None:
    sample = _drawn(0)
    distance = distance_to_mesh(sample.posed.sealed_vertices, RIG.sealed_faces, sample.points)
    assert float((distance[-461:] < 0.001).float().mean()) > 0.6
    assert float((distance[:51] > 0.002).float().mean()) > 0.6


def test_a_surface_inside_another_part_is_no_surface() -> None:
    """A finger bent through the palm: its skin there is inside the hand, on both sides."""
    rotations = torch.zeros(NUM_BONES, 3)
    angles = torch.tensor([1.9, 1.9, 1.2])
    for bone, angle in zip((1, 2, 3), angles, strict=True):
        rotations[bone] = angle * RIG.joint_axes[bone, 0]
    posed = RIG.shaped().posed(HandPose(rotations, torch.zeros(3)))
    generator = torch.Generator().manual_seed(0)
    points, offsets = training_points(PARTS, posed, 4000, 0.012, generator)
    targets = training_targets(posed, points, offsets)
    winding = winding_number(posed.sealed_vertices, RIG.sealed_faces, points)
    is_double = winding > 1.5
    assert int(is_double.sum()) > 20
    assert torch.equal(targets[is_double], torch.ones(int(is_double.sum())))
    near = slice(len(points) - len(offsets), None)
    is_beneath = (offsets > 0) & (winding[near] > 0.5)
    assert int(is_beneath.sum()) > 20
    assert torch.equal(targets[near][is_beneath], torch.ones(int(is_beneath.sum())))
