"""Occupancy with one answer per part: the house in which other decoders meet PairOF.

Encoder, canonical queries, part boxes and fusion are those of
:class:`handavatar.field.occupancy.PairOccupancy`; only the decoder differs, and is passed in.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from handavatar.field.coap import CoapDecoder
from handavatar.field.layers import PointNet
from handavatar.field.occupancy import (
    BOX_MARGIN,
    LENGTH_SCALE,
    HandCodes,
    MaximumFusion,
    contains,
    hand_codes,
    local_points,
    soft_occupancy,
)
from handavatar.field.transformer import TransformerDecoder
from handavatar.hand.parts import Parts
from handavatar.hand.rig import PosedHand
from handavatar.jobs.threads import mapped


@dataclass(frozen=True, eq=False)
class PartOccupancy:
    """Occupancy at points, part by part.

    Attributes:
        whole: of the hand, in [0, 1], surface at 0.5.
        logits: of each part, positive inside; minus infinity where its box does not hold the
            point.
    """

    whole: Float[Tensor, "points"]
    logits: Float[Tensor, "points bones"]


class PartwiseOccupancy(nn.Module):
    """Part encoder, a decoder with one answer per part, maximum over the parts.

    Source: paper Sec. 4.2 (same encoder, different decoders).
    """

    def __init__(
        self,
        encoder: PointNet,
        decoder: CoapDecoder | TransformerDecoder,
        margin: float = BOX_MARGIN,
        chunk: int = 1024,
    ) -> None:
        """Joins the parts of the field.

        Args:
            encoder: of a part's points and normals, 6 numbers each.
            decoder: answers for the parts whose boxes hold a point.
            margin: how far a part's box reaches beyond the part, metres.
            chunk: points evaluated at a time without gradient.
        """
        super().__init__()
        self.encoder = encoder
        self.decoder = decoder
        self.fusion = MaximumFusion()
        self.margin = margin
        self.chunk = chunk

    def encode(self, parts: Parts, posed: PosedHand) -> HandCodes:
        """Encodes the surface of a posed hand; once per pose."""
        return hand_codes(self.encoder.factorised, parts, posed, self.margin)

    def forward(self, codes: HandCodes, points: Float[Tensor, "points 3"]) -> PartOccupancy:
        """Occupancy at world points (metres), without gradient, piece by piece."""
        # A core's cache wants small pieces; a GPU wants large ones, one after the other.
        chunk = self.chunk if points.device.type == "cpu" else 128 * self.chunk
        starts = range(0, max(len(points), 1), chunk)
        pieces = mapped(
            lambda piece: self.part_logits(codes, piece),
            [points[start : start + chunk] for start in starts],
        )
        logits = torch.cat(pieces)
        return PartOccupancy(self._whole(logits), logits)

    def trainable_whole(
        self, codes: HandCodes, points: Float[Tensor, "points 3"]
    ) -> Float[Tensor, "points"]:
        """Occupancy of the hand with gradient."""
        return self._whole(self.part_logits(codes, points))

    def part_logits(
        self, codes: HandCodes, points: Float[Tensor, "points 3"]
    ) -> Float[Tensor, "points bones"]:
        """Logit of each part with gradient; minus infinity outside its box."""
        local = local_points(codes.boxes, points)
        is_in_box = contains(codes.boxes, local)
        answers = self.decoder(codes.part_codes, local * LENGTH_SCALE, is_in_box)
        nowhere = answers.new_full(is_in_box.shape, -torch.inf)
        return nowhere.masked_scatter(is_in_box, answers)

    def _whole(self, logits: Float[Tensor, "points bones"]) -> Float[Tensor, "points"]:
        return self.fusion.over_parts(soft_occupancy(logits, 1.0))
