"""Following one hand: what is kept, skipped, mirrored and refused."""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from videos import REAL_VIDEO, needs_real_video

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling, VideoFrame, video_frames
from handavatar.capture.tracking import (
    LANDMARK_NAMES,
    HandFinder,
    MediaPipeDetector,
    Sighting,
    UnusableTrackError,
    find_other_hand,
    track_hand,
)
from handavatar.capture.windows import resampled, window_around

WIDTH, HEIGHT = 320, 240


def _sighting(right: bool, shift: float = 0.0) -> Sighting:
    generator = np.random.default_rng(0)
    landmarks = generator.uniform((40, 60), (120, 160), (21, 2)) + np.array([shift, 0])
    world = generator.uniform(-0.1, 0.1, (21, 3))
    return Sighting(landmarks, world, 0.9, right)


def _frames(count: int) -> list[VideoFrame]:
    """The grey level is the number of the frame: all that the false finder looks at."""
    return [
        VideoFrame(i, i / 10, np.full((HEIGHT, WIDTH, 3), i, dtype=np.uint8)) for i in range(count)
    ]


@dataclass(frozen=True)
class _Finder:
    """Sees one right hand, but in some frames what ``seen`` says."""

    seen: Mapping[int, list[Sighting]]

    def track(self, image: np.ndarray) -> list[Sighting]:
        return self.seen.get(int(image[0, 0, 0]), [_sighting(True)])

    def look_closely(self, image: np.ndarray, around: np.ndarray, turn: float) -> Sighting | None:
        found = self.track(image)
        return min(found, key=lambda seen: abs(seen.landmarks - around).sum(), default=None)


def test_names_follow_the_tracker_s_order() -> None:
    assert len(LANDMARK_NAMES) == 21
    assert LANDMARK_NAMES[4] == "thumb_tip" and LANDMARK_NAMES[17] == "little_mcp"


def test_a_few_frames_without_or_with_two_hands_are_skipped_by_name() -> None:
    finder = _Finder({3: [], 5: [_sighting(True), _sighting(False, 150)]})
    track = track_hand(_frames(20), finder=finder)
    assert track.skipped == {3: "no hand found", 5: "two hands"}
    assert track.side == "right" and len(track.hands) == 18
    assert track.picture_size == (WIDTH, HEIGHT)
    assert [glance.index for glance in track.glances] == list(range(20))
    assert track.votes_right == 1.0


def test_two_hands_all_along_are_refused() -> None:
    both = [_sighting(True), _sighting(False, 150)]
    with pytest.raises(UnusableTrackError, match="two hands in 4 of 20") as caught:
        track_hand(_frames(20), finder=_Finder({i: both for i in range(4)}))
    assert "`hand='left'`" in caught.value.remedy
    assert len(caught.value.track.hands) == 16 and len(caught.value.track.skipped) == 4


def _moving(right: bool, number: int, size: float = 1.0) -> Sighting:
    """A hand that goes to and fro on its own side of the picture."""
    seen = _sighting(right, 4 * np.sin(number) + (0 if right else 160))
    middle = seen.landmarks.mean(0)
    return replace(seen, landmarks=middle + size * (seen.landmarks - middle))


def test_one_of_two_hands_is_followed() -> None:
    both = {i: [_moving(True, i), _moving(False, i, 1.2)] for i in range(20)}
    # A picture in which one of them is taken for the other side, one without the left hand, and
    # one in which they come in another order.
    both[4] = [_moving(True, 4), replace(_moving(False, 4, 1.2), presence=0.6, is_right=True)]
    both[9] = [_moving(True, 9)]
    both[12] = both[12][::-1]
    finder = _Finder(both)
    right = track_hand(_frames(20), which="right", finder=finder)
    assert right.side == "right" and len(right.hands) == 20 and right.skipped == {}
    assert all(hand.landmarks[:, 0].mean() < WIDTH / 2 for hand in right.hands)
    left = track_hand(_frames(20), which="left", finder=finder)
    assert left.side == "left"
    assert left.skipped == {9: "the other hand"} and len(left.hands) == 19
    # Mirrored, so that it is a right hand on the left side.
    assert all(hand.landmarks[:, 0].mean() < WIDTH / 2 for hand in left.hands)
    assert track_hand(_frames(20), which="larger", finder=finder).side == "left"


