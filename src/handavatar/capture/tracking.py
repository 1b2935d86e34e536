"""Finding the hand: 21 landmarks per picture, by MediaPipe 0.10.14 (the ``video`` extra).

Three looks at every picture are combined: the tracker's own, and two at a crop around it turned
by 35 degrees either way. Their median is steadier than any one of them, and where they disagree
(a fist, a hand seen edge-on) the landmarks are not to be trusted.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import VideoFrame
from handavatar.capture.skin_points import SeenPoints
from handavatar.capture.windows import (
    FINE_SIDE,
    MASK_SIDE,
    Window,
    mirror_places,
    resampled,
    window_around,
)
from handavatar.jobs.progress import SILENT, Progress

LANDMARK_NAMES: tuple[str, ...] = (
    "wrist",
    *(f"thumb_{part}" for part in ("cmc", "mcp", "ip", "tip")),
    *(
        f"{finger}_{part}"
        for finger in ("index", "middle", "ring", "little")
        for part in ("mcp", "pip", "dip", "tip")
    ),
)
_TURNS = (math.radians(35), math.radians(-35))
_VIEW_SIDE = 448
_VIEW_SCALE = 2.0
_MAX_SHARE_OF_TWO_HANDS = 0.1
# Seconds before or after; pictures in there that speak for the other hand, and their share.
_SIDE_WINDOW, _MIN_AGAINST, _AGAINST_SHARE = 0.6, 4, 0.8
# A vote that says anything; less is that of a tracker that does not know.
_CLEAR_VOTE = 0.3
_MIN_FRAMES = 8
_GLANCE_SIDE = 160
DARK = 30.0
"""Of a picture's brightness, 0 to 255: below, a camera sees noise rather than skin."""
# Between two pictures, in units of its size: as far does a hand that is followed move.
_FARTHEST_STEP = 0.6
TWO_HANDS, NO_HAND, OTHER_HAND = "two hands", "no hand found", "the other hand"
WhichHand = Literal["only", "left", "right", "larger"]
"""Of the hands of a video: the only one there is, or one of two."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One hand as one look at a picture found it.

    Attributes:
        landmarks: in the order of ``LANDMARK_NAMES``, pixels of the picture.
        world_landmarks: metres about the hand's centre, camera axes.
        presence: the tracker's certainty, in [0, 1].
        is_right: of a person's right hand, in a picture that is not mirrored.
        vote: certainty of its being a right one, negative of a left one, in [-1, 1]; of the
            tracker's certainty of a hand if None.
    """

    landmarks: Float[np.ndarray, "21 2"]
    world_landmarks: Float[np.ndarray, "21 3"]
    presence: float
    is_right: bool
    vote: float | None = None

    @property
    def side_vote(self) -> float:
        """Certainty of its being a right hand, negative that of a left one."""
        if self.vote is not None:
            return self.vote
        return self.presence if self.is_right else -self.presence


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """The hand in one picture of the video; after tracking always a right one.

    Attributes:
        index: number of the frame in the file.
        time: seconds from the start.
        window: the surroundings of the hand, in which its mask is found.
        landmarks: pixels of the whole (possibly mirrored) picture.
        spread: disagreement of the looks per landmark, pixels.
        world_landmarks: metres about the hand's centre, camera axes.
        presence: the tracker's certainty, in [0, 1].
        fine: the same surroundings with up to twice the pixels; None where the video has no more.
        points: what our own tracker sees there; None where it was not asked.
    """

    index: int
    time: float
    window: Window
    landmarks: Float[np.ndarray, "21 2"]
    spread: Float[np.ndarray, "21"]
    world_landmarks: Float[np.ndarray, "21 3"]
    presence: float
    fine: Window | None = None
    points: SeenPoints | None = None

    @property
    def stored_from(self) -> Window:
        """The surroundings from which the picture is stored."""
        return self.fine or self.window

    def mirrored(self) -> "TrackedHand":
        """The same hand in the mirrored picture."""
        return replace(
            self,
            window=self.window.mirrored(),
            fine=None if self.fine is None else self.fine.mirrored(),
            landmarks=mirror_places(self.landmarks, self.window.picture_size[0]),
            world_landmarks=self.world_landmarks * np.array([-1.0, 1.0, 1.0]),
        )


