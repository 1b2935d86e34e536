"""Plausible hand poses: joint limits, a sampler, named gestures, smooth motion.

Angles here are flexion, abduction and twist in this order, about the axes of ``rig.joint_axes``:
positive flexion curls into the palm, positive abduction turns towards the thumb side (for the
thumb: away from the palm), twist goes about the bone's own direction. Tables are in degrees,
tensors in radians. A joint's rotation is flexion @ abduction @ twist, so that the angles stay
unambiguous at any flexion.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.errors import ArgumentError
from handavatar.geometry.meshes import unique_edges
from handavatar.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    rotations_between,
)
from handavatar.hand.pose import BONE_NAMES, BONE_PARENTS, FINGER_BONES, NUM_BONES, HandPose
from handavatar.hand.rig import Rig

PENETRATION_LIMIT = 2e-3
"""Metres one part may sink into another: about what soft flesh gives."""


@dataclass(frozen=True)
class JointLimits:
    """Range of one joint in degrees, each (least, greatest)."""

    flexion: tuple[float, float]
    abduction: tuple[float, float] = (0.0, 0.0)
    twist: tuple[float, float] = (0.0, 0.0)


JOINT_LIMITS: dict[str, JointLimits] = {
    "index1": JointLimits((-15.0, 90.0), (-8.0, 16.0)),
    "middle1": JointLimits((-15.0, 90.0), (-9.0, 9.0)),
    "ring1": JointLimits((-15.0, 90.0), (-14.0, 8.0)),
    "little1": JointLimits((-15.0, 90.0), (-25.0, 8.0)),
    **{f"{finger}2": JointLimits((0.0, 105.0)) for finger in ("index", "middle", "ring", "little")},
    **{f"{finger}3": JointLimits((-5.0, 65.0)) for finger in ("index", "middle", "ring", "little")},
    "thumb1": JointLimits((-25.0, 40.0), (-20.0, 25.0), (-40.0, 20.0)),
    "thumb2": JointLimits((-10.0, 50.0)),
    "thumb3": JointLimits((-15.0, 70.0)),
}
"""Every joint but the wrist, which is free: its rotation is the hand's place in the world."""


@dataclass(frozen=True)
class JointAngle:
    """An angle by which a joint turns, as a slider shows it.

    Attributes:
        bone: number of the joint's bone.
        angle: 0 flexion, 1 abduction, 2 twist.
        finger: that the joint belongs to.
        label: such as ``index1 flexion``.
        least: degrees.
        greatest: degrees.
    """

    bone: int
    angle: int
    finger: str
    label: str
    least: float
    greatest: float


def joint_angles() -> list[JointAngle]:
    """All angles that are free within :data:`JOINT_LIMITS`, joint by joint."""
    return [
        JointAngle(bone, angle, name[:-1], f"{name} {kind}", *limits)
        for bone, name in enumerate(BONE_NAMES)
        if name in JOINT_LIMITS
        for angle, (kind, limits) in enumerate(vars(JOINT_LIMITS[name]).items())
        if limits != (0.0, 0.0)
    ]


# A bent finger cannot be spread: the abduction range shrinks by this part at this flexion.
_SPREAD_LOSS = 0.85
_SPREAD_LOSS_FLEXION = math.radians(88)
_SPREADING = [f"{finger}1" for finger in ("index", "middle", "ring", "little")]
_FINGERS = ("index", "middle", "ring", "little")


# ------------------------------------------------------------------------ angles and rotations


def rotations_from_angles(
    rig: Rig, angles: Float[Tensor, "*batch bones 3"]
) -> Float[Tensor, "*batch bones 3"]:
    """Axis-angle rotations of given flexion, abduction and twist (radians)."""
    axes = rig.joint_axes.to(angles)
    flexion, abduction, twist = (
        matrix_from_axis_angle(angles[..., i : i + 1] * axes[:, i]) for i in range(3)
    )
    return axis_angle_from_matrix(flexion @ abduction @ twist)