def test_no_hand_is_refused() -> None:
    finder = _Finder({i: [] for i in range(256)})
    bright = [replace(frame, image=frame.image + np.uint8(100)) for frame in _frames(20)]
    with pytest.raises(CaptureError, match="found in 0 of 20") as caught:
        track_hand(bright, finder=finder)
    assert "dark" not in str(caught.value)
    # The same with grey levels of 0 to 19: what is to blame has a name.
    with pytest.raises(CaptureError, match=r"found in 0 of 20.*too dark") as caught:
        track_hand(_frames(20), finder=finder)
    assert "light" in caught.value.remedy


def test_frames_of_the_other_hand_are_left_out_by_name() -> None:
    """First the right hand, with one picture taken for a left one, then the left hand."""
    finder = _Finder({i: [_sighting(False)] for i in (4, *range(20, 35))})
    track = track_hand(_frames(35), finder=finder)
    assert track.side == "right" and 4 in [hand.index for hand in track.hands]
    left_out = sorted(track.skipped)
    # Where the hands change, a picture or two may count for either.
    assert left_out[-1] == 34 and 20 <= left_out[0] <= 22
    assert len(left_out) == 35 - left_out[0] and set(track.skipped.values()) == {"the other hand"}
    assert len(track.glances) == 35
    left = track_hand(_frames(35), "left", finder=finder)
    assert left.side == "left" and [hand.index for hand in left.hands] == left_out
    # One hand all along, seen in a mirror: the wish turns it, and all pictures stay.
    assert len(track_hand(_frames(35), "left", finder=_Finder({})).hands) == 35


def test_a_left_hand_is_mirrored_to_a_right_one() -> None:
    finder = _Finder({i: [_sighting(False)] for i in range(10)})
    track = track_hand(_frames(10), finder=finder)
    assert track.side == "left"
    seen, hand = _sighting(False), track.hands[0]
    assert np.allclose(hand.landmarks[:, 0], WIDTH - seen.landmarks[:, 0])
    assert np.allclose(hand.landmarks[:, 1], seen.landmarks[:, 1])
    assert np.allclose(hand.world_landmarks, seen.world_landmarks * (-1, 1, 1))
    # Overruled, the same pictures stay as they are.
    assert np.allclose(
        track_hand(_frames(10), "right", finder=finder).hands[0].landmarks, seen.landmarks
    )


def test_unsure_votes_say_nothing_of_the_other_hand() -> None:
    """A second of them neither; a second of clear ones does."""
    times = [number / 10 for number in range(20)]
    for against, is_other in ((-0.2, False), (-0.4, True)):
        votes = np.array([0.9] * 10 + [against] * 10)
        found = find_other_hand(votes, times)
        assert found.tolist() == [False] * 10 + [is_other] * 10


def test_mirroring_a_window_and_a_point_commute() -> None:
    image = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    landmarks = np.array([[60.0, 50.0], [180.0, 150.0]]).repeat([10, 11], axis=0)
    window = window_around(image, landmarks)
    other = window.mirrored()
    side = window.image.shape[0]
    point = np.array([100.0, 80.0])
    x, y = window.from_picture(point)
    assert np.allclose(other.from_picture(np.array([WIDTH - 100.0, 80.0])), [side - x, y])
    assert (other.mirrored().image == window.image).all()
    assert np.allclose(other.mirrored().corner, window.corner)


def test_resampling_keeps_the_picture_where_it_is() -> None:
    image = np.random.default_rng(2).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    assert (resampled(image, np.eye(2), np.zeros(2), 64) == image).all()
    # A quarter turn about the middle; bilinear weights round by one step.
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    turned = resampled(image, quarter, np.array([64.0, 0.0]), 64)
    assert np.abs(turned.astype(int) - np.rot90(image).astype(int)).max() <= 1
    half = resampled(image, 2 * np.eye(2), np.zeros(2), 32)
    mean = image.reshape(32, 2, 32, 2, 3).mean((1, 3))
    assert np.abs(half - mean).max() <= 1


