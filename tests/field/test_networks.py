"""Building blocks: encodings and small networks."""

import math

import pytest
import torch

from handavatar.field.layers import MLP, PointNet, ResidualBlock, SkipMLP, positional_encoding


def test_the_encoding_agrees_with_its_formula() -> None:
    positions = torch.rand(4, 3, generator=torch.Generator().manual_seed(0)).double()
    found = positional_encoding(positions, 3)
    assert found.shape == (4, 21)
    for row, point in enumerate(positions.tolist()):
        expected = [*point]
        for function in (math.sin, math.cos):
            expected += [function(2**k * math.pi * x) for k in range(3) for x in point]
        torch.testing.assert_close(found[row], torch.tensor(expected).double())


def test_a_residual_block_starts_as_its_shortcut() -> None:
    torch.manual_seed(0)
    block, inputs = ResidualBlock(8, 4), torch.randn(5, 8)
    with torch.no_grad():
        block.outer.bias.zero_()
    torch.testing.assert_close(block(inputs), block.shortcut(inputs))


def test_a_pooled_pointnet_ignores_order_and_repetition() -> None:
    torch.manual_seed(0)
    network, points = PointNet(6), torch.randn(2, 30, 6)
    shuffled = points[:, torch.randperm(30)]
    repeated = torch.cat([points, points[:, :7]], dim=1)
    code = network(points)
    assert code.shape == (2, 64)
    torch.testing.assert_close(network(shuffled), code)
    torch.testing.assert_close(network(repeated), code)


def test_an_unpooled_pointnet_follows_the_order() -> None:
    torch.manual_seed(0)
    network, points = PointNet(6, is_pooled=False), torch.randn(3, 2, 6)
    features = network(points)
    assert features.shape == (3, 2, 64)
    torch.testing.assert_close(network(points.flip(1)), features.flip(1))


@pytest.mark.parametrize("is_pooled", [True, False])
def test_the_factorised_pointnet_is_the_same_function_with_the_same_gradient(
    is_pooled: bool,
) -> None:
    torch.manual_seed(0)
    network = PointNet(6, is_pooled=is_pooled).double()
    for block in network.blocks:  # They start as their shortcuts; the rest must count too.
        torch.nn.init.normal_(block.outer.weight, std=0.1)  # type: ignore[union-attr,arg-type]
    points = torch.randn(3, 20, 6, dtype=torch.float64, requires_grad=True)
    wanted = [points, *network.parameters()]
    found, expected = network.factorised(points), network(points)
    torch.testing.assert_close(found, expected)
    scale = torch.randn_like(expected)
    gradients = [torch.autograd.grad((scale * value).sum(), wanted) for value in (found, expected)]
    for ours, theirs in zip(*gradients, strict=True):
        assert bool(theirs.any())
        torch.testing.assert_close(ours, theirs)


def test_depth_counts_hidden_layers() -> None:
    network = MLP(5, 16, 4, 2)
    assert len(network.hidden) == 4 and network(torch.zeros(3, 5)).shape == (3, 2)
    widths = [(layer.in_features, layer.out_features) for layer in SkipMLP(64, 128, 1).layers]
    assert widths == [(64, 128), (128, 64), (128, 128), (128, 128)]


def test_the_joined_network_agrees_with_its_formula() -> None:
    """The input joins the second hidden layer's units, with as much variance as they have."""
    torch.manual_seed(0)
    network, inputs = SkipMLP(8, 20, 2), torch.randn(5, 8)
    (w1, b1), (w2, b2), (w3, b3), (w4, b4) = (
        (layer.weight, layer.bias) for layer in network.layers
    )
    second = (w2 @ (w1 @ inputs.T + b1[:, None]).relu() + b2[:, None]).relu()
    joined = torch.cat([second, inputs.T]) * 0.5**0.5
    last = (w4 @ (w3 @ joined + b3[:, None]).relu() + b4[:, None]).relu()
    expected = (network.output.weight @ last + network.output.bias[:, None]).T
    torch.testing.assert_close(network(inputs), expected)
