"""What the Transformer decoder's attention says: does a part look at those it is joined to?"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from PIL import Image, ImageDraw
from torch import Tensor

from handavatar.errors import HandAvatarError
from handavatar.field.occupancy import HandCodes
from handavatar.field.partwise import PartwiseOccupancy
from handavatar.field.transformer import TransformerDecoder, attention_maps
from handavatar.hand.pose import BONE_NAMES, CONNECTED_PAIRS, NUM_BONES

_CELL, _LABELS, _TITLE, _GAP = 15, 60, 18, 10
"""Pixels: of a cell, of the names left of a map, of the line above it, between maps."""
_DARKEST = 0.5
"""The weight that the picture paints darkest."""


@dataclass(frozen=True, eq=False)
class AttentionReading:
    """Attention where it counts: a part's row, at the points which that part decides.

    Attributes:
        rows: mean over heads and over the part's points; each row sums to 1, or is zero for a
            part that decides no point.
        counts: points that each part decides.
    """

    rows: Float[Tensor, "blocks bones bones"]
    counts: Int[Tensor, "bones"]


def read_attention(
    field: PartwiseOccupancy, codes: HandCodes, points: Float[Tensor, "points 3"]
) -> AttentionReading:
    """Groups points by the part with the largest occupancy and averages that part's row.

    Args:
        field: with a Transformer decoder.
        codes: of the posed hand.
        points: on the hand's surface, metres, world frame.

    Raises:
        ValueError: if the field has another decoder.

    Source: paper Sec. 4.2, comparison with the Transformer-based decoder.
    Departs: the paper takes the vertices of the extracted mesh; which points are taken is left to
        the caller, and :mod:`handavatar.train.comparison` takes the guiding mesh's.
    """
    decoder = field.decoder
    if not isinstance(decoder, TransformerDecoder):
        raise HandAvatarError(
            f"attention: found a {type(decoder).__name__}, expected a TransformerDecoder: train a "
            "prior with `decoder='transformer'`"
        )
    found = field(codes, points)
    winner = found.logits.argmax(-1).where(found.whole > 0, -1)
    rows = torch.zeros(len(decoder.blocks), NUM_BONES, NUM_BONES)
    counts = torch.zeros(NUM_BONES, dtype=torch.long)
    for bone in winner[winner >= 0].unique().tolist():
        decided = points[winner == bone]
        maps = attention_maps(decoder, codes, decided).mean(1)
        rows[:, bone], counts[bone] = maps[:, bone].cpu(), len(decided)
    return AttentionReading(rows, counts)


def neighbour_preference(rows: Float[Tensor, "bones bones"]) -> Float[Tensor, "bones"]:
    """Weight that a part gives to a connected part, over what it gives to one that is not.

    Both are means over the parts of their kind, the part itself left out: 1 is indifference
    whatever the number of neighbours. NaN for a part without weights.
    """
    is_joined = _is_joined()
    is_other = ~is_joined & ~torch.eye(NUM_BONES, dtype=torch.bool)
    joined = (rows * is_joined).sum(-1) / is_joined.sum(-1)
    return joined / ((rows * is_other).sum(-1) / is_other.sum(-1))


def attention_figures(reading: AttentionReading) -> dict[str, dict[str, float]]:
    """By part, for those that decide points: the weights and the preference for neighbours.

    Returns:
        ``points``; ``itself``, ``neighbours`` and ``others`` (total weights, sum 1);
        ``preference``, see :func:`neighbour_preference`.
    """
    rows = reading.rows.mean(0)
    preference = neighbour_preference(rows)
    figures = {}
    for bone in reading.counts.nonzero()[:, 0].tolist():
        itself = float(rows[bone, bone])
        neighbours = float(rows[bone, _is_joined()[bone]].sum())
        figures[BONE_NAMES[bone]] = {
            "points": float(reading.counts[bone]),
            "itself": itself,
            "neighbours": neighbours,
            "others": 1 - itself - neighbours,
            "preference": float(preference[bone]),
        }
    return figures


def attention_picture(readings: Mapping[str, AttentionReading]) -> Image.Image:
    """One line of maps per reading: the mean over the blocks, then each block.

    Rows are parts that attend, columns parts attended to; the darker, the more weight, from 0
    (white) to 0.5. Frames mark connected parts. A row without points is grey.

    Source: paper Sec. 4.2, figure of attention maps.
    """
    num_blocks = max(len(reading.rows) for reading in readings.values())
    side = NUM_BONES * _CELL
    width = _LABELS + (num_blocks + 1) * (side + _GAP)
    line_height = _TITLE + side + _CELL + _GAP
    picture = Image.new("RGB", (width, line_height * len(readings)), "white")
    draw = ImageDraw.Draw(picture)
    for line, (name, reading) in enumerate(readings.items()):
        maps = [reading.rows.mean(0), *reading.rows]
        for column, weights in enumerate(maps):
            left, top = _LABELS + column * (side + _GAP), line * line_height + _TITLE
            title = f"{name}, mean of all blocks" if column == 0 else f"block {column}"
            draw.text((left, top - _TITLE + 3), title, "black")
            _draw_map(draw, left, top, weights, reading.counts)
            for bone in range(NUM_BONES):
                draw.text((left + bone * _CELL + 1, top + side + 1), str(bone), "black")
        for bone, part in enumerate(BONE_NAMES):
            place = (1, line * line_height + _TITLE + bone * _CELL + 1)
            draw.text(place, f"{bone:>2} {part}", "black", font_size=9)
    return picture


def _draw_map(
    draw: ImageDraw.ImageDraw,
    left: int,
    top: int,
    weights: Float[Tensor, "bones bones"],
    counts: Int[Tensor, "bones"],
) -> None:
    is_joined = _is_joined().tolist()
    darkness = (weights / _DARKEST).clamp(0, 1).tolist()
    for row in range(NUM_BONES):
        for column in range(NUM_BONES):
            shade = darkness[row][column]
            # White to dark blue; the red channel falls first, so that small weights show.
            color = tuple(round(255 * (1 - part * shade)) for part in (1.0, 0.8, 0.45))
            corner = (left + column * _CELL, top + row * _CELL)
            opposite = (corner[0] + _CELL - 1, corner[1] + _CELL - 1)
            fill = color if int(counts[row]) else (215, 215, 215)
            outline = (220, 60, 30) if is_joined[row][column] else (235, 235, 235)
            draw.rectangle((*corner, *opposite), fill, outline)


def _is_joined() -> Tensor:
    """Which parts are connected, in both directions."""
    first, second = torch.tensor(CONNECTED_PAIRS).T
    joined = torch.zeros(NUM_BONES, NUM_BONES, dtype=torch.bool)
    joined[first, second] = joined[second, first] = True
    return joined
