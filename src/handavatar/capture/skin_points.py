"""Where our own tracker sees joints, fingertips and skin in the surroundings of a tracked hand."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float

from handavatar.capture.windows import Window, resampled
from handavatar.hand.landmarks import HAND_SIZE, KNUCKLES, MIDDLE_KNUCKLE
from handavatar.hand.rigs import load_rig
from handavatar.tracker.model import TrainedTracker
from handavatar.tracker.network import INPUT_SIDE
from handavatar.tracker.points import TrackedPoints, upright_turn

_LOOKS = ((0.0, 1.45), (math.radians(20), 1.55), (math.radians(-20), 1.35))
"""Turn of a crop from where the hand is upright, and its side in units of the hand's box."""


@dataclass(frozen=True)
class Look:
    """A crop that the tracker is asked about.

    Attributes:
        middle: of the crop, pixels of the picture.
        side: of the crop, pixels of the picture.
        turn: radians by which it is turned.
        is_mirrored: whether a left hand is looked at as a right one.
    """

    middle: tuple[float, float]
    side: float
    turn: float
    is_mirrored: bool = False

    @classmethod
    def about(
        cls,
        places: Float[np.ndarray, "places 2"],
        turn: float,
        room: float,
        is_mirrored: bool = False,
    ) -> "Look":
        """The turned square about places of a picture.

        Args:
            places: pixels.
            turn: radians.
            room: side in units of the longer side of the turned box about the places.
            is_mirrored: whether a left hand is looked at as a right one.
        """
        axes = _turned_axes(turn)
        turned = places @ axes
        low, high = turned.min(0), turned.max(0)
        x, y = axes @ ((low + high) / 2)
        return cls((float(x), float(y)), float((high - low).max()) * room, turn, is_mirrored)

    def picture_from_crop(self) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2"]]:
        """Matrix and corner that bring pixels of the crop to the picture."""
        matrix = _turned_axes(self.turn) * (self.side / INPUT_SIDE)
        if self.is_mirrored:
            matrix = matrix @ np.diag([-1.0, 1.0])
        return matrix, np.array(self.middle) - matrix @ np.full(2, INPUT_SIDE / 2)


def _turned_axes(turn: float) -> Float[np.ndarray, "2 2"]:
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([[cos, -sin], [sin, cos]])


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of a right hand in a picture.

    Attributes:
        places: pixels of the picture.
        errors: expected, of each coordinate, pixels.
        depths: behind the wrist's joint, in units of the distance from it to the middle finger's
            knuckle.
        depth_errors: expected.
        spread: disagreement of the looks, pixels.
    """

    places: Float[np.ndarray, "points 2"]
    errors: Float[np.ndarray, "points"]
    depths: Float[np.ndarray, "points"]
    depth_errors: Float[np.ndarray, "points"]
    spread: Float[np.ndarray, "points"]

    def first(self, count: int) -> "SeenPoints":
        """The first so many of them."""
        return SeenPoints(
            self.places[:count],
            self.errors[:count],
            self.depths[:count],
            self.depth_errors[:count],
            self.spread[:count],
        )


def see_points(
    tracker: TrainedTracker, window: Window, landmarks: Float[np.ndarray, "21 2"]
) -> SeenPoints:
    """Several looks at a right hand, combined.

    Args:
        tracker: to ask.
        window: the hand's surroundings.
        landmarks: about where the hand is, pixels of the picture; their box is what counts.
    """
    around = window.from_picture(landmarks)
    upright = float(upright_turn(torch.from_numpy(around)[None])[0])
    looks = [Look.about(around, upright + turn, room) for turn, room in _LOOKS]
    placed = [look.picture_from_crop() for look in looks]
    told = tracker.tell(np.stack([resampled(window.image, *place, INPUT_SIDE) for place in placed]))
    found = INPUT_SIDE * told.places.double().numpy()
    places = np.stack(
        [
            (place @ matrix.T + corner) / window.scale + np.array(window.corner)
            for place, (matrix, corner) in zip(found, placed, strict=True)
        ]
    )
    sides = np.array([look.side for look in looks]) / window.scale
    errors = told.place_errors.double().numpy() * sides[:, None]
    place, error = _combined(places, errors)
    depth, depth_error = _combined(
        told.depths.double().numpy()[..., None], told.depth_errors.double().numpy()
    )
    spread = np.linalg.norm(places - place, axis=-1).max(0)
    return SeenPoints(place, error, depth[..., 0], depth_error, spread)


def world_places(
    tracked: TrackedPoints,
    landmarks: Float[np.ndarray, "21 2"],
    depths: Float[np.ndarray, "21"],
) -> Float[np.ndarray, "21 3"]:
    """Landmarks in metres about their middle, of a hand of the usual size.

    Args:
        tracked: whose template says how far the knuckles are from the wrist.
        landmarks: pixels.
        depths: behind the wrist, in units of the hand's size.
    """
    knuckles = list(KNUCKLES)
    length = _knuckle_distances(tracked.rig_name)
    # As long as they seem, and the rest of it is depth.
    flat = np.sqrt(np.maximum(length**2 - depths[knuckles] ** 2, (0.3 * length) ** 2))
    seen = np.linalg.norm(landmarks[knuckles] - landmarks[0], axis=-1)
    scale = max(float(np.median(seen / (HAND_SIZE * flat))), 1e-6)
    across = (landmarks - landmarks.mean(0)) / scale
    return np.concatenate([across, HAND_SIZE * depths[:, None]], axis=-1)


@lru_cache(maxsize=4)
def _knuckle_distances(rig_name: str) -> Float[np.ndarray, "knuckles"]:
    """From the wrist, on the template of a rig, in units of the hand's size."""
    rig = load_rig(rig_name)
    places = TrackedPoints.of(rig, 0).template_places(rig).double().numpy()
    lengths = np.linalg.norm(places - places[0], axis=-1)
    return lengths[list(KNUCKLES)] / lengths[MIDDLE_KNUCKLE]


def _combined(
    values: Float[np.ndarray, "looks points axes"], errors: Float[np.ndarray, "looks points"]
) -> tuple[Float[np.ndarray, "points axes"], Float[np.ndarray, "points"]]:
    """Looks err together: their mean is as unsure as they are, and more where they disagree."""
    weights = errors**-2
    weights = (weights / weights.sum(0))[..., None]
    mean = (weights * values).sum(0)
    apart = (weights * (values - mean) ** 2).sum(0).mean(-1)
    usual = (weights[..., 0] * errors**2).sum(0)
    return mean, np.sqrt(usual + apart)
