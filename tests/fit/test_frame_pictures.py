"""What one frame shows: blur, slopes, border; and that unknown pixels say nothing."""

import pytest
import torch
from jaxtyping import Float
from made_frames import calm_poses, camera_over, draw, pose_at, scribble
from torch import Tensor

from handavatar.fit.pictures import FramePicture, blur, sample_with_slope
from handavatar.geometry.cameras import Camera, pixel_centers
from handavatar.hand.rig import Rig

SIZE = 64


def _camera(size: int = SIZE) -> Camera:
    return Camera((100.0, 100.0), (size / 2, size / 2), size, size, torch.eye(4))


def _disc(
    center: tuple[float, float], radius: float, size: int = SIZE
) -> Float[Tensor, "size size"]:
    """How much of each pixel a disc covers, by 8 x 8 points in each."""
    fine = (pixel_centers(_camera(8 * size)) / 8 - torch.tensor(center)).norm(dim=-1) < radius
    return fine.float().reshape(size, 8, size, 8).mean((1, 3))


def _picture(coverage: Tensor, known: Tensor | None = None) -> FramePicture:
    generator = torch.Generator().manual_seed(0)
    color = torch.rand(*coverage.shape, 3, generator=generator)
    known = torch.ones_like(coverage, dtype=torch.bool) if known is None else known
    return FramePicture.of(_camera(len(coverage)), color, coverage, known, torch.ones(3))


@pytest.mark.parametrize("sigma", [0.0, 0.7, 3.0])
def test_blur_keeps_constants(sigma: float) -> None:
    image = torch.tensor([0.2, 0.5, 0.9]).expand(20, 30, 3)
    torch.testing.assert_close(blur(image, sigma), image, rtol=0, atol=1e-6)


def test_blur_spreads_a_point_as_a_gaussian_does() -> None:
    image = torch.zeros(41, 41, 1)
    image[20, 20] = 1.0
    spread = blur(image, 2.0)[..., 0]
    assert float(spread.sum()) == pytest.approx(1, abs=1e-5)
    away = torch.arange(41.0) - 20
    # Cut off at three standard deviations, a Gaussian's variance is 0.973 of the whole one's.
    assert float((spread.sum(0) * away.square()).sum()) == pytest.approx(4, rel=0.04)
    torch.testing.assert_close(spread, spread.T)


def test_sampling_is_exact_on_a_linear_picture() -> None:
    slopes = torch.tensor([[0.3, -0.2], [0.0, 1.0]])
    channels = (pixel_centers(_camera()) @ slopes.T + torch.tensor([1.0, -2.0])).permute(2, 0, 1)
    generator = torch.Generator().manual_seed(1)
    points = 1.5 + (SIZE - 3) * torch.rand(200, 2, generator=generator)
    values, found = sample_with_slope(channels, points)
    expected = points @ slopes.T + torch.tensor([1.0, -2.0])
    torch.testing.assert_close(values, expected, rtol=0, atol=1e-4)
    # Differences over one pixel of values up to 64: their rounding is 1e-5.
    torch.testing.assert_close(found, slopes.expand(200, 2, 2), rtol=0, atol=1e-4)


def test_beyond_the_picture_its_border_goes_on() -> None:
    channels = torch.arange(4.0).expand(1, 3, 4)
    values, slopes = sample_with_slope(channels, torch.tensor([[-20.0, 1.5], [30.0, -9.0]]))
    assert values[:, 0].tolist() == [0.0, 3.0] and not slopes.any()


@pytest.mark.parametrize("radius", [10.0, 21.3])
def test_the_border_of_a_disc_is_its_circle(radius: float) -> None:
    center = (31.3, 33.8)
    picture = _picture(_disc(center, radius))
    away = picture.border - torch.tensor(center)
    # Half a pixel of what the mask knows, and the blur of the distance by one pixel pulls the
    # border in by about 1 / (2 radius).
    assert float((away.norm(dim=-1) - radius).abs().max()) < 0.3
    outward = (picture.border_normals * away).sum(-1) / away.norm(dim=-1)
    assert float(outward.min()) > 0.98
    # All around, about one in every pixel's length or more.
    assert len(picture.border) > 6 * radius
    turn = torch.atan2(away[:, 1], away[:, 0]).sort().values
    assert float(turn.diff().max()) < 3 / radius
    # The distance itself: negative inside, and nearly the true one.
    values, _ = sample_with_slope(picture.distance[None], torch.tensor([center, (5.0, 33.8)]))
    assert float(values[0, 0]) < -radius + 1.5
    assert float(values[1, 0]) == pytest.approx(26.3 - radius, abs=0.5)


