"""Attention grouped by deciding part, and its preference for neighbours."""

import numpy as np
import pytest
import torch

from handavatar.field.decoders import untrained_field
from handavatar.field.partwise import PartwiseOccupancy
from handavatar.field.transformer import TransformerDecoder, attention_maps
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.pose import BONE_NAMES, CONNECTED_PAIRS, NUM_BONES, HandPose
from handavatar.train.attention import (
    AttentionReading,
    attention_figures,
    attention_picture,
    neighbour_preference,
    read_attention,
)


def _rows(itself: float, neighbours: float) -> torch.Tensor:
    """Given total weights for a part itself and its neighbours, the rest spread evenly."""
    rows = torch.zeros(NUM_BONES, NUM_BONES)
    for bone in range(NUM_BONES):
        joined = {a + b - bone for a, b in CONNECTED_PAIRS if bone in (a, b)}
        others = set(range(NUM_BONES)) - joined - {bone}
        rows[bone, bone] = itself
        rows[bone, list(joined)] = neighbours / len(joined)
        rows[bone, list(others)] = (1 - itself - neighbours) / len(others)
    return rows


def test_indifference_is_one_and_neighbours_raise_it() -> None:
    even = torch.full((NUM_BONES, NUM_BONES), 1 / NUM_BONES)
    torch.testing.assert_close(neighbour_preference(even), torch.ones(NUM_BONES))
    assert float(neighbour_preference(_rows(0.2, 0.7)).min()) > 1
    # The wrist has five neighbours and ten others: half each weighs a neighbour twice.
    assert float(neighbour_preference(_rows(0.0, 0.5))[0]) == pytest.approx(2)


def test_figures_are_those_of_the_rows() -> None:
    counts = torch.zeros(NUM_BONES, dtype=torch.long)
    counts[3] = 7
    figures = attention_figures(AttentionReading(_rows(0.2, 0.7)[None], counts))
    assert list(figures) == [BONE_NAMES[3]]
    assert figures[BONE_NAMES[3]] == pytest.approx(
        {"points": 7, "itself": 0.2, "neighbours": 0.7, "others": 0.1, "preference": 0.7 / 0.1 * 14}
    )


def test_rows_are_means_over_the_points_that_a_part_decides() -> None:
    rig = load_open_hand("778")
    parts = divide_into_parts(rig)
    posed = rig.shaped().posed(HandPose.flat())
    torch.manual_seed(0)
    field = untrained_field("transformer")
    assert isinstance(field, PartwiseOccupancy)
    assert isinstance(field.decoder, TransformerDecoder)
    codes, points = field.encode(parts, posed), posed.vertices[::16]
    reading = read_attention(field, codes, points)
    assert int(reading.counts.sum()) == len(points)  # every vertex is in some part's box
    sums = reading.rows.sum(-1)
    torch.testing.assert_close(sums, (reading.counts > 0).float().expand_as(sums))
    slow = torch.zeros(NUM_BONES, NUM_BONES)
    for point in points:
        winner = int(field.part_logits(codes, point[None])[0].argmax())
        slow[winner] += attention_maps(field.decoder, codes, point[None]).mean((0, 1))[winner]
    slow /= reading.counts.clamp(min=1)[:, None]
    torch.testing.assert_close(reading.rows.mean(0), slow, atol=1e-6, rtol=0)
    coap = untrained_field("coap")
    assert isinstance(coap, PartwiseOccupancy)
    with pytest.raises(ValueError, match="found a CoapDecoder, expected a TransformerDecoder"):
        read_attention(coap, codes, points)


def test_the_picture_is_dark_where_weight_is() -> None:
    counts = torch.ones(NUM_BONES, dtype=torch.long)
    counts[5] = 0
    bright, dark = (
        np.asarray(attention_picture({"flat": AttentionReading(rows[None], counts)})).mean()
        for rows in (torch.full((NUM_BONES, NUM_BONES), weight) for weight in (0.1, 0.3))
    )
    assert dark < bright
    two = AttentionReading(_rows(0.2, 0.5).expand(4, -1, -1), counts)
    one_line, two_lines = (attention_picture(dict.fromkeys(names, two)) for names in ("a", "ab"))
    assert two_lines.width == one_line.width and two_lines.height == 2 * one_line.height
