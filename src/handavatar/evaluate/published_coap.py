"""The occupancy query of COAP's own published code, where someone has installed it.

It is timed beside ours (``bench --table speed``): the same points, the boxes of the same parts. Its
weights are for bodies and play no part in its cost, so they stay as they are made.
"""

from collections.abc import Callable
from importlib import import_module
from unittest.mock import patch

import torch
from jaxtyping import Float
from torch import Tensor, nn

from handavatar.hand.parts import PartBoxes

Query = Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]]


class _PartsOfAHand(nn.Module):
    """What COAP's model asks of its division into parts, which knows bodies alone."""

    model_type = "hand"

    def __init__(self, num_parts: int) -> None:
        super().__init__()
        self.num_parts = num_parts


def published_coap_query(boxes: PartBoxes) -> Query | str:
    """COAP's query for a posed hand, without gradient; or why there is none, as a clause.

    Source: Mihajlovic et al., COAP, CVPR 2022, package ``coap`` (github.com/markomih/COAP): its
    query decodes every part at every point and keeps the largest answer among the boxes that hold
    the point.
    """
    try:
        published = import_module("coap.coap")
    except ImportError as error:
        # The name is also that of unrelated packages, which hold no such module.
        if error.name in ("coap", "coap.coap"):
            return "COAP's code (github.com/markomih/COAP) is not installed"
        return f"COAP's code cannot be imported ({error})"
    num_parts = len(boxes.lower)
    with patch.object(published, "Partitioner", lambda _: _PartsOfAHand(num_parts)):
        model = published.COAPBodyModel(None).to(boxes.lower.device).eval()
    model.impl_code = {
        "latent_code": boxes.lower.new_zeros(1, num_parts, model.encoder.out_dim),
        "bone_trans": boxes.bone_from_world[None],
        "bbox_size": (boxes.upper - boxes.lower)[None, :, None] * model.bbox_padding,
        "bbox_center": (boxes.upper + boxes.lower)[None, :, None] / 2,
    }

    def query(points: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        with torch.no_grad():
            found: Tensor = model.query(points[None])
        return found[0]

    return query
