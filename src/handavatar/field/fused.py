"""The occupancy field in Triton kernels, for NVIDIA GPUs.

Optional: Triton comes with torch's CUDA builds and is imported here, in
:mod:`handavatar.field.fused_anchors`, :mod:`handavatar.render.fused_rays` and
:mod:`handavatar.render.fused_coverage` alone. The kernels compute what
``PairOccupancy._chunk_occupancy`` computes with torch's operations, without gradient. *Boxes* finds
the part boxes that hold a point and *listed* what is to be decoded, pair by pair, so that a program
reads the codes of two parts only. Of the decoder, a *trunk* runs for every point of a pair, up to
the last block of its PointNet, and *answers*, the last block and the MLP, for those of the two
parts that were asked; what lies between layers stays on the chip. The largest answers are found on
the way, and *values* makes occupancies of them.

Weights come from one buffer, in the order in which the layers need them. Layers that no
nonlinearity separates are one: the opening's shortcut is an affine map of the place, and the
PointNet's output is part of the layers that read it.

Without a GPU the kernels run in Triton's interpreter (``TRITON_INTERPRET=1``), slowly: for tests.
"""

import math
import os
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor, nn

from handavatar.field.kernels import Precision
from handavatar.field.layers import PointNet, ResidualBlock, SkipMLP
from handavatar.hand.parts import PartBoxes
from handavatar.hand.pose import NUM_BONES

_BLOCK, _WARPS = 128, 8
"""Items at a time in one program of the decoder, and its warps."""
_POINTS = 128
"""Points at a time in one program."""
_NUM_BONES: tl.constexpr = tl.constexpr(NUM_BONES)
_NOBODY = torch.iinfo(torch.int64).min
"""Where no answer was given; smaller than every answer, and so is its upper half."""
_IS_INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"


@dataclass(frozen=True, eq=False)
class PackedWeights:
    """A decoder's weights as the kernels read them, layer after layer.

    Attributes:
        matrices: of the trunk, then of the answers; inputs times outputs each.
        vectors: all biases but those before the first ReLU, then the last layer.
        first: of the first layer and of the shortcut past the first block: from a part's code and
            the place in its frame, in metres.
        first_bias: what both add.
        precision: of the matrices.
        num_trunk_matrices: entries of ``matrices`` that belong to the trunk.
        num_trunk_vectors: entries of ``vectors`` that do.
    """

    matrices: Float[Tensor, "entries"]
    vectors: Float[Tensor, "rows"]
    first: Float[Tensor, "192 67"]
    first_bias: Float[Tensor, "192"]
    precision: Precision
    num_trunk_matrices: int
    num_trunk_vectors: int


@triton.jit
def _product(values, matrix, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr):
    if PRECISION != "bf16":
        product = tl.dot(values, matrix, input_precision=PRECISION)
    elif IS_INTERPRETED:
        # The interpreter's product of two bfloat16 is wrong; this is the same number.
        rounded = values.to(tl.bfloat16).to(tl.float32)
        product = tl.dot(rounded, matrix.to(tl.float32), input_precision="ieee")
    else:
        product = tl.dot(values.to(tl.bfloat16), matrix)
    return product