@dataclass(frozen=True, eq=False)
class Glance:
    """A whole picture of the video, made small.

    Attributes:
        index: number of the frame in the file.
        time: seconds from the start.
        image: sRGB; its longer side has at most 160 pixels.
    """

    index: int
    time: float
    image: UInt8[np.ndarray, "height width 3"]

    def mirrored(self) -> "Glance":
        """The mirrored picture."""
        return replace(self, image=np.ascontiguousarray(self.image[:, ::-1]))


@dataclass(frozen=True, eq=False)
class Track:
    """One hand through a video.

    Attributes:
        side: ``left`` if the pictures were mirrored to show a right hand.
        hands: the frames in which it was found.
        skipped: frame index to the reason, for the others.
        picture_size: width and height of the pictures.
        glances: all pictures that were looked at, with a hand or without, mirrored as the hands.
        votes_right: the share of the tracker's votes that took it for a right hand, in [0, 1].
        notes: what a person should know of the video, a sentence each.
        is_own: whether our own tracker alone has found the hand.
    """

    side: str
    hands: tuple[TrackedHand, ...]
    skipped: dict[int, str]
    picture_size: tuple[int, int]
    glances: tuple[Glance, ...] = ()
    votes_right: float = 1.0
    notes: tuple[str, ...] = ()
    is_own: bool = False

    def with_principal_point(self, place: tuple[float, float]) -> "Track":
        """The same, of a camera that is known.

        Args:
            place: pixels of the pictures as they were filmed, not mirrored.
        """
        x, y = place
        if self.side == "left":
            x = self.picture_size[0] - x

        def known(window: Window) -> Window:
            return replace(window, principal_point=(x, y))

        hands = [
            replace(
                hand,
                window=known(hand.window),
                fine=None if hand.fine is None else known(hand.fine),
            )
            for hand in self.hands
        ]
        return replace(self, hands=tuple(hands))

    @property
    def principal_point(self) -> tuple[float, float]:
        """Of the camera, pixels of the pictures; their middle where nobody said otherwise."""
        if self.hands:
            return self.hands[0].window.principal_point
        return self.picture_size[0] / 2, self.picture_size[1] / 2


class UnusableTrackError(CaptureError):
    """No hand to go on with.

    Attributes:
        track: what was found all the same.
    """

    def __init__(self, what: str, remedy: str, track: Track) -> None:
        """Keeps the track, so that it can be shown."""
        super().__init__(what, remedy)
        self.track = track


@runtime_checkable
class Finder(Protocol):
    """What finds hands in the pictures of a video."""

    def track(self, image: UInt8[np.ndarray, "height width 3"]) -> list[Sighting]:
        """All hands of the next picture of a video."""
        ...

    def look_closely(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        around: Float[np.ndarray, "21 2"],
        turn: float,
    ) -> Sighting | None:
        """The hand near given landmarks, looked for in a turned crop."""
        ...


@runtime_checkable
class Detector(Protocol):
    """What sees hands in one picture, or in one after the other."""

    def detect(self, image: UInt8[np.ndarray, "height width 3"]) -> list[Sighting]:
        """All hands of a picture, in its pixels and axes."""
        ...


class MediaPipeDetector:
    """A graph of MediaPipe's hand models."""

    def __init__(self, graph: Any) -> None:
        """Takes a graph that is open: ``mediapipe.python.solutions.hands.Hands``."""
        self._graph = graph

    def detect(self, image: UInt8[np.ndarray, "height width 3"]) -> list[Sighting]:
        """All hands of a picture."""
        return _sightings(self._graph, image)


