"""Which points of a hand the tracker tells: 21 landmarks, and points all over the skin."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.hand.landmarks import LANDMARK_ROWS, MIDDLE_KNUCKLE, NUM_LANDMARKS
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import Rig, ShapedHand


def upright_turn(places: Float[Tensor, "crops points 2"]) -> Float[Tensor, "crops"]:
    """Radians by which upright hands are turned into those of pictures: wrist below the knuckle.

    Args:
        places: landmarks and what follows them, right and down.
    """
    right, down = (places[:, MIDDLE_KNUCKLE] - places[:, 0]).unbind(-1)
    return torch.atan2(right, -down)


@dataclass(frozen=True, eq=False)
class TrackedPoints:
    """Joints and fingertips of a rig in the usual order of 21 landmarks, then points of its skin.

    Attributes:
        rig_name: whose vertices they are.
        rig_sha256: its fingerprint.
        tips: vertices of the fingertips, thumb to little.
        vertices: of the skin.
    """

    rig_name: str
    rig_sha256: str
    tips: Int[Tensor, "5"]
    vertices: Int[Tensor, "skin"]

    @classmethod
    def of(cls, rig: Rig, count: int) -> "TrackedPoints":
        """Points of a rig's skin that are as far from each other as can be.

        Args:
            rig: with fingertips.
            count: of the points of its skin.
        """
        places = rig.template_vertices
        tips = torch.as_tensor(rig.vertex_sets["fingertips"])
        distance = (places[:, None] - places[tips]).norm(dim=-1).amin(1)
        chosen = []
        for _ in range(count):
            farthest = int(distance.argmax())
            chosen.append(farthest)
            distance = distance.minimum((places - places[farthest]).norm(dim=-1))
        return cls(rig.name, rig.sha256, tips, torch.tensor(chosen, dtype=torch.long))

    def fit(self, rig: Rig) -> bool:
        """Whether they are points of a rig, so that its skin may be told, and not joints alone."""
        return rig.sha256 == self.rig_sha256

    def are(self, other: "TrackedPoints") -> bool:
        """Whether they are the same points of the same rig."""
        is_same_rig = self.rig_sha256 == other.rig_sha256
        return is_same_rig and self.vertices.equal(other.vertices) and self.tips.equal(other.tips)

    def template_places(self, rig: Rig) -> Float[Tensor, "points 3"]:
        """Where the points are on the template hand, metres."""
        pose = HandPose(torch.zeros(NUM_BONES, 3), torch.zeros(3))
        shape = torch.zeros(rig.shape_directions.shape[-1])
        return self.positions(rig.shaped(shape), pose)

    def nearest_landmarks(self, rig: Rig) -> Int[Tensor, "skin"]:
        """The landmark that each point of the skin lies nearest to, on the template hand."""
        places = self.template_places(rig)
        landmarks, skin = places[:NUM_LANDMARKS], places[NUM_LANDMARKS:]
        return (skin[:, None] - landmarks).norm(dim=-1).argmin(1)

    def __len__(self) -> int:
        """Number of points, landmarks included."""
        return NUM_LANDMARKS + len(self.vertices)

    def positions(self, hand: ShapedHand, pose: HandPose) -> Float[Tensor, "points 3"]:
        """Where the points are in a pose: metres, world.

        Args:
            hand: rest hand, with the rig's vertices.
            pose: one.
        """
        posed = hand.posed(pose)
        joints = torch.cat([posed.joints, posed.vertices[self.tips]])
        return torch.cat([joints[list(LANDMARK_ROWS)], posed.vertices[self.vertices]])
