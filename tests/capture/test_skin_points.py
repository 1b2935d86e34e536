"""What the tracker tells of crops, brought back to the picture."""

import numpy as np
import pytest
import torch

from handavatar.capture.fitted_hand import HandFit
from handavatar.capture.fitting import Observations, with_skin
from handavatar.capture.registration import see_landmarks
from handavatar.capture.skin_points import SeenPoints, see_points
from handavatar.capture.windows import window_around
from handavatar.hand.landmarks import HAND_SIZE
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


def _seen(places: torch.Tensor, unsure: float) -> Observations:
    frames = len(places)
    return Observations(
        landmarks=places[:, :21],
        uncertainty=torch.full((frames, 21), unsure),
        world_landmarks=torch.zeros(frames, 21, 3),
        scale=torch.full((frames,), 1000.0),
        times=torch.arange(frames) / 10,
        picture_size=(640, 480),
        principal_point=(320.0, 240.0),
    )


def test_two_trackers_are_surer_where_they_agree_and_less_sure_where_they_do_not() -> None:
    generator = torch.Generator().manual_seed(0)
    places = 100 + 200 * torch.rand(3, 24, 2, generator=generator)
    depths = torch.rand(3, 24, generator=generator)
    own = places.clone()
    own[1, 7] += torch.tensor([40.0, 0.0])
    points = [
        SeenPoints(
            place.double().numpy(),
            np.full(24, 3.0),
            depth.double().numpy(),
            np.full(24, 0.1),
            np.zeros(24),
        )
        for place, depth in zip(own, depths, strict=True)
    ]
    both = with_skin(_seen(places, 2.0), points, torch.tensor([4, 5, 6]), torch.tensor([7, 8, 0]))
    assert both.skin is not None and both.skin.vertices.tolist() == [4, 5, 6]
    # 2 and 4 pixels (millimetres) here, 3 and 10 there.
    other, mine = 2**2 + 4**2, 3**2 + 10**2
    least = (1 / (1 / other + 1 / mine)) ** 0.5
    error = both.uncertainty
    assert torch.allclose(error[0], torch.tensor(least), rtol=1e-5)
    torch.testing.assert_close(both.landmarks[0], places[0, :21])
    share = other / (other + mine)
    expected = places[1, 7] + share * torch.tensor([40.0, 0.0])
    torch.testing.assert_close(both.landmarks[1, 7], expected)
    # As far as the mixture of both is wide, each way on average.
    wide = (least**2 + share * (1 - share) * 40**2 / 2) ** 0.5
    assert float(error[1, 7]) == pytest.approx(wide, rel=1e-5)
    # Skin is our own's alone, and so are depths, which come in metres.
    torch.testing.assert_close(both.skin.places, places[:, 21:])
    assert torch.allclose(both.skin.errors[0], torch.tensor(mine**0.5))
    # Skin near a landmark that the other tracker sees elsewhere is as unsure, in depth as well.
    factor = (40**2 / 2 / (other + mine)) ** 0.5
    expected_errors = mine**0.5 * torch.tensor([factor, 1, 1])
    assert torch.allclose(both.skin.errors[1], expected_errors, rtol=1e-4)
    depth_ratio = both.skin.depth_errors[1, [7, 21, 22]] / both.skin.depth_errors[0, [7, 21, 22]]
    assert torch.allclose(depth_ratio, torch.tensor([factor, factor, 1]), rtol=1e-4)
    torch.testing.assert_close(both.skin.depths, HAND_SIZE * depths)
    torch.testing.assert_close(both.world_landmarks[..., 2], HAND_SIZE * depths[:, :21])


def test_captures_keep_what_both_saw() -> None:
    places = 100 + 200 * torch.rand(2, 23, 2, generator=torch.Generator().manual_seed(1))
    points = [
        SeenPoints(
            place.double().numpy(), np.full(23, 3.0), np.zeros(23), np.full(23, 0.1), np.zeros(23)
        )
        for place in places
    ]
    seen = with_skin(_seen(places, 2.0), points, torch.tensor([4, 5]), torch.tensor([0, 1]))
    fit = HandFit(
        torch.zeros(2, 16, 3),
        torch.zeros(2, 3),
        torch.zeros(10),
        torch.tensor(500.0).log(),
        torch.zeros(21, 3),
    )
    for frame, sighting in enumerate(see_landmarks(seen, fit)):
        assert sighting.vertices.tolist() == [4, 5] and sighting.depths.shape == (23,)
        pixels = sighting.directions * 500 + torch.tensor([320.0, 240.0])
        torch.testing.assert_close(pixels, places[frame], rtol=0, atol=1e-3)
        assert float(sighting.depths.mean()) == pytest.approx(0.0, abs=1e-7)


def test_some_frames_of_what_both_saw_keep_their_skin() -> None:
    places = 100 + 200 * torch.rand(3, 23, 2, generator=torch.Generator().manual_seed(2))
    points = [
        SeenPoints(
            place.double().numpy(),
            np.full(23, 3.0),
            np.full(23, float(depth)),
            np.full(23, 0.1),
            np.zeros(23),
        )
        for depth, place in enumerate(places)
    ]
    seen = with_skin(_seen(places, 2.0), points, torch.tensor([4, 5]), torch.tensor([0, 1]))
    some = seen.chosen(torch.tensor([2, 0, 2]))
    assert some.skin is not None and some.skin.vertices.tolist() == [4, 5]
    torch.testing.assert_close(some.skin.places, places[[2, 0, 2], 21:])
    torch.testing.assert_close(some.skin.depths[:, 0], HAND_SIZE * torch.tensor([2.0, 0.0, 2.0]))
