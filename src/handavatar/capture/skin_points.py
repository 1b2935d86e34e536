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
    crops, places_in, sides = [], [], []
    for turn, share in _LOOKS:
        cos, sin = math.cos(upright + turn), math.sin(upright + turn)
        axes = np.array([[cos, -sin], [sin, cos]])
        turned = around @ axes
        low, high = turned.min(0), turned.max(0)
        side = float((high - low).max()) * share
        window_from_crop = axes * (side / INPUT_SIDE)
        corner = axes @ ((low + high) / 2 - side / 2)
        crops.append(resampled(window.image, window_from_crop, corner, INPUT_SIDE))
        places_in.append((window_from_crop * INPUT_SIDE, corner))
        sides.append(side / window.scale)
    told = tracker.tell(np.stack(crops))
    found = told.places.double().numpy()
    places = np.stack(
        [
            (place @ matrix.T + corner) / window.scale + np.array(window.corner)
            for place, (matrix, corner) in zip(found, places_in, strict=True)
        ]
    )
    errors = told.place_errors.double().numpy() * np.array(sides)[:, None]
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
    places = TrackedPoints.of(rig, 0).template_places(rig)
    lengths: Float[np.ndarray, knuckles]
    lengths = (places[list(KNUCKLES)] - places[0]).norm(dim=-1).double().numpy()
    return lengths / float((places[MIDDLE_KNUCKLE] - places[0]).norm())


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