class HandFinder:
    """Finds hands by two detectors: one follows them, the other looks at turned views of them."""

    def __init__(self, following: Detector, looking: Detector) -> None:
        """Takes both detectors.

        Args:
            following: is shown the pictures of a video in their order.
            looking: is shown single views.
        """
        self._following, self._looking = following, looking

    def track(self, image: UInt8[np.ndarray, "height width 3"]) -> list[Sighting]:
        """All hands of the next picture of a video."""
        return _without_doubles(self._following.detect(image))

    def look_closely(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        around: Float[np.ndarray, "21 2"],
        turn: float,
    ) -> Sighting | None:
        """The hand near given landmarks, looked for in a turned and enlarged crop.

        Args:
            image: the whole picture.
            around: landmarks of about the right place and size, pixels.
            turn: radians by which the crop is turned.
        """
        low, high = around.min(0), around.max(0)
        center, side = (low + high) / 2, float((high - low).max()) * _VIEW_SCALE
        cos, sin = math.cos(turn), math.sin(turn)
        picture_from_view = np.array([[cos, -sin], [sin, cos]]) * (side / _VIEW_SIDE)
        corner = center - picture_from_view @ np.array([_VIEW_SIDE / 2, _VIEW_SIDE / 2])
        view = resampled(image, picture_from_view, corner, _VIEW_SIDE)
        found = [
            _turned(sighting, picture_from_view, corner) for sighting in self._looking.detect(view)
        ]
        return min(found, key=lambda s: _distance(s.landmarks, around), default=None)


@contextmanager
def mediapipe_finder() -> Iterator[HandFinder]:
    """MediaPipe's hand models that ship in its wheel, opened once.

    Raises:
        CaptureError: mediapipe is not installed, or has no hand models.
    """
    hands = _mediapipe_hands()
    tracker = hands(
        static_image_mode=False,
        max_num_hands=2,
        model_complexity=1,
        min_detection_confidence=0.5,
        min_tracking_confidence=0.5,
    )
    still = hands(
        static_image_mode=True,
        max_num_hands=2,
        model_complexity=1,
        min_detection_confidence=0.3,
    )
    with closing(tracker), closing(still):
        yield HandFinder(MediaPipeDetector(tracker), MediaPipeDetector(still))


_USUAL_FRAMES = 60


def track_hand(
    frames: Iterable[VideoFrame],
    side: str = "auto",
    progress: Progress = SILENT,
    which: WhichHand = "only",
    finder: Finder | None = None,
) -> Track:
    """Follows one hand of a video.

    Args:
        frames: upright pictures in the order of time.
        side: ``left`` or ``right`` to overrule the tracker, which takes the video as not mirrored.
        progress: told how far it is: nobody knows how many frames there are.
        which: of two hands.
        finder: of hands; MediaPipe's if None.

    Raises:
        UnusableTrackError: no hand, or two hands in more than a tenth of the pictures where the
            only one is asked for.
        CaptureError: mediapipe is missing.
    """
    opened = mediapipe_finder() if finder is None else nullcontext(finder)
    with opened as used:
        seen, glances, picture_size = _all_hands(used, frames, which != "only", progress)
    if which == "only":
        hands, votes, skipped = _only_hand(seen, side)
    else:
        hands, votes, skipped = _chosen_hand(seen, which)
    if side == "auto":
        side = "right" if sum(votes) >= 0 else "left"
    if side == "left":
        hands = [hand.mirrored() for hand in hands]
        glances = [glance.mirrored() for glance in glances]
    total = sum(abs(vote) for vote in votes)
    share = sum(vote for vote in votes if vote > 0) / total if total else 0.5
    track = Track(side, tuple(hands), skipped, picture_size, tuple(glances), share)
    _check_found(track)
    return track


@dataclass(frozen=True, eq=False)
class _SeenHand:
    """A hand in one picture: its vote is its certainty of a right one, negative of a left one."""

    hand: TrackedHand
    vote: float


