"""The local-pair occupancy field ("PairOF"): inside or outside, per part and for the whole hand.

Every part's surface points are encoded by a shared PointNet; two physically connected parts are
decoded together, so that each knows where the other continues. Part boxes belong to the model: a
part has no occupancy outside its box, so culling by boxes changes nothing.

Two ways to evaluate the same field live side by side: :meth:`PairOccupancy.plain` decodes every
pair at every point and is obvious; :meth:`PairOccupancy.forward` decodes only pairs whose boxes
hold the point, shares first layers between pairs, and is fast.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from handavatar.field.kernels import PRECISIONS, Kernel, Precision, settled_kernel
from handavatar.field.layers import PointNet, SkipMLP
from handavatar.hand.parts import PartBoxes, Parts
from handavatar.hand.pose import CONNECTED_PAIRS, NUM_BONES
from handavatar.hand.rig import PosedHand
from handavatar.jobs.threads import mapped

if TYPE_CHECKING:
    from handavatar.field.fused import Decided, PackedHand, PackedWeights

CODE_WIDTH = 64
LENGTH_SCALE = 20.0
"""Bone-frame metres are multiplied by this before any network sees them (5 cm become 1)."""
LOGIT_SCALE = 10.0
"""The decoder's output is multiplied by this: a surface needs logits of some units per mm."""
BOX_MARGIN = 0.012
"""How far a part's box reaches beyond the part, metres."""


@dataclass(frozen=True, eq=False)
class HandCodes:
    """All that the occupancy of one posed hand depends on.

    Attributes:
        part_codes: encoding of each part's surface.
        boxes: the part boxes in their bones' frames.
    """

    part_codes: Float[Tensor, "bones 64"]
    boxes: PartBoxes


@dataclass(frozen=True, eq=False)
class PairItems:
    """Pairs to decode: which points, which pairs, and which of the two answers are wanted."""

    points: Int[Tensor, "items"]
    pairs: Int[Tensor, "items"]
    is_wanted: Bool[Tensor, "items 2"]

    def among(self, chosen: Bool[Tensor, "points"]) -> "PairItems":
        """The items of the chosen points, which are numbered anew in their order."""
        is_kept = chosen[self.points]
        numbers = chosen.cumsum(0) - 1
        return PairItems(
            numbers[self.points[is_kept]], self.pairs[is_kept], self.is_wanted[is_kept]
        )


