"""The self-occlusion-aware shading field ("SelF"): albedo and illumination."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from handavatar.field.anchors import Neighbours
from handavatar.field.layers import MLP, positional_encoding
from handavatar.field.texture import detailed
from handavatar.geometry.rotations import nearest_rotations

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

    def forward(
        self, neighbours: Neighbours, residual: Float[Tensor, "queries 3"] | None = None
    ) -> Float[Tensor, "queries 3"]:
        """RGB in [0, 1].

        Args:
            neighbours: nearest anchors of the queries.
            residual: of :class:`handavatar.field.texture.DetailTexture`, where there is one.
        """
        albedo = self.mlp(neighbours.interpolated(self.codes)).sigmoid()
        return albedo if residual is None else detailed(albedo, residual)


@dataclass(frozen=True, eq=False)
class Cues:
    """What the illumination at some queries may depend on.

    Attributes:
        pose: the whole pose of each query's hand, axis-angle, the wrist in the world frame.
        places: surface-calibrated positions (interpolated encodings E).
        directed: directed soft occupancy, without gradient.
        normals: world normals of the surface, without gradient.
        light: cosine times visibility for each direction of light, without gradient.
    """

    pose: Float[Tensor, "queries 48"]
    places: Float[Tensor, "queries 21"]
    directed: Float[Tensor, "queries 16"]
    normals: Float[Tensor, "queries 3"]
    light: Float[Tensor, "queries directions"]


class PaperCues:
    """The paper's 85 inputs: directed soft occupancy 16, place 21, pose 48.

    Source: paper Sec. 3.3 (illumination field).
    """

    name = "paper"
    width = 85
    hidden = (256,) * 4
    num_directions = 0
    pose_dropout = 0.0

    def __call__(self, cues: Cues) -> Float[Tensor, "queries 85"]:
        """The network's input."""
        return torch.cat([cues.directed, cues.places, cues.pose], dim=-1)


class PlainCues:
    """Place and pose: the paper's illumination without directed occupancy (its ablation)."""

    name = "plain"
    width = 69
    hidden = (256,) * 4
    num_directions = 0
    pose_dropout = 0.0

    def __call__(self, cues: Cues) -> Float[Tensor, "queries 69"]:
        """The network's input."""
        return torch.cat([cues.places, cues.pose], dim=-1)


class OrientedCues:
    """The paper's inputs and the surface's world normal: 88.

    Departs: light depends on where the surface looks. The paper's network must work that out from
        pose and place, for which a hundred frames do not suffice. Method ``paper`` does without it.
    """

    name = "oriented"
    width = 88
    hidden = (256,) * 4
    num_directions = 0
    pose_dropout = 0.0

    def __call__(self, cues: Cues) -> Float[Tensor, "queries 88"]:
        """The network's input."""
        return torch.cat([cues.directed, cues.places, cues.pose, cues.normals], dim=-1)


class TracedCues:
    """What a light in each of many directions would bring, the normal, the place, and the pose.

    Departs: the paper looks for what casts shadows along the view ray, so that shadows move with
        the camera, and must learn from the pose what the light does. Here the posed mesh itself
        says which part of the sky a place sees (:func:`handavatar.render.skylight.sky_light`), in
        the world's axes; the network learns how bright each part is, and what comes second hand.
        The pose is there for what follows it and is not traced: skin that stretches and folds, a
        pose that is a little off, the body behind the hand. While training, some frames come
        without theirs (``pose_dropout``, as a share), so that light is not read off the pose
        where tracing can tell.
    """

    name = "traced"
    hidden = (256,) * 4
    pose_dropout = 0.1

    def __init__(self, num_directions: int = 112) -> None:
        """With so many directions of light; which ones, the field knows."""
        self.num_directions = num_directions
        self.width = num_directions + 72

    def __call__(self, cues: Cues) -> Float[Tensor, "queries width"]:
        """The network's input."""
        return torch.cat([cues.light, cues.normals, cues.places, cues.pose], dim=-1)