PLACES = 120
"""Pixels along a side of the picture whose colours are its places."""


def _picture_of_places() -> np.ndarray:
    """Red and green are a pixel's column and row, two steps each."""
    y, x = np.mgrid[:PLACES, :PLACES]
    return np.stack([2 * x, 2 * y, 0 * x], axis=-1).astype(np.uint8)


@dataclass(frozen=True)
class _PlaceReader:
    """Sees known hands of :func:`_picture_of_places` in whatever view of it is shown.

    The colours tell which part of the picture that is.
    """

    hands: list[Sighting]

    def detect(self, image: np.ndarray) -> list[Sighting]:
        # Where the picture's border is repeated colours tell nothing.
        is_inside = ((image[..., :2] > 2) & (image[..., :2] < 2 * PLACES - 5)).all(-1)
        rows, columns = np.nonzero(is_inside)
        # Pixel centres lie at a half; resampled values are rounded down.
        places = (image[rows, columns, :2] + 0.5) / 2 + 0.5
        view = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=-1)
        picture_from_view = np.linalg.lstsq(view, places, rcond=None)[0].T
        back = np.linalg.inv(picture_from_view[:, :2])
        turn = back / math.sqrt(float(np.linalg.det(back)))
        found = []
        for hand in self.hands:
            world = hand.world_landmarks.copy()
            world[:, :2] = world[:, :2] @ turn.T
            landmarks = (hand.landmarks - picture_from_view[:, 2]) @ back.T
            found.append(replace(hand, landmarks=landmarks, world_landmarks=world))
        return found


@dataclass(frozen=True)
class _Fixed:
    """Sees the same hands in every view."""

    hands: list[Sighting]

    def detect(self, image: np.ndarray) -> list[Sighting]:
        return self.hands


@pytest.mark.parametrize("degrees", [0, 35, -35, 120])
def test_what_a_turned_view_shows_lies_where_the_picture_shows_it(degrees: int) -> None:
    """Landmarks and the axes of depth come back from a crop that is turned and enlarged."""
    seen = _sighting(True)
    near = replace(seen, landmarks=seen.landmarks / 2)
    far = replace(near, landmarks=near.landmarks + np.array([40.0, 10.0]), presence=0.99)
    finder = HandFinder(_Fixed([]), _PlaceReader([far, near]))
    around = near.landmarks + np.random.default_rng(1).normal(0, 2, (21, 2))
    found = finder.look_closely(_picture_of_places(), around, math.radians(degrees))
    assert found is not None and found.is_right and found.presence == near.presence
    # Each of thousands of colours is rounded to half a pixel; together they tell a line.
    assert np.abs(found.landmarks - near.landmarks).max() < 0.1
    assert np.abs(found.world_landmarks - near.world_landmarks).max() < 1e-3
    assert finder.track(_picture_of_places()) == []


def test_the_view_turns_as_it_is_asked_to() -> None:
    """A detector that sees a hand upright in every view tells by how far the view is turned."""
    upright = replace(_sighting(True), world_landmarks=np.eye(21, 3))
    finder = HandFinder(_Fixed([]), _Fixed([upright]))
    for turn in (0.0, 0.6, -0.6):
        found = finder.look_closely(_picture_of_places(), _sighting(True).landmarks, turn)
        assert found is not None
        # The view's x axis, in the picture.
        expected = [math.cos(turn), math.sin(turn), 0.0]
        assert np.allclose(found.world_landmarks[0], expected, atol=1e-9)


def test_the_fainter_of_two_sightings_of_one_hand_is_dropped() -> None:
    faint, sure = replace(_sighting(True, 5.0), presence=0.6), _sighting(True)
    finder = HandFinder(_Fixed([faint, sure, _sighting(False, 150.0)]), _Fixed([]))
    found = finder.track(_picture_of_places())
    assert sorted((seen.presence, seen.is_right) for seen in found) == [(0.9, False), (0.9, True)]


