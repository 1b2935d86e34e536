"""What a tracker sees, on a rig: joints and fingertips, each with its own offset, and skin.

Trackers are taught by people who click on knuckles; a rig's joints lie inside. The difference is
the same in every frame, in the axes of the bone, and is learned over the clip.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.fit.kinematics import RestPoints
from handavatar.fit.shape import ShapeSpace
from handavatar.hand.landmarks import LANDMARK_BONES, LANDMARK_ROWS, NUM_LANDMARKS
from handavatar.hand.pose import NUM_BONES
from handavatar.hand.rig import ShapedHand

NUM_OFFSETS = 3 * NUM_LANDMARKS
"""Three for each landmark."""
_TOLERANCES = {"wrist": 0.010, "cmc": 0.008, "mcp": 0.006, "tip": 0.004}
_TOLERANCE = 0.003


@dataclass(frozen=True, eq=False)
class LandmarkSightings:
    """A tracker's landmarks in one frame, as any picture of its camera has them.

    Points are the 21 landmarks and, of a tracker that sees them, vertices of the skin.

    Attributes:
        directions: x and y over z, in the camera's axes (OpenCV).
        errors: expected, of x and of y alike.
        depths: along the line of sight, metres, relative to their mean.
        depth_errors: expected, metres.
        offsets: from the rig's joints and fingertips to the landmarks, metres in the rest axes of
            their bone, as far as they are known.
        vertices: of the rig, that the points behind the landmarks are.
    """

    directions: Float[Tensor, "points 2"]
    errors: Float[Tensor, "points"]
    depths: Float[Tensor, "points"]
    depth_errors: Float[Tensor, "points"]
    offsets: Float[Tensor, "21 3"]
    vertices: Int[Tensor, "skin"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))


def landmark_rest(
    hand: ShapedHand,
    space: ShapeSpace,
    offsets: Float[Tensor, "63"],
    vertices: Int[Tensor, "skin"] | None = None,
) -> RestPoints:
    """The landmarks in the zero pose; unknowns are those of the shape, and then the offsets.

    Args:
        hand: rest hand, its shape as it is.
        space: how its shape moves.
        offsets: of the landmarks, metres in the rest axes of their bone.
        vertices: further points, of the skin.
    """
    tips = hand.rig.vertex_sets["fingertips"]
    rows = list(LANDMARK_ROWS)
    places = torch.cat([hand.rest_joints, hand.rest_vertices[tips]])[rows]
    moving = torch.cat([space.joint_directions, space.directions[tips]])[rows]
    own = torch.eye(NUM_OFFSETS).reshape(21, 3, NUM_OFFSETS)
    weights = torch.nn.functional.one_hot(torch.tensor(LANDMARK_BONES), NUM_BONES).to(places)
    places = places + offsets.reshape(21, 3)
    directions = torch.cat([moving, own], dim=-1)
    if vertices is not None and len(vertices):
        places = torch.cat([places, hand.rest_vertices[vertices]])
        weights = torch.cat([weights, hand.rig.skin_weights[vertices]])
        # What a tracker errs by is much the same in all frames, and would be taken for shape:
        # joints have offsets that tell the two apart, points of the skin tell of poses alone.
        still = directions.new_zeros(len(vertices), 3, directions.shape[-1])
        directions = torch.cat([directions, still])
    return RestPoints(places, weights, directions)


def offset_tolerances() -> Float[Tensor, "63"]:
    """How far landmarks lie beside joints and fingertips, metres, one standard deviation."""
    parts = ["wrist", "cmc", "mcp", "ip", "tip", *["mcp", "pip", "dip", "tip"] * 4]
    found = torch.tensor([_TOLERANCES.get(part, _TOLERANCE) for part in parts])
    return found.repeat_interleave(3)