@dataclass(eq=False)
class _Followed:
    """One hand for as long as it is followed from picture to picture."""

    seen: list[_SeenHand]

    @property
    def vote(self) -> float:
        return sum(hand.vote for hand in self.seen)

    @property
    def size(self) -> float:
        """Over all pictures, pixels."""
        return sum(float(np.ptp(hand.hand.landmarks, axis=0).max()) for hand in self.seen)


@dataclass(frozen=True, eq=False)
class _LookedAt:
    """A picture, the hands in it, and whether there were more than are told."""

    index: int
    hands: list[_SeenHand]
    are_two: bool


def _all_hands(
    finder: Finder,
    frames: Iterable[VideoFrame],
    both: bool,
    progress: Progress,
) -> tuple[list[_LookedAt], list[Glance], tuple[int, int]]:
    """The hands of all pictures; where there are two, none unless both are asked for."""
    looked: list[_LookedAt] = []
    glances: list[Glance] = []
    last: list[Float[np.ndarray, "21 2"]] = []
    picture_size = (0, 0)
    for count, frame in enumerate(frames):
        picture_size = (frame.image.shape[1], frame.image.shape[0])
        glances.append(_glance(frame))
        found = finder.track(frame.image)
        if len(found) < len(last) and (both or not found):
            again = [
                finder.look_closely(frame.image, landmarks, 0.0)
                for landmarks in last
                if all(not _is_same_hand(one.landmarks, landmarks) for one in found)
            ]
            found = _without_doubles([*found, *(look for look in again if look is not None)])
        are_two = len(found) > 1
        hands = []
        if both or not are_two:
            for sighting in found:
                hand = _combined(finder, frame, sighting)
                hands.append(_SeenHand(hand, sighting.side_vote))
        if hands:
            last = [seen.hand.landmarks for seen in hands]
        looked.append(_LookedAt(frame.index, hands, are_two))
        # Each frame is a part of what is left.
        progress((count + 1) / (count + 1 + _USUAL_FRAMES), 1.0, f"picture {count + 1}")
    return looked, glances, picture_size


def _only_hand(
    looked: list[_LookedAt], side: str
) -> tuple[list[TrackedHand], list[float], dict[int, str]]:
    """The hands, their votes, and why other pictures have none."""
    skipped = {
        picture.index: TWO_HANDS if picture.are_two else NO_HAND
        for picture in looked
        if not picture.hands
    }
    seen = [picture.hands[0] for picture in looked if picture.hands]
    hands, votes = [one.hand for one in seen], [one.vote for one in seen]
    majority = "right" if sum(votes) >= 0 else "left"
    others = find_other_hand(np.array(votes), [hand.time for hand in hands])
    if side not in ("auto", majority) and len(hands) > others.sum() >= _MIN_FRAMES:
        # Both hands are there one after the other, and the smaller part is asked for.
        others = ~others
    skipped |= {
        hand.index: OTHER_HAND for hand, is_other in zip(hands, others, strict=True) if is_other
    }
    kept = [hand for hand, is_other in zip(hands, others, strict=True) if not is_other]
    return kept, votes, skipped


def _chosen_hand(
    looked: list[_LookedAt], which: WhichHand
) -> tuple[list[TrackedHand], list[float], dict[int, str]]:
    """One of two hands: as :func:`_only_hand`."""
    followed = _follow(looked)
    right, left = (
        [one for one in followed if (one.vote >= 0) == is_right] for is_right in (True, False)
    )
    if which == "larger":
        chosen = max(right, left, key=lambda side: sum(one.size for one in side))
    else:
        chosen = right if which == "right" else left
    by_index: dict[int, _SeenHand] = {}
    # Where two are taken for the same side, the one that is followed longer.
    for one in sorted(chosen, key=lambda one: -len(one.seen)):
        by_index = {seen.hand.index: seen for seen in one.seen} | by_index
    skipped = {
        picture.index: OTHER_HAND if picture.hands else NO_HAND
        for picture in looked
        if picture.index not in by_index
    }
    seen = [by_index[index] for index in sorted(by_index)]
    return [one.hand for one in seen], [one.vote for one in seen], skipped


