"""Unwrapping: a plane of known colours comes back from its pictures."""

import math
from dataclasses import replace

import pytest
import torch

from handavatar.geometry.cameras import Camera, look_at
from handavatar.render.chart import Texels
from handavatar.train.unwrap import UnwrapView, unwrap_pictures, weighted_median

FACES = torch.tensor([[0, 2, 1], [1, 2, 3]])
CORNERS = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])[FACES]
SIZE = 16


def _plane(height: float = 0.0) -> torch.Tensor:
    """A square of 10 cm; (u, v) are x and y in tenths of a metre, its normal points to -z."""
    flat = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.1, 0.1]])
    return torch.cat([flat, torch.full((4, 1), height)], dim=-1)


def _texels() -> Texels:
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    u, v = ((part.flatten() + 0.5) / SIZE for part in (columns, rows))
    is_first = u + v < 1
    first = torch.stack([1 - u - v, v, u], dim=-1)
    second = torch.stack([1 - v, 1 - u, u + v - 1], dim=-1)
    return Texels(
        SIZE,
        rows.flatten(),
        columns.flatten(),
        torch.where(is_first, 0, 1),
        torch.where(is_first[:, None], first, second),
    )


def _value(places: torch.Tensor) -> torch.Tensor:
    u, v = places.unbind(-1)
    return torch.stack([u - 0.5, 0.5 * v, u * v - 0.3], dim=-1)


def _view(
    eye: tuple[float, float, float],
    error: float = 0.0,
    sharpness: float = 1.0,
    beside: float = 0.0,
    fit_error: float = 0.0,
    size: int = 64,
) -> UnwrapView:
    """The plane as a camera sees it, its surface ``beside`` metres before the mesh."""
    placed = look_at(
        torch.tensor(eye), torch.tensor([0.05, 0.05, 0.0]), torch.tensor([0.0, -1.0, 0.0])
    )
    focal, middle = 120.0 * size / 64, size / 2
    camera = Camera((focal, focal), (middle, middle), size, size, placed)
    y, x = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    rotation, translation = placed[:3, :3], placed[:3, 3]
    across, down = (x - middle) / focal, (y - middle) / focal
    directions = torch.stack([across, down, torch.ones_like(x)], dim=-1)
    directions, origin = directions @ rotation, -translation @ rotation
    along = (-beside - origin[2]) / directions[..., 2]
    places = 10 * (origin + along[..., None] * directions)[..., :2]
    is_known = ((places > -0.1) & (places < 1.1)).all(-1)
    places = places[is_known]
    return UnwrapView(
        residual=_value(places) + error,
        places=places,
        is_known=is_known,
        camera=camera,
        vertices=_plane(),
        sharpness=sharpness,
        fit_error=fit_error,
        pixel=size / 64,
    )


def _unwrapped(*views: UnwrapView) -> tuple[torch.Tensor, torch.Tensor]:
    found = unwrap_pictures(list(views), FACES, _texels(), CORNERS)
    return found.residual, found.seen


def _truth() -> torch.Tensor:
    texels = _texels()
    return _value((torch.stack([texels.columns, texels.rows], dim=-1) + 0.5) / SIZE)


FRONT, SIDE, BACK = (0.05, 0.05, -0.25), (-0.1, 0.05, -0.2), (0.05, 0.05, 0.25)


@pytest.mark.parametrize("beside", [0.0, 2e-3])
def test_the_values_of_a_plane_come_back(beside: float) -> None:
    """Also where the surface that is seen lies before the mesh: pixels know their places."""
    values, seen = _unwrapped(_view(FRONT), _view(SIDE, beside=beside))
    inside = seen > 0
    assert float(inside.float().mean()) > 0.9
    torch.testing.assert_close(values[inside], _truth()[inside], atol=4e-3, rtol=0)
    only, _ = _unwrapped(_view(SIDE, beside=beside))
    torch.testing.assert_close(only[inside], _truth()[inside], atol=0.02, rtol=0)


def test_what_no_frame_sees_is_zero() -> None:
    unknown = replace(
        _view(FRONT),
        residual=torch.zeros(0, 3),
        places=torch.zeros(0, 2),
        is_known=torch.zeros(64, 64, dtype=torch.bool),
    )
    for views in ([], [_view(BACK)], [unknown]):
        values, seen = _unwrapped(*views)
        assert not bool(values.any()) and not bool(seen.any())


def test_a_surface_before_the_texel_hides_it() -> None:
    behind = unwrap_pictures(
        [_with_cover(_view(FRONT))],
        torch.cat([FACES, FACES + 4]),
        _texels(),
        CORNERS.repeat(2, 1, 1),
    )
    assert not bool(behind.seen.any())


def _with_cover(view: UnwrapView) -> UnwrapView:
    """A second, larger plane 2 cm before the first."""
    cover = 2 * _plane(-0.01) - torch.tensor([0.05, 0.05, 0.0])
    return replace(view, vertices=torch.cat([view.vertices, cover]))


def test_one_wrong_frame_of_three_does_not_count() -> None:
    values, seen = _unwrapped(_view(FRONT), _view(FRONT, error=0.5), _view(FRONT))
    torch.testing.assert_close(values[seen > 0], _truth()[seen > 0], atol=4e-3, rtol=0)


@pytest.mark.parametrize(
    "worse",
    [{"sharpness": 0.3}, {"fit_error": 3.0}, {"eye": SIDE}],
    ids=lambda worse: next(iter(worse)),
)
def test_a_blurred_a_badly_fitted_and_a_slanted_frame_weigh_less(worse: dict) -> None:
    bad = _view(**({"eye": FRONT, "error": 0.5} | worse))
    values, seen = _unwrapped(_view(FRONT), bad)
    torch.testing.assert_close(values[seen > 0.5], _truth()[seen > 0.5], atol=4e-3, rtol=0)


def test_the_median_of_weights_is_where_half_of_them_lies() -> None:
    values = torch.tensor([3.0, 1.0, 2.0])[:, None, None]
    for weights, expected in (
        ((1, 1, 1), 2.0),
        ((5, 1, 1), 3.0),
        ((1, 5, 1), 1.0),
        ((0, 0, 1), 2.0),
    ):
        found = weighted_median(values, torch.tensor(weights)[:, None].float())
        assert float(found) == expected
    assert math.isfinite(float(weighted_median(values, torch.zeros(3, 1))))


def test_a_surface_beside_the_mesh_is_found_in_larger_pictures_too() -> None:
    """The shift that is still believed is a share of the picture, not a number of pixels."""
    eye = (-0.05, 0.05, -0.2)
    # More than two pixels of the small picture, more than four of the large one.
    view = _view(eye, beside=0.008, size=128)
    small, large = _unwrapped(_view(eye, beside=0.008)), _unwrapped(view)
    assert float((small[1] > 0).float().mean()) > 0.6
    assert abs(float((small[1] > 0).float().mean() - (large[1] > 0).float().mean())) < 0.05
    both = (small[1] > 0) & (large[1] > 0)
    assert float((small[0] - large[0])[both].abs().mean()) < 0.03
    as_if_small = replace(view, pixel=1.0)
    assert float((_unwrapped(as_if_small)[1] > 0).float().mean()) < 0.3
