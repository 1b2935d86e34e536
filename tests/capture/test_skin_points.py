"""What the tracker tells of crops, brought back to the picture."""

import numpy as np
import torch

from handavatar.capture.skin_points import see_points
from handavatar.capture.windows import window_around
from handavatar.hand.rig import Rig
from handavatar.tracker.model import TrainedTracker
from handavatar.tracker.network import INPUT_SIDE, MAP_SIDE, HandNetwork, Told
from handavatar.tracker.points import TrackedPoints


class _DotSeer(HandNetwork):
    """All points are where the picture is bright, with an error of a hundredth of the crop."""

    def forward(self, crops: torch.Tensor) -> Told:
        bright = (crops.mean(1) - 0.5).relu()
        steps = (torch.arange(INPUT_SIDE) + 0.5) / INPUT_SIDE
        weight = bright.sum((1, 2))
        right = (bright.sum(1) * steps).sum(1) / weight
        down = (bright.sum(2) * steps).sum(1) / weight
        count = self.num_points
        places = torch.stack([right, down], -1)[:, None].expand(-1, count, -1)
        ones = torch.ones(len(crops), count)
        classes = torch.zeros(len(crops), 3, MAP_SIDE, MAP_SIDE)
        yes = torch.ones(len(crops))
        return Told(places, 0.01 * ones, 0.5 * ones, 0.1 * ones, classes, yes, yes)


def test_turned_and_scaled_looks_agree_in_the_picture(rig: Rig) -> None:
    y, x = np.mgrid[0:600, 0:800] + 0.5
    at = np.array([430.0, 260.0])
    dot = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 9.0**2))
    image = (255 * dot).round().astype(np.uint8)[..., None].repeat(3, axis=-1)
    landmarks = np.linspace([300.0, 150.0], [520.0, 390.0], 21)
    points = TrackedPoints.of(rig, 2)
    tracker = TrainedTracker(_DotSeer(len(points)).eval(), points)
    for scale in (1, 2):
        large = image.repeat(scale, axis=0).repeat(scale, axis=1)
        window = window_around(large, landmarks * scale)
        seen = see_points(tracker, window, landmarks * scale)
        assert seen.places.shape == (23, 2)
        np.testing.assert_allclose(seen.places, np.tile(at * scale, (23, 1)), atol=0.4 * scale)
        # Crops are 1.35 to 1.55 times as long as the upright hand of 326 pixels.
        assert ((seen.errors > 4.0 * scale) & (seen.errors < 5.5 * scale)).all()
        assert np.allclose(seen.depths, 0.5) and np.allclose(seen.depth_errors, 0.1)
