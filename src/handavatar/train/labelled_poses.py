"""The endless stream that the occupancy prior learns from: hands with points and their labels.

No data set and no pool: hand number ``n`` of a seed is the same wherever and whenever it is drawn,
so that several processes can share the work and a killed training can go on where it was.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.field.shape import personal_hand
from handavatar.geometry.meshes import is_inside, sample_surface
from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.parts import Parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import PosedHand, Rig, ShapedHand
from handavatar.train.stage_times import StageTimes

SURFACE_SIGMAS = (0.00025, 0.0005, 0.001, 0.003)
"""Noise of training points at the surface, metres, in equal shares."""
SURFACE_SHARE = 0.9
"""Share of the training points near the surface; the others lie anywhere in the part boxes."""
JOINT_WEIGHT = 0.7
"""Where no bone has more of a face than this, the face is at a joint: a sixth of the skin."""
LARGEST_OFFSET = 0.002
"""Of people's hands from the rig's: standard deviation along each axis, at most, metres."""
_WAVES = 8
_WAVELENGTHS = (0.03, 0.15)


@dataclass(frozen=True, eq=False)
class LabelledPose:
    """A posed hand with points whose inside or outside is known."""

    posed: PosedHand
    points: Float[Tensor, "points 3"]
    is_inside: Bool[Tensor, "points"]


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
        joint_share: of the points near the surface, those at joints: see :func:`training_points`.
    """

    base: Rig
    rig: Rig
    parts: Parts
    margin: float
    points: int
    seed: int
    joint_share: float = 0.0

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
            points = training_points(
                self.parts, posed, self.points, self.margin, generator, self.joint_share
            )
        with times.stage("labels"):
            labels = is_inside(posed.sealed_vertices, self.rig.sealed_faces, points)
        return LabelledPose(posed, points, labels)


def training_points(
    parts: Parts,
    posed: PosedHand,
    count: int,
    margin: float,
    generator: torch.Generator,
    joint_share: float = 0.0,
) -> Float[Tensor, "points 3"]:
    """Points to learn from: a few in the part boxes first, then those near the surface.

    Without gradient and on the CPU. Of the latter ``joint_share`` lie at joints, where several
    bones move the skin and one part of a field hands over to the next.

    Departs: COAP and the paper draw half the points in the boxes and half near the surface, with
        noise of one sigma. Nine in ten errors of a trained field lie within half a millimetre of
        the surface, where few of those points are.
    """
    num_near = round(count * SURFACE_SHARE)
    uniform = _box_points(parts, posed, count - num_near, margin, generator)
    sigmas = torch.tensor(SURFACE_SIGMAS)[torch.arange(num_near) % len(SURFACE_SIGMAS)]
    num_at_joints = round(num_near * joint_share)
    pieces = [uniform]
    if num_at_joints:
        rig = posed.rig
        is_joint = rig.skin_weights[rig.faces].mean(1).amax(-1) < JOINT_WEIGHT
        at_joints = rig.faces[is_joint]
        pieces.append(_surface_points(posed, sigmas[:num_at_joints], generator, at_joints))
    if num_at_joints < num_near:
        pieces.append(_surface_points(posed, sigmas[num_at_joints:], generator))
    return torch.cat(pieces)


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


def _surface_points(
    posed: PosedHand,
    sigmas: Float[Tensor, "points"],
    generator: torch.Generator,
    faces: Int[Tensor, "faces 3"] | None = None,
) -> Float[Tensor, "points 3"]:
    """Points of the sealed surface, or of the given faces, with noise of so many metres."""
    sealed = posed.sealed_vertices.detach().cpu()
    faces = (posed.rig.sealed_faces if faces is None else faces).cpu()
    surface = sample_surface(sealed, faces, len(sigmas), generator)
    noise = torch.randn(len(sigmas), 3, generator=generator)
    return surface.positions(sealed) + sigmas[:, None] * noise
