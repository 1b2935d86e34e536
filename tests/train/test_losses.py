"""The losses of end-to-end training: each against its formula written out."""

import pytest
import torch

from handavatar.train.losses import border_loss, color_loss, occupancy_loss, offset_loss


def _random(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def test_occupancy_loss_is_the_mean_squared_error() -> None:
    predicted, is_inside = _random(50), _random(50) > 0.4
    errors = [(float(p) - float(t)) ** 2 for p, t in zip(predicted, is_inside, strict=True)]
    torch.testing.assert_close(occupancy_loss(predicted, is_inside), torch.tensor(sum(errors) / 50))
    assert float(occupancy_loss(is_inside.float(), is_inside)) == 0
    assert float(occupancy_loss((~is_inside).float(), is_inside)) == 1


def test_color_loss_is_the_mean_absolute_error() -> None:
    rendered, truth = _random(30, 3), _random(31, 3)[1:]
    errors = [abs(a - b) for a, b in zip(rendered.flatten().tolist(), truth.flatten().tolist())]  # noqa: B905
    torch.testing.assert_close(color_loss(rendered, truth), torch.tensor(sum(errors) / 90))
    assert float(color_loss(truth, truth)) == 0


# A square with one vertex in its middle.
EDGES = torch.tensor([[0, 1], [1, 2], [2, 3], [0, 3], [0, 4], [1, 4], [2, 4], [3, 4]])


def test_offset_loss_agrees_with_a_loop_over_the_vertices() -> None:
    offsets = (0.002 * _random(5, 3)).double()
    total = 0.0
    for vertex in range(5):
        ring = [int(b if a == vertex else a) for a, b in EDGES if vertex in (int(a), int(b))]
        rough = offsets[ring].mean(0) - offsets[vertex]
        total += float(1.6e-3 * rough.square().sum() + 5e-5 * offsets[vertex].square().sum()) / 5
    # Edges of 2.5 mm, half of the open hand's: sixteen times the weight.
    found = offset_loss(offsets, EDGES, 0.0025)
    torch.testing.assert_close(found, torch.tensor(1e6 * total).double())


def test_an_even_offset_is_cheap_and_a_rough_one_dear() -> None:
    even = torch.full((5, 3), 0.001)
    rough = even * torch.tensor([1.0, 1, 1, 1, -1])[:, None]
    assert float(offset_loss(torch.zeros(5, 3), EDGES, 0.0025)) == 0
    costs = [float(offset_loss(offsets, EDGES, 0.0025)) for offsets in (rough, even)]
    assert costs[0] > 10 * costs[1]


def test_gradients_agree_with_finite_differences() -> None:
    predicted = _random(6).double().requires_grad_()
    rendered = _random(4, 3).double().requires_grad_()
    offsets = (0.001 * _random(5, 3)).double().requires_grad_()
    is_inside, truth = _random(6) > 0.5, _random(5, 3)[:4].double() + 2
    assert torch.autograd.gradcheck(lambda p: occupancy_loss(p, is_inside), predicted)
    assert torch.autograd.gradcheck(lambda r: color_loss(r, truth), rendered)
    assert torch.autograd.gradcheck(lambda o: offset_loss(o, EDGES, 0.0025), offsets)


def test_the_border_loss_is_the_share_of_wrongly_covered_pixels() -> None:
    is_hand = torch.tensor([1.0, 1.0, 0.0, 0.0])
    assert float(border_loss(is_hand, is_hand)) == 0
    assert float(border_loss(torch.tensor([1.0, 0.5, 0.25, 0.0]), is_hand)) == pytest.approx(0.1875)
    alpha = torch.tensor([0.7, 0.2, 0.4, 0.1], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: border_loss(a, is_hand), alpha)