def test_without_a_hand_there_is_no_border() -> None:
    for coverage in (torch.zeros(SIZE, SIZE), torch.ones(SIZE, SIZE)):
        picture = _picture(coverage)
        assert len(picture.border) == len(picture.border_normals) == 0


def test_no_border_runs_along_what_is_unknown_or_beyond() -> None:
    # The disc hangs over the picture's left border, and its lower half is unknown.
    known = torch.ones(SIZE, SIZE, dtype=torch.bool)
    known[34:] = False
    picture = _picture(_disc((4.0, 32.0), 15.0), known)
    away = picture.border - torch.tensor([4.0, 32.0])
    assert len(picture.border) > 10
    assert float((away.norm(dim=-1) - 15).abs().max()) < 0.3
    assert float(picture.border[:, 1].max()) < 33 and float(picture.border[:, 0].min()) > 1
    assert bool(picture.sees_outline(torch.tensor([[10.0, 17.0]]))[0])
    points = torch.tensor([[10.0, 20.0], [10.0, 40.0], [-1.0, 20.0], [64.0, 20.0]])
    assert picture.is_known(points).tolist() == [True, False, False, False]


def test_a_band_has_details_of_its_size_and_nothing_of_the_background() -> None:
    coverage = _disc((32.0, 32.0), 20.0)
    plain = torch.tensor([0.6, 0.5, 0.4])
    x = torch.arange(SIZE) + 0.5
    known, gain = torch.ones_like(coverage, dtype=torch.bool), torch.tensor([1.2, 1.0, 0.8])
    inside = torch.tensor([[32.0, 32.0], [46.0, 40.0], [32.0, 14.5]])
    strengths = []
    for wavelength in (10.0, 200.0):
        waves = 1 + 0.2 * torch.sin(2 * torch.pi / wavelength * x)[None, :, None]
        color = torch.where(coverage[..., None] > 0, plain * waves, torch.ones(3))
        picture = FramePicture.of(_camera(), color, coverage, known, gain)
        channels = picture.band(1.5).channels[:3, picture.hand]
        strengths.append(float(channels.std()))
    assert strengths[0] > 0.06 and strengths[1] < 0.02
    color = torch.where(coverage[..., None] > 0, plain, torch.ones(3))
    picture = FramePicture.of(_camera(), color, coverage, known, gain)
    values, _ = picture.band(3.0).sample(inside)
    torch.testing.assert_close(values[:, :3], torch.zeros(3, 3), rtol=0, atol=1e-5)


def test_scribbling_over_the_unknown_changes_no_bit(rig: Rig) -> None:
    camera = camera_over(SIZE)
    color, coverage = draw(rig.shaped(), pose_at(calm_poses(rig, 1), 0), camera)
    known = torch.ones(SIZE, SIZE, dtype=torch.bool)
    known[:20] = False
    known[36:40, 28:34] = False
    both = []
    for shown in ((color, coverage), scribble(color, coverage, known)):
        picture = FramePicture.of(camera, *shown, known, torch.tensor([1.1, 1.0, 0.9]))
        bands = [picture.band(sigma).channels for sigma in (0.7, 3.0)]
        parts = [picture.distance, picture.border, picture.border_normals, *bands]
        both.append([*parts, picture.hand, picture.has_outline, picture.known])
    assert len(both[0][1]) > 50
    assert all(torch.equal(first, second) for first, second in zip(*both, strict=True))


def test_levels_are_the_colors_that_they_stand_for() -> None:
    picture = _picture(_disc((30.0, 30.0), 12.0))
    levels = (picture.pixels * 255).round().to(torch.uint8)
    arguments = (picture.camera, (picture.distance < 0).float(), picture.known, torch.rand(3) + 0.5)
    camera, coverage, known, gain = arguments
    small = FramePicture.of(camera, levels, coverage, known, gain)
    large = FramePicture.of(camera, levels.float() / 255, coverage, known, gain)
    assert torch.equal(small.color, large.color) and small.pixels.dtype == torch.uint8
    assert torch.equal(small.band(2.0).channels, large.band(2.0).channels)
