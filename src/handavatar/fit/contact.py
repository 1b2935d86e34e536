"""A hand does not pass through itself: balls that fill it, and by how much they overlap.

Outlines do not change when a finger that lies on the palm sinks into it, and hardly when it passes
behind it. Only what a body is tells such poses apart.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import igl
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from handavatar.fit.kinematics import RestPoints, Skeleton
from handavatar.fit.shape import ShapeSpace
from handavatar.geometry.closest import closest_on_mesh
from handavatar.geometry.meshes import SurfacePoints, face_normals, sample_surface_evenly
from handavatar.hand.pose import BONE_PARENTS, HandPose
from handavatar.hand.pose_sampling import PENETRATION_LIMIT, PenetrationProbe, sample_poses
from handavatar.hand.rig import Rig, ShapedHand

_NUM_BALLS = 256
_LEAST_RADIUS = 2e-3
"""Metres; smaller ones lie at folds of the mesh."""
_LIFT = 1e-4
"""Metres inside of the skin from where the skin opposite is looked for."""
_NUM_POSES = 384
"""In which it is looked how near each other balls come without a part in another."""


@dataclass(frozen=True, eq=False)
class Balls:
    """Balls inside a rig's template, each midway between a point of the skin and the one opposite.

    Attributes:
        near: a point of the skin.
        opposite: where the line from there, straight into the hand, comes out again.
        pairs: which balls cannot be in the same place: those of bones that are not connected.
        reach: how far apart the middles of each pair are, metres, where they touch.
    """

    near: SurfacePoints
    opposite: SurfacePoints
    pairs: Int[Tensor, "pairs 2"]
    reach: Float[Tensor, "pairs"]

    def middles(self, vertices: Float[Tensor, "vertices 3"]) -> Float[Tensor, "balls 3"]:
        """Of a posed hand's balls, metres."""
        return (self.near.positions(vertices) + self.opposite.positions(vertices)) / 2

    def distances(self, vertices: Float[Tensor, "vertices 3"]) -> Float[Tensor, "pairs"]:
        """Between the middles of each pair in a posed hand, metres."""
        first, second = self.middles(vertices)[self.pairs].unbind(1)
        return (first - second).norm(dim=-1)


@lru_cache(maxsize=4)
def fill_with_balls(rig: Rig) -> Balls:
    """The balls of a rig; the same ones every time."""
    vertices, faces = rig.template_vertices, rig.faces
    generator = torch.Generator().manual_seed(0)
    near = sample_surface_evenly(vertices, faces, _NUM_BALLS, generator)
    opposite, is_found = _opposite(vertices, faces, near)
    middles = (near.positions(vertices) + opposite.positions(vertices)) / 2
    radii = closest_on_mesh(vertices, faces, middles).distances
    kept = is_found & (radii > _LEAST_RADIUS)
    near, opposite, radii = near.chosen(kept), opposite.chosen(kept), radii[kept]
    weights = near.positions(rig.skin_weights) + opposite.positions(rig.skin_weights)
    bones = weights.argmax(-1)
    parents = torch.tensor(BONE_PARENTS)[bones]
    is_child = parents[:, None] == bones
    is_connected = (bones[:, None] == bones) | is_child | is_child.T
    pairs = (~is_connected).triu(1).nonzero()
    balls = Balls(near, opposite, pairs, radii[pairs].sum(-1))
    return replace(balls, reach=balls.reach.minimum(_nearest(rig, balls, generator)))


def _nearest(rig: Rig, balls: Balls, generator: torch.Generator) -> Float[Tensor, "pairs"]:
    """How near the balls of each pair come in poses that hands can take: flesh gives way."""
    rotations = sample_poses(rig, _NUM_POSES, generator)
    hands = rig.shaped().posed(HandPose(rotations, torch.zeros(_NUM_POSES, 3))).vertices
    probe = PenetrationProbe(rig)
    nearest = balls.distances(rig.template_vertices)
    for vertices in hands:
        if probe.depth(vertices) < PENETRATION_LIMIT:
            nearest = nearest.minimum(balls.distances(vertices))
    return nearest


def overlaps(
    balls: Balls, hand: ShapedHand, space: ShapeSpace, skeleton: Skeleton
) -> tuple[Float[Tensor, "overlaps"], Float[Tensor, "overlaps unknowns"]]:
    """By how much balls overlap, metres, and how that moves with a pose and the hand's shape.

    Args:
        balls: of the rig.
        hand: rest hand.
        space: how its shape moves.
        skeleton: of the posed hand.
    """
    sides = (balls.near, balls.opposite)
    still = space.directions[..., :0]
    rest = [RestPoints.between(side.positions, hand, still) for side in sides]
    middles = torch.stack([skeleton.positions(side) for side in rest]).mean(0)
    first, second = balls.pairs.unbind(-1)
    between = middles[first] - middles[second]
    depth = balls.reach - between.norm(dim=-1)
    touching = (depth > 0).nonzero()[:, 0]
    involved, places = balls.pairs[touching].unique(return_inverse=True)
    parts = [
        RestPoints.between(side.chosen(involved).positions, hand, space.directions)
        for side in sides
    ]
    moving = torch.stack([skeleton.jacobian(part) for part in parts]).mean(0)
    towards = normalize(between[touching], dim=-1)
    slope = moving[places[:, 0]] - moving[places[:, 1]]
    return depth[touching], -(towards[:, None] @ slope)[:, 0]


def _opposite(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], near: SurfacePoints
) -> tuple[SurfacePoints, Bool[Tensor, "near"]]:
    """Where lines straight into the mesh come out of it first, and whether they do."""
    inwards = -face_normals(vertices, near.faces)
    # Not from the face itself.
    starts = (near.positions(vertices) + _LIFT * inwards).double().numpy()
    places, all_faces = vertices.double().numpy(), faces.numpy()
    hit_faces, weights, is_found = [], [], []
    for start, inward in zip(starts, inwards.double().numpy(), strict=True):
        hits = igl.ray_mesh_intersect(start, inward, places, all_faces)
        face, _, second, third = hits[0] if hits else (0, 0.0, 0.0, 0.0)
        hit_faces.append(face)
        weights.append([1 - second - third, second, third])
        is_found.append(bool(hits))
    return SurfacePoints(faces[hit_faces], torch.tensor(weights)), torch.tensor(is_found)