def angles_from_rotations(
    rig: Rig, rotations: Float[Tensor, "*batch bones 3"]
) -> Float[Tensor, "*batch bones 3"]:
    """Flexion, abduction and twist (radians) of axis-angle rotations; differentiable.

    Inverse of :func:`rotations_from_angles` for abductions below a right angle.
    """
    axes = rig.joint_axes.to(rotations)
    m = axes @ matrix_from_axis_angle(rotations) @ axes.transpose(-1, -2)
    # At a right angle of abduction, as of the wrist of an upright hand, the root has no gradient.
    squared = m[..., 0, 0].square() + m[..., 0, 1].square()
    abduction = torch.atan2(m[..., 0, 2], squared.clamp_min(torch.finfo(m.dtype).tiny).sqrt())
    flexion = torch.atan2(-m[..., 1, 2], m[..., 2, 2])
    twist = torch.atan2(-m[..., 0, 1], m[..., 0, 0])
    return torch.stack([flexion, abduction, twist], dim=-1)


def limit_excess(
    rig: Rig, rotations: Float[Tensor, "*batch bones 3"]
) -> Float[Tensor, "*batch bones"]:
    """How far each joint is bent beyond its limits: radians, summed over its three angles.

    Zero inside the limits and always for the wrist; differentiable, so that it serves as a
    penalty when a pose is fitted.
    """
    angles = angles_from_rotations(rig, rotations)
    least, greatest = limit_bounds(angles)
    return ((least - angles).relu() + (angles - greatest).relu()).sum(-1)


def clamped_angles(angles: Float[Tensor, "*batch bones 3"]) -> Float[Tensor, "*batch bones 3"]:
    """The nearest angles (radians) inside the limits, flexion first."""
    flexion_least, flexion_greatest = (bound[..., 0] for bound in limit_bounds(angles))
    flexion = angles[..., 0].clamp(flexion_least, flexion_greatest)
    angles = torch.cat([flexion[..., None], angles[..., 1:]], dim=-1)
    least, greatest = limit_bounds(angles)
    return angles.clamp(least, greatest)


def limit_bounds(
    angles: Float[Tensor, "*batch bones 3"],
) -> tuple[Float[Tensor, "*batch bones 3"], Float[Tensor, "*batch bones 3"]]:
    """Least and greatest angles in radians, which for abduction depend on the flexion."""
    # No angle reaches a full turn, so the wrist stays free; infinity would spoil the gradient.
    least = torch.full((NUM_BONES, 3), -2 * math.pi)
    greatest = torch.full((NUM_BONES, 3), 2 * math.pi)
    for name, limits in JOINT_LIMITS.items():
        ranges = torch.tensor([limits.flexion, limits.abduction, limits.twist])
        least[BONE_NAMES.index(name)], greatest[BONE_NAMES.index(name)] = ranges.deg2rad().T
    spreads = torch.zeros(NUM_BONES, 3)
    spreads[[BONE_NAMES.index(name) for name in _SPREADING], 1] = 1.0
    flexion = angles[..., :1].clamp(0, _SPREAD_LOSS_FLEXION)
    freedom = 1 - spreads.to(angles) * (_SPREAD_LOSS / _SPREAD_LOSS_FLEXION) * flexion
    return least.to(angles) * freedom, greatest.to(angles) * freedom


# ------------------------------------------------------------------------------------ sampling


