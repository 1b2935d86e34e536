"""The endless stream that the occupancy prior learns from: hands with points and their labels.

No data set and no pool: hand number ``n`` of a seed is the same wherever and whenever it is drawn,
so that several processes can share the work and a killed training can go on where it was.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.field.shape import personal_hand
from handavatar.geometry.meshes import is_inside, sample_surface
from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.parts import Parts
from handavatar.hand.pose import CONNECTED_PAIRS, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import PosedHand, Rig, ShapedHand
from handavatar.train.stage_times import StageTimes

SURFACE_SIGMAS = (0.00025, 0.0005, 0.001, 0.003)
"""Noise of training points at the surface, metres, in equal shares."""
SURFACE_SHARE = 0.9
"""Share of the training points near the surface; the others lie anywhere in the part boxes."""
JOINT_WEIGHT = 0.7
"""Where no bone has more of a face than this, the face is at a joint."""
LARGEST_OFFSET = 0.002
"""Of people's hands from the rig's: standard deviation along each axis, at most, metres."""
_WAVES = 8
_WAVELENGTHS = (0.03, 0.15)


@dataclass(frozen=True, eq=False)
class LabelledPose:
    """A posed hand with points whose inside or outside is known.

    Attributes:
        posed: the hand.
        points: metres, in its world.
        is_inside: of each.
        joint_pairs: of the last points, which lie where two connected parts meet, the pair; -1
            where more than the two parts decides the label.
    """

    posed: PosedHand
    points: Float[Tensor, "points 3"]
    is_inside: Bool[Tensor, "points"]
    joint_pairs: Int[Tensor, "joints"] = field(
        default_factory=lambda: torch.zeros(0, dtype=torch.int64)
    )


def sample_points(
    parts: Parts, posed: PosedHand, count: int, margin: float, generator: torch.Generator
) -> Float[Tensor, "points 3"]:
    """Half the points uniform in the part boxes, half near the surface (sigma 1 and 4 mm).

    Without gradient and on the CPU. The surface is the sealed one: the cut at the wrist must be
    learned like the rest.

    Source: paper Sec. 3.2 (pre-training), after COAP: box and surface samples.
    """
    uniform = _box_points(parts, posed, count // 2, margin, generator)
    num_near = count - len(uniform)
    sigmas = torch.where(torch.arange(num_near) % 2 == 0, 0.001, 0.004)
    return torch.cat([uniform, _surface_points(posed, sigmas, generator)])


def labelled_pose(
    rig: Rig,
    parts: Parts,
    rotations: Float[Tensor, "bones 3"],
    count: int,
    margin: float,
    generator: torch.Generator,
    is_person: bool = False,
) -> LabelledPose:
    """A hand of random shape in the given pose, with labelled points; what judges a prior.

    ``is_person`` moves it off the rig's shapes: see :func:`random_person`.
    """
    hand = _random_shape(rig, generator)
    if is_person:
        hand = random_person(hand, generator)
    posed = hand.posed(HandPose(rotations, torch.zeros(3)))
    points = sample_points(parts, posed, count, margin, generator)
    return LabelledPose(posed, points, is_inside(posed.sealed_vertices, rig.sealed_faces, points))


@dataclass(frozen=True, eq=False)
class PoseStream:
    """Hands without end, each with fresh points.

    Attributes:
        base: the rig whose joints are bent; ``rig`` is it or finer.
        rig: whose surface is encoded and labelled.
        parts: of ``rig``.
        margin: of the part boxes, metres.
        points: on each hand.
        seed: of everything.
        joint_points: further points on each, where parts meet: see :func:`joint_points`.
    """

    base: Rig
    rig: Rig
    parts: Parts
    margin: float
    points: int
    seed: int
    joint_points: int = 0

    @cached_property
    def _joint_faces(self) -> tuple[Int[Tensor, "faces 3"], Int[Tensor, "bones bones"]]:
        return joint_faces(self.rig)

    def drawn(self, number: int, times: StageTimes) -> LabelledPose:
        """Hand ``number`` of the stream."""
        # Hashed, so that neither neighbouring seeds nor the seed that judges share numbers.
        state = np.random.SeedSequence([self.seed, number]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state[0]))
        with times.stage("poses"):
            rotations = sample_poses(self.base, 1, generator)[0]
            hand = _random_shape(self.rig, generator)
            posed = hand.posed(HandPose(rotations, torch.zeros(3)))
        with times.stage("points"):
            points = training_points(self.parts, posed, self.points, self.margin, generator)
            pairs = torch.zeros(0, dtype=torch.int64)
            if self.joint_points:
                at_joints, pairs, is_within = joint_points(
                    posed, *self._joint_faces, self.joint_points, generator
                )
                points = torch.cat([points, at_joints])
        with times.stage("labels"):
            labels = is_inside(posed.sealed_vertices, self.rig.sealed_faces, points)
        if self.joint_points:
            # Where another finger touches or the skin folds, the two parts cannot know the label.
            pairs[labels[-len(pairs) :] != is_within] = -1
        return LabelledPose(posed, points, labels, pairs)


def training_points(
    parts: Parts, posed: PosedHand, count: int, margin: float, generator: torch.Generator
) -> Float[Tensor, "points 3"]:
    """Points to learn from: a few in the part boxes first, then those near the surface.

    Without gradient and on the CPU.

    Departs: COAP and the paper draw half the points in the boxes and half near the surface, with
        noise of one sigma. Nine in ten errors of a trained field lie within half a millimetre of
        the surface, where few of those points are.
    """
    num_near = round(count * SURFACE_SHARE)
    uniform = _box_points(parts, posed, count - num_near, margin, generator)
    return torch.cat([uniform, _surface_points(posed, _sigmas(num_near), generator)])


def joint_faces(rig: Rig) -> tuple[Int[Tensor, "faces 3"], Int[Tensor, "bones bones"]]:
    """Faces where two connected parts meet, on the CPU, and the number of each two bones' pair.

    No bone has more of such a face than ``JOINT_WEIGHT``, and the two that have most are connected.
    Bones that are not connected have the number -1.
    """
    pair_of = torch.full((NUM_BONES, NUM_BONES), -1)
    for number, (parent, child) in enumerate(CONNECTED_PAIRS):
        pair_of[parent, child] = pair_of[child, parent] = number
    faces = rig.faces.cpu()
    largest, bones = rig.skin_weights.cpu()[faces].mean(1).topk(2, dim=-1)
    is_joint = (largest[:, 0] < JOINT_WEIGHT) & (pair_of[bones[:, 0], bones[:, 1]] >= 0)
    return faces[is_joint], pair_of


def joint_points(
    posed: PosedHand,
    faces: Int[Tensor, "faces 3"],
    pair_of: Int[Tensor, "bones bones"],
    count: int,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "points 3"], Int[Tensor, "points"], Bool[Tensor, "points"]]:
    """Points near the given faces, the pair that meets at each, and which lie within.

    Within: behind the face that the point was drawn on, whatever else of the hand is there.
    Without gradient and on the CPU.

    Args:
        posed: the hand.
        faces: of its rig, and
        pair_of: numbers of pairs: see :func:`joint_faces`.
        count: how many.
        generator: draws them.
    """
    vertices = posed.vertices.detach().cpu()
    surface = sample_surface(vertices, faces, count, generator)
    bones = posed.rig.skin_weights.cpu()[surface.faces].mean(1).topk(2, dim=-1).indices
    noise = _sigmas(count)[:, None] * torch.randn(count, 3, generator=generator)
    first, second, third = vertices[surface.faces].unbind(1)
    is_within = (noise * torch.linalg.cross(second - first, third - first)).sum(-1) < 0
    return surface.positions(vertices) + noise, pair_of[bones[:, 0], bones[:, 1]], is_within


def random_person(rest: ShapedHand, generator: torch.Generator) -> ShapedHand:
    """A hand with small smooth offsets, such as no shape coefficients give.

    Args:
        rest: the hand to move a little.
        generator: draws the size of the offsets, up to ``LARGEST_OFFSET``, and their waves.
    """
    shortest, longest = _WAVELENGTHS
    lengths = shortest * (longest / shortest) ** torch.rand(_WAVES, 1, generator=generator)
    directions = torch.randn(_WAVES, 3, generator=generator)
    waves = torch.nn.functional.normalize(directions, dim=-1) / lengths
    phases = torch.rand(_WAVES, generator=generator)
    size = LARGEST_OFFSET * float(torch.rand((), generator=generator))
    heights = size * (2 / _WAVES) ** 0.5 * torch.randn(_WAVES, 3, generator=generator)
    offsets = torch.sin(2 * math.pi * (rest.rest_vertices @ waves.T + phases)) @ heights
    return personal_hand(rest, offsets)


def _random_shape(rig: Rig, generator: torch.Generator) -> ShapedHand:
    return rig.shaped(torch.randn(rig.shape_directions.shape[-1], generator=generator))


def _box_points(
    parts: Parts, posed: PosedHand, count: int, margin: float, generator: torch.Generator
) -> Float[Tensor, "points 3"]:
    """Uniform in the part boxes, as many in each."""
    boxes = parts.boxes(posed, margin)
    bone = torch.arange(count) % NUM_BONES
    lower, upper = boxes.lower.cpu()[bone] - margin, boxes.upper.cpu()[bone] + margin
    local = lower + (upper - lower) * torch.rand(count, 3, generator=generator)
    return apply_rigid(posed.world_from_bone.detach().cpu()[bone], local[:, None])[:, 0]


def _sigmas(count: int) -> Float[Tensor, "points"]:
    return torch.tensor(SURFACE_SIGMAS)[torch.arange(count) % len(SURFACE_SIGMAS)]


def _surface_points(
    posed: PosedHand, sigmas: Float[Tensor, "points"], generator: torch.Generator
) -> Float[Tensor, "points 3"]:
    """Points of the sealed surface with noise of so many metres in every direction."""
    sealed, faces = posed.sealed_vertices.detach().cpu(), posed.rig.sealed_faces.cpu()
    surface = sample_surface(sealed, faces, len(sigmas), generator)
    noise = torch.randn(len(sigmas), 3, generator=generator)
    return surface.positions(sealed) + sigmas[:, None] * noise