CueSet = PaperCues | PlainCues | OrientedCues | TracedCues


def cue_set(name: str, num_directions: int) -> CueSet:
    """The cues of a stored avatar.

    Raises:
        KeyError: if there are none of that name.
    """
    parts: tuple[CueSet, ...] = (
        PaperCues(),
        PlainCues(),
        OrientedCues(),
        TracedCues(num_directions),
    )
    return {part.name: part for part in parts}[name]


class IlluminationField(nn.Module):
    """How much light arrives: a scalar from pose, place and directed soft occupancy.

    Source: paper Sec. 3.3 (illumination field); MLP 4 x 256.
    Departs: the paper knows one light. Recordings of one hand that were made under different ones
        share its albedo; here the network is told which recording's light it is, by a column for
        each. With one light there is no column.
    """

    position_codes: Tensor
    directions: Tensor
    wrist_reference: Tensor

    def __init__(
        self, anchor_positions: Float[Tensor, "anchors 3"], chosen: CueSet, num_lights: int = 1
    ) -> None:
        """Fixes the encodings E of the anchors' template positions (metres).

        Args:
            anchor_positions: on the template.
            chosen: which cues the network sees.
            num_lights: under which the hand was recorded.
        """
        super().__init__()
        centred = (anchor_positions - anchor_positions.mean(0)) / POSITION_SCALE
        self.register_buffer("position_codes", positional_encoding(centred, NUM_FREQUENCIES))
        self.register_buffer("directions", torch.zeros(chosen.num_directions, 3))
        self.register_buffer("wrist_reference", torch.zeros(3))
        self.chosen = chosen
        self.num_lights = num_lights
        columns = num_lights if num_lights > 1 else 0
        self.mlp = MLP(chosen.width + columns, chosen.hidden[0], len(chosen.hidden), 1)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *others: Any, **more: Any
    ) -> None:
        """Weights of before there was a reference mean rotations of at most half a turn."""
        state_dict.setdefault(f"{prefix}wrist_reference", torch.zeros(3))
        super()._load_from_state_dict(state_dict, prefix, *others, **more)

    def forward(
        self,
        rotations: Float[Tensor, "*queries bones 3"],
        neighbours: Neighbours,
        directed: Float[Tensor, "queries bones"],
        normals: Float[Tensor, "queries 3"],
        light: Float[Tensor, "queries directions"],
        which: Int[Tensor, "queries"] | int = 0,
    ) -> Float[Tensor, "queries"]:
        """Illumination, in (0, 1).

        Args:
            rotations: the whole pose, the wrist's rotation in the world frame; one for all
                queries or one for each.
            neighbours: nearest anchors of the queries.
            directed: directed soft occupancy at the queries, without gradient.
            normals: world normals at the queries.
            light: what lights in ``directions`` bring; no columns where the cues know none.
            which: of the lights that the field knows, by number; one for all queries or one for
                each.

        Departs: the authors give the wrist's rotation in camera axes, which cannot tell where a
            light that is fixed in the world stands; here it is the world's. Of the two vectors
            that mean the same rotation, the network gets the one that is nearer to
            ``wrist_reference``: hands that are seen half a turn from their rest would else jump
            between two inputs.
        """
        places = neighbours.interpolated(self.position_codes)
        wrist = nearest_rotations(rotations[..., :1, :], self.wrist_reference)
        pose = torch.cat([wrist, rotations[..., 1:, :]], dim=-2)
        pose = pose.flatten(-2).expand(len(places), -1)
        inputs = self.chosen(Cues(pose, places, directed, normals.detach(), light.detach()))
        if self.num_lights > 1:
            numbers = torch.arange(self.num_lights, device=inputs.device)
            is_lit = numbers == (which if isinstance(which, int) else which[:, None])
            inputs = torch.cat([inputs, is_lit.to(inputs).expand(len(inputs), -1)], dim=-1)
        return self.mlp(inputs)[:, 0].sigmoid()
