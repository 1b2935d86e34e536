"""Finding hands by our own tracker alone: without MediaPipe, on any Python.

The network says of a crop whether it shows a hand, where that is and what is hand and forearm.
Crops of several sizes all over the picture are asked first; the best of each size are looked at
again about what they have seen, as a right and, mirrored, as a left hand, until the answer stays
where it is. From then on a hand is looked for where it was in the picture before.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from handavatar.capture.skin_points import Look, world_places
from handavatar.capture.tracking import Sighting
from handavatar.capture.windows import resampled
from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.tracker.model import TrainedTracker, shipped_tracker
from handavatar.tracker.network import HAND, INPUT_SIDE, MAP_SIDE
from handavatar.tracker.points import upright_turn

SEARCHED_SIZES = (1.1, 0.75, 0.5, 0.34)
"""Sides of the crops that are asked first, in units of the picture's shorter side."""
_OF_EACH_SIZE = 3
_ROUNDS_OF_SEARCH, _ROUNDS_OF_FOLLOWING = 4, 2
_ROOM = 1.35
"""Side of a crop in units of the box of what was seen of the hand in the one before."""
_LEAST_SIDE = 8.0
"""Pixels of the picture, where all that was seen falls together."""
_NEAR = 0.07
"""Shares of a crop's side within which pixels of a hand are near one of its points."""
_MOST_ERROR, _MOST_MOTION, _LEAST_PRESENCE = 0.12, 0.04, 0.997
"""Expected error of points, in units of what they span, their motion in the last round, in units of
the crop's side, and probability of a hand, with which one is believed that nothing was known of."""
_MOST_ERROR_FOLLOWED, _LEAST_PRESENCE_FOLLOWED = 0.16, 0.98
_SECOND_ERROR = 0.04
"""Up to which a second hand is believed."""
_SMALLEST = 0.1
"""Extent of a hand's points in units of the picture's shorter side, at least."""
_PATIENCE = 3
"""Pictures without a hand after which only every third is searched."""
_CLEAR_SIDE, _CLEAR_ERROR = 1.5, 0.035
"""Logits by which the network has to prefer one side, and how exactly it has to see the hand, for
its vote to count fully."""
_UNCLEAR_VOTE = 0.2


@dataclass(frozen=True, eq=False)
class SeenCrop:
    """What the network saw in a look.

    Attributes:
        look: where.
        points: landmarks and skin, pixels of the picture.
        point_errors: expected, of each coordinate, pixels of the picture.
        depths: behind the wrist, in units of the hand's size.
        depth_errors: expected.
        error: expected one, mean over the points, in units of the crop's side.
        presence: probability of a hand.
        right: logit of its being a right one as looked at, so a left one where it is mirrored.
        hand: places of the picture that show the hand.
        border: share of the crop's border that shows the hand.
        motion: of the points since the look before, in units of the crop's side.
    """

    look: Look
    points: Float[np.ndarray, "points 2"]
    point_errors: Float[np.ndarray, "points"]
    depths: Float[np.ndarray, "points"]
    depth_errors: Float[np.ndarray, "points"]
    error: float
    presence: float
    right: float
    hand: Float[np.ndarray, "places 2"]
    border: float
    motion: float = 1.0

    @property
    def extent(self) -> float:
        """Of the points, pixels."""
        return float(np.ptp(self.points, axis=0).max())

    @property
    def vagueness(self) -> float:
        """The expected error in units of what the points span: large where they fall together."""
        return self.error * self.look.side / max(self.extent, 1e-6)

    def score(self, short_side: float) -> float:
        """How much it looks like a whole hand; larger ones first, since fingers look like hands."""
        explained = 0.0
        if len(self.hand):
            apart = np.linalg.norm(self.hand[:, None] - self.points, axis=-1).min(1)
            explained = float((apart < _NEAR * self.look.side).mean())
        return (
            self.presence
            - 2 * self.error
            - 2 * self.motion
            - 3 * self.border
            + explained
            + 0.3 * math.tanh(self.right / 3)
            + 0.3 * math.log2(self.look.side / short_side)
        )

    def again(self) -> Look:
        """The upright crop about all that was seen of the hand."""
        # Of a left hand in the mirror, in which it is a right one.
        flip = np.array([-1.0 if self.look.is_mirrored else 1.0, 1.0])
        turn = float(upright_turn(torch.from_numpy(self.points[None] * flip))[0] * flip[0])
        places = np.concatenate([self.points, self.hand])
        look = Look.about(places, turn, _ROOM, self.look.is_mirrored)
        return replace(look, side=max(look.side, _LEAST_SIDE))