def _follow(looked: list[_LookedAt]) -> list[_Followed]:
    """Hands of neighbouring pictures that are the same, by where they are."""
    followed: list[_Followed] = []
    current: list[_Followed] = []
    for picture in looked:
        going_on: list[_Followed] = []
        left = list(picture.hands)
        for one in current:
            before = one.seen[-1].hand.landmarks
            near = min(left, key=lambda seen: _distance(seen.hand.landmarks, before), default=None)
            if near is not None and _is_same_hand(near.hand.landmarks, before):
                left.remove(near)
                one.seen.append(near)
                going_on.append(one)
        started = [_Followed([seen]) for seen in left]
        followed += started
        current = going_on + started
    return followed


def _is_same_hand(first: Float[np.ndarray, "21 2"], second: Float[np.ndarray, "21 2"]) -> bool:
    size = float(np.ptp(second, axis=0).max())
    return _distance(first, second) < _FARTHEST_STEP * size


def find_other_hand(
    votes: Float[np.ndarray, "hands"], times: Sequence[float]
) -> Bool[np.ndarray, "hands"]:
    """Frames whose neighbourhood clearly shows the hand that is not that of most frames.

    A tracker mistakes single pictures, of a fist or of a hand seen edge-on; it does not mistake all
    pictures of a second.

    Args:
        votes: certainty of a right hand, negative that of a left one, in [-1, 1].
        times: seconds, growing.
    """
    is_other = np.zeros(len(votes), dtype=bool)
    sign = 1.0 if votes.sum() >= 0 else -1.0
    is_against = sign * votes < -_CLEAR_VOTE
    moments = np.array(times)
    for number in np.flatnonzero(is_against):
        is_near = np.abs(moments - moments[number]) <= _SIDE_WINDOW
        is_near[max(0, number - _MIN_AGAINST) : number + _MIN_AGAINST + 1] = True
        # Before or after: at a change of hands one of the two is clear.
        for part in (slice(number + 1), slice(number, None)):
            near = is_against[part][is_near[part]]
            is_other[number] |= near.sum() >= max(_MIN_AGAINST, _AGAINST_SHARE * len(near))
    return is_other


