"""What a tracker's 21 landmarks are on a rig: joints and fingertips, each with its own offset.

Trackers are taught by people who click on knuckles; a rig's joints lie inside. The difference is
the same in every frame, in the axes of the bone, and is learned over the clip.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.fit.kinematics import RestPoints
from handavatar.fit.shape import ShapeSpace
from handavatar.hand.pose import FINGER_BONES, NUM_BONES
from handavatar.hand.rig import ShapedHand

NUM_OFFSETS = 63
"""Three for each landmark."""
_FINGERS = ("thumb", "index", "middle", "ring", "little")
_TOLERANCES = {"wrist": 0.010, "cmc": 0.008, "mcp": 0.006, "tip": 0.004}
_TOLERANCE = 0.003


@dataclass(frozen=True, eq=False)
class LandmarkSightings:
    """A tracker's landmarks in one frame, as any picture of its camera has them.

    Attributes:
        directions: x and y over z, in the camera's axes (OpenCV).
        errors: expected, of x and of y alike.
        depths: along the line of sight, metres, relative to their mean.
        depth_errors: expected, metres.
        offsets: from the rig's joints and fingertips to the landmarks, metres in the rest axes of
            their bone, as far as they are known.
    """

    directions: Float[Tensor, "21 2"]
    errors: Float[Tensor, "21"]
    depths: Float[Tensor, "21"]
    depth_errors: Float[Tensor, "21"]
    offsets: Float[Tensor, "21 3"]


def landmark_rest(hand: ShapedHand, space: ShapeSpace, offsets: Float[Tensor, "63"]) -> RestPoints:
    """The landmarks in the zero pose; unknowns are those of the shape, and then the offsets.

    Args:
        hand: rest hand, its shape as it is.
        space: how its shape moves.
        offsets: of the landmarks, metres in the rest axes of their bone.
    """
    tips = hand.rig.vertex_sets["fingertips"]
    bones, rows = [0], [0]
    for number, finger in enumerate(_FINGERS):
        chain = FINGER_BONES[finger]
        bones += [*chain, chain[-1]]
        rows += [*chain, NUM_BONES + number]
    places = torch.cat([hand.rest_joints, hand.rest_vertices[tips]])[rows]
    moving = torch.cat([space.joint_directions, space.directions[tips]])[rows]
    own = torch.eye(NUM_OFFSETS).reshape(21, 3, NUM_OFFSETS)
    return RestPoints(
        places + offsets.reshape(21, 3),
        torch.nn.functional.one_hot(torch.tensor(bones), NUM_BONES).to(places),
        torch.cat([moving, own], dim=-1),
    )


def offset_tolerances() -> Float[Tensor, "63"]:
    """How far landmarks lie beside joints and fingertips, metres, one standard deviation."""
    parts = ["wrist", "cmc", "mcp", "ip", "tip", *["mcp", "pip", "dip", "tip"] * 4]
    found = torch.tensor([_TOLERANCES.get(part, _TOLERANCE) for part in parts])
    return found.repeat_interleave(3)
