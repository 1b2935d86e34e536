"""Hands are found by our own tracker alone, where they are and as what they are."""

import numpy as np
import pytest
from conftest import coarse_skin
from videos import CASES, needs_cases

from handavatar.capture.decoding import Sampling, VideoFrame, video_frames
from handavatar.capture.own_finder import OwnFinder
from handavatar.capture.skin_points import world_places
from handavatar.capture.tracking import UnusableTrackError, track_hand
from handavatar.hand.landmarks import HAND_SIZE, MIDDLE_KNUCKLE, NUM_LANDMARKS
from handavatar.hand.rigs import load_rig
from handavatar.synthetic.crops import CROP_SIDE, make_crops
from handavatar.tracker.model import shipped_tracker
from handavatar.tracker.points import TrackedPoints

WIDTH, HEIGHT = 400, 300


def _placed(crop: np.ndarray, right: int, down: int) -> np.ndarray:
    """A picture with a made one somewhere; what is around it goes on from its border."""
    after = (HEIGHT - down - CROP_SIDE, WIDTH - right - CROP_SIDE)
    around = ((down, after[0]), (right, after[1]), (0, 0))
    return np.ascontiguousarray(np.pad(crop, around, mode="edge"))


@pytest.fixture(scope="module")
def scenes() -> list[tuple[np.ndarray, np.ndarray]]:
    """Pictures of hands with the fingers up and in the picture, and where their landmarks are."""
    rig = load_rig("open-hand")
    with coarse_skin():
        made = make_crops(rig, TrackedPoints.of(rig, 64), 40, 11)
    found = []
    for image, points, is_hand in zip(made.images, made.points, made.is_hand, strict=True):
        places = points[:NUM_LANDMARKS, :2]
        is_inside = places.min() > 0.05 and places.max() < 0.95
        reach = places[0, 1] - places[MIDDLE_KNUCKLE, 1]
        if len(found) < 4 and is_hand and is_inside and reach > 0.2:
            at = (20 + 30 * len(found), 60 - 15 * len(found))
            found.append((_placed(image, *at), places * CROP_SIDE + np.array(at)))
    assert len(found) == 4
    return found


@pytest.mark.slow
def test_hands_are_found_in_whole_pictures(scenes: list[tuple[np.ndarray, np.ndarray]]) -> None:
    apart = []
    for image, truth in scenes:
        sightings = OwnFinder().track(image)
        if sightings:
            size = np.ptp(truth, axis=0).max()
            error = np.linalg.norm(sightings[0].landmarks - truth, axis=-1).mean()
            apart.append(float(error / size))
    # Of one look each; in use more follow about what was found.
    assert len(apart) == 4 and float(np.median(apart)) < 0.1 and max(apart) < 0.25


def test_a_hand_is_followed_and_its_side_told(
    scenes: list[tuple[np.ndarray, np.ndarray]],
) -> None:
    image, truth = scenes[3]
    for is_left in (False, True):
        shown = np.ascontiguousarray(image[:, ::-1]) if is_left else image
        frames = [
            VideoFrame(number, number / 10, np.roll(shown, 3 * number, axis=1))
            for number in range(9)
        ]
        track = track_hand(frames, finder=OwnFinder())
        assert track.side == ("left" if is_left else "right")
        assert len(track.hands) == 9 and track.skipped == {}
        size = np.ptp(truth, axis=0).max()
        for number, hand in enumerate(track.hands):
            shift = -3 * number if is_left else 3 * number
            error = np.linalg.norm(hand.landmarks - truth - [shift, 0], axis=-1).mean()
            assert error < 0.15 * size


@pytest.mark.slow
def test_walls_have_no_hands() -> None:
    generator = np.random.default_rng(0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    planks = 120 + 40 * np.sin(rows / 9 + 0.4 * np.sin(columns / 40))
    wood = planks[..., None] + np.array([30, 0, -40]) + generator.normal(0, 4, (HEIGHT, WIDTH, 3))
    image = wood.clip(0, 255).astype(np.uint8)
    frames = [VideoFrame(number, number / 10, image) for number in range(3)]
    with pytest.raises(UnusableTrackError, match="found in 0 of 3"):
        track_hand(frames, finder=OwnFinder())


def test_landmarks_and_depths_become_a_hand_of_the_usual_size() -> None:
    """The template, seen from afar and turned: as long as it is, whatever the turn."""
    points = shipped_tracker().points
    template = points.template_places(load_rig(points.rig_name))[:NUM_LANDMARKS].double().numpy()
    size = np.linalg.norm(template[MIDDLE_KNUCKLE] - template[0])
    for turn in (0.0, 0.5, 0.9):
        cos, sin = np.cos(turn), np.sin(turn)
        turned = template @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]).T
        depths = (turned[:, 2] - turned[0, 2]) / size
        found = world_places(points, 2000 * turned[:, :2] + 300, depths)
        lengths = np.linalg.norm(found - found[0], axis=-1)
        expected = np.linalg.norm(template - template[0], axis=-1) * HAND_SIZE / size
        np.testing.assert_allclose(lengths, expected, rtol=0.02, atol=1e-4)


@pytest.mark.slow
@needs_cases
def test_one_of_two_real_hands_is_chosen() -> None:
    """A real hand and its mirror image, side by side."""
    frames = list(video_frames(CASES / "two_hands.mp4", Sampling(4.0)))
    with pytest.raises(UnusableTrackError, match="two hands in 11 of 11"):
        track_hand(frames, finder=OwnFinder())
    middles = {}
    for which in ("left", "right"):
        track = track_hand(frames, which=which, finder=OwnFinder())
        assert track.side == which and len(track.hands) == 11
        assert abs(track.votes_right - (which == "right")) < 0.1
        middles[which] = [float(hand.landmarks[:, 0].mean()) for hand in track.hands]
    # Each is mirrored to a right hand, and so they lie in the same place.
    assert np.allclose(middles["left"], middles["right"], atol=40)
    assert max(middles["right"]) < 640
