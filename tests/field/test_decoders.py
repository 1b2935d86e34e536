"""The decoders that PairOF is compared with: sizes, and what they share."""

from typing import get_args

import pytest
import torch

from handavatar.field.decoders import SHUFFLED_PAIRS, Decoder, untrained_field
from handavatar.field.occupancy import PairOccupancy
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts, shuffled_pairs
from handavatar.hand.pose import CONNECTED_PAIRS, NUM_BONES, HandPose


@pytest.mark.parametrize(
    ("decoder", "count", "printed"),
    [
        ("pair", 232_513, 237_000),
        ("pair-shuffled", 232_513, 237_000),
        ("coap", 137_214, 138_000),
        ("coap-wide", 285_310, 287_000),
        ("transformer", 255_977, 256_000),
    ],
)
def test_sizes_are_near_those_of_the_papers_table(
    decoder: Decoder, count: int, printed: int
) -> None:
    field = untrained_field(decoder)
    assert sum(parameter.numel() for parameter in field.parameters()) == count
    assert count == pytest.approx(printed, rel=0.02)


def test_all_start_from_the_same_encoder() -> None:
    states = []
    for decoder in get_args(Decoder):
        torch.manual_seed(3)
        states.append(untrained_field(decoder).encoder.state_dict())
    for state in states[1:]:
        assert all(torch.equal(state[name], value) for name, value in states[0].items())


@pytest.mark.parametrize("seed", range(5))
def test_shuffled_pairs_join_all_parts_and_none_that_belong_together(seed: int) -> None:
    pairs = shuffled_pairs(seed)
    assert len(pairs) == len(CONNECTED_PAIRS) == len({frozenset(pair) for pair in pairs})
    assert {part for pair in pairs for part in pair} == set(range(NUM_BONES))
    real = {frozenset(pair) for pair in CONNECTED_PAIRS}
    assert real.isdisjoint(frozenset(pair) for pair in pairs)
    assert pairs == shuffled_pairs(seed)


def test_the_fast_evaluation_with_shuffled_pairs_equals_the_plain_one() -> None:
    rig = load_open_hand("778")
    posed = rig.shaped().posed(HandPose.flat())
    torch.manual_seed(0)
    field, real = untrained_field("pair-shuffled"), PairOccupancy()
    real.load_state_dict(field.state_dict())
    assert isinstance(field, PairOccupancy)
    assert [tuple(pair) for pair in field.pairs.tolist()] == list(SHUFFLED_PAIRS)
    codes = field.encode(divide_into_parts(rig), posed)
    points = posed.vertices[::3] + 0.004
    with torch.no_grad():
        plain, _ = field.plain(codes, points)
        # float32 through a dozen layers, times LOGIT_SCALE
        torch.testing.assert_close(field(codes, points).whole, plain, atol=2e-5, rtol=0)
        torch.testing.assert_close(field.trainable_whole(codes, points), plain, atol=2e-5, rtol=0)
    assert not torch.allclose(real(codes, points).whole, plain, atol=1e-3)