class OwnFinder:
    """Finds up to two hands in the pictures of a video."""

    def __init__(self, tracker: TrainedTracker | None = None) -> None:
        """Takes the tracker that ships, or another."""
        self._tracker = tracker or shipped_tracker()
        self._last: list[Look] = []
        self._without = 0

    def track(self, image: UInt8[np.ndarray, "height width 3"]) -> list[Sighting]:
        """All hands of the next picture of a video."""
        found = [self._followed(image, look) for look in self._last]
        pairs = _without_doubles([pair for pair in found if pair is not None])
        if not pairs:
            self._without += 1
            if self._without <= _PATIENCE or self._without % 3 == 0:
                pairs = self._searched(image)
        if pairs:
            self._without = 0
        self._last = [first.again() for first, _ in pairs]
        return [self._sighting(first, second) for first, second in pairs]

    def look_closely(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        around: Float[np.ndarray, "21 2"],
        turn: float,
    ) -> Sighting | None:
        """The hand near given landmarks, in a crop turned from where it is upright.

        Args:
            image: the whole picture.
            around: landmarks of about the right place and size, pixels.
            turn: radians by which the crop is turned.
        """
        upright = float(upright_turn(torch.from_numpy(around[None]))[0])
        low, high = around.min(0), around.max(0)
        x, y = (low + high) / 2
        side = float((high - low).max()) * 1.5
        looks = [Look((float(x), float(y)), side, upright + turn, flip) for flip in (False, True)]
        first, second = sorted(ask_looks(self._tracker, image, looks), key=lambda seen: -seen.right)
        if not is_hand_followed(first, image):
            return None
        return self._sighting(first, second)

    def _followed(
        self, image: UInt8[np.ndarray, "height width 3"], look: Look
    ) -> tuple[SeenCrop, SeenCrop] | None:
        looks = [look, replace(look, is_mirrored=not look.is_mirrored)]
        pair = refine_looks(self._tracker, image, looks, _ROUNDS_OF_FOLLOWING)
        short_side = float(min(image.shape[:2]))
        first, second = sorted(pair, key=lambda seen: -seen.score(short_side))
        if not is_hand_followed(first, image):
            return None
        # What has shrunk to a finger, or has grown over the picture, is no longer the hand.
        if not 0.5 < first.look.side / look.side < 2.0:
            return None
        return first, second

    def _searched(
        self, image: UInt8[np.ndarray, "height width 3"]
    ) -> list[tuple[SeenCrop, SeenCrop]]:
        looks = looks_all_over(image.shape[1], image.shape[0])
        seen = ask_looks(self._tracker, image, looks)
        sides = sorted({look.side for look in looks})
        chosen = []
        for side in sides:
            of_size = [one for one in seen if one.look.side == side]
            of_size.sort(key=lambda one: 2 * one.error - one.presence)
            chosen += [one.look for one in of_size[:_OF_EACH_SIZE]]
        both = [replace(look, is_mirrored=flip) for look in chosen for flip in (False, True)]
        refined = refine_looks(self._tracker, image, both, _ROUNDS_OF_SEARCH)
        short_side = float(min(image.shape[:2]))
        pairs = []
        for one, other in zip(refined[::2], refined[1::2], strict=True):
            first, second = sorted((one, other), key=lambda seen: -seen.score(short_side))
            if is_hand_found(first, image):
                pairs.append((first, second))
        pairs.sort(key=lambda pair: -pair[0].score(short_side))
        apart = _without_doubles(pairs)
        return apart[:1] + [pair for pair in apart[1:2] if pair[0].vagueness <= _SECOND_ERROR]

    def _sighting(self, first: SeenCrop, second: SeenCrop) -> Sighting:
        vote = side_vote(first, second)
        landmarks = first.points[:NUM_LANDMARKS]
        return Sighting(
            landmarks,
            world_places(self._tracker.points, landmarks, first.depths[:NUM_LANDMARKS]),
            first.presence,
            # Of no certainty at all it is what it was looked at as.
            not first.look.is_mirrored if vote == 0 else vote > 0,
            vote,
        )


def refine_looks(
    tracker: TrainedTracker,
    image: UInt8[np.ndarray, "height width 3"],
    looks: Sequence[Look],
    rounds: int,
) -> list[SeenCrop]:
    """Looks, and looks again about what was seen.

    Args:
        tracker: to ask.
        image: the whole picture.
        looks: where to begin.
        rounds: of looking again; the answers are those of the last.
    """
    seen = ask_looks(tracker, image, looks)
    for _ in range(rounds):
        before = seen
        seen = [
            replace(
                now,
                motion=float(
                    np.linalg.norm(now.points - then.points, axis=-1).mean() / now.look.side
                ),
            )
            for now, then in zip(
                ask_looks(tracker, image, [one.again() for one in before]), before, strict=True
            )
        ]
    return seen


