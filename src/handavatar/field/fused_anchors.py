"""The search for the nearest anchors as a Triton kernel; see :mod:`handavatar.field.fused`."""

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

_QUERIES = 32
"""At a time in one program."""


@triton.jit(do_not_specialize=["num_queries", "num_anchors"])
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
