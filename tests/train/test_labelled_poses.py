"""The stream that the prior learns from: endless, the same everywhere, and true."""

import torch

from handavatar.geometry.meshes import distance_to_mesh, is_inside, unique_edges
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.pose import CONNECTED_PAIRS, HandPose
from handavatar.train.labelled_poses import (
    LARGEST_OFFSET,
    LabelledPose,
    PoseStream,
    joint_faces,
    joint_points,
    random_person,
)
from handavatar.train.stage_times import StageTimes

RIG = load_open_hand("778")
PARTS = divide_into_parts(RIG)


def _drawn(number: int, seed: int = 0) -> LabelledPose:
    return PoseStream(RIG, RIG, PARTS, 0.012, 512, seed).drawn(number, StageTimes())


def test_a_hand_of_the_stream_is_the_same_whenever_it_is_drawn() -> None:
    first = _drawn(3)
    _drawn(4)
    again = _drawn(3)
    assert torch.equal(first.points, again.points)
    assert torch.equal(first.is_inside, again.is_inside)
    for other in (_drawn(4), _drawn(3, seed=1), _drawn(4, seed=2)):
        assert not torch.equal(first.posed.vertices, other.posed.vertices)


def test_people_are_smooth_hands_off_the_rigs_shapes() -> None:
    """No coefficients give them, yet neighbouring vertices move together."""
    directions = RIG.shape_directions.flatten(0, 1)
    rest = RIG.shaped()
    edges = unique_edges(RIG.faces)
    residuals, rough = [], []
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        hand = random_person(rest, generator)
        moved = hand.rest_vertices - rest.rest_vertices
        torch.testing.assert_close(hand.rest_joints[0], rest.rest_joints[0])
        fitted = torch.linalg.lstsq(directions, moved.flatten()[:, None]).solution
        off = (moved.flatten() - (directions @ fitted)[:, 0]).reshape(-1, 3)
        residuals.append(float(off.square().mean().sqrt()))
        rough.append(float((off[edges[:, 0]] - off[edges[:, 1]]).square().mean().sqrt()))
    assert max(residuals) < 3 * LARGEST_OFFSET
    assert sorted(residuals)[10] > 0.1 * LARGEST_OFFSET
    assert sum(rough) < 0.7 * sum(residuals)


def test_labels_equal_those_of_the_exact_winding_number() -> None:
    """Van Oosterom and Strackee's solid angles, summed over every face, in float64."""
    num_wrong = 0
    for number in range(3):
        sample = _drawn(number)
        corners = sample.posed.sealed_vertices.double()[RIG.sealed_faces]
        a, b, c = (corners[None, :, k] - sample.points.double()[:, None] for k in range(3))
        volume = (a * torch.linalg.cross(b, c)).sum(-1)
        la, lb, lc = (side.norm(dim=-1) for side in (a, b, c))
        flat = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        winding = torch.atan2(volume, flat).sum(-1) / (2 * torch.pi)
        num_wrong += int(((winding > 0.5) != sample.is_inside).sum())
    # The far field is approximate, by less than 0.01; only points on the surface come that close.
    assert num_wrong <= 1


def test_most_points_lie_near_the_surface_and_some_anywhere() -> None:
    sample = _drawn(0)
    distance = distance_to_mesh(sample.posed.sealed_vertices, RIG.sealed_faces, sample.points)
    assert float((distance[-461:] < 0.001).float().mean()) > 0.6
    assert float((distance[:51] > 0.002).float().mean()) > 0.6


def test_points_at_joints_lie_where_the_two_parts_of_their_pair_meet() -> None:
    posed = RIG.shaped().posed(HandPose(torch.zeros(16, 3), torch.zeros(3)))
    generator = torch.Generator().manual_seed(0)
    points, pairs, is_within = joint_points(posed, *joint_faces(RIG), 500, generator)
    assert float(distance_to_mesh(posed.vertices, RIG.faces, points).median()) < 0.001
    assert set(pairs.tolist()) == set(range(len(CONNECTED_PAIRS)))
    near = (points[:, None] - posed.vertices).square().sum(-1).argmin(1)
    weights = RIG.skin_weights[near].gather(1, torch.tensor(CONNECTED_PAIRS)[pairs])
    assert float(weights.sum(1).mean()) > 0.8
    assert float(weights.amin(1).mean()) > 0.2
    truth = is_inside(posed.sealed_vertices, RIG.sealed_faces, points)
    assert float((truth == is_within).float().mean()) > 0.9


def test_points_at_joints_come_last_and_leave_the_others_as_they_are() -> None:
    stream = PoseStream(RIG, RIG, PARTS, 0.012, 512, 0, joint_points=100)
    plain, more = _drawn(3), stream.drawn(3, StageTimes())
    assert len(plain.joint_pairs) == 0 and len(more.joint_pairs) == 100
    assert torch.equal(more.points[:512], plain.points) and len(more.points) == 612
    assert torch.equal(more.is_inside[:512], plain.is_inside)
    assert 20 < int(more.is_inside[512:].sum()) < 80
    assert 50 < int((more.joint_pairs >= 0).sum()) <= 100
