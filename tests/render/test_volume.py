"""Volume rendering of occupancy: laws, the printed double loop, gradients."""

import torch
from torch import Tensor

from handavatar.render.volume import composite, composite_sparse, transmittance, visibility


def _occupancy(rays: int = 7, samples: int = 12, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(rays, samples, generator=generator, dtype=dtype) ** 3
    values[0] = 0  # empty
    values[1, 4] = 1  # a wall
    return values


def _composite_slowly(occupancy: Tensor, values: Tensor) -> Tensor:
    """Equation 2 as printed: a product inside a sum."""
    total = torch.zeros(len(occupancy), values.shape[-1], dtype=values.dtype)
    for ray in range(len(occupancy)):
        for i in range(occupancy.shape[1]):
            light = 1.0
            for j in range(i):
                light *= 1 - float(occupancy[ray, j])
            total[ray] += light * occupancy[ray, i] * values[ray, i]
    return total


def test_compositing_agrees_with_the_printed_double_loop() -> None:
    occupancy = _occupancy()
    values = torch.rand(7, 12, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = composite(visibility(occupancy), values)
    torch.testing.assert_close(found, _composite_slowly(occupancy, values))


def test_weights_and_what_passes_share_the_light() -> None:
    occupancy = _occupancy()
    weights = visibility(occupancy)
    passed = (1 - occupancy).prod(1)
    torch.testing.assert_close(weights.sum(1) + passed, torch.ones(7, dtype=torch.float64))
    assert float(weights.min()) >= 0
    assert float(weights[0].abs().max()) == 0


def test_nothing_behind_a_wall_is_seen() -> None:
    occupancy = _occupancy()
    assert float(visibility(occupancy)[1, 5:].abs().max()) == 0
    assert float(transmittance(occupancy)[1, 5:].abs().max()) == 0
    assert torch.equal(transmittance(occupancy)[:, 0], torch.ones(7, dtype=torch.float64))


def test_a_constant_colour_is_seen_as_it_is_where_the_ray_ends_in_a_wall() -> None:
    occupancy = _occupancy()
    occupancy[:, -1] = 1
    color = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    found = composite(visibility(occupancy), color.expand(7, 12, 3))
    torch.testing.assert_close(found, color.expand(7, 3))


def test_dropping_samples_without_weight_changes_nothing() -> None:
    occupancy = _occupancy()
    values = torch.rand(7, 12, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    weights = visibility(occupancy)
    ray, sample = (weights > 0).nonzero().unbind(-1)
    found = composite_sparse(weights[ray, sample], ray, values[ray, sample], 7)
    torch.testing.assert_close(found, composite(weights, values))


def test_the_gradient_is_right_also_at_a_wall() -> None:
    occupancy = _occupancy(3, 5)
    values = torch.rand(3, 5, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def rendered(occupancy: Tensor, values: Tensor) -> Tensor:
        return composite(visibility(occupancy), values)

    occupancy[2, 1] = 1.0
    inputs = (occupancy.requires_grad_(), values.requires_grad_())
    assert torch.autograd.gradcheck(rendered, inputs)