@triton.jit
def _matrix(pointer, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    rows, columns = tl.arange(0, ROWS), tl.arange(0, COLUMNS)
    return tl.load(pointer + rows[:, None] * COLUMNS + columns[None, :])


@triton.jit
def _vector(pointer, SIZE: tl.constexpr):
    return tl.load(pointer + tl.arange(0, SIZE))[None, :]


@triton.jit
def _along(row, x, y, z):
    """One coordinate in a part's frame."""
    return tl.load(row) * x + tl.load(row + 1) * y + tl.load(row + 2) * z + tl.load(row + 3)


@triton.jit
def _affine(rows, x, y, z, STRIDE: tl.constexpr, SIZE: tl.constexpr):
    """An affine map of the place: three rows of factors, then what is added."""
    return (
        x[:, None] * _vector(rows, SIZE)
        + y[:, None] * _vector(rows + STRIDE, SIZE)
        + z[:, None] * _vector(rows + 2 * STRIDE, SIZE)
        + _vector(rows + 3 * STRIDE, SIZE)
    )


@triton.jit
def _opened(
    opening, x, y, z, matrices, vectors,
    PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr,
):  # fmt: skip
    """First layer and first block of one part: before the first ReLU all is affine."""
    # In two halves: the whole layer would not fit into the registers.
    left = tl.maximum(_affine(opening, x, y, z, 192, 64), 0.0)
    inner = _product(left, _matrix(matrices, 64, 64), PRECISION, IS_INTERPRETED)
    right = tl.maximum(_affine(opening + 64, x, y, z, 192, 64), 0.0)
    inner += _product(right, _matrix(matrices + 4096, 64, 64), PRECISION, IS_INTERPRETED)
    inner = tl.maximum(inner + _vector(vectors, 64), 0.0)
    outer = _product(inner, _matrix(matrices + 8192, 64, 64), PRECISION, IS_INTERPRETED)
    return outer + _affine(opening + 128, x, y, z, 192, 64)


@triton.jit
def _common(pooled, matrices, vectors, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr):
    """What the two parts of a pair share in a block: of the hidden layer, and of the output."""
    hidden = _product(
        tl.maximum(pooled, 0.0), _matrix(matrices, 64, 64), PRECISION, IS_INTERPRETED
    ) + _vector(vectors, 64)
    out = _product(pooled, _matrix(matrices + 4096, 64, 64), PRECISION, IS_INTERPRETED) + _vector(
        vectors + 64, 64
    )
    return hidden, out


@triton.jit
def _own(values, hidden, out, matrices, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr):
    """A block for one part, given what it shares with the other."""
    hidden += _product(
        tl.maximum(values, 0.0), _matrix(matrices + 8192, 64, 64), PRECISION, IS_INTERPRETED
    )
    out += _product(
        tl.maximum(hidden, 0.0), _matrix(matrices + 12288, 64, 64), PRECISION, IS_INTERPRETED
    )
    return out + _product(values, _matrix(matrices + 16384, 64, 64), PRECISION, IS_INTERPRETED)


@triton.jit(do_not_specialize=["num_pairs"])
def _trunk(
    points, point_of, pair_ends, pairs, openings, matrices, vectors, tokens, num_pairs,
    BLOCK: tl.constexpr, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr,
):  # fmt: skip
    tile = tl.program_id(0)
    # Tiles are counted pair by pair; the last one of a pair may be filled in part.
    pair, start, end, begun, before = 0, 0, 0, 0, 0
    for number in range(num_pairs):
        stop = tl.load(pair_ends + number)
        tiles = tl.cdiv(stop - begun, BLOCK)
        is_here = (tile >= before) & (tile < before + tiles)
        pair = tl.where(is_here, number, pair)
        start = tl.where(is_here, begun + (tile - before) * BLOCK, start)
        end = tl.where(is_here, stop, end)
        before += tiles
        begun = stop
    item = start + tl.arange(0, BLOCK)
    is_item = item < end
    point = points + 3 * tl.load(point_of + item, mask=is_item, other=0)
    x, y, z = tl.load(point), tl.load(point + 1), tl.load(point + 2)
    opening = openings + 768 * tl.load(pairs + 2 * pair)
    first = _opened(opening, x, y, z, matrices, vectors, PRECISION, IS_INTERPRETED)
    opening = openings + 768 * tl.load(pairs + 2 * pair + 1)
    second = _opened(opening, x, y, z, matrices, vectors, PRECISION, IS_INTERPRETED)
    matrices += 12288
    vectors += 64
    for _ in tl.static_range(2):
        hidden, out = _common(
            tl.maximum(first, second), matrices, vectors, PRECISION, IS_INTERPRETED
        )
        first = _own(first, hidden, out, matrices, PRECISION, IS_INTERPRETED)
        second = _own(second, hidden, out, matrices, PRECISION, IS_INTERPRETED)
        matrices += 20480
        vectors += 128
    place = tokens + 128 * item.to(tl.int64)[:, None] + tl.arange(0, 64)[None, :]
    tl.store(place, first.to(tokens.dtype.element_ty), mask=is_item[:, None])
    tl.store(place + 64, second.to(tokens.dtype.element_ty), mask=is_item[:, None])


@triton.jit(do_not_specialize=["count"])
def _answers(
    tokens, answers, point_of, pair_of, pairs, matrices, vectors, best, winners, count,
    BLOCK: tl.constexpr, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr,
):  # fmt: skip
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_answer = index < count
    answer = tl.load(answers + index, mask=is_answer, other=0)
    side = answer % 2
    item = (answer // 2).to(tl.int64)
    place = tokens + (128 * item)[:, None] + tl.arange(0, 64)[None, :]
    own = tl.load(place + (64 * side)[:, None]).to(tl.float32)
    other = tl.load(place + (64 - 64 * side)[:, None]).to(tl.float32)
    hidden, out = _common(tl.maximum(own, other), matrices, vectors, PRECISION, IS_INTERPRETED)
    values = tl.maximum(_own(own, hidden, out, matrices, PRECISION, IS_INTERPRETED), 0.0)
    matrices += 20480
    vectors += 128
    first = _product(values, _matrix(matrices, 64, 128), PRECISION, IS_INTERPRETED) + _vector(
        vectors, 128
    )
    second = _product(
        tl.maximum(first, 0.0), _matrix(matrices + 8192, 128, 64), PRECISION, IS_INTERPRETED
    ) + _vector(vectors + 128, 64)
    third = (
        _product(
            tl.maximum(second, 0.0), _matrix(matrices + 16384, 64, 128), PRECISION, IS_INTERPRETED
        )
        + _product(values, _matrix(matrices + 24576, 64, 128), PRECISION, IS_INTERPRETED)
        + _vector(vectors + 192, 128)
    )
    fourth = _product(
        tl.maximum(third, 0.0), _matrix(matrices + 32768, 128, 128), PRECISION, IS_INTERPRETED
    ) + _vector(vectors + 320, 128)
    logit = tl.sum(tl.maximum(fourth, 0.0) * _vector(vectors + 448, 128), axis=1)
    logit += tl.load(vectors + 576)
    point = tl.load(point_of + item, mask=is_answer, other=0)
    pair = tl.load(pair_of + item, mask=is_answer, other=0)
    bone = tl.load(pairs + 2 * pair + side)
    # Integers that are ordered like the numbers; the lower half of a key says who gave it.
    bits = logit.to(tl.int32, bitcast=True)
    ordered = bits ^ ((bits >> 31) & 0x7FFFFFFF)
    key = (ordered.to(tl.int64) << 32) | (2 * pair + side).to(tl.int64)
    tl.atomic_max(best + _NUM_BONES * point + bone, ordered, mask=is_answer, sem="relaxed")
    tl.atomic_max(winners + point, key, mask=is_answer, sem="relaxed")


@triton.jit
def _beyond(box, axis, place):
    """How far a coordinate lies outside of a part's own box, negative inside."""
    return tl.maximum(tl.load(box + axis) - place, place - tl.load(box + 3 + axis))


@triton.jit(do_not_specialize=["count"])
def _boxes(
    points, transforms, boxes, cut, pairs, held_by, counts, count, margin,
    NUM_PAIRS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Which boxes hold a point (bits); of each pair, items and answers there."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_point = index < count
    x = tl.load(points + 3 * index, mask=is_point, other=0.0)
    y = tl.load(points + 3 * index + 1, mask=is_point, other=0.0)
    z = tl.load(points + 3 * index + 2, mask=is_point, other=0.0)
    held = tl.zeros((BLOCK,), tl.int32)
    for bone in tl.static_range(_NUM_BONES):
        row, box = transforms + 12 * bone, boxes + 6 * bone
        is_inside = is_point
        for axis in tl.static_range(3):
            place = _along(row + 4 * axis, x, y, z)
            is_above = place > tl.load(box + axis) - margin
            is_inside = is_inside & is_above & (place < tl.load(box + 3 + axis) + margin)
        held |= is_inside.to(tl.int32) << bone
    height = tl.zeros((BLOCK,), tl.float32)
    for axis in tl.static_range(3):
        place = _along(transforms + 4 * axis, x, y, z)
        height += (place - tl.load(cut + axis)) * tl.load(cut + 3 + axis)
    held = tl.where(height < 0, held, 0)
    tl.store(held_by + index, held, mask=is_point)
    for pair in tl.static_range(NUM_PAIRS):
        first = (held >> tl.load(pairs + 2 * pair)) & 1
        second = (held >> tl.load(pairs + 2 * pair + 1)) & 1
        both = ((first | second).to(tl.int64) << 32) | (first + second)
        tl.store(counts + pair * count.to(tl.int64) + index, both, mask=is_point)


@triton.jit(do_not_specialize=["count"])
def _listed(
    held_by, ends, counts, pairs, item_points, item_pairs, answers, count, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes down what the counts have made room for."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    pair = tl.program_id(1)
    is_point = index < count
    held = tl.load(held_by + index, mask=is_point, other=0)
    place = pair * count.to(tl.int64) + index
    begin = tl.load(ends + place, mask=is_point, other=0)
    begin -= tl.load(counts + place, mask=is_point, other=0)
    item, answer = (begin >> 32).to(tl.int32), (begin & 0xFFFFFFFF).to(tl.int32)
    first = (held >> tl.load(pairs + 2 * pair)) & 1
    second = (held >> tl.load(pairs + 2 * pair + 1)) & 1
    is_item = (first | second) > 0
    tl.store(item_points + item, index, mask=is_item)
    tl.store(item_pairs + item, tl.zeros((BLOCK,), tl.int32) + pair, mask=is_item)
    tl.store(answers + answer, 2 * item, mask=first > 0)
    tl.store(answers + answer + first, 2 * item + 1, mask=second > 0)


@triton.jit
def _number(ordered):
    bits = ordered ^ ((ordered >> 31) & 0x7FFFFFFF)
    return bits.to(tl.float32, bitcast=True)


@triton.jit(do_not_specialize=["count"])
def _values(
    points, transforms, boxes, best, winners, places, whole, soft, deciders, count,
    margin, softness, sharpness, BLOCK: tl.constexpr,
):  # fmt: skip
    """Occupancies of the largest answers; what nobody has answered is nothing."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_point = index < count
    place = tl.load(places + index, mask=is_point, other=0)
    x = tl.load(points + 3 * index, mask=is_point, other=0.0)
    y = tl.load(points + 3 * index + 1, mask=is_point, other=0.0)
    z = tl.load(points + 3 * index + 2, mask=is_point, other=0.0)
    winner = tl.load(winners + index, mask=is_point, other=0)
    ordered = (winner >> 32).to(tl.int32)
    is_answered = ordered >= -2147483647
    value = tl.where(is_answered, tl.sigmoid(sharpness * _number(ordered)), 0.0)
    tl.store(whole + place, value, mask=is_point)
    decider = tl.where(is_answered, (winner & 0xFFFFFFFF).to(tl.int32), -1)
    tl.store(deciders + place, decider, mask=is_point)
    for bone in tl.static_range(_NUM_BONES):
        row, box = transforms + 12 * bone, boxes + 6 * bone
        outside = _beyond(box, 0, _along(row, x, y, z))
        outside = tl.maximum(outside, _beyond(box, 1, _along(row + 4, x, y, z)))
        outside = tl.maximum(outside, _beyond(box, 2, _along(row + 8, x, y, z)))
        ramp = tl.minimum(tl.maximum(1 - outside / margin, 0.0), 1.0)
        ordered = tl.load(best + _NUM_BONES * index + bone, mask=is_point, other=0)
        value = tl.sigmoid(softness * _number(ordered)) * (ramp * ramp * (3 - 2 * ramp))
        value = tl.where(ordered >= -2147483647, value, 0.0)
        tl.store(soft + _NUM_BONES * place + bone, value, mask=is_point)


def pack_weights(
    pointnet: PointNet, mlp: SkipMLP, precision: Precision, length_scale: float, logit_scale: float
) -> PackedWeights:
    """A decoder's weights in the kernels' order, scales included.

    Args:
        pointnet: the decoder's, of codes and positions.
        mlp: what turns its features into a logit.
        precision: ``bf16`` rounds the matrices.
        length_scale: what positions in metres are multiplied by.
        logit_scale: what the logit is multiplied by.
    """
    width = pointnet.output.out_features
    opening, *between, last = cast(list[ResidualBlock], list(pointnet.blocks))
    trunk = [opening.inner.weight.T, opening.outer.weight.T]
    trunk += [part for block in between for part in _shared_first(block, width)]
    first, second, third, fourth = cast(list[nn.Linear], list(mlp.layers))
    joined, from_features = (third.weight / math.sqrt(2)).split(width, dim=1)
    output, output_bias = pointnet.output.weight, pointnet.output.bias
    answers = [*_shared_first(last, width), (first.weight @ output).T]
    answers += [second.weight.T, joined.T, (from_features @ output).T, fourth.weight.T]
    trunk_vectors: list[Tensor] = [opening.inner.bias]
    for block in between:
        trunk_vectors += [block.inner.bias, block.outer.bias]
    vectors: list[Tensor] = [last.inner.bias, last.outer.bias]
    vectors += [first.bias + first.weight @ output_bias, second.bias]
    vectors += [third.bias + from_features @ output_bias, fourth.bias]
    vectors += [logit_scale * mlp.output.weight, logit_scale * mlp.output.bias]
    opened, shortcut = pointnet.input, opening.shortcut.weight
    affine = torch.cat([opened.weight, shortcut @ opened.weight]).detach()
    scale = torch.ones_like(affine[0])
    scale[width:] = length_scale
    bias = torch.cat([opened.bias, shortcut @ opened.bias + opening.outer.bias]).detach()
    return PackedWeights(
        _flat(trunk + answers).to(torch.bfloat16 if precision == "bf16" else torch.float32),
        _flat(trunk_vectors + vectors),
        affine * scale,
        bias,
        precision,
        sum(matrix.numel() for matrix in trunk),
        sum(vector.numel() for vector in trunk_vectors),
    )


@dataclass(frozen=True, eq=False)
class PackedHand:
    """A posed hand as the kernels read it.

    Attributes:
        openings: first layer and shortcut of each part as an affine map of the world's metres:
            factors of x, y and z, and what is added.
        transforms: frames of the parts, upper three rows, metres.
        boxes: lower and upper corner of each part's own box, metres.
        cut: point and normal of the wrist's plane, in the wrist's frame.
        margin: how far boxes reach beyond the parts, metres.
        pairs: the two parts of each pair, 32-bit.
    """

    openings: Float[Tensor, "bones 4 192"]
    transforms: Float[Tensor, "bones 3 4"]
    boxes: Float[Tensor, "bones 6"]
    cut: Float[Tensor, "6"]
    margin: float
    pairs: Int[Tensor, "pairs 2"]


@torch.no_grad()
def pack_hand(
    weights: PackedWeights,
    part_codes: Float[Tensor, "bones 64"],
    boxes: PartBoxes,
    pairs: Int[Tensor, "pairs 2"],
) -> PackedHand:
    """What a pose adds to the weights.

    Args:
        weights: of the decoder.
        part_codes: encodings of the parts.
        boxes: of the parts.
        pairs: the two parts of each pair.
    """
    of_code, of_place = weights.first.split((part_codes.shape[-1], 3), dim=1)
    transforms = boxes.bone_from_world[:, :3].contiguous()
    openings = (of_place @ transforms).mT
    openings[:, 3] += part_codes @ of_code.T + weights.first_bias
    return PackedHand(
        openings.contiguous(),
        transforms,
        torch.cat([boxes.lower, boxes.upper], dim=-1),
        torch.cat([boxes.cut_point, boxes.cut_normal]),
        boxes.margin,
        pairs.int(),
    )


def decided_logits(
    weights: PackedWeights,
    hand: PackedHand,
    points: Float[Tensor, "points 3"],
    deciders: Int[Tensor, "points"],
) -> Float[Tensor, "points"]:
    """The answer that decides each point, without gradient; minus infinity where there is none.

    Args:
        weights: packed.
        hand: packed.
        points: in the world, metres.
        deciders: as in :class:`Decided`.

    Source: paper Sec. 3.2 and appendix (local-pair decoder).
    """
    count = len(points)
    ordered, order = deciders.clamp_min(0).int().sort()
    pairs = ordered // 2
    numbers = torch.arange(max(count, len(hand.pairs)), dtype=torch.int32, device=points.device)
    answers = 2 * numbers[:count] + ordered % 2
    ends = torch.searchsorted(pairs, numbers[: len(hand.pairs)], right=True, out_int32=True)
    best, winners = _nobody(points, len(hand.transforms))
    # A pair's last tile may be filled in part, and what comes after all tiles does nothing.
    tiles = triton.cdiv(count, _BLOCK) + len(hand.pairs)
    _decode(weights, hand, points, _Items(order.int(), pairs, answers, ends), tiles, best, winners)
    bits = (winners >> 32).int()
    bits = bits ^ ((bits >> 31) & 0x7FFFFFFF)
    return torch.where(deciders >= 0, bits.view(torch.float32), -torch.inf)


@dataclass(frozen=True, eq=False)
class Decided:
    """Occupancies by maximum fusion at places, and what decides them.

    Attributes:
        whole: of the hand.
        soft: of each part, softly.
        deciders: twice the number of the pair that decides, plus one if it is its second part; -1
            where there is none.
    """

    whole: Float[Tensor, "places"]
    soft: Float[Tensor, "places bones"]
    deciders: Int[Tensor, "places"]

    @staticmethod
    def nothing(count: int, num_bones: int, device: torch.device) -> "Decided":
        """No hand at so many places."""
        return Decided(
            torch.zeros(count, device=device),
            torch.zeros(count, num_bones, device=device),
            torch.full((count,), -1, dtype=torch.int32, device=device),
        )


def decide(
    weights: PackedWeights,
    hand: PackedHand,
    points: Float[Tensor, "points 3"],
    softness: float,
    sharpness: float,
    decided: Decided,
    places: Int[Tensor, "points"],
) -> None:
    """Evaluates occupancies at points, without gradient.

    Args:
        weights: packed.
        hand: packed.
        points: in the world, metres; what is not a number is nowhere near the hand.
        softness: the paper's tau.
        sharpness: what the logit of the whole is multiplied by.
        decided: takes the answers.
        places: where it takes them.

    Source: paper Sec. 3.2, Eq. 1, and Sec. 3.3, Eq. 3.
    """
    points = points.detach().contiguous()
    count, num_pairs = len(points), len(hand.pairs)
    if count == 0:
        return
    blocks = triton.cdiv(count, _POINTS)
    held_by = torch.empty(count, dtype=torch.int32, device=points.device)
    # Items in the upper half, answers in the lower one.
    counts = torch.empty(num_pairs, count, dtype=torch.int64, device=points.device)
    _boxes[(blocks,)](
        points, hand.transforms, hand.boxes, hand.cut, hand.pairs, held_by, counts, count,
        hand.margin, NUM_PAIRS=num_pairs, BLOCK=_POINTS,
    )  # fmt: skip
    ends = counts.flatten().cumsum(0)
    pair_ends = ends[count - 1 :: count]
    item_ends = (pair_ends >> 32).int()
    best, winners = _nobody(points, len(hand.transforms))
    # All that can be asked of the GPU before its answer is waited for is asked above.
    found = pair_ends.tolist()
    if found[-1]:
        num_items, num_answers = found[-1] >> 32, found[-1] & 0xFFFFFFFF
        item_points, item_pairs = held_by.new_empty(2, num_items)
        answers = held_by.new_empty(num_answers)
        _listed[(blocks, num_pairs)](
            held_by, ends, counts, hand.pairs, item_points, item_pairs, answers, count,
            BLOCK=_POINTS,
        )  # fmt: skip
        items = _Items(item_points, item_pairs, answers, item_ends)
        ranges = pairwise([0, *(end >> 32 for end in found)])
        tiles = sum(triton.cdiv(end - begin, _BLOCK) for begin, end in ranges)
        _decode(weights, hand, points, items, tiles, best, winners)
    _values[(blocks,)](
        points, hand.transforms, hand.boxes, best, winners, places, decided.whole, decided.soft,
        decided.deciders, count, hand.margin, softness, sharpness, BLOCK=_POINTS,
    )  # fmt: skip


def _nobody(
    points: Float[Tensor, "points 3"], num_bones: int
) -> tuple[Int[Tensor, "points bones"], Int[Tensor, "points"]]:
    """Where the largest answers are to be noted: of each part, and of all."""
    size, device = (len(points), num_bones), points.device
    return (
        torch.full(size, _NOBODY >> 32, dtype=torch.int32, device=device),
        torch.full(size[:1], _NOBODY, dtype=torch.int64, device=device),
    )


@dataclass(frozen=True, eq=False)
class _Items:
    """What is to be decoded, pair by pair; 32-bit.

    Attributes:
        points: the point of each item.
        pairs: its pair.
        answers: twice the number of an item, plus one for the second part.
        pair_ends: where each pair's items end.
    """

    points: Int[Tensor, "items"]
    pairs: Int[Tensor, "items"]
    answers: Int[Tensor, "answers"]
    pair_ends: Int[Tensor, "pairs"]


def _decode(
    weights: PackedWeights,
    hand: PackedHand,
    points: Float[Tensor, "points 3"],
    items: _Items,
    tiles: int,
    best: Int[Tensor, "points bones"],
    winners: Int[Tensor, "points"],
) -> None:
    """Trunk, in so many tiles, and answers; notes the largest in ``best`` and ``winners``."""
    constants: dict[str, Any] = {
        "num_warps": _WARPS,
        "BLOCK": _BLOCK,
        "PRECISION": weights.precision,
        "IS_INTERPRETED": _IS_INTERPRETED,
    }
    token_type = torch.bfloat16 if weights.precision == "bf16" else torch.float32
    tokens = points.new_empty(len(items.points), 2, 64, dtype=token_type)
    if len(items.points):
        _trunk[(tiles,)](
            points.detach().contiguous(),
            items.points,
            items.pair_ends,
            hand.pairs,
            hand.openings,
            weights.matrices,
            weights.vectors,
            tokens,
            len(hand.pairs),
            **constants,
        )
    if len(items.answers):
        _answers[(triton.cdiv(len(items.answers), _BLOCK),)](
            tokens,
            items.answers,
            items.points,
            items.pairs,
            hand.pairs,
            weights.matrices[weights.num_trunk_matrices :],
            weights.vectors[weights.num_trunk_vectors :],
            best,
            winners,
            len(items.answers),
            **constants,
        )


def _shared_first(block: ResidualBlock, width: int) -> list[Tensor]:
    """Matrices of a block on a set: those of the pooled half first, then those of each point."""
    own, common = block.inner.weight.split(width, dim=1)
    own_shortcut, common_shortcut = block.shortcut.weight.split(width, dim=1)
    return [common.T, common_shortcut.T, own.T, block.outer.weight.T, own_shortcut.T]


def _flat(pieces: list[Tensor]) -> Float[Tensor, "entries"]:
    return torch.cat([piece.detach().contiguous().flatten() for piece in pieces])
