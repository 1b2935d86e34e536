"""The Transformer decoder: all sixteen parts see each other, and none is told its neighbours.

A point has sixteen tokens, one per part: the part's code with the point in the part's frame. No
token says which part it stands for; like the pair decoder, this one has the shapes alone.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from handavatar.field.layers import SkipMLP
from handavatar.field.occupancy import (
    CODE_WIDTH,
    LENGTH_SCALE,
    LOGIT_SCALE,
    HandCodes,
    local_points,
)

HIDDEN_WIDTH = 90
"""Units between the two layers of a block's MLP: the total comes to the paper's 256K."""


class SelfAttention(nn.Module):
    """Scaled dot-product attention of tokens among themselves.

    Source: paper appendix, Transformer-based decoder, after Vaswani et al. 2017.
    """

    def __init__(self, width: int, num_heads: int) -> None:
        """Width of a token, divided evenly among the heads."""
        super().__init__()
        self.num_heads = num_heads
        self.input = nn.Linear(width, 3 * width)
        self.output = nn.Linear(width, width)

    def weights(
        self, tokens: Float[Tensor, "points tokens width"]
    ) -> Float[Tensor, "points heads tokens tokens"]:
        """Rows sum to 1: how much each token takes from every token."""
        query, key, _ = self._heads(tokens)
        return _attention(query, key)

    def forward(
        self, tokens: Float[Tensor, "points tokens width"]
    ) -> Float[Tensor, "points tokens width"]:
        """What each token gathers from all."""
        query, key, value = self._heads(tokens)
        mixed = _attention(query, key) @ value
        return self.output(mixed.transpose(1, 2).flatten(2))

    def _heads(self, tokens: Float[Tensor, "points tokens width"]) -> tuple[Tensor, ...]:
        """Query, key and value: points, heads, tokens, width of a head."""
        split = self.input(tokens).unflatten(-1, (3, self.num_heads, -1))
        return split.permute(2, 0, 3, 1, 4).unbind(0)


class TransformerBlock(nn.Module):
    """Attention, then an MLP per token; both normalise what they read and add what they find."""

    def __init__(self, width: int, num_heads: int, hidden: int) -> None:
        """Widths in units."""
        super().__init__()
        self.attention_norm = nn.LayerNorm(width)
        self.attention = SelfAttention(width, num_heads)
        self.mlp_norm = nn.LayerNorm(width)
        self.inner = nn.Linear(width, hidden)
        self.outer = nn.Linear(hidden, width)

    def forward(
        self, tokens: Float[Tensor, "points tokens width"]
    ) -> Float[Tensor, "points tokens width"]:
        """Applies the block."""
        tokens = tokens + self.attention(self.attention_norm(tokens))
        return tokens + self.outer(self.inner(self.mlp_norm(tokens)).relu())


class TransformerDecoder(nn.Module):
    """Sixteen encodings with their canonical queries -> a logit for each wanted part.

    Source: paper appendix, Transformer-based decoder: four self-attention blocks in the place of
        the pair decoder's PointNet.
    Departs: the paper prints 256K parameters and no widths. Here blocks of width 64 with four
        heads, an MLP of 90 units, normalised before each half; the last MLP is the pair decoder's.
    """

    def __init__(self, num_blocks: int = 4, num_heads: int = 4, hidden: int = HIDDEN_WIDTH) -> None:
        """Sizes by which, with the shared encoder, there are 255,977 parameters."""
        super().__init__()
        self.input = nn.Linear(CODE_WIDTH + 3, CODE_WIDTH)
        self.blocks = nn.ModuleList(
            TransformerBlock(CODE_WIDTH, num_heads, hidden) for _ in range(num_blocks)
        )
        self.norm = nn.LayerNorm(CODE_WIDTH)
        self.mlp = SkipMLP(CODE_WIDTH, 128, 1)

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
            is_wanted: which parts at which points; each is one answer. Points without any are
                spared, all others need all their tokens.
        """
        is_asked = is_wanted.any(-1)
        tokens = self._tokens(codes, queries[is_asked])
        for block in self.blocks:
            tokens = block(tokens)
        return LOGIT_SCALE * self.mlp(self.norm(tokens[is_wanted[is_asked]]))[:, 0]

    def attention_weights(
        self, codes: Float[Tensor, "bones 64"], queries: Float[Tensor, "points bones 3"]
    ) -> Float[Tensor, "points blocks heads bones bones"]:
        """How much each part (row) takes from every part (column); rows sum to 1."""
        tokens = self._tokens(codes, queries)
        found = []
        for block in self.blocks:
            assert isinstance(block, TransformerBlock)
            found.append(block.attention.weights(block.attention_norm(tokens)))
            tokens = block(tokens)
        return torch.stack(found, dim=1)

    def _tokens(
        self, codes: Float[Tensor, "bones 64"], queries: Float[Tensor, "points bones 3"]
    ) -> Float[Tensor, "points bones 64"]:
        encodings = codes.expand(len(queries), -1, -1)
        return self.input(torch.cat([encodings, queries], dim=-1))


def attention_maps(
    decoder: TransformerDecoder, codes: HandCodes, points: Float[Tensor, "points 3"]
) -> Float[Tensor, "blocks heads bones bones"]:
    """Attention averaged over world points (metres), without gradient; rows sum to 1.

    Source: paper Sec. 4.2, figure of attention maps.
    """
    total = codes.part_codes.new_zeros(())
    with torch.no_grad():
        for piece in points.split(1024):
            queries = local_points(codes.boxes, piece) * LENGTH_SCALE
            total = total + decoder.attention_weights(codes.part_codes, queries).sum(0)
    return total / len(points)


def _attention(
    query: Float[Tensor, "points heads tokens channels"],
    key: Float[Tensor, "points heads tokens channels"],
) -> Float[Tensor, "points heads tokens tokens"]:
    return (query @ key.transpose(-1, -2) / math.sqrt(query.shape[-1])).softmax(-1)