def _glance(frame: VideoFrame) -> Glance:
    picture = Image.fromarray(frame.image)
    # Means of whole blocks, so that the noise of single pixels is gone.
    factor = max(1, -(-max(picture.size) // _GLANCE_SIDE))
    return Glance(frame.index, frame.time, np.asarray(picture.reduce(factor)))


def _combined(finder: Finder, frame: VideoFrame, first: Sighting) -> TrackedHand:
    """The median of several looks at a picture, and how far they disagree."""
    looks = [first]
    for turn in _TURNS:
        look = finder.look_closely(frame.image, first.landmarks, turn)
        if look is not None and look.is_right == first.is_right:
            looks.append(look)
    landmarks = np.stack([look.landmarks for look in looks])
    middle = np.median(landmarks, axis=0)
    size = float(np.ptp(middle, axis=0).max())
    # A hand that only one look has found is as uncertain as a tenth of its size.
    unsure = 0.1 * size if len(looks) == 1 else 0.0
    spread = np.linalg.norm(landmarks - middle, axis=-1).max(0) + unsure
    window = window_around(frame.image, middle)
    is_whole = len(window.image) < MASK_SIDE
    return TrackedHand(
        index=frame.index,
        time=frame.time,
        window=window,
        fine=None if is_whole else window_around(frame.image, middle, FINE_SIDE),
        landmarks=middle,
        spread=spread,
        world_landmarks=np.median(np.stack([look.world_landmarks for look in looks]), axis=0),
        presence=float(np.mean([look.presence for look in looks])),
    )


def _check_found(track: Track) -> None:
    total = len(track.hands) + len(track.skipped)
    num_double = sum(reason == TWO_HANDS for reason in track.skipped.values())
    if num_double > _MAX_SHARE_OF_TWO_HANDS * total:
        raise UnusableTrackError(
            f"two hands in {num_double} of {total} pictures; expected one",
            "choose one with `hand='left'`, `hand='right'` or `hand='larger'`, or record one alone",
            track,
        )
    if len(track.hands) < _MIN_FRAMES:
        found = (
            f"a hand was found in {len(track.hands)} of {total} pictures; at least {_MIN_FRAMES} "
            "are needed"
        )
        brightness = [float(glance.image.mean()) for glance in track.glances]
        if brightness and float(np.median(brightness)) < DARK:
            raise UnusableTrackError(
                f"{found}; the pictures are too dark (mean {np.median(brightness):.0f} of 255)",
                "record in more light",
                track,
            )
        remedy = "record one bare hand, whole, larger than a sixth of the picture"
        if total < _MIN_FRAMES and len(track.hands) == total:
            remedy = "take more pictures: `max_frames`, `fps`, `start`, `end`, or a longer video"
        raise UnusableTrackError(found, remedy, track)


def has_mediapipe() -> bool:
    """Whether MediaPipe's hand models can be loaded."""
    try:
        _mediapipe_hands()
    except CaptureError:
        return False
    return True


def _mediapipe_hands() -> Any:
    try:
        from mediapipe.python.solutions.hands import Hands
    except ImportError as error:
        raise CaptureError(
            f"the hand tracker cannot be loaded ({error})",
            "choose `tracker='own'`, which needs no other package, or pip install "
            "'handavatar[video]' (mediapipe 0.10.14: newer ones have no hand models)",
        ) from error
    return Hands


def _sightings(graph: Any, image: UInt8[np.ndarray, "height width 3"]) -> list[Sighting]:
    result = graph.process(np.ascontiguousarray(image))
    if not result.multi_hand_landmarks:
        return []
    size = np.array([image.shape[1], image.shape[0]])
    found = []
    for landmarks, world, hand in zip(
        result.multi_hand_landmarks,
        result.multi_hand_world_landmarks,
        result.multi_handedness,
        strict=True,
    ):
        label = hand.classification[0]
        found.append(
            Sighting(
                np.array([[p.x, p.y] for p in landmarks.landmark]) * size,
                np.array([[p.x, p.y, p.z] for p in world.landmark]),
                float(label.score),
                # The legacy interface takes every picture for a mirrored selfie.
                label.label == "Left",
            )
        )
    return found


def _turned(
    sighting: Sighting,
    picture_from_view: Float[np.ndarray, "2 2"],
    corner: Float[np.ndarray, "2"],
) -> Sighting:
    """A sighting in a view, in the picture's pixels and axes."""
    rotation = picture_from_view / math.sqrt(abs(float(np.linalg.det(picture_from_view))))
    world = sighting.world_landmarks.copy()
    world[:, :2] = world[:, :2] @ rotation.T
    landmarks = sighting.landmarks @ picture_from_view.T + corner
    return replace(sighting, landmarks=landmarks, world_landmarks=world)


def _without_doubles(sightings: list[Sighting]) -> list[Sighting]:
    """Drops the fainter of two sightings of the same hand."""
    kept: list[Sighting] = []
    for sighting in sorted(sightings, key=lambda s: -s.presence):
        size = float(np.ptp(sighting.landmarks, axis=0).max())
        if all(_distance(sighting.landmarks, other.landmarks) > 0.4 * size for other in kept):
            kept.append(sighting)
    return kept


def _distance(first: Float[np.ndarray, "21 2"], second: Float[np.ndarray, "21 2"]) -> float:
    """Mean distance of landmarks, pixels."""
    return float(np.linalg.norm(first - second, axis=-1).mean())
