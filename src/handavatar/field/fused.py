"""The pair decoder and the search for anchors in Triton kernels, for NVIDIA GPUs.

Optional: Triton comes with torch's CUDA builds and is imported here alone. Two kernels compute
what ``PairOccupancy._item_logits`` computes with torch's operations, without gradient: a *trunk*
for every pair that has a point, up to the last block of its PointNet, and *answers*, the last block
and the MLP, for those of the two parts that were asked; what lies between layers stays on the chip.
Weights come from one buffer, in the order in which the layers need them. Layers that no
nonlinearity separates are one: the opening's shortcut is an affine map of the place, and the
PointNet's output is part of the layers that read it.

Without a GPU the kernels run in Triton's interpreter (``TRITON_INTERPRET=1``), slowly: for tests.
"""

import math
import os
from dataclasses import dataclass
from typing import Any, cast

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from handavatar.field.kernels import Precision
from handavatar.field.layers import PointNet, ResidualBlock, SkipMLP

_LAUNCHES: dict[Precision, tuple[int, int]] = {
    "ieee": (64, 4),
    "tf32x3": (64, 4),
    "tf32": (64, 4),
    "bf16": (128, 8),
}
"""Items at a time in one program, and its warps."""
_QUERIES = 64
"""Queries at a time in one program of the search for anchors."""
_IS_INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"


@dataclass(frozen=True, eq=False)
class PackedWeights:
    """A decoder's weights as the kernels read them, layer after layer.

    Attributes:
        matrices: of the trunk, then of the answers; inputs times outputs each.
        vectors: the position's rows of the first layer and of its shortcut, then all biases.
        of_code: the code's part of the first layer.
        shortcut: from the first layer's output past the first block.
        precision: of the matrices.
        num_trunk_matrices: entries of ``matrices`` that belong to the trunk.
        num_trunk_vectors: entries of ``vectors`` that do.
    """

    matrices: Float[Tensor, "entries"]
    vectors: Float[Tensor, "rows"]
    of_code: Float[Tensor, "128 64"]
    shortcut: Float[Tensor, "64 128"]
    precision: Precision
    num_trunk_matrices: int
    num_trunk_vectors: int


@triton.jit
def _product(values, matrix, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr):
    if PRECISION == "bf16":
        rounded = values.to(tl.bfloat16)
        if IS_INTERPRETED:
            # The interpreter's product of two bfloat16 is wrong; this is the same number.
            return tl.dot(rounded.to(tl.float32), matrix.to(tl.float32), input_precision="ieee")
        return tl.dot(rounded, matrix)
    return tl.dot(values, matrix, input_precision=PRECISION)


