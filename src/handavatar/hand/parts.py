"""Per-bone parts of a rig: which faces, which fixed surface points, which box.

Labels by the largest skin weight. A part's points lie half on its own faces and half on its own
and its neighbours' faces near them, so that the encoding of a part knows how it continues.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.meshes import (
    SurfacePoints,
    distance_between_sets,
    face_cross_products,
    sample_surface_evenly,
)
from handavatar.geometry.rotations import apply_rigid, invert_rigid
from handavatar.hand.detail import refined, subdivided
from handavatar.hand.pose import BONE_PARENTS, CONNECTED_PAIRS, NUM_BONES
from handavatar.hand.rig import PosedHand, Rig, RigError

EXTENSION = 0.010
"""How far a part's points reach into its neighbours, metres (as in the authors' code)."""
POINT_ROUNDS = 1
"""Finer levels of a rig have the points that are drawn at this one: a trained encoder knows its own
points better than others of the same surface."""


@dataclass(frozen=True, eq=False)
class PartBoxes:
    """Axis-aligned boxes in the frames of the bones.

    Attributes:
        bone_from_world: rigid transforms.
        lower: smallest corner of the part itself, metres, bone frame.
        upper: largest corner.
        margin: how far the part's occupancy reaches beyond its own box, metres.
        cut_point: a point of the plane that cuts the wrist, in the wrist's frame; nothing of the
            hand lies beyond it, whatever the boxes.
        cut_normal: unit, pointing away from the hand.
    """

    bone_from_world: Float[Tensor, "bones 4 4"]
    lower: Float[Tensor, "bones 3"]
    upper: Float[Tensor, "bones 3"]
    margin: float
    cut_point: Float[Tensor, "3"]
    cut_normal: Float[Tensor, "3"]


@dataclass(frozen=True, eq=False)
class Parts:
    """Fixed surface points and labels of every part of a rig.

    Attributes:
        vertex_labels: bone of each vertex, by largest skin weight.
        corner_indices: face corners of the points of each part.
        barycentric: weights of the corners.
    """

    vertex_labels: Int[Tensor, "vertices"]
    corner_indices: Int[Tensor, "bones points 3"]
    barycentric: Float[Tensor, "bones points 3"]

    def to(self, device: torch.device | str) -> "Parts":
        """The same parts on another device."""
        return Parts(
            self.vertex_labels.to(device),
            self.corner_indices.to(device),
            self.barycentric.to(device),
        )

    @property
    def points(self) -> SurfacePoints:
        """The points of all parts, one part after the other, as they are stored."""
        return SurfacePoints(self.corner_indices.flatten(0, 1), self.barycentric.flatten(0, 1))

    def with_points(self, points: SurfacePoints) -> "Parts":
        """The same parts with other points, such as stored ones.

        Args:
            points: as :attr:`points` gives them.

        Raises:
            RigError: if they are not as many for each part, or not on this rig.
        """
        count, corners = len(points.faces), points.faces
        if count == 0 or count % NUM_BONES or len(points.barycentric) != count:
            raise RigError(
                f"part points: found {count} with {len(points.barycentric)} weights, expected as "
                f"many for each of {NUM_BONES} parts"
            )
        if int(corners.min()) < 0 or int(corners.max()) >= len(self.vertex_labels):
            raise RigError(
                f"part points: found corners from {int(corners.min())} to {int(corners.max())}, "
                f"expected vertices of a rig of {len(self.vertex_labels)}"
            )
        shape = (NUM_BONES, count // NUM_BONES)
        return Parts(
            self.vertex_labels,
            corners.long().unflatten(0, shape),
            points.barycentric.unflatten(0, shape),
        )

    def point_clouds(self, posed: PosedHand) -> Float[Tensor, "bones points 6"]:
        """Points and unit normals of each part in its own bone's frame (metres).

        Source: paper Sec. 3.2, canonicalised point clouds and normals.
        """
        corners = posed.vertices[self.corner_indices]
        points = (corners * self.barycentric[..., None]).sum(-2)
        first, second, third = corners.unbind(-2)
        normals = torch.linalg.cross(second - first, third - first)
        normals = torch.nn.functional.normalize(normals, dim=-1, eps=1e-20)
        bone_from_world = invert_rigid(posed.world_from_bone)
        rotation = bone_from_world[:, :3, :3]
        return torch.cat(
            [apply_rigid(bone_from_world, points), normals @ rotation.transpose(-1, -2)], dim=-1
        )

    def boxes(self, posed: PosedHand, margin: float) -> PartBoxes:
        """The box of each part's own vertices in its bone's frame, without gradient."""
        with torch.no_grad():
            bone_from_world = invert_rigid(posed.world_from_bone)
            own = bone_from_world[self.vertex_labels]
            local = (own[:, :3, :3] @ posed.vertices[..., None])[..., 0] + own[:, :3, 3]
            index = self.vertex_labels[:, None].expand(-1, 3)
            empty = local.new_full((NUM_BONES, 3), torch.inf)
            lower = empty.scatter_reduce(0, index, local, "amin")
            upper = (-empty).scatter_reduce(0, index, local, "amax")
            rim = apply_rigid(bone_from_world[0], posed.vertices[posed.rig.rim])
            spokes = rim - rim.mean(0)
            # The rim runs along its faces' half edges, so this area vector points off the hand.
            area = torch.linalg.cross(spokes.roll(-1, 0), spokes).sum(0)
            normal = torch.nn.functional.normalize(area, dim=0)
            outmost = rim[(spokes @ normal).argmax(0, keepdim=True)][0]
        return PartBoxes(bone_from_world, lower, upper, margin, outmost, normal)


def divide_into_parts(
    rig: Rig, points_per_part: int = 256, seed: int = 0, drawn_on: Rig | None = None
) -> Parts:
    """Labels a rig's vertices and fixes the surface points of every part.

    Args:
        rig: the rig; its template decides everything.
        points_per_part: half of them on the part, half on the part and its surroundings.
        seed: of the surface sampling.
        drawn_on: a coarser level of ``rig`` on whose faces the points are drawn; see
            :func:`finer_rig`.

    Returns:
        Tensors on the CPU, wherever the rig is.

    Raises:
        RigError: if a bone owns no face, or none with an area.
        ValueError: if ``drawn_on`` is no coarser level of ``rig``.

    Source: paper Sec. 3.2 (N^p = 256 points per part, uniform).
    Departs: the points are drawn once, evenly spread, and stay fixed, so that inference is
        deterministic; the authors redraw them at every pass, also when they evaluate.
    """
    vertex_labels = rig.skin_weights.cpu().argmax(-1)
    if drawn_on is not None:
        _require_coarser(drawn_on, rig)
        rig = drawn_on
    generator = torch.Generator().manual_seed(seed)
    vertices, faces = rig.template_vertices.cpu(), rig.faces.cpu()
    labels = vertex_labels[: len(vertices)]
    face_labels = labels[faces].mode(-1).values
    corner_indices, barycentric = [], []
    for bone in range(NUM_BONES):
        own = faces[face_labels == bone]
        if len(own) == 0:
            raise RigError(
                f"rig {rig.name}: bone {bone} has the largest weight nowhere, so its part is "
                "empty; check the skin weights"
            )
        family = [b for b in range(NUM_BONES) if BONE_PARENTS[b] == bone] + [bone]
        if bone > 0:
            family.append(BONE_PARENTS[bone])
        candidates = faces[torch.isin(face_labels, torch.tensor(family))]
        distance = distance_between_sets(vertices, vertices[own.unique()])
        extended = candidates[(distance[candidates] < EXTENSION).all(-1)]
        if not float(face_cross_products(vertices, own).abs().max()) > 0:
            raise RigError(
                f"rig {rig.name}: the {len(own)} faces of bone {bone} have no area, so no point "
                "can lie on them; check the template's vertices"
            )
        half = points_per_part // 2
        clouds: list[SurfacePoints] = [
            sample_surface_evenly(vertices, own, half, generator),
            sample_surface_evenly(vertices, extended, points_per_part - half, generator),
        ]
        corner_indices.append(torch.cat([cloud.faces for cloud in clouds]))
        barycentric.append(torch.cat([cloud.barycentric for cloud in clouds]))
    return Parts(vertex_labels, torch.stack(corner_indices), torch.stack(barycentric))


def finer_rig(base: Rig, rounds: int, points: SurfacePoints | None = None) -> tuple[Rig, Parts]:
    """A rig subdivided so many times, and its parts, with points as a prior knows them.

    The finer rig is :func:`handavatar.hand.detail.refined`; which bone owns a vertex is told by the
    averaged weights, so that the parts do not depend on the refinement.

    Args:
        base: the rig.
        rounds: midpoint subdivisions.
        points: of the parts, as :attr:`Parts.points` has given them; drawn if there are none.

    Raises:
        RigError: as :func:`divide_into_parts` and :meth:`Parts.with_points`.
    """
    known = subdivided(base, min(rounds, POINT_ROUNDS))
    averaged = subdivided(known, max(rounds - POINT_ROUNDS, 0))
    fine = refined(base, rounds, fine=averaged)
    if points is None:
        return fine, divide_into_parts(averaged, drawn_on=known)
    labels = averaged.skin_weights.cpu().argmax(-1)
    nothing = torch.zeros(NUM_BONES, 0, 3)
    return fine, Parts(labels, nothing.long(), nothing).with_points(points)


def _require_coarser(coarse: Rig, fine: Rig) -> None:
    """Subdivision keeps the vertices it finds, first and in their order."""
    kept = fine.template_vertices[: coarse.num_vertices]
    if not torch.equal(kept.cpu(), coarse.template_vertices.cpu()):
        raise ValueError(
            f"parts: {coarse.name} with {coarse.num_vertices} vertices is no coarser level of "
            f"{fine.name} with {fine.num_vertices}, expected the rig before subdivision"
        )


def shuffled_pairs(seed: int) -> tuple[tuple[int, int], ...]:
    """A tree of pairs like ``CONNECTED_PAIRS`` whose parts have changed places at random.

    Every part is in a pair, and none of the pairs is physically connected: a control for the
    claim that connections matter.
    """
    generator = torch.Generator().manual_seed(seed)
    real = {frozenset(pair) for pair in CONNECTED_PAIRS}
    while True:
        place = torch.randperm(NUM_BONES, generator=generator).tolist()
        pairs = tuple((place[a], place[b]) for a, b in CONNECTED_PAIRS)
        if real.isdisjoint(frozenset(pair) for pair in pairs):
            return pairs
