"""How well a tracker sees made pictures that it was not taught with."""

from dataclasses import dataclass

import numpy as np
import torch

from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.tracker.model import TrainedTracker
from handavatar.tracker.network import HAND, MAP_SIDE
from handavatar.tracker.training import CropBatch

_AT_ONCE = 100
ONE_SIGMA = 0.6827
"""Share of normal errors within their deviation."""


@dataclass(frozen=True)
class TrackerFigures:
    """Errors of a tracker on made pictures of right hands.

    Attributes:
        landmarks: mean distance of joints and fingertips in the picture, per cent of its side.
        skin: of points of the skin.
        depths: mean error of depths behind the wrist, per cent of the hand's size.
        place_coverage: share of coordinates within their expected error; 0.68 is right.
        depth_coverage: share of depths within theirs.
        mask_iou: of the hand's pixels at a quarter of the resolution.
        presence: share of pictures of which it is known whether there is a hand.
        side: share of hands known to be right ones, or left ones when they are mirrored.
    """

    landmarks: float
    skin: float
    depths: float
    place_coverage: float
    depth_coverage: float
    mask_iou: float
    presence: float
    side: float


def measure_tracker(tracker: TrainedTracker, pictures: CropBatch) -> TrackerFigures:
    """Asks a tracker about pictures and compares.

    Args:
        tracker: to judge.
        pictures: of right hands, with their truth.
    """
    sums: dict[str, list[np.ndarray]] = {}
    joint = union = 0
    for start in range(0, len(pictures.images), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        images = pictures.images[part].numpy()
        told = tracker.tell(images)
        is_hand, truth = pictures.is_hand[part], pictures.points[part]
        apart = told.places - truth[..., :2]
        behind = (told.depths - truth[..., 2]).abs()
        mirrored = tracker.tell(np.ascontiguousarray(images[:, :, ::-1]))
        sides = torch.cat([told.is_right > 0, mirrored.is_right < 0])
        stride = pictures.classes.shape[1] // MAP_SIDE
        true_hand = pictures.classes[part, ::stride, ::stride] == HAND
        seen_hand = told.classes.argmax(1) == HAND
        joint += int((true_hand & seen_hand).sum())
        union += int((true_hand | seen_hand).sum())
        for name, values in {
            "landmarks": 100 * apart.norm(dim=-1)[is_hand, :NUM_LANDMARKS],
            "skin": 100 * apart.norm(dim=-1)[is_hand, NUM_LANDMARKS:],
            "depths": 100 * behind[is_hand],
            "place_coverage": apart.abs()[is_hand] < told.place_errors[is_hand, :, None],
            "depth_coverage": behind[is_hand] < told.depth_errors[is_hand],
            "presence": (told.is_hand > 0) == is_hand,
            "side": sides[is_hand.repeat(2)],
        }.items():
            sums.setdefault(name, []).append(values.float().numpy().ravel())
    means = {name: float(np.concatenate(values).mean()) for name, values in sums.items()}
    return TrackerFigures(mask_iou=joint / max(union, 1), **means)
