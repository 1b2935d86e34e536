"""COAP's decoder: every part for itself."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from handavatar.field.layers import SkipMLP
from handavatar.field.occupancy import CODE_WIDTH, LOGIT_SCALE

COAP_WIDTH = 128
"""With the shared encoder 137,214 parameters; the paper says 138K."""
WIDE_COAP_WIDTH = 256
"""With the shared encoder 285,310 parameters; the paper says 287K."""


class CoapDecoder(nn.Module):
    """A part's code and canonical query -> one logit: the pair decoder without its PointNet.

    A part knows of its neighbours only what its own point cloud, which reaches 1 cm into them,
    tells.

    Source: paper Sec. 4.2 and table of geometry (COAP, and COAP* with the wider MLP).
    Departs: the paper prints sizes and no layers. COAP's own code has 840K parameters for a hand;
        here it is the MLP of the pair decoder on the same encodings, which comes within 0.6 % of
        both printed sizes.
    """

    def __init__(self, width: int = COAP_WIDTH) -> None:
        """The MLP's width in units."""
        super().__init__()
        self.mlp = SkipMLP(CODE_WIDTH + 3, width, 1)

    def forward(
        self,
        codes: Float[Tensor, "bones 64"],
        queries: Float[Tensor, "points bones 3"],
        is_wanted: Bool[Tensor, "points bones"],
    ) -> Float[Tensor, "answers"]:
        """Logits of the wanted parts, positive inside, point by point.

        Args:
            codes: part encodings.
            queries: the points in every bone's frame, times ``LENGTH_SCALE``.
            is_wanted: which parts at which points; each is one answer.
        """
        part = is_wanted.nonzero()[:, 1]
        return LOGIT_SCALE * self.mlp(torch.cat([codes[part], queries[is_wanted]], dim=-1))[:, 0]
