"""Made pictures for the tracker: what they say of themselves is true."""

import numpy as np
import pytest
from conftest import coarse_skin

from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.hand.rig import Rig
from handavatar.synthetic.crops import CROP_SIDE, MadeCrops, make_crops
from handavatar.tracker.network import FOREARM, HAND
from handavatar.tracker.points import TrackedPoints


@pytest.fixture(scope="module")
def made(rig: Rig) -> MadeCrops:
    with coarse_skin():
        return make_crops(rig, TrackedPoints.of(rig, 64), 60, 7)


def test_the_same_seed_gives_the_same_pictures(rig: Rig) -> None:
    with coarse_skin():
        first, again = (make_crops(rig, TrackedPoints.of(rig, 64), 5, 7) for _ in range(2))
    assert not np.array_equal(first.images[0], first.images[1])
    for name in ("images", "classes", "points", "is_hand"):
        assert np.array_equal(getattr(first, name), getattr(again, name))


def test_points_lie_on_the_hand(made: MadeCrops) -> None:
    on_hand, total = 0, 0
    for classes, points, is_hand in zip(made.classes, made.points, made.is_hand, strict=True):
        if not is_hand:
            assert not (classes == HAND).any()
            continue
        # Joints lie inside, skin on the border now and then; the wrist's joint may lie on the arm.
        places = np.floor(points[1:, :2] * CROP_SIDE).astype(int)
        inside = ((places >= 0) & (places < CROP_SIDE)).all(-1)
        right, down = places[inside].T
        near = np.stack(
            [
                classes[(down + y).clip(0, CROP_SIDE - 1), (right + x).clip(0, CROP_SIDE - 1)]
                for x in (-1, 0, 1)
                for y in (-1, 0, 1)
            ]
        )
        on_hand += int((near == HAND).any(0).sum())
        total += int(inside.sum())
    # Some are hidden by things and by the arm.
    assert on_hand > 0.93 * total
    assert 0 < (~made.is_hand).sum() < 10


def test_hands_come_with_arms_in_any_depth(made: MadeCrops) -> None:
    assert (made.classes == FOREARM).any((1, 2)).mean() > 0.6
    depths = made.points[made.is_hand, :, 2]
    assert (depths[:, 0] == 0).all()
    # The middle finger's knuckle is one hand's size from the wrist.
    assert 0.5 < abs(depths[:, 9]).max() <= 1.0 + 1e-5
    spread = np.ptp(made.points[made.is_hand, :NUM_LANDMARKS, :2], axis=1).max(-1)
    assert 0.4 < np.median(spread) < 0.9
