"""The personal rest shape: per-vertex offsets that depend on place and pose."""

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from handavatar.field.layers import MLP, positional_encoding
from handavatar.hand.pose import NUM_BONES
from handavatar.hand.rig import ShapedHand

HAND_SCALE = 0.4
"""Rest positions are divided by this (metres) before they are encoded: the finest wave is 25 mm
long. Shorter ones would go up and down between the vertices of the coarse mesh, unseen by it."""
NUM_FREQUENCIES = 6
OFFSET_SCALE = 0.01
"""The network's output is multiplied by this (metres), so that its weights are of order one."""


class ShapeOffsets(nn.Module):
    """M_shape: offsets of the rest vertices from their position and the finger pose.

    Source: paper Sec. 3.1 (shape fitting); 84 inputs = 39 encoded position + 45 finger pose,
        four hidden layers of 128.
    Departs: starts from the shape of the capture's coefficients where it has them, not from the
        mean; positions are normalised before they are encoded.
    """

    def __init__(self) -> None:
        """Starts at zero offsets."""
        super().__init__()
        self.mlp = MLP(3 + 6 * NUM_FREQUENCIES + 3 * (NUM_BONES - 1), 128, 4, 3)
        nn.init.normal_(self.mlp.output.weight, std=1e-3)
        nn.init.zeros_(self.mlp.output.bias)

    def forward(
        self, rest: ShapedHand, rotations: Float[Tensor, "bones 3"]
    ) -> Float[Tensor, "vertices 3"]:
        """Offsets in metres.

        Args:
            rest: the hand to refine.
            rotations: the pose, axis-angle; the wrist's is not used.
        """
        vertices = rest.rest_vertices
        # The joints' mean: the same for every resolution of a rig.
        centre = (rest.rig.joint_regressor @ rest.rig.template_vertices).mean(0)
        encoded = positional_encoding((vertices - centre) / HAND_SCALE, NUM_FREQUENCIES)
        # The pose is the same for every vertex: its share of the first layer is a bias.
        first = cast(nn.Linear, self.mlp.hidden[0])
        width = encoded.shape[-1]
        pose = rotations[1:].flatten()
        bias = first.bias + first.weight[:, width:] @ pose
        values = torch.addmm(bias, encoded, first.weight[:, :width].T).relu()
        for layer in list(self.mlp.hidden)[1:]:
            values = layer(values).relu()
        return OFFSET_SCALE * self.mlp.output(values)


def personal_hand(rest: ShapedHand, offsets: Float[Tensor, "vertices 3"]) -> ShapedHand:
    """The rest hand with offsets added, shifted so that the wrist joint stays.

    Source: paper Sec. 3.1, V~ = V + M_shape.
    """
    vertices = rest.rest_vertices + offsets
    joints = rest.rig.joint_regressor @ vertices
    shift = rest.rest_joints[0] - joints[0]
    return ShapedHand(rest.rig, vertices + shift, joints + shift)