def sample_poses(
    rig: Rig, count: int, generator: torch.Generator
) -> Float[Tensor, "count bones 3"]:
    """Random poses as hands take them: fingers move together, the thumb with them.

    One grip value curls all fingers, each deviates a little from it, sometimes one is stretched;
    spreading fades as fingers curl; DIP joints follow PIP joints. All inside ``JOINT_LIMITS``;
    parts may still overlap: see :class:`PenetrationProbe`.

    Returns:
        Axis-angle rotations, wrist at zero.
    """

    def uniform(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator)

    # Kumaraswamy's distribution, close to Beta(1.1, 1.3), has an inverse to draw with.
    grip = (1 - (1 - uniform(1)) ** (1 / 1.3)) ** (1 / 1.1)
    deviation = 0.28 * normal(4)
    neighbours = torch.cat([deviation[:, :1], deviation, deviation[:, -1:]], dim=1)
    deviation = 0.5 * deviation + 0.25 * (neighbours[:, :-2] + neighbours[:, 2:])
    curl = (grip + 1.3 * deviation).clamp(0, 1)
    stretched = torch.randint(0, 4, (count,), generator=generator)
    is_stretched = uniform() < 0.25
    chosen = torch.nn.functional.one_hot(stretched, 4).bool() & is_stretched[:, None]
    curl = torch.where(chosen, 0.1 * uniform(4), curl)
    spread = 2 * uniform(1) - 1

    angles = torch.zeros(count, NUM_BONES, 3)
    # Where each finger goes when all spread (+1) or close up (-1), degrees.
    fan = torch.tensor([12.0, 1.0, -8.0, -18.0])
    for column, finger in enumerate(_FINGERS):
        first, second, third = FINGER_BONES[finger]
        bend = curl[:, column]
        angles[:, first, 0] = -12 + 98 * (bend + 0.12 * normal()).clamp(0, 1)
        angles[:, second, 0] = 3 + 95 * (bend + 0.12 * normal()).clamp(0, 1)
        angles[:, third, 0] = 0.55 * angles[:, second, 0] + 12 * uniform() - 6
        closing = torch.where(spread[:, 0] > 0, spread[:, 0], 0.4 * spread[:, 0])
        angles[:, first, 1] = fan[column] * closing + 1.5 * normal()
    opposition = (0.6 * grip[:, 0] + 0.5 * uniform() - 0.05 + 0.1 * normal()).clamp(0, 1)
    for axis, (apart, opposed, noise) in enumerate([(-18, 26, 5), (-4, 18, 6), (6, -28, 4)]):
        angles[:, FINGER_BONES["thumb"][0], axis] = (
            apart + (opposed - apart) * opposition + noise * normal()
        )
    angles[:, FINGER_BONES["thumb"][1], 0] = -5 + 38 * opposition + 8 * normal()
    angles[:, FINGER_BONES["thumb"][2], 0] = -6 + 50 * opposition * uniform() + 8 * normal()
    return rotations_from_angles(rig, clamped_angles(angles.deg2rad()))


@dataclass(frozen=True, eq=False)
class PenetrationProbe:
    """Measures how deep parts of a posed hand sink into parts that are not their neighbours.

    A part is the faces of one bone; it is open where it joins the next, which the generalised
    winding number tolerates. Vertices within ``joined_edges`` edges of a part belong to the skin
    fold between them and are not held against each other.

    Attributes:
        rig: the hand; use the base mesh, not a subdivided one.
        joined_edges: how many edges away from a part a vertex counts as joined to it.
    """

    rig: Rig
    joined_edges: int = 3

    @cached_property
    def _part_faces(self) -> list[np.ndarray]:
        owner = self.rig.skin_weights.argmax(dim=1)[self.rig.faces].mode(dim=1).values
        return [self.rig.faces[owner == bone].cpu().numpy() for bone in range(NUM_BONES)]

    @cached_property
    def _is_apart(self) -> Bool[Tensor, "bones vertices"]:
        """Which vertices may be tested against which part."""
        owner = self.rig.skin_weights.argmax(dim=1)
        edges = unique_edges(self.rig.faces)
        apart = torch.ones(NUM_BONES, self.rig.num_vertices, dtype=torch.bool)
        for bone, faces in enumerate(self._part_faces):
            joined = torch.zeros(self.rig.num_vertices, dtype=torch.bool)
            joined[torch.from_numpy(faces).flatten()] = True
            for _ in range(self.joined_edges):
                reached = joined[edges].any(dim=1)
                joined[edges[reached].flatten()] = True
            related = [
                other
                for other in range(NUM_BONES)
                if other == bone or BONE_PARENTS[other] == bone or BONE_PARENTS[bone] == other
            ]
            # The thumb's base turns inside the palm's flesh; only its free part can collide.
            if bone == 0:
                related += [FINGER_BONES["thumb"][0]]
            apart[bone] = ~joined & ~torch.isin(owner, torch.tensor(related))
        return apart

    def depth(self, vertices: Float[Tensor, "vertices 3"]) -> float:
        """Greatest depth in metres of a vertex inside another part; 0 if none is inside."""
        places = np.ascontiguousarray(vertices.detach().cpu().double().numpy())
        deepest = 0.0
        for faces, is_apart in zip(self._part_faces, self._is_apart, strict=True):
            corners = places[faces].reshape(-1, 3)
            low, high = corners.min(axis=0), corners.max(axis=0)
            near = is_apart.numpy() & ((places > low) & (places < high)).all(axis=1)
            if not near.any():
                continue
            used, local = np.unique(faces, return_inverse=True)
            part, part_faces = places[used], local.reshape(-1, 3)
            winding = np.asarray(igl.fast_winding_number(part, part_faces, places[near]))
            inside = places[near][winding > 0.5]
            if len(inside):
                squared = igl.point_mesh_squared_distance(inside, part, part_faces)[0]
                deepest = max(deepest, float(np.sqrt(squared.max())))
        return deepest

    def depths(self, rotations: Float[Tensor, "count bones 3"]) -> Float[Tensor, "count"]:
        """Depth in metres of every pose of the mean hand."""
        pose = HandPose(rotations, rotations.new_zeros(len(rotations), 3))
        vertices = self.rig.shaped().posed(pose).vertices
        return torch.tensor([self.depth(hand) for hand in vertices])


