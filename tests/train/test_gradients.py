"""Gradients of several losses, a thread each."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor, nn

from handavatar.train.gradients import set_mean_gradient


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_the_gradient_is_that_of_the_mean(threads: int) -> None:
    torch.manual_seed(0)
    network, unused = nn.Linear(5, 3), nn.Parameter(torch.ones(2))
    inputs = list(torch.randn(7, 4, 5))

    def loss_of(piece: Tensor) -> tuple[Tensor, float]:
        loss = network(piece).square().sum()
        return loss, float(loss.detach())

    expected = torch.stack([loss_of(piece)[0] for piece in inputs]).mean()
    expected_gradients = torch.autograd.grad(expected, list(network.parameters()))
    with torch.no_grad():
        told = set_mean_gradient([*network.parameters(), unused], loss_of, inputs)
    assert told == pytest.approx(float(expected), rel=1e-6)
    for parameter, gradient in zip(network.parameters(), expected_gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)
    assert unused.grad is not None and not unused.grad.any()
    assert torch.get_num_threads() == threads