def decided_items(points: Int[Tensor, "items"], deciders: Int[Tensor, "items"]) -> PairItems:
    """The pairs and the sides of them that decide points, as items.

    Args:
        points: their numbers.
        deciders: twice the number of a pair, plus one for its second part.
    """
    deciders = deciders.long()
    is_wanted = torch.nn.functional.one_hot(deciders % 2, 2).bool()
    return PairItems(points, deciders // 2, is_wanted)


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Occupancy at points.

    Attributes:
        whole: of the hand, in [0, 1], surface at 0.5.
        soft_parts: soft occupancy of each part, in [0, 1], zero outside its box.
        items: the decoded pairs that decide the values, one a point; all for a fusion that mixes.
    """

    whole: Float[Tensor, "points"]
    soft_parts: Float[Tensor, "points bones"]
    items: PairItems


def soft_occupancy(logits: Float[Tensor, "*batch"], softness: float) -> Float[Tensor, "*batch"]:
    """Sigmoid of ``softness`` times the logits.

    Args:
        logits: positive inside; minus infinity (no box holds the point) gives zero.
        softness: 1 gives the occupancy; the paper's tau, 0.05, a gentle slope by which near and
            far outside differ.

    Source: paper Sec. 3.2, Eq. 1 (sigma, softness 1) and Sec. 3.3, Eq. 3 (softness tau).
    """
    return torch.sigmoid(softness * logits)


def box_fade(
    local_points: Float[Tensor, "points bones 3"], boxes: PartBoxes
) -> Float[Tensor, "points bones"]:
    """1 inside a part's own box, falling smoothly to 0 at ``margin`` outside it.

    Departs: in the authors' code the soft occupancy jumps to zero at the border of the enlarged
        box; here it is faded, so that the illumination's input is continuous.
    """
    outside = torch.maximum(boxes.lower - local_points, local_points - boxes.upper).amax(-1)
    ramp = (1 - outside / boxes.margin).clamp(0, 1)
    return ramp * ramp * (3 - 2 * ramp)


class MaximumFusion:
    """The paper's fusion: the largest logit over pairs, then the largest part."""

    def over_pairs(
        self,
        logits: Float[Tensor, "answers"],
        slots: Int[Tensor, "answers"],
        num_slots: int,
        slope: float,
    ) -> Float[Tensor, "slots"]:
        """Value of each slot (a part at a point): sigmoid of ``slope`` times the largest logit.

        Source: paper Sec. 3.2, Eq. 1; with the paper's tau as slope, its soft variant.
        """
        lowest = logits.new_full((num_slots,), -torch.inf)
        return soft_occupancy(lowest.scatter_reduce(0, slots, logits, "amax"), slope)

    def over_parts(self, parts: Float[Tensor, "points bones"]) -> Float[Tensor, "points"]:
        """Value of the whole hand.

        Source: paper Sec. 3.2, the global occupancy.
        """
        return parts.amax(-1)

    def deciding(
        self, logits: Float[Tensor, "answers"], points: Int[Tensor, "answers"], num_points: int
    ) -> Int[Tensor, "deciding"]:
        """Indices of the answers that the whole hand's value depends on: one per point."""
        highest = logits.new_full((num_points,), -torch.inf).scatter_reduce(
            0, points, logits, "amax"
        )
        candidates = (logits == highest[points]).nonzero()[:, 0]
        first = torch.full((num_points,), len(logits), device=logits.device)
        first = first.scatter_reduce(0, points[candidates], candidates, "amin")
        return first[first < len(logits)]


class SoftmaxFusion:
    """The authors' fusion: sigmoid first, then softmax-weighted means over pairs and parts.

    Departs: not in the paper; selectable to compare with the released code.
    """

    temperature = 0.05

    def over_pairs(
        self,
        logits: Float[Tensor, "answers"],
        slots: Int[Tensor, "answers"],
        num_slots: int,
        slope: float,
    ) -> Float[Tensor, "slots"]:
        """Softmax-weighted mean of the sigmoids in each slot; zero where there are none."""
        values = soft_occupancy(logits, slope)
        weights = (values / self.temperature).exp()
        empty = logits.new_zeros(num_slots)
        total = empty.scatter_add(0, slots, weights)
        return empty.scatter_add(0, slots, weights * values) / (total + 1e-5)

    def over_parts(self, parts: Float[Tensor, "points bones"]) -> Float[Tensor, "points"]:
        """Softmax-weighted mean over the parts whose value is not zero."""
        weights = (parts / self.temperature).exp() * (parts > 0)
        return (weights * parts).sum(-1) / (weights.sum(-1) + 1e-5)

    def deciding(
        self, logits: Float[Tensor, "answers"], points: Int[Tensor, "answers"], num_points: int
    ) -> Int[Tensor, "deciding"]:
        """Every answer decides."""
        return torch.arange(len(logits), device=logits.device)


class PairDecoder(nn.Module):
    """Two part encodings with their canonical queries -> one logit for each of the two.

    Source: paper Sec. 3.2 and appendix (local-pair decoder).
    """

    def __init__(self) -> None:
        """Sizes as in the paper's tables."""
        super().__init__()
        self.pointnet = PointNet(CODE_WIDTH + 3, CODE_WIDTH, is_pooled=False)
        self.mlp = SkipMLP(CODE_WIDTH, 128, 1)

    def forward(
        self, codes: Float[Tensor, "items 2 64"], queries: Float[Tensor, "items 2 3"]
    ) -> Float[Tensor, "items 2"]:
        """Logits, positive inside.

        Args:
            codes: part encodings.
            queries: the point in the two bones' frames, times ``LENGTH_SCALE``.
        """
        features = self.pointnet(torch.cat([codes, queries], dim=-1))
        return LOGIT_SCALE * self.mlp(features)[..., 0]


class PairOccupancy(nn.Module):
    """PairOF: part encoder, pair decoder, fusion.

    Source: paper Sec. 3.2. 232,513 parameters (the paper says 237K; the authors' code counts
        232,513 as well).
    """

    pairs: Tensor

    def __init__(
        self,
        fusion: MaximumFusion | SoftmaxFusion | None = None,
        softness: float = 0.05,
        margin: float = BOX_MARGIN,
        chunk: int = 1024,
        connections: tuple[tuple[int, int], ...] = CONNECTED_PAIRS,
        sharpness: float = 1.0,
    ) -> None:
        """Builds an untrained field.

        Args:
            fusion: how the answers of several pairs and parts become one; default the maximum.
            softness: the paper's tau.
            margin: how far a part's box reaches beyond the part, metres.
            chunk: points evaluated at a time without gradient.
            connections: the pairs of parts to decode, every part in one at least; others than
                the physical ones serve as a control.
            sharpness: the occupancy is the sigmoid of so many times the logit. A field trained on
                points is as soft as it is unsure, and along a grazing ray the tail adds up to an
                outline too wide; more than 1 takes the tail away and leaves the surface where it
                is.

        Departs: the authors' boxes are twice the size of the part. A fixed margin gives fingers
            the same reach, and spares the wide empty space that doubling the palm encloses.
        """
        super().__init__()
        self.encoder = PointNet(6, CODE_WIDTH)
        self.decoder = PairDecoder()
        self.fusion = fusion or MaximumFusion()
        self.softness = softness
        self.margin = margin
        self.chunk = chunk
        self.connections = connections
        self.sharpness = sharpness
        self._packed: dict[Precision, tuple[tuple[object, ...], PackedWeights]] = {}
        self._hands: WeakKeyDictionary[HandCodes, tuple[tuple[object, ...], PackedHand]] = (
            WeakKeyDictionary()
        )
        self.register_buffer("pairs", torch.tensor(connections), persistent=False)

    def encode(self, parts: Parts, posed: PosedHand) -> HandCodes:
        """Encodes the surface of a posed hand; once per pose."""
        return hand_codes(self.encoder.factorised, parts, posed, self.margin)

    def forward(
        self, codes: HandCodes, points: Float[Tensor, "points 3"], kernel: Kernel = "auto"
    ) -> Occupancy:
        """Occupancy at world points (metres), without gradient; the fast way."""
        kernel = settled_kernel(kernel, points.device)
        if self.is_fused(kernel):
            with torch.no_grad():
                return self._fused_occupancy(codes, points, kernel)
        # A core's cache wants small pieces; a GPU wants large ones, one after the other.
        chunk = self.chunk * (1 if points.device.type == "cpu" else 128)
        starts = range(0, max(len(points), 1), chunk)
        chunks = [points[start : start + chunk] for start in starts]
        pieces = mapped(lambda piece: self._chunk_occupancy(codes, piece), chunks)
        if len(pieces) == 1:
            return pieces[0]
        items = PairItems(
            torch.cat([p.items.points + start for p, start in zip(pieces, starts, strict=True)]),
            torch.cat([p.items.pairs for p in pieces]),
            torch.cat([p.items.is_wanted for p in pieces]),
        )
        return Occupancy(
            torch.cat([p.whole for p in pieces]), torch.cat([p.soft_parts for p in pieces]), items
        )

    def trainable_whole(
        self, codes: HandCodes, points: Float[Tensor, "points 3"]
    ) -> Float[Tensor, "points"]:
        """Occupancy of the hand with gradient: first which pairs decide, then those alone."""
        with torch.no_grad():
            items = self(codes, points).items
        return self.of_items(codes, points, items)

    def of_items(
        self,
        codes: HandCodes,
        points: Float[Tensor, "points 3"],
        items: PairItems,
    ) -> Float[Tensor, "points"]:
        """Occupancy with gradient, from the given pairs alone.

        With the items that :meth:`forward` found to decide, value and gradient equal those of
        the full evaluation, at a fraction of the work.

        Args:
            codes: of the posed hand.
            points: world, metres.
            items: of these points.
        """
        logits = self.wanted_logits(codes, points, items)
        slots = (items.points[:, None] * NUM_BONES + self.pairs[items.pairs])[items.is_wanted]
        parts = self.fusion.over_pairs(logits, slots, len(points) * NUM_BONES, slope=self.sharpness)
        return self.fusion.over_parts(parts.view(-1, NUM_BONES))

    def plain(
        self, codes: HandCodes, points: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, "points"], Float[Tensor, "points bones"]]:
        """Occupancy and soft part occupancy, every pair at every point, with gradient.

        The slow and obvious evaluation that the fast one is tested against.
        """
        num_points, num_pairs = len(points), len(self.pairs)
        local = local_points(codes.boxes, points)
        is_in_box = contains(codes.boxes, local)
        items = PairItems(
            torch.arange(num_points, device=points.device).repeat_interleave(num_pairs),
            torch.arange(num_pairs, device=points.device).repeat(num_points),
            is_in_box[:, self.pairs].flatten(0, 1),
        )
        logits = self._decode(codes, points, items)[items.is_wanted]
        slots = (items.points[:, None] * NUM_BONES + self.pairs[items.pairs])[items.is_wanted]
        size = num_points * NUM_BONES
        parts = self.fusion.over_pairs(logits, slots, size, slope=self.sharpness).view(
            -1, NUM_BONES
        )
        soft = self.fusion.over_pairs(logits, slots, size, self.softness).view(-1, NUM_BONES)
        return self.fusion.over_parts(parts), soft * box_fade(local, codes.boxes)

    def _decode(
        self, codes: HandCodes, points: Float[Tensor, "points 3"], items: PairItems
    ) -> Float[Tensor, "items 2"]:
        members, queries = self._members_and_queries(codes, points, items)
        return self.decoder(codes.part_codes[members], queries)

    def _members_and_queries(
        self, codes: HandCodes, points: Float[Tensor, "points 3"], items: PairItems
    ) -> tuple[Int[Tensor, "items 2"], Float[Tensor, "items 2 3"]]:
        """The two parts of every item, and its point in their frames, times ``LENGTH_SCALE``."""
        members = self.pairs[items.pairs]
        transforms = codes.boxes.bone_from_world[members]
        position = points[items.points][:, None, :, None]
        queries = (transforms[..., :3, :3] @ position)[..., 0] + transforms[..., :3, 3]
        return members, queries * LENGTH_SCALE

    def wanted_logits(
        self, codes: HandCodes, points: Float[Tensor, "points 3"], items: PairItems
    ) -> Float[Tensor, "wanted"]:
        """The wanted answers of the given pairs, with gradient, by exact algebra.

        The constant part code enters the first layer as a bias; then :meth:`_answers`.
        """
        members, queries = self._members_and_queries(codes, points, items)
        network = self.decoder.pointnet
        of_code, of_query = network.input.weight.split((CODE_WIDTH, 3), dim=1)
        biases = codes.part_codes @ of_code.T + network.input.bias
        tokens = network.blocks[0](biases[members] + queries @ of_query.T)
        return self._answers(tokens, items.is_wanted)

    def _answers(
        self, tokens: Float[Tensor, "items 2 64"], is_wanted: Bool[Tensor, "items 2"]
    ) -> Float[Tensor, "wanted"]:
        """From the features after the first block to the wanted logits.

        The pooled half of every block runs once per pair instead of once per member; the last
        block and the MLP run for wanted answers only.
        """
        *between, last = self.decoder.pointnet.set_blocks
        for block in between:
            tokens = block.of_set(tokens, tokens.amax(-2))
        item = is_wanted.nonzero()[:, 0]
        answers = last.of_set(tokens[is_wanted][:, None], tokens.amax(-2)[item])[:, 0]
        return LOGIT_SCALE * self.decoder.mlp(self.decoder.pointnet.output(answers.relu()))[:, 0]

    def _chunk_occupancy(self, codes: HandCodes, points: Float[Tensor, "points 3"]) -> Occupancy:
        """The fast evaluation: the same function as :meth:`plain`, by exact algebra.

        Only pairs with a box that holds the point are decoded.
        """
        num_points = len(points)
        local = local_points(codes.boxes, points)
        is_in_box = contains(codes.boxes, local)
        first, second = self.pairs.unbind(-1)
        pair_index, point_index = (is_in_box[:, first] | is_in_box[:, second]).T.nonzero().T
        members = self.pairs[pair_index]
        is_wanted = is_in_box[point_index[:, None], members]
        items = PairItems(point_index, pair_index, is_wanted)
        item_of_answer, side = is_wanted.nonzero().unbind(-1)
        logits = self._item_logits(codes, local, items)
        answer_points = point_index[item_of_answer]
        slots = answer_points * NUM_BONES + members[is_wanted]
        size = num_points * NUM_BONES
        parts = self.fusion.over_pairs(logits, slots, size, slope=self.sharpness).view(
            -1, NUM_BONES
        )
        soft = self.fusion.over_pairs(logits, slots, size, self.softness).view(-1, NUM_BONES)
        deciding = self.fusion.deciding(logits, answer_points, num_points)
        items = PairItems(
            answer_points[deciding],
            pair_index[item_of_answer[deciding]],
            torch.nn.functional.one_hot(side[deciding], 2).bool(),
        )
        return Occupancy(self.fusion.over_parts(parts), soft * box_fade(local, codes.boxes), items)

    def _item_logits(
        self, codes: HandCodes, local: Float[Tensor, "points bones 3"], items: PairItems
    ) -> Float[Tensor, "wanted"]:
        """The wanted answers of the given pairs, without gradient.

        As :meth:`wanted_logits`, but the first block runs once per part instead of once per pair.
        """
        members = self.pairs[items.pairs]
        is_needed = torch.zeros_like(local[..., 0], dtype=torch.bool)
        is_needed[items.points[:, None], members] = True
        features, row_of = self._part_features(codes, local, is_needed)
        return self._answers(features[row_of[members, items.points[:, None]]], items.is_wanted)

    def _fused_occupancy(
        self, codes: HandCodes, points: Float[Tensor, "points 3"], kernel: Kernel
    ) -> Occupancy:
        """:meth:`_chunk_occupancy` with maximum fusion, all of it in kernels."""
        decided = self.nothing_decided(codes, len(points))
        self.decide(codes, points, kernel, decided, torch.arange(len(points), device=points.device))
        where = (decided.deciders >= 0).nonzero()[:, 0]
        return Occupancy(decided.whole, decided.soft, decided_items(where, decided.deciders[where]))

    def nothing_decided(self, codes: HandCodes, count: int) -> "Decided":
        """What :meth:`decide` fills in: no hand at so many places."""
        from handavatar.field.fused import Decided

        return Decided.nothing(count, NUM_BONES, codes.part_codes.device)

    def decide(
        self,
        codes: HandCodes,
        points: Float[Tensor, "points 3"],
        kernel: Kernel,
        decided: "Decided",
        places: Int[Tensor, "points"],
    ) -> None:
        """Evaluates :meth:`forward` in kernels and notes the answers, without gradient.

        Args:
            codes: of the posed hand.
            points: world, metres; what is not a number is nowhere near the hand.
            kernel: one of Triton's; see :meth:`is_fused`.
            decided: takes the answers.
            places: where it takes them.
        """
        from handavatar.field.fused import decide

        at_once = 1024 * self.chunk
        weights, hand = self._packed_for(codes, PRECISIONS[kernel])
        for part, where in zip(points.split(at_once), places.split(at_once), strict=True):
            decide(weights, hand, part, self.softness, self.sharpness, decided, where)

    def whole_again(
        self,
        codes: HandCodes,
        points: Float[Tensor, "points 3"],
        deciders: Int[Tensor, "points"],
    ) -> Float[Tensor, "points"]:
        """Occupancy from the answers that decide, with long factors in kernels; without gradient.

        Args:
            codes: of the posed hand.
            points: world, metres.
            deciders: what :meth:`decide` has found there.
        """
        from handavatar.field.fused import decided_logits

        weights, hand = self._packed_for(codes, PRECISIONS["triton"])
        return soft_occupancy(decided_logits(weights, hand, points, deciders), self.sharpness)

    def is_fused(self, kernel: Kernel) -> bool:
        """Whether the field runs in Triton's kernels; ``kernel`` is not ``auto``."""
        return kernel != "torch" and isinstance(self.fusion, MaximumFusion)

    def _packed_for(
        self, codes: HandCodes, precision: Precision
    ) -> "tuple[PackedWeights, PackedHand]":
        from handavatar.field.fused import pack_hand, pack_weights

        network = self.decoder.pointnet
        # Weights that a step has changed, or that were moved, are packed anew.
        state = tuple((weight.data_ptr(), weight._version) for weight in self.decoder.parameters())
        if precision not in self._packed or self._packed[precision][0] != state:
            packed = pack_weights(network, self.decoder.mlp, precision, LENGTH_SCALE, LOGIT_SCALE)
            self._packed[precision] = state, packed
        weights = self._packed[precision][1]
        known = self._hands.get(codes)
        if known is None or known[0] != state:
            hand = pack_hand(weights, codes.part_codes, codes.boxes, self.pairs)
            known = self._hands[codes] = state, hand
        return weights, known[1]

    def _part_features(
        self,
        codes: HandCodes,
        local: Float[Tensor, "points bones 3"],
        is_needed: Bool[Tensor, "points bones"],
    ) -> tuple[Float[Tensor, "tokens 64"], Int[Tensor, "bones points"]]:
        """First layer and block per needed (part, point), and where to find them."""
        layer = self.decoder.pointnet.input
        biases = layer.bias + codes.part_codes @ layer.weight[:, :CODE_WIDTH].T
        position_weight = LENGTH_SCALE * layer.weight[:, CODE_WIDTH:].T
        needed = is_needed.T
        row_of = needed.flatten().cumsum(0).view_as(needed) - 1
        if local.device.type != "cpu":
            # A GPU spends more on each operation's start than on moving the biases.
            bones, inside = needed.nonzero().unbind(-1)
            opened = biases[bones] + local[inside, bones] @ position_weight
            return self.decoder.pointnet.blocks[0](opened), row_of
        counts = needed.sum(-1).tolist()
        features = local.new_empty(sum(counts), layer.out_features)
        start = 0
        for bone, count in enumerate(counts):
            held = local[:, bone][needed[bone]]
            torch.addmm(biases[bone], held, position_weight, out=features[start : start + count])
            start += count
        return self.decoder.pointnet.blocks[0](features), row_of


