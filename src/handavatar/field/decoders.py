"""The decoders that are compared, by the names that files and commands use."""

from typing import Literal, assert_never

from handavatar.field.coap import COAP_WIDTH, WIDE_COAP_WIDTH, CoapDecoder
from handavatar.field.layers import PointNet
from handavatar.field.occupancy import CODE_WIDTH, PairOccupancy
from handavatar.field.partwise import PartwiseOccupancy
from handavatar.field.transformer import TransformerDecoder
from handavatar.hand.parts import shuffled_pairs

Decoder = Literal["pair", "pair-shuffled", "coap", "coap-wide", "transformer"]
OccupancyField = PairOccupancy | PartwiseOccupancy

SHUFFLED_PAIRS = shuffled_pairs(seed=0)
"""Of the control; fixed, so that a file's weights always meet the pairs they were trained with."""


def untrained_field(decoder: Decoder) -> OccupancyField:
    """A field with random weights; the encoder's are the same whatever the decoder.

    Args:
        decoder: ``pair`` is PairOF; ``pair-shuffled`` the same with unconnected parts as pairs;
            ``coap`` and ``coap-wide`` decode each part for itself; ``transformer`` lets all
            parts see each other.
    """
    match decoder:
        # The encoder is built first everywhere, so that it takes the same random numbers.
        case "pair":
            return PairOccupancy()
        case "pair-shuffled":
            return PairOccupancy(connections=SHUFFLED_PAIRS)
        case "coap":
            return PartwiseOccupancy(PointNet(6, CODE_WIDTH), CoapDecoder(COAP_WIDTH))
        case "coap-wide":
            return PartwiseOccupancy(PointNet(6, CODE_WIDTH), CoapDecoder(WIDE_COAP_WIDTH))
        case "transformer":
            return PartwiseOccupancy(PointNet(6, CODE_WIDTH), TransformerDecoder())
    assert_never(decoder)