def ask_looks(
    tracker: TrainedTracker, image: UInt8[np.ndarray, "height width 3"], looks: Sequence[Look]
) -> list[SeenCrop]:
    """What the network says of crops of a picture, all at once.

    Args:
        tracker: to ask.
        image: the whole picture.
        looks: where.
    """
    placed = [look.picture_from_crop() for look in looks]
    crops = [resampled(image, matrix, corner, INPUT_SIDE) for matrix, corner in placed]
    told = tracker.tell(np.stack(crops))
    is_hand = (told.classes.argmax(1) == HAND).numpy()
    found = []
    for number, (look, (matrix, corner)) in enumerate(zip(looks, placed, strict=True)):
        places = told.places[number].double().numpy() * INPUT_SIDE
        errors = told.place_errors[number].double().numpy()
        found.append(
            SeenCrop(
                look,
                places @ matrix.T + corner,
                errors * look.side,
                told.depths[number].double().numpy(),
                told.depth_errors[number].double().numpy(),
                float(told.place_errors[number].mean()),
                float(told.is_hand[number].sigmoid()),
                float(told.is_right[number]),
                _cell_middles(is_hand[number]) @ matrix.T + corner,
                _border_share(is_hand[number]),
            )
        )
    return found


def is_hand_found(seen: SeenCrop, image: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Whether a hand is believed of which nothing was known, after looking again."""
    is_hand = seen.presence >= _LEAST_PRESENCE and seen.vagueness <= _MOST_ERROR
    return is_hand and seen.motion <= _MOST_MOTION and _is_large(seen, image)


def is_hand_followed(seen: SeenCrop, image: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Whether a hand is believed where one has been before."""
    is_hand = seen.presence >= _LEAST_PRESENCE_FOLLOWED
    return is_hand and seen.vagueness <= _MOST_ERROR_FOLLOWED and _is_large(seen, image)


def side_vote(first: SeenCrop, second: SeenCrop) -> float:
    """Certainty of a right hand, negative of a left one, in [-1, 1].

    Args:
        first: of a crop, the look that sees it better.
        second: the look at the same crop in the mirror, or out of it.
    """
    preferred = (first.right - second.right) / 2
    is_clear = abs(preferred) >= _CLEAR_SIDE and first.vagueness <= _CLEAR_ERROR
    sure = first.presence * math.tanh(abs(preferred)) * (1.0 if is_clear else _UNCLEAR_VOTE)
    is_right = (preferred >= 0) != first.look.is_mirrored
    return sure if is_right else -sure


def _is_large(seen: SeenCrop, image: UInt8[np.ndarray, "height width 3"]) -> bool:
    return seen.extent >= _SMALLEST * min(image.shape[:2])


def looks_all_over(width: int, height: int, sizes: Sequence[float] = SEARCHED_SIZES) -> list[Look]:
    """Crops of every size that overlap by half.

    Args:
        width: of the picture.
        height: of the picture.
        sizes: sides, in units of the picture's shorter side.
    """
    looks = []
    for share in sizes:
        side = share * min(width, height)
        columns, rows = (_middles(length, side) for length in (width, height))
        looks += [Look((x, y), side, 0.0) for y in rows for x in columns]
    return looks


def _middles(length: int, side: float) -> list[float]:
    if length <= side:
        return [length / 2]
    count = math.ceil((length - side) / (side / 2)) + 1
    return [float(at) for at in np.linspace(side / 2, length - side / 2, count)]


def _cell_middles(is_hand: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "places 2"]:
    """Pixels of a crop in the middle of the cells of its mask."""
    rows, columns = np.nonzero(is_hand)
    return (np.stack([columns, rows], axis=-1) + 0.5) * (INPUT_SIDE / MAP_SIDE)


def _border_share(is_hand: Bool[np.ndarray, "rows columns"]) -> float:
    edges = (is_hand[0], is_hand[-1], is_hand[:, 0], is_hand[:, -1])
    return float(np.concatenate(edges).mean())


def _without_doubles(pairs: list[tuple[SeenCrop, SeenCrop]]) -> list[tuple[SeenCrop, SeenCrop]]:
    """Leaves what lies where a better one does; the better ones come first."""
    kept: list[tuple[SeenCrop, SeenCrop]] = []
    for pair in pairs:
        look = pair[0].look
        apart = [
            math.dist(look.middle, other.look.middle) > 0.5 * max(look.side, other.look.side)
            for other, _ in kept
        ]
        if all(apart):
            kept.append(pair)
    return kept