def resolve_penetration(
    rig: Rig,
    rotations: Float[Tensor, "count bones 3"],
    limit: float = PENETRATION_LIMIT,
    steps: int = 6,
) -> Float[Tensor, "count bones 3"]:
    """Opens poses just as far as needed for no part to sink deeper than ``limit`` metres.

    Bisects between each pose and the same pose opened up (fingers nearly straight and slightly
    apart, thumb out). Poses that are fine come back unchanged.
    """
    probe = PenetrationProbe(rig)
    resolved = rotations.clone()
    for number in (probe.depths(rotations) > limit).nonzero()[:, 0].tolist():
        angles = angles_from_rotations(rig, rotations[number])
        opened = _opened(angles)

        def blended(share: float, start: Tensor = angles, end: Tensor = opened) -> Tensor:
            return rotations_from_angles(rig, torch.lerp(start, end, share))

        resolved[number] = _least_blend(blended, probe, limit, steps)
    return resolved


def _least_blend(
    blended: Callable[[float], Tensor], probe: PenetrationProbe, limit: float, steps: int
) -> Tensor:
    low, high = 0.0, 1.0
    best = blended(1.0)
    for _ in range(steps):
        middle = (low + high) / 2
        candidate = blended(middle)
        if float(probe.depths(candidate[None])[0]) > limit:
            low = middle
        else:
            high, best = middle, candidate
    return best


def _opened(angles: Tensor) -> Tensor:
    """The same pose with hardly any bend, fingers a little apart, thumb out; wrist kept."""
    opened = angles.clone()
    for finger, abduction in zip(_FINGERS, (5.0, 0.0, -4.0, -9.0), strict=True):
        bones = list(FINGER_BONES[finger])
        opened[bones, 0] = 0.15 * angles[bones, 0].clamp(min=0)
        opened[bones[0], 1] = math.radians(abduction)
    thumb = list(FINGER_BONES["thumb"])
    opened[thumb] = torch.tensor([[-10.0, 5.0, 0.0], [0.0, 0, 0], [0.0, 0, 0]]).deg2rad().to(angles)
    return opened


# ------------------------------------------------------------------------------------ gestures


@dataclass(frozen=True)
class Gesture:
    """A named pose in degrees; fingers as (MCP flexion, PIP flexion, DIP flexion, abduction).

    The thumb is (CMC flexion, CMC abduction, CMC twist, MP flexion, IP flexion).
    """

    index: tuple[float, float, float, float]
    middle: tuple[float, float, float, float]
    ring: tuple[float, float, float, float]
    little: tuple[float, float, float, float]
    thumb: tuple[float, float, float, float, float]

    def angles(self) -> Float[Tensor, "bones 3"]:
        """Flexion, abduction and twist of every joint in radians."""
        angles = torch.zeros(NUM_BONES, 3)
        for finger in _FINGERS:
            *flexions, abduction = getattr(self, finger)
            bones = list(FINGER_BONES[finger])
            angles[bones, 0] = torch.tensor(flexions, dtype=angles.dtype)
            angles[bones[0], 1] = abduction
        first, second, third = FINGER_BONES["thumb"]
        angles[first] = torch.tensor(self.thumb[:3], dtype=angles.dtype)
        angles[second, 0], angles[third, 0] = self.thumb[3:]
        return angles.deg2rad()


_STRAIGHT = (0.0, 0.0, 0.0, 0.0)
_FIST_INDEX = (80.0, 90.0, 42.0, 0.0)
_FIST_MIDDLE = (82.0, 90.0, 42.0, 0.0)
_FIST_RING = (84.0, 90.0, 42.0, 0.0)
_FIST_LITTLE = (86.0, 88.0, 40.0, 0.0)