def hand_codes(
    encoded: Callable[[Tensor], Tensor], parts: Parts, posed: PosedHand, margin: float
) -> HandCodes:
    """Encodes the surface of every part of a posed hand, and bounds it by a box.

    Args:
        encoded: of clouds of 256 points with normals, lengths times ``LENGTH_SCALE``: a code each.
        parts: which points.
        posed: the hand.
        margin: how far a part's box reaches beyond the part, metres.

    Source: paper Sec. 3.2, part-space encoder.
    """
    clouds = parts.point_clouds(posed)
    scaled = torch.cat([clouds[..., :3] * LENGTH_SCALE, clouds[..., 3:]], dim=-1)
    return HandCodes(encoded(scaled), parts.boxes(posed, margin))


def local_points(
    boxes: PartBoxes, points: Float[Tensor, "points 3"]
) -> Float[Tensor, "points bones 3"]:
    """World points in the frame of every bone, metres.

    Source: paper Sec. 3.2, the canonicalised query.
    """
    rotation = boxes.bone_from_world[:, :3, :3].reshape(-1, 3)
    shift = boxes.bone_from_world[:, :3, 3].reshape(-1)
    return (points @ rotation.T + shift).view(len(points), len(boxes.lower), 3)


def contains(
    boxes: PartBoxes, local: Float[Tensor, "points bones 3"]
) -> Bool[Tensor, "points bones"]:
    """Whether each part's box, margin included, holds the point; never beyond the wrist's cut."""
    lower, upper = boxes.lower - boxes.margin, boxes.upper + boxes.margin
    is_before_cut = (local[:, 0] - boxes.cut_point) @ boxes.cut_normal < 0
    return ((local > lower) & (local < upper)).all(-1) & is_before_cut[:, None]