def test_mediapipe_takes_pictures_for_selfies() -> None:
    """Its labels are those of a mirrored picture; its places are shares of the picture."""
    shown = []

    def marks(count: int) -> SimpleNamespace:
        points = [SimpleNamespace(x=0.25, y=0.5, z=0.125) for _ in range(count)]
        return SimpleNamespace(landmark=points)

    class Graph:
        def process(self, image: np.ndarray) -> SimpleNamespace:
            shown.append(image)
            label = SimpleNamespace(label="Left", score=0.75)
            other = SimpleNamespace(label="Right", score=0.5)
            return SimpleNamespace(
                multi_hand_landmarks=[marks(21), marks(21)],
                multi_hand_world_landmarks=[marks(21), marks(21)],
                multi_handedness=[
                    SimpleNamespace(classification=[label]),
                    SimpleNamespace(classification=[other]),
                ],
            )

    right, left = MediaPipeDetector(Graph()).detect(_picture_of_places())
    assert right.is_right and not left.is_right
    assert (right.presence, left.presence) == (0.75, 0.5)
    assert right.side_vote == 0.75 and left.side_vote == -0.5
    assert np.allclose(right.landmarks, [PLACES / 4, PLACES / 2])
    assert np.allclose(right.world_landmarks, [0.25, 0.5, 0.125])
    assert (shown[0] == _picture_of_places()).all()

    class Blind:
        def process(self, image: np.ndarray) -> SimpleNamespace:
            return SimpleNamespace(multi_hand_landmarks=None)

    assert MediaPipeDetector(Blind()).detect(_picture_of_places()) == []


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mediapipe.python.solutions.hands", None)
    with pytest.raises(CaptureError, match=r"handavatar\[video\]"):
        track_hand(_frames(1))


def test_a_picture_without_a_hand_shows_none() -> None:
    pytest.importorskip("mediapipe")
    noise = np.random.default_rng(3).integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    with pytest.raises(CaptureError, match="found in 0 of 3"):
        track_hand([VideoFrame(i, i / 10, noise) for i in range(3)])


@pytest.mark.real
@needs_real_video
def test_the_real_hand_is_a_right_one_and_its_mirror_image_a_left_one() -> None:
    pytest.importorskip("mediapipe")
    frames = list(video_frames(REAL_VIDEO, Sampling(max_frames=8)))
    right = track_hand(frames)
    mirrored = [VideoFrame(f.index, f.time, np.ascontiguousarray(f.image[:, ::-1])) for f in frames]
    left = track_hand(mirrored)
    assert (right.side, left.side) == ("right", "left")
    apart = [
        np.linalg.norm(a.landmarks - b.landmarks, axis=-1).mean()
        for a, b in zip(right.hands, left.hands, strict=True)
    ]
    # The hand is some 290 pixels large; the network is not exactly symmetric.
    assert max(apart) < 6


@pytest.mark.real
@needs_real_video
def test_two_real_hands_are_refused() -> None:
    pytest.importorskip("mediapipe")
    frames = list(video_frames(REAL_VIDEO, Sampling(max_frames=4)))
    doubled = [
        VideoFrame(f.index, f.time, np.concatenate([f.image[:, 400:1100]] * 2, axis=1))
        for f in frames
    ]
    with pytest.raises(CaptureError, match="two hands"):
        track_hand(doubled)


def test_too_few_pictures_are_no_fault_of_the_hand() -> None:
    with pytest.raises(UnusableTrackError, match="found in 2 of 2 pictures") as caught:
        track_hand(_frames(2), finder=_Finder({}))
    assert "dark" in str(caught.value)
    bright = [replace(frame, image=frame.image + np.uint8(100)) for frame in _frames(2)]
    with pytest.raises(UnusableTrackError, match="found in 2 of 2 pictures") as caught:
        track_hand(bright, finder=_Finder({}))
    assert caught.value.remedy.startswith("take more pictures: `max_frames`")
