"""Poses of exact sightings are the true ones, whichever hand it is."""

import numpy as np
import pytest
import torch

from handavatar.capture.own_finder import SeenCrop
from handavatar.capture.skin_points import Look
from handavatar.capture.windows import mirror_places
from handavatar.fit.energy import EnergyOptions, linearise_landmarks
from handavatar.fit.kinematics import NUM_UNKNOWNS, RestPoints, moved_pose
from handavatar.fit.landmarks import NUM_OFFSETS, LandmarkSightings, landmark_rest
from handavatar.fit.shape import fixed_shape
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.landmarks import HAND_SIZE, MIDDLE_KNUCKLE
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import GESTURES, gesture_rotations
from handavatar.hand.rig import ShapedHand
from handavatar.hand.rigs import load_rig
from handavatar.tracker.model import shipped_tracker
from handavatar.webcam.coverage import gestures_shown
from handavatar.webcam.following import FollowedHand
from handavatar.webcam.posing import PoseFollower

SIZE = (640, 480)
CAMERA = Camera((640.0, 640.0), (320.0, 240.0), *SIZE, torch.eye(4))
UPRIGHT = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


@pytest.fixture(scope="module")
def hand() -> ShapedHand:
    return load_rig("open-hand").shaped()


def true_pose(hand: ShapedHand, gesture: str, step: int) -> HandPose:
    rotations = gesture_rotations(hand.rig, gesture).clone()
    turn = matrix_from_axis_angle(torch.tensor([0.05 * step, 0.2, 0.1 * step]))
    rotations[0] = axis_angle_from_matrix(turn @ UPRIGHT)
    return HandPose(rotations, torch.tensor([0.01 * step, 0.06, 0.42]))


def sighting(hand: ShapedHand, pose: HandPose, is_left: bool, is_new: bool) -> FollowedHand:
    """As a tracker without errors would see it."""
    points = shipped_tracker().points.positions(hand, pose)
    pixels = project(CAMERA, points)[0].double().numpy()
    if is_left:
        pixels = mirror_places(pixels, SIZE[0])
    size = float((points[MIDDLE_KNUCKLE] - points[0]).norm())
    depths = ((points[:, 2] - points[0, 2]) / size).double().numpy()
    error = np.full(len(points), 1.0)
    look = Look((320.0, 240.0), 300.0, 0.0, is_left)
    seen = SeenCrop(
        look, pixels, error, depths, 0.01 * error, 0.01, 1.0, 3.0, np.zeros((0, 2)), 0.0
    )
    return FollowedHand(seen, "left" if is_left else "right", is_new)


@pytest.mark.parametrize("is_left", [False, True])
@pytest.mark.parametrize("gesture", ["spread", "relaxed", "fist"])
def test_exact_sightings_give_the_pose(hand: ShapedHand, gesture: str, is_left: bool) -> None:
    follower = PoseFollower(hand, shipped_tracker().points)
    for step in range(4):
        pose = true_pose(hand, gesture, step)
        followed = sighting(hand, pose, is_left, step == 0)
        live = follower.see(followed, SIZE, step / 10)
    # A usual hand is not quite as large as this one, which depths are told in.
    found, wanted = (hand.posed(p).joints - hand.posed(p).joints[0] for p in (live.pose, pose))
    assert live.misfit < 0.03
    assert float((found - wanted).norm(dim=-1).mean()) < 0.006
    assert abs(float(live.pose.translation[2]) - 0.42) < 0.03
    assert gesture == "relaxed" or gestures_shown(hand.rig, live.pose) == [gesture]


def test_a_jump_is_followed_after_a_while(hand: ShapedHand) -> None:
    """Where the hand was lost from sight for a second, the old pose says nothing."""
    follower = PoseFollower(hand, shipped_tracker().points)
    follower.see(sighting(hand, true_pose(hand, "spread", 0), False, True), SIZE, 0.0)
    pose = true_pose(hand, "fist", 4)
    live = follower.see(sighting(hand, pose, False, False), SIZE, 1.0)
    assert live.misfit < 0.05 and gestures_shown(hand.rig, live.pose) == ["fist"]


def test_gestures_that_are_asked_for_are_told_from_others(hand: ShapedHand) -> None:
    for name in GESTURES:
        shown = gestures_shown(hand.rig, HandPose(gesture_rotations(hand.rig, name), torch.ones(3)))
        # A thumb may lie anywhere about a fist.
        assert ("fist" in shown) == (name in ("fist", "thumbs_up")), name
        assert ("spread" in shown) == (name == "spread"), name


def test_the_landmarks_energy_has_its_slope(hand: ShapedHand) -> None:
    """The gradient is half of what the energy changes by, as its central differences say."""
    points = shipped_tracker().points
    rest = landmark_rest(hand, fixed_shape(hand.rig), torch.zeros(NUM_OFFSETS), points.vertices)
    rest = RestPoints(rest.positions, rest.skin_weights, rest.directions[..., :0])
    pose = true_pose(hand, "relaxed", 0)
    places = points.positions(hand, true_pose(hand, "spread", 1))
    count = len(places)
    landmarks = LandmarkSightings(
        (project(CAMERA, places)[0] - torch.tensor(CAMERA.center)) / 640,
        torch.full((count,), 0.02),
        places[:, 2] - places[:, 2].mean(),
        torch.full((count,), HAND_SIZE),
        torch.zeros(21, 3),
        points.vertices,
    )
    # No point is an outlier: there the weights would move with the pose as well.
    options = EnergyOptions(landmark_outlier=1e4)

    def energy(change: torch.Tensor) -> float:
        moved = moved_pose(pose, change)
        return linearise_landmarks(rest, hand, moved, CAMERA, landmarks, options).energy

    found = linearise_landmarks(rest, hand, pose, CAMERA, landmarks, options)
    assert found.hessian.shape == (NUM_UNKNOWNS, NUM_UNKNOWNS)
    for unknown in (0, 4, 20, 44, 48, 50):
        change = torch.zeros(NUM_UNKNOWNS)
        change[unknown] = 5e-3 if unknown < 48 else 1e-3
        slope = (energy(change) - energy(-change)) / (2 * float(change[unknown]))
        assert 2 * float(found.gradient[unknown]) == pytest.approx(slope, rel=0.03, abs=0.5)
