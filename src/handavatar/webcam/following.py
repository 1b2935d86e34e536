"""One hand, followed from picture to picture by our own tracker: one or two looks at each.

Where nothing is followed, a few crops of every picture are looked at, large ones first, so that a
picture never takes much longer than others; after a few pictures all places were looked at.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from handavatar.capture.own_finder import (
    SeenCrop,
    ask_looks,
    is_hand_followed,
    is_hand_found,
    looks_all_over,
    refine_looks,
    side_vote,
)
from handavatar.capture.skin_points import Look
from handavatar.tracker.model import TrainedTracker, shipped_tracker

WhichSide = Literal["auto", "left", "right"]
_SIZES = (1.1, 0.75, 0.5)
"""Sides of the crops in which a hand is searched, in units of the picture's shorter side."""
_AT_ONCE = 5
"""Crops of one picture in which a hand is searched."""
_ROUNDS = 2
"""By which the best of them is looked at again."""
_WORTH = 0.9
"""Probability of a hand with which a crop is looked at again in the next picture."""
_FAR = 0.1
"""In units of the crop's side: a hand that was further from its middle is looked at again."""
_SIDE_LOOKS, _SIDE_EVERY = 6, 12
"""So many pictures are looked at in the mirror, too, and then every so manyth."""
_MOST_VOTES, _CHANGED = 6.0, 1.5
"""Sum of votes that is kept at most, and from which on the other side is believed."""
_SHRUNK, _GROWN = 0.5, 2.0
"""Of a crop from one picture to the next: beyond, it is no longer the hand that is followed."""
_PREDICTED = 0.8
"""Of a hand's last motion, as much is taken to go on."""


@dataclass(frozen=True, eq=False)
class FollowedHand:
    """A hand in one picture.

    Attributes:
        seen: in the picture as it is.
        side: of whose hand it is, ``left`` or ``right``; the picture is taken as not mirrored.
        is_new: whether it, or its side, has not been known before.
    """

    seen: SeenCrop
    side: Literal["left", "right"]
    is_new: bool

    @property
    def is_mirrored(self) -> bool:
        """Whether it is a right hand in the mirror alone."""
        return self.side == "left"


class HandFollower:
    """Follows the hand that it finds first."""

    def __init__(self, side: WhichSide = "auto", tracker: TrainedTracker | None = None) -> None:
        """Follows nothing yet.

        Args:
            side: of the hand; auto looks for both, and tells which it is.
            tracker: by default the one that ships.
        """
        self.tracker = tracker or shipped_tracker()
        self._side = side
        self._flips = {"auto": (False, True), "left": (True,), "right": (False,)}[side]
        self._look: Look | None = None
        self._hopes: list[Look] = []
        self._next_place = 0
        self._votes = 0.0
        self._pictures = 0
        self._motion = np.zeros(2)
        self._has_turned = False

    def see(self, image: UInt8[np.ndarray, "height width 3"]) -> FollowedHand | None:
        """The hand in the next picture; None where there is none.

        Args:
            image: sRGB, upright, not mirrored.
        """
        look = self._look
        if look is None:
            seen = self._search(image)
            is_new = True
        else:
            seen = self._follow(image, look)
            is_new, self._has_turned = self._has_turned, False
        if seen is None:
            self._look = None
            return None
        is_left = self._votes < 0
        is_sure = self._side == "auto" and abs(self._votes) > _CHANGED
        if is_sure and seen.look.is_mirrored != is_left:
            # Its points are those of the other side: that look comes with the next picture.
            self._look = replace(seen.again(), is_mirrored=is_left)
            self._motion = np.zeros(2)
            self._has_turned = True
            return None
        again = seen.again()
        self._motion = np.zeros(2) if look is None else np.subtract(again.middle, look.middle)
        self._look = again
        return FollowedHand(seen, "left" if again.is_mirrored else "right", is_new)

    def _follow(self, image: UInt8[np.ndarray, "height width 3"], look: Look) -> SeenCrop | None:
        x, y = np.array(look.middle) + _PREDICTED * self._motion
        seen = self._asked(image, replace(look, middle=(float(x), float(y))))
        middle = (seen.points.min(0) + seen.points.max(0)) / 2
        if math.dist(middle, seen.look.middle) > _FAR * seen.look.side:
            seen = ask_looks(self.tracker, image, [seen.again()])[0]
        if not is_hand_followed(seen, image):
            return None
        grown = seen.again().side / look.side
        return seen if _SHRUNK < grown < _GROWN else None

    def _asked(self, image: UInt8[np.ndarray, "height width 3"], look: Look) -> SeenCrop:
        """A look, and now and then one in the mirror, which votes for a side."""
        self._pictures += 1
        is_asked = self._pictures <= _SIDE_LOOKS or self._pictures % _SIDE_EVERY == 0
        if len(self._flips) == 1 or not is_asked:
            return ask_looks(self.tracker, image, [look])[0]
        other = replace(look, is_mirrored=not look.is_mirrored)
        first, second = ask_looks(self.tracker, image, [look, other])
        self._vote(first, second)
        return first

    def _vote(self, first: SeenCrop, second: SeenCrop) -> None:
        votes = self._votes + side_vote(first, second)
        self._votes = max(-_MOST_VOTES, min(_MOST_VOTES, votes))

    def _search(self, image: UInt8[np.ndarray, "height width 3"]) -> SeenCrop | None:
        height, width = image.shape[:2]
        places = looks_all_over(width, height, _SIZES)
        start = self._next_place % len(places)
        chosen = (places + places)[start : start + _AT_ONCE]
        self._next_place = (start + _AT_ONCE) % len(places)
        seen = ask_looks(self.tracker, image, [*self._hopes, *chosen])
        best = min(seen, key=lambda one: 2 * one.error - one.presence)
        both = [replace(best.look, is_mirrored=flip) for flip in self._flips]
        refined = refine_looks(self.tracker, image, both, _ROUNDS)
        ranked = sorted(refined, key=lambda one: -one.score(float(min(height, width))))
        first = ranked[0]
        self._hopes = [first.again()] if first.presence > _WORTH else []
        if not is_hand_found(first, image):
            return None
        self._hopes = []
        # The sizes of crops that were tried have found a hand; the next search begins anew.
        self._next_place = self._pictures = 0
        self._votes = 0.0
        if len(ranked) > 1:
            self._vote(first, ranked[1])
        return first
