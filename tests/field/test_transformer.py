"""Self-attention against torch's own layers, and what attention maps are."""

import pytest
import torch
from torch import Tensor, nn

from handavatar.field.layers import PointNet
from handavatar.field.occupancy import CODE_WIDTH, LENGTH_SCALE, HandCodes, local_points
from handavatar.field.partwise import PartwiseOccupancy
from handavatar.field.transformer import TransformerBlock, TransformerDecoder, attention_maps
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.pose import NUM_BONES, HandPose


@pytest.fixture(scope="module")
def decoder() -> TransformerDecoder:
    torch.manual_seed(0)
    return TransformerDecoder()


@pytest.fixture(scope="module")
def seen(decoder: TransformerDecoder) -> tuple[HandCodes, Tensor]:
    rig = load_open_hand("778")
    posed = rig.shaped().posed(HandPose.flat())
    field = PartwiseOccupancy(PointNet(6, CODE_WIDTH), decoder)
    return field.encode(divide_into_parts(rig), posed), posed.vertices[::20]


def _torchs_own(block: TransformerBlock) -> nn.TransformerEncoderLayer:
    """The same weights in torch's layer."""
    width, heads = block.outer.out_features, block.attention.num_heads
    layer = nn.TransformerEncoderLayer(
        width, heads, block.inner.out_features, dropout=0.0, batch_first=True, norm_first=True
    )
    names = {
        "self_attn.in_proj_weight": block.attention.input.weight,
        "self_attn.in_proj_bias": block.attention.input.bias,
        "self_attn.out_proj.weight": block.attention.output.weight,
        "self_attn.out_proj.bias": block.attention.output.bias,
        "linear1.weight": block.inner.weight,
        "linear1.bias": block.inner.bias,
        "linear2.weight": block.outer.weight,
        "linear2.bias": block.outer.bias,
        "norm1.weight": block.attention_norm.weight,
        "norm1.bias": block.attention_norm.bias,
        "norm2.weight": block.mlp_norm.weight,
        "norm2.bias": block.mlp_norm.bias,
    }
    layer.load_state_dict(names)
    return layer


def test_a_block_agrees_with_torchs_encoder_layer(decoder: TransformerDecoder) -> None:
    block = decoder.blocks[0]
    assert isinstance(block, TransformerBlock)
    tokens = torch.randn(5, NUM_BONES, CODE_WIDTH, generator=torch.Generator().manual_seed(1))
    layer = _torchs_own(block)
    torch.testing.assert_close(block(tokens), layer(tokens), atol=2e-6, rtol=1e-5)
    normalised = block.attention_norm(tokens)
    _, expected = layer.self_attn(normalised, normalised, normalised, average_attn_weights=False)
    found = block.attention.weights(normalised)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)


def test_no_part_has_a_number(decoder: TransformerDecoder) -> None:
    """Parts in another order give the same answers in that order: shapes are all it sees."""
    generator = torch.Generator().manual_seed(2)
    codes = torch.randn(NUM_BONES, CODE_WIDTH, generator=generator)
    queries = torch.randn(4, NUM_BONES, 3, generator=generator)
    order = torch.randperm(NUM_BONES, generator=generator)
    everything = torch.ones(4, NUM_BONES, dtype=torch.bool)
    with torch.no_grad():
        straight = decoder(codes, queries, everything).view(4, NUM_BONES)
        mixed = decoder(codes[order], queries[:, order], everything).view(4, NUM_BONES)
    torch.testing.assert_close(mixed, straight[:, order], atol=1e-4, rtol=0)


def test_maps_are_means_of_weights_that_sum_to_one(
    decoder: TransformerDecoder, seen: tuple[HandCodes, Tensor]
) -> None:
    codes, points = seen
    maps = attention_maps(decoder, codes, points)
    assert maps.shape == (4, 4, NUM_BONES, NUM_BONES) and not maps.requires_grad
    torch.testing.assert_close(maps.sum(-1), torch.ones(4, 4, NUM_BONES))
    assert float(maps.min()) > 0
    slow = torch.zeros_like(maps)
    with torch.no_grad():
        for point in points:
            queries = local_points(codes.boxes, point[None]) * LENGTH_SCALE
            slow += decoder.attention_weights(codes.part_codes, queries)[0] / len(points)
    torch.testing.assert_close(maps, slow, atol=1e-6, rtol=0)
