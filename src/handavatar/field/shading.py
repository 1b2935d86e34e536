"""The self-occlusion-aware shading field ("SelF"): albedo and illumination."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from handavatar.field.anchors import Neighbours
from handavatar.field.layers import MLP, positional_encoding
from handavatar.hand.pose import NUM_BONES

NUM_FREQUENCIES = 3
CODE_WIDTH = 128
CODE_SPREAD = 0.1
"""Standard deviation of the codes at the start; small ones start as one even colour."""
POSITION_SCALE = 0.1
"""Anchor positions are divided by this (metres) before they are encoded."""


def directed_occupancy(
    soft_parts: Float[Tensor, "rays samples bones"],
) -> Float[Tensor, "rays samples bones"]:
    """Largest soft occupancy of each part that the ray has met up to and including each sample.

    Source: paper Sec. 3.3, Eq. 4. Samples are ordered from the camera outwards.
    """
    return soft_parts.cummax(dim=1).values


class AlbedoField(nn.Module):
    """Colour of the skin: codes on the anchors, interpolated, decoded; knows no pose.

    Source: paper Sec. 3.3 (albedo field); 4096 x 128 codes, MLP 128 -> 4 x 256 -> 3.
    """

    def __init__(self, num_anchors: int) -> None:
        """Random codes."""
        super().__init__()
        self.codes = nn.Parameter(CODE_SPREAD * torch.randn(num_anchors, CODE_WIDTH))
        self.mlp = MLP(CODE_WIDTH, 256, 4, 3)

    def forward(self, neighbours: Neighbours) -> Float[Tensor, "queries 3"]:
        """RGB in [0, 1]."""
        return self.mlp(neighbours.interpolated(self.codes)).sigmoid()


class IlluminationField(nn.Module):
    """How much light arrives: pose, surface-calibrated place, directed soft occupancy -> scalar.

    Source: paper Sec. 3.3 (illumination field); 85 inputs = 16 + 21 + 48, MLP 4 x 256.
    """

    position_codes: Tensor

    def __init__(self, anchor_positions: Float[Tensor, "anchors 3"]) -> None:
        """Fixes the encodings E of the anchors' template positions (metres)."""
        super().__init__()
        centred = (anchor_positions - anchor_positions.mean(0)) / POSITION_SCALE
        codes = positional_encoding(centred, NUM_FREQUENCIES)
        self.register_buffer("position_codes", codes)
        self.mlp = MLP(NUM_BONES + codes.shape[-1] + 3 * NUM_BONES, 256, 4, 1)

    def forward(
        self,
        rotations: Float[Tensor, "*queries bones 3"],
        neighbours: Neighbours,
        directed: Float[Tensor, "queries bones"],
    ) -> Float[Tensor, "queries"]:
        """Illumination, in (0, 1).

        Args:
            rotations: the whole pose, the wrist's rotation in the world frame; one for all
                queries or one for each.
            neighbours: nearest anchors of the queries.
            directed: directed soft occupancy at the queries, without gradient.

        Departs: the authors give the wrist's rotation in camera axes, which cannot tell where a
            light that is fixed in the world stands; here it is the world's.
        """
        places = neighbours.interpolated(self.position_codes)
        pose = rotations.flatten(-2).expand(len(places), -1)
        return self.mlp(torch.cat([directed, places, pose], dim=-1))[:, 0].sigmoid()
