"""Anchors: nearest neighbours, inverse distance, interpolation."""

import pytest
import torch
from torch import Tensor

from handavatar.field.anchors import (
    SMALLEST_DISTANCE,
    Neighbours,
    inverse_distance_weights,
    nearest_anchors,
    place_anchors,
)
from handavatar.hand.open_hand import load_open_hand


def _scene() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return (
        0.1 * torch.randn(500, 3, generator=generator),
        0.1 * torch.randn(40, 3, generator=generator),
    )


@pytest.mark.parametrize("count", [0, 1, 100_000])
def test_no_channels_are_interpolated_to_no_channels(count: int) -> None:
    generator = torch.Generator().manual_seed(0)
    indices = torch.randint(4096, (count, 4), generator=generator)
    neighbours = Neighbours(indices, torch.full((count, 4), 0.25))
    assert neighbours.interpolated(torch.zeros(4096, 0)).shape == (count, 0)


def test_neighbours_and_weights_agree_with_a_full_search() -> None:
    anchors, queries = _scene()
    found = nearest_anchors(anchors, queries, 4)
    for row, query in enumerate(queries):
        distance = (anchors - query).norm(dim=-1)
        expected = distance.argsort()[:4]
        assert found.indices[row].tolist() == expected.tolist()
        inverse = 1 / distance[expected]
        torch.testing.assert_close(found.weights[row], inverse / inverse.sum())


def test_weights_sum_to_one_and_are_finite_on_an_anchor() -> None:
    anchors, _ = _scene()
    queries = anchors[:5].clone().requires_grad_()
    found = nearest_anchors(anchors, queries)
    torch.testing.assert_close(found.weights.sum(-1), torch.ones(5))
    assert bool((found.weights[:, 0] > 0.99).all())
    found.weights.square().sum().backward()
    assert queries.grad is not None and bool(torch.isfinite(queries.grad).all())


def test_interpolation_keeps_constants_and_stays_between_the_neighbours() -> None:
    anchors, queries = _scene()
    found = nearest_anchors(anchors, queries)
    constant = torch.full((500, 2), 3.0)
    torch.testing.assert_close(found.interpolated(constant), torch.full((40, 2), 3.0))
    values = torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    mixed = found.interpolated(values)
    nearby = values[found.indices]
    slow = (nearby * found.weights[..., None]).sum(1)
    torch.testing.assert_close(mixed, slow)
    assert bool((mixed >= nearby.amin(1) - 1e-6).all() and (mixed <= nearby.amax(1) + 1e-6).all())


def test_the_gradient_of_the_weights_to_queries_and_anchors() -> None:
    anchors, queries = (values.double() for values in _scene())
    anchors, queries = anchors[:20].requires_grad_(), queries[:5].requires_grad_()
    indices = nearest_anchors(anchors, queries, 3).indices
    assert torch.autograd.gradcheck(
        lambda a, q: inverse_distance_weights(a, q, indices), (anchors, queries)
    )


def test_no_queries_give_no_neighbours() -> None:
    anchors, _ = _scene()
    assert nearest_anchors(anchors, torch.zeros(0, 3)).indices.shape == (0, 4)


def test_anchors_spread_over_the_whole_hand_without_clumps() -> None:
    rig = load_open_hand("778")
    anchors = place_anchors(rig, 500)
    positions = anchors.positions(rig.template_vertices)
    spacing = torch.cdist(positions, positions) + torch.eye(500)
    assert float(spacing.min()) > 20 * SMALLEST_DISTANCE
    # Every vertex of the hand has an anchor within two typical spacings.
    area = 0.5 * sum(
        float(torch.linalg.cross(b - a, c - a).norm())
        for a, b, c in rig.template_vertices[rig.faces]
    )
    typical = (area / 500) ** 0.5
    nearest = torch.cdist(rig.template_vertices, positions).min(-1).values
    assert float(nearest.max()) < 2 * typical
    assert float(spacing.min()) > 0.3 * typical
    again = place_anchors(rig, 500)
    assert torch.equal(anchors.barycentric, again.barycentric)