GESTURES: dict[str, Gesture] = {
    "flat": Gesture(_STRAIGHT, _STRAIGHT, _STRAIGHT, _STRAIGHT, (0.0, 0.0, 0.0, 0.0, 0.0)),
    "spread": Gesture(
        (-4.0, 0.0, 0.0, 14.0),
        (-4.0, 0.0, 0.0, 2.0),
        (-4.0, 0.0, 0.0, -11.0),
        (-4.0, 0.0, 0.0, -22.0),
        (-20.0, 0.0, 0.0, -5.0, -5.0),
    ),
    "relaxed": Gesture(
        (18.0, 25.0, 12.0, 2.0),
        (24.0, 32.0, 15.0, 0.0),
        (28.0, 36.0, 17.0, -1.0),
        (30.0, 36.0, 17.0, -3.0),
        (4.0, 6.0, -8.0, 10.0, 14.0),
    ),
    "fist": Gesture(
        _FIST_INDEX, _FIST_MIDDLE, _FIST_RING, _FIST_LITTLE, (20.0, 17.0, -26.0, 30.0, 40.0)
    ),
    "point": Gesture(
        (2.0, 3.0, 1.0, 0.0),
        _FIST_MIDDLE,
        _FIST_RING,
        _FIST_LITTLE,
        (29.0, 12.0, -38.0, 21.0, 30.0),
    ),
    "pinch": Gesture(
        (53.0, 47.0, 24.0, -3.0),
        (32.0, 34.0, 16.0, -1.0),
        (26.0, 30.0, 14.0, -2.0),
        (20.0, 26.0, 12.0, -6.0),
        (33.0, 9.0, -40.0, 4.0, -6.0),
    ),
    "ok": Gesture(
        (54.0, 46.0, 23.0, -1.0),
        (5.0, 8.0, 3.0, 2.0),
        (0.0, 5.0, 2.0, -5.0),
        (-4.0, 3.0, 1.0, -14.0),
        (32.0, 10.0, -40.0, 5.0, -6.0),
    ),
    "victory": Gesture(
        (-2.0, 2.0, 1.0, 13.0),
        (-2.0, 2.0, 1.0, -8.0),
        _FIST_RING,
        _FIST_LITTLE,
        (39.0, 13.0, -34.0, 28.0, 25.0),
    ),
    "thumbs_up": Gesture(
        _FIST_INDEX, _FIST_MIDDLE, _FIST_RING, _FIST_LITTLE, (-22.0, -8.0, 5.0, -8.0, -12.0)
    ),
    # The one gesture in which fingers push each other beyond their own limits.
    "crossed_fingers": Gesture(
        (33.0, 5.0, 3.0, -15.0),
        (8.0, 20.0, 10.0, 15.0),
        _FIST_RING,
        _FIST_LITTLE,
        (39.0, 13.0, -34.0, 28.0, 25.0),
    ),
}
"""Poses whose names everybody knows."""


def gesture_rotations(rig: Rig, name: str) -> Float[Tensor, "bones 3"]:
    """Axis-angle rotations of a named gesture.

    Raises:
        ArgumentError: unknown name.
    """
    if name not in GESTURES:
        raise ArgumentError("name", repr(name), f"one of {sorted(GESTURES)}")
    return rotations_from_angles(rig, GESTURES[name].angles())


def interpolate_rotations(
    keyframes: Float[Tensor, "keys bones 3"], times: Float[Tensor, "times"]
) -> Float[Tensor, "times bones 3"]:
    """Motion through key poses along the shortest rotation of every joint.

    Args:
        keyframes: axis-angle rotations.
        times: 0 is the first key pose, 1 the second and so on; beyond the ends the pose is held.
            Motion eases in and out of each key pose, so that speed has no jumps.
    """
    last = len(keyframes) - 1
    clamped = times.clamp(0, last)
    start = clamped.floor().long().clamp(max=max(last - 1, 0))
    end = (start + 1).clamp(max=last)
    share = clamped - start
    share = share * share * (3 - 2 * share)
    matrices = matrix_from_axis_angle(keyframes)
    return axis_angle_from_matrix(
        rotations_between(matrices[start], matrices[end], share[:, None, None])
    )