@triton.jit
def _matrix(pointer, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    rows, columns = tl.arange(0, ROWS), tl.arange(0, COLUMNS)
    return tl.load(pointer + rows[:, None] * COLUMNS + columns[None, :])


@triton.jit
def _vector(pointer, SIZE: tl.constexpr):
    return tl.load(pointer + tl.arange(0, SIZE))[None, :]


@triton.jit
def _opened(
    members, x, y, z, transforms, code_biases, shortcut_biases, matrices, vectors,
    PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr,
):  # fmt: skip
    """First layer and first block of one part: its code is a bias, its frame an affine map."""
    row = transforms + 12 * members
    hidden = tl.load(code_biases + members[:, None] * 128 + tl.arange(0, 128)[None, :])
    out = tl.load(shortcut_biases + members[:, None] * 64 + tl.arange(0, 64)[None, :])
    for axis in tl.static_range(3):
        place = (
            tl.load(row + 4 * axis) * x
            + tl.load(row + 4 * axis + 1) * y
            + tl.load(row + 4 * axis + 2) * z
            + tl.load(row + 4 * axis + 3)
        )
        hidden += place[:, None] * _vector(vectors + 128 * axis, 128)
        out += place[:, None] * _vector(vectors + 384 + 64 * axis, 64)
    inner = _product(
        tl.maximum(hidden, 0.0), _matrix(matrices, 128, 64), PRECISION, IS_INTERPRETED
    ) + _vector(vectors + 576, 64)
    outer = _product(
        tl.maximum(inner, 0.0), _matrix(matrices + 8192, 64, 64), PRECISION, IS_INTERPRETED
    ) + _vector(vectors + 640, 64)
    return out + outer


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


@triton.jit
def _trunk(
    points, point_of, members, transforms, code_biases, shortcut_biases,
    matrices, vectors, tokens, count,
    BLOCK: tl.constexpr, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr,
):  # fmt: skip
    item = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    is_item = item < count
    point = points + 3 * tl.load(point_of + item, mask=is_item, other=0)
    x, y, z = tl.load(point), tl.load(point + 1), tl.load(point + 2)
    pair = members + 2 * item
    first = _opened(
        tl.load(pair, mask=is_item, other=0), x, y, z,
        transforms, code_biases, shortcut_biases, matrices, vectors, PRECISION, IS_INTERPRETED,
    )  # fmt: skip
    second = _opened(
        tl.load(pair + 1, mask=is_item, other=0), x, y, z,
        transforms, code_biases, shortcut_biases, matrices, vectors, PRECISION, IS_INTERPRETED,
    )  # fmt: skip
    matrices += 12288
    vectors += 704
    for _ in tl.static_range(2):
        hidden, out = _common(
            tl.maximum(first, second), matrices, vectors, PRECISION, IS_INTERPRETED
        )
        first = _own(first, hidden, out, matrices, PRECISION, IS_INTERPRETED)
        second = _own(second, hidden, out, matrices, PRECISION, IS_INTERPRETED)
        matrices += 20480
        vectors += 128
    place = tokens + 128 * item[:, None] + tl.arange(0, 64)[None, :]
    tl.store(place, first.to(tokens.dtype.element_ty), mask=is_item[:, None])
    tl.store(place + 64, second.to(tokens.dtype.element_ty), mask=is_item[:, None])


@triton.jit
def _answers(
    tokens, item_of, side_of, matrices, vectors, logits, count,
    BLOCK: tl.constexpr, PRECISION: tl.constexpr, IS_INTERPRETED: tl.constexpr,
):  # fmt: skip
    answer = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_answer = answer < count
    item = tl.load(item_of + answer, mask=is_answer, other=0).to(tl.int64)
    side = tl.load(side_of + answer, mask=is_answer, other=0)
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
    tl.store(logits + answer, logit + tl.load(vectors + 576), mask=is_answer)


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
    of_code, of_place = pointnet.input.weight.detach().split((width, 3), dim=1)
    opening, *between, last = cast(list[ResidualBlock], list(pointnet.blocks))
    trunk = [opening.inner.weight.T, opening.outer.weight.T]
    trunk += [part for block in between for part in _shared_first(block, width)]
    first, second, third, fourth = cast(list[nn.Linear], list(mlp.layers))
    joined, from_features = (third.weight / math.sqrt(2)).split(width, dim=1)
    output, output_bias = pointnet.output.weight, pointnet.output.bias
    answers = [*_shared_first(last, width), (first.weight @ output).T]
    answers += [second.weight.T, joined.T, (from_features @ output).T, fourth.weight.T]
    of_shortcut = opening.shortcut.weight.detach()
    trunk_vectors = [length_scale * of_place.T, length_scale * (of_shortcut @ of_place).T]
    for block in (opening, *between):
        trunk_vectors += [block.inner.bias, block.outer.bias]
    vectors: list[Tensor] = [last.inner.bias, last.outer.bias]
    vectors += [first.bias + first.weight @ output_bias, second.bias]
    vectors += [third.bias + from_features @ output_bias, fourth.bias]
    vectors += [logit_scale * mlp.output.weight, logit_scale * mlp.output.bias]
    return PackedWeights(
        _flat(trunk + answers).to(torch.bfloat16 if precision == "bf16" else torch.float32),
        _flat(trunk_vectors + vectors),
        of_code,
        of_shortcut,
        precision,
        sum(matrix.numel() for matrix in trunk),
        sum(vector.numel() for vector in trunk_vectors),
    )


def fused_logits(
    weights: PackedWeights,
    code_biases: Float[Tensor, "bones 128"],
    bone_from_world: Float[Tensor, "bones 4 4"],
    points: Float[Tensor, "points 3"],
    item_points: Int[Tensor, "items"],
    members: Int[Tensor, "items 2"],
    is_wanted: Bool[Tensor, "items 2"],
) -> Float[Tensor, "wanted"]:
    """Logits of the wanted answers, without gradient.

    Args:
        weights: packed; with ``tf32`` or ``bf16`` for looking, not for what must be exact.
        code_biases: the first layer of each part's code, bias included.
        bone_from_world: frames of the parts, metres.
        points: in the world, metres.
        item_points: the point of each item.
        members: the two parts of each item's pair.
        is_wanted: which of their answers.

    Source: paper Sec. 3.2 and appendix (local-pair decoder).
    """
    answer_items, answer_sides = is_wanted.nonzero().unbind(-1)
    num_items, num_answers = len(members), len(answer_items)
    token_type = torch.bfloat16 if weights.precision == "bf16" else torch.float32
    tokens = points.new_empty(num_items, 2, 64, dtype=token_type)
    logits = points.new_empty(num_answers)
    block, warps = _LAUNCHES[weights.precision]
    constants: dict[str, Any] = {
        "num_warps": warps,
        "BLOCK": block,
        "PRECISION": weights.precision,
        "IS_INTERPRETED": _IS_INTERPRETED,
    }
    if num_items:
        _trunk[(triton.cdiv(num_items, block),)](
            points.contiguous(),
            item_points.contiguous(),
            members.contiguous(),
            bone_from_world[:, :3].contiguous(),
            code_biases.contiguous(),
            (code_biases @ weights.shortcut.T).contiguous(),
            weights.matrices,
            weights.vectors,
            tokens,
            num_items,
            **constants,
        )
    if num_answers:
        _answers[(triton.cdiv(num_answers, block),)](
            tokens,
            answer_items.contiguous(),
            answer_sides.contiguous(),
            weights.matrices[weights.num_trunk_matrices :],
            weights.vectors[weights.num_trunk_vectors :],
            logits,
            num_answers,
            **constants,
        )
    return logits


def _shared_first(block: ResidualBlock, width: int) -> list[Tensor]:
    """Matrices of a block on a set: those of the pooled half first, then those of each point."""
    own, common = block.inner.weight.split(width, dim=1)
    own_shortcut, common_shortcut = block.shortcut.weight.split(width, dim=1)
    return [common.T, common_shortcut.T, own.T, block.outer.weight.T, own_shortcut.T]


def _flat(pieces: list[Tensor]) -> Float[Tensor, "entries"]:
    return torch.cat([piece.detach().contiguous().flatten() for piece in pieces])


@triton.jit
def _nearest(
    anchors, queries, found, num_queries, num_anchors,
    BLOCK: tl.constexpr, ANCHORS: tl.constexpr,
):  # fmt: skip
    query = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_query = query < num_queries
    x = tl.load(queries + 3 * query, mask=is_query, other=0.0)[:, None]
    y = tl.load(queries + 3 * query + 1, mask=is_query, other=0.0)[:, None]
    z = tl.load(queries + 3 * query + 2, mask=is_query, other=0.0)[:, None]
    far = float("inf")
    d0 = tl.full((BLOCK,), far, tl.float32)
    d1, d2, d3 = d0, d0, d0
    i0 = tl.zeros((BLOCK,), tl.int32)
    i1, i2, i3 = i0, i0, i0
    column = tl.arange(0, ANCHORS)
    for start in range(0, num_anchors, ANCHORS):
        anchor = start + column
        place = anchors + 3 * anchor
        is_anchor = anchor < num_anchors
        dx = x - tl.load(place, mask=is_anchor, other=far)[None, :]
        dy = y - tl.load(place + 1, mask=is_anchor, other=far)[None, :]
        dz = z - tl.load(place + 2, mask=is_anchor, other=far)[None, :]
        distance = dx * dx + dy * dy + dz * dz
        lowest, at = tl.min(distance, axis=1, return_indices=True)
        # The nearest of these anchors goes into the list, then the next, while any is nearer.
        while tl.max((lowest < d3).to(tl.int32), axis=0) > 0:
            value, index = lowest, (start + at).to(tl.int32)
            is_less = value < d0
            d0, value = tl.where(is_less, value, d0), tl.where(is_less, d0, value)
            i0, index = tl.where(is_less, index, i0), tl.where(is_less, i0, index)
            is_less = value < d1
            d1, value = tl.where(is_less, value, d1), tl.where(is_less, d1, value)
            i1, index = tl.where(is_less, index, i1), tl.where(is_less, i1, index)
            is_less = value < d2
            d2, value = tl.where(is_less, value, d2), tl.where(is_less, d2, value)
            i2, index = tl.where(is_less, index, i2), tl.where(is_less, i2, index)
            is_less = value < d3
            d3 = tl.where(is_less, value, d3)
            i3 = tl.where(is_less, index, i3)
            distance = tl.where(column[None, :] == at[:, None], far, distance)
            lowest, at = tl.min(distance, axis=1, return_indices=True)
    place = found + 4 * query
    tl.store(place, i0.to(tl.int64), mask=is_query)
    tl.store(place + 1, i1.to(tl.int64), mask=is_query)
    tl.store(place + 2, i2.to(tl.int64), mask=is_query)
    tl.store(place + 3, i3.to(tl.int64), mask=is_query)


def four_nearest(
    anchors: Float[Tensor, "anchors 3"], queries: Float[Tensor, "queries 3"]
) -> Int[Tensor, "queries 4"]:
    """Indices of the four nearest anchors of each query, nearest first; no gradient.

    Every anchor is looked at, and no distance leaves the chip.

    Args:
        anchors: four or more.
        queries: in the same units.
    """
    found = torch.empty(len(queries), 4, dtype=torch.long, device=queries.device)
    if len(queries):
        _nearest[(triton.cdiv(len(queries), _QUERIES),)](
            anchors.detach().contiguous(),
            queries.detach().contiguous(),
            found,
            len(queries),
            len(anchors),
            BLOCK=_QUERIES,
            ANCHORS=128,
        )
    return found
