"""Following one hand: what is kept, skipped, mirrored and refused."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from videos import REAL_VIDEO, needs_real_video

from handavatar.capture import tracking
from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling, VideoFrame, video_frames
from handavatar.capture.tracking import (
    LANDMARK_NAMES,
    HandFinder,
    Sighting,
    UnusableTrackError,
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


def _install(monkeypatch: pytest.MonkeyPatch, seen: dict[int, list[Sighting]]) -> None:
    """A finder that sees one right hand, but in some frames what ``seen`` says."""

    class FalseFinder(HandFinder):
        def __init__(self) -> None:
            pass

        def __exit__(self, *_: object) -> None:
            return None

        def track(self, image: np.ndarray) -> list[Sighting]:
            return seen.get(int(image[0, 0, 0]), [_sighting(True)])

        def look_closely(
            self, image: np.ndarray, around: np.ndarray, turn: float
        ) -> Sighting | None:
            found = self.track(image)
            return min(found, key=lambda seen: abs(seen.landmarks - around).sum(), default=None)

    monkeypatch.setattr(tracking, "HandFinder", FalseFinder)


def test_names_follow_the_tracker_s_order() -> None:
    assert len(LANDMARK_NAMES) == 21
    assert LANDMARK_NAMES[4] == "thumb_tip" and LANDMARK_NAMES[17] == "little_mcp"


def test_a_few_frames_without_or_with_two_hands_are_skipped_by_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _install(monkeypatch, {3: [], 5: [_sighting(True), _sighting(False, 150)]})
    track = track_hand(_frames(20))
    assert track.skipped == {3: "no hand found", 5: "two hands"}
    assert track.side == "right" and len(track.hands) == 18
    assert track.picture_size == (WIDTH, HEIGHT)
    assert [glance.index for glance in track.glances] == list(range(20))
    assert track.votes_right == 1.0


def test_two_hands_all_along_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    both = [_sighting(True), _sighting(False, 150)]
    _install(monkeypatch, {i: both for i in range(4)})
    with pytest.raises(UnusableTrackError, match="two hands in 4 of 20") as caught:
        track_hand(_frames(20))
    assert "`hand='left'`" in caught.value.remedy
    assert len(caught.value.track.hands) == 16 and len(caught.value.track.skipped) == 4


def _moving(right: bool, number: int, size: float = 1.0) -> Sighting:
    """A hand that goes to and fro on its own side of the picture."""
    seen = _sighting(right, 4 * np.sin(number) + (0 if right else 160))
    middle = seen.landmarks.mean(0)
    return replace(seen, landmarks=middle + size * (seen.landmarks - middle))


def test_one_of_two_hands_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    both = {i: [_moving(True, i), _moving(False, i, 1.2)] for i in range(20)}
    # A picture in which one of them is taken for the other side, one without the left hand, and
    # one in which they come in another order.
    both[4] = [_moving(True, 4), replace(_moving(False, 4, 1.2), presence=0.6, is_right=True)]
    both[9] = [_moving(True, 9)]
    both[12] = both[12][::-1]
    _install(monkeypatch, both)
    right = track_hand(_frames(20), which="right")
    assert right.side == "right" and len(right.hands) == 20 and right.skipped == {}
    assert all(hand.landmarks[:, 0].mean() < WIDTH / 2 for hand in right.hands)
    left = track_hand(_frames(20), which="left")
    assert left.side == "left"
    assert left.skipped == {9: "the other hand"} and len(left.hands) == 19
    # Mirrored, so that it is a right hand on the left side.
    assert all(hand.landmarks[:, 0].mean() < WIDTH / 2 for hand in left.hands)
    assert track_hand(_frames(20), which="larger").side == "left"


def test_no_hand_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, {i: [] for i in range(256)})
    bright = [replace(frame, image=frame.image + np.uint8(100)) for frame in _frames(20)]
    with pytest.raises(CaptureError, match="found in 0 of 20") as caught:
        track_hand(bright)
    assert "dark" not in str(caught.value)
    # The same with grey levels of 0 to 19: what is to blame has a name.
    with pytest.raises(CaptureError, match=r"found in 0 of 20.*too dark") as caught:
        track_hand(_frames(20))
    assert "light" in caught.value.remedy


def test_frames_of_the_other_hand_are_left_out_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """First the right hand, with one picture taken for a left one, then the left hand."""
    others = {i: [_sighting(False)] for i in (4, *range(20, 35))}
    _install(monkeypatch, others)
    track = track_hand(_frames(35))
    assert track.side == "right" and 4 in [hand.index for hand in track.hands]
    left_out = sorted(track.skipped)
    # Where the hands change, a picture or two may count for either.
    assert left_out[-1] == 34 and 20 <= left_out[0] <= 22
    assert len(left_out) == 35 - left_out[0] and set(track.skipped.values()) == {"the other hand"}
    assert len(track.glances) == 35
    left = track_hand(_frames(35), "left")
    assert left.side == "left" and [hand.index for hand in left.hands] == left_out
    # One hand all along, seen in a mirror: the wish turns it, and all pictures stay.
    _install(monkeypatch, {})
    assert len(track_hand(_frames(35), "left").hands) == 35


def test_a_left_hand_is_mirrored_to_a_right_one(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, {i: [_sighting(False)] for i in range(10)})
    track = track_hand(_frames(10))
    assert track.side == "left"
    seen, hand = _sighting(False), track.hands[0]
    assert np.allclose(hand.landmarks[:, 0], WIDTH - seen.landmarks[:, 0])
    assert np.allclose(hand.landmarks[:, 1], seen.landmarks[:, 1])
    assert np.allclose(hand.world_landmarks, seen.world_landmarks * (-1, 1, 1))
    # Overruled, the same pictures stay as they are.
    assert np.allclose(track_hand(_frames(10), "right").hands[0].landmarks, seen.landmarks)


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
