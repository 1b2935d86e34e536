"""The endless stream that the occupancy prior learns from: hands with points and their labels.

No data set and no pool: hand number ``n`` of a seed is the same wherever and whenever it is drawn,
so that several processes can share the work and a killed training can go on where it was.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.geometry.meshes import (
    face_normals,
    is_inside,
    sample_surface,
    winding_number,
)
from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.parts import Parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import PosedHand, Rig
from handavatar.train.stage_times import StageTimes

LABEL_SOFTNESS = 0.0002
"""Metres outside the surface at which a training target has fallen from 1/2 to 1/(1 + e)."""
SURFACE_SIGMAS = (0.00025, 0.0005, 0.001, 0.003)
"""Distances of training points from the surface, metres, in equal shares."""
SURFACE_SHARE = 0.9
"""Share of the training points near the surface; the others lie anywhere in the part boxes."""


@dataclass(frozen=True, eq=False)
class LabelledPose:
    """A posed hand with points whose inside or outside is known."""

    posed: PosedHand
    points: Float[Tensor, "points 3"]
    is_inside: Bool[Tensor, "points"]


@dataclass(frozen=True, eq=False)
class TargetPose:
    """A posed hand with points and the occupancy to be learned there, in [0, 1]."""

    posed: PosedHand
    points: Float[Tensor, "points 3"]
    occupancy: Float[Tensor, "points"]


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
    sealed = posed.sealed_vertices.detach().cpu()
    surface = sample_surface(sealed, posed.rig.sealed_faces.cpu(), num_near, generator)
    sigma = torch.where(torch.arange(num_near) % 2 == 0, 0.001, 0.004)[:, None]
    near = surface.positions(sealed)
    return torch.cat([uniform, near + sigma * torch.randn(num_near, 3, generator=generator)])


def labelled_pose(
    rig: Rig,
    parts: Parts,
    rotations: Float[Tensor, "bones 3"],
    count: int,
    margin: float,
    generator: torch.Generator,
) -> LabelledPose:
    """A hand of random shape in the given pose, with labelled points; what judges a prior."""
    posed = _random_hand(rig, rotations, generator)
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
    """

    base: Rig
    rig: Rig
    parts: Parts
    margin: float
    points: int
    seed: int

    def drawn(self, number: int, times: StageTimes) -> TargetPose:
        """Hand ``number`` of the stream."""
        # Hashed, so that neither neighbouring seeds nor the seed that judges share numbers.
        state = np.random.SeedSequence([self.seed, number]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state[0]))
        with times.stage("poses"):
            rotations = sample_poses(self.base, 1, generator)[0]
            posed = _random_hand(self.rig, rotations, generator)
        with times.stage("points"):
            points, offsets = training_points(
                self.parts, posed, self.points, self.margin, generator
            )
        with times.stage("labels"):
            occupancy = training_targets(posed, points, offsets)
        return TargetPose(posed, points, occupancy)


def training_points(
    parts: Parts, posed: PosedHand, count: int, margin: float, generator: torch.Generator
) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "near"]]:
    """Points to learn from: a few in the part boxes, the others moved off the surface.

    Without gradient and on the CPU.

    Returns:
        The points, and by how much the last of them were moved along the normal, metres,
        positive outwards.

    Departs: COAP and the paper draw half the points in the boxes and half near the surface with
        noise in all directions. A trained field errs within a quarter of a millimetre of the
        surface only, where hardly any of those lie.
    """
    num_near = round(count * SURFACE_SHARE)
    uniform = _box_points(parts, posed, count - num_near, margin, generator)
    sealed, faces = posed.sealed_vertices.detach().cpu(), posed.rig.sealed_faces.cpu()
    surface = sample_surface(sealed, faces, num_near, generator)
    corners = sealed[surface.faces]
    normals = face_normals(corners.flatten(0, 1), torch.arange(3 * num_near).view(-1, 3))
    sigma = torch.tensor(SURFACE_SIGMAS)[torch.arange(num_near) % len(SURFACE_SIGMAS)]
    offsets = sigma * torch.randn(num_near, generator=generator)
    near = surface.positions(sealed) + offsets[:, None] * normals
    return torch.cat([uniform, near]), offsets


def training_targets(
    posed: PosedHand, points: Float[Tensor, "points 3"], offsets: Float[Tensor, "near"]
) -> Float[Tensor, "points"]:
    """The occupancy to be learned at points of :func:`training_points`.

    Inside is 1 and outside 0 by the winding number. Near the surface the target falls smoothly
    with the distance, 1/2 on the surface: a point says where the surface is, not just on which
    side of it it lies. Where the hand overlaps itself there is no surface, and the target is 1.

    Departs: the paper's targets are 0 and 1.
    """
    winding = winding_number(posed.sealed_vertices, posed.rig.sealed_faces, points)
    targets = (winding > 0.5).to(points)
    near = slice(len(points) - len(offsets), None)
    # Just inside counts one layer more than just outside: 1 and 0 where nothing overlaps.
    is_surface = (winding[near] - (offsets < 0).to(winding)).abs() < 0.5
    graded = torch.sigmoid(-offsets / LABEL_SOFTNESS)
    targets[near] = torch.where(is_surface, graded, targets[near])
    return targets


def _random_hand(
    rig: Rig, rotations: Float[Tensor, "bones 3"], generator: torch.Generator
) -> PosedHand:
    coefficients = torch.randn(rig.shape_directions.shape[-1], generator=generator)
    return rig.shaped(coefficients).posed(HandPose(rotations, torch.zeros(3)))


def _box_points(
    parts: Parts, posed: PosedHand, count: int, margin: float, generator: torch.Generator
) -> Float[Tensor, "points 3"]:
    """Uniform in the part boxes, as many in each."""
    boxes = parts.boxes(posed, margin)
    bone = torch.arange(count) % NUM_BONES
    lower, upper = boxes.lower.cpu()[bone] - margin, boxes.upper.cpu()[bone] + margin
    local = lower + (upper - lower) * torch.rand(count, 3, generator=generator)
    return apply_rigid(posed.world_from_bone.detach().cpu()[bone], local[:, None])[:, 0]
