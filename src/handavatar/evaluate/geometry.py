"""What the surface of an occupancy field is measured by, against the mesh that guides it.

Lengths in metres, angles in radians. The truth is the posed mesh, closed at the wrist; inside
means the generalised winding number, so that an overlap of fingers is inside.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from handavatar.geometry.closest import ClosestPoints, closest_on_mesh
from handavatar.geometry.extraction import Field
from handavatar.geometry.meshes import (
    distance_between_sets,
    distance_to_mesh,
    face_cross_products,
    is_inside,
    uniform_laplacian,
    unique_edges,
    vertex_normals,
)
from handavatar.hand.pose import NUM_BONES
from handavatar.hand.rig import PosedHand, Rig

SEAM_REACH = 3e-3
"""Metres from the border of two parts within which a seam would show."""
CONTACT_REACH = 2e-3
"""Metres between parts that count as touching, and around such places that are judged."""
JOINED_REACH = 12e-3
"""Metres along the skin within which parts are joined to each other, not in contact."""


def roughness(vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"]) -> float:
    """Mean distance of a vertex from the mean of its neighbours, metres; grows with the voxel.

    Source: paper Sec. 4.1, Lap.
    """
    return float(uniform_laplacian(vertices, unique_edges(faces)).norm(dim=-1).mean())


@dataclass(frozen=True, eq=False)
class Skin:
    """What the measures know of a rig's surface, whatever the pose.

    Attributes:
        labels: bone of each vertex by largest skin weight; the wrist for the one that seals it.
        borders: edges whose ends belong to different parts.
        distances: from each part's skin to each vertex along the skin of the template, metres.
    """

    labels: Int[Tensor, "sealed_vertices"]
    borders: Int[Tensor, "borders 2"]
    distances: Float[Tensor, "bones sealed_vertices"]

    @staticmethod
    def of(rig: Rig) -> "Skin":
        """Labels, borders and distances of a rig."""
        vertices = rig.sealed(rig.template_vertices)
        labels = torch.cat([rig.skin_weights.argmax(-1), torch.zeros(1, dtype=torch.int64)])
        edges = unique_edges(rig.sealed_faces)
        first, second = edges.unbind(-1)
        lengths = (vertices[first] - vertices[second]).norm(dim=-1).double().clamp_min(1e-12)
        size = len(vertices)
        graph = coo_array((lengths.numpy(), (first.numpy(), second.numpy())), (size, size)).tocsr()
        rows = [
            dijkstra(graph, directed=False, indices=own.numpy(), min_only=True)
            for own in ((labels == bone).nonzero()[:, 0] for bone in range(NUM_BONES))
        ]
        return Skin(
            labels, edges[labels[first] != labels[second]], torch.from_numpy(np.stack(rows)).float()
        )


@dataclass(frozen=True, eq=False)
class Truth:
    """A posed hand as the truth about inside and outside.

    Attributes:
        hand: where it is.
        skin: facts of its rig.
    """

    hand: PosedHand
    skin: Skin

    @cached_property
    def vertices(self) -> Float[Tensor, "sealed_vertices 3"]:
        """Sealed, without gradient."""
        return self.hand.sealed_vertices.detach()

    @property
    def faces(self) -> Int[Tensor, "sealed_faces 3"]:
        """Sealed."""
        return self.hand.rig.sealed_faces

    @cached_property
    def normals(self) -> Float[Tensor, "sealed_vertices 3"]:
        """Unit vertex normals."""
        return vertex_normals(self.vertices, self.faces)

    @cached_property
    def is_outmost(self) -> Bool[Tensor, "sealed_vertices"]:
        """Vertices on the outside of the whole, not buried where skin folds or fingers overlap."""
        return ~is_inside(self.vertices, self.faces, self.vertices + 3e-4 * self.normals)

    def contains(self, points: Float[Tensor, "points 3"]) -> Bool[Tensor, "points"]:
        """Inside, overlaps included."""
        return is_inside(self.vertices, self.faces, points)

    def signed_distances(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Distance to the surface, metres, positive inside."""
        distance = distance_to_mesh(self.vertices, self.faces, points)
        return torch.where(self.contains(points), distance, -distance)

    def occupancy(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """What a perfect field would answer: the floor of every measure."""
        return torch.sigmoid(1000 * self.signed_distances(points))

    @cached_property
    def contacts(self) -> Float[Tensor, "contacts 3"]:
        """Places where skin of two parts that are not joined comes within ``CONTACT_REACH``.

        Halfway between a vertex and the nearest point of the other part, for every vertex on the
        outside or in an overlap of fingers; none for an open hand.
        """
        places = [torch.zeros(0, 3)]
        labels = self.skin.labels
        for bone in range(NUM_BONES):
            part = self.faces[(labels[self.faces] == bone).all(-1)]
            if len(part) == 0:
                continue
            corners = self.vertices[part].reshape(-1, 3)
            lower, upper = corners.amin(0) - CONTACT_REACH, corners.amax(0) + CONTACT_REACH
            is_near = ((self.vertices > lower) & (self.vertices < upper)).all(-1)
            is_apart = self.skin.distances[bone] > JOINED_REACH
            chosen = self.vertices[is_near & is_apart & (labels != bone)]
            closest = closest_on_mesh(self.vertices, part, chosen)
            touching = closest.distances < CONTACT_REACH
            places.append((chosen[touching] + closest.positions[touching]) / 2)
        return torch.cat(places)

    def closest(self, points: Float[Tensor, "points 3"]) -> ClosestPoints:
        """Nearest points of the closed surface."""
        return closest_on_mesh(self.vertices, self.faces, points)


@dataclass(frozen=True)
class Chamfer:
    """Mean unsquared distances between an extracted surface and the truth, metres.

    Attributes:
        to_truth: from extracted vertices to the faces of the truth: the paper's.
        from_truth: from vertices of the truth, those on the outside, to extracted faces; it
            notices what is missing.
    """

    to_truth: float
    from_truth: float

    @property
    def mean(self) -> float:
        """Of both directions."""
        return (self.to_truth + self.from_truth) / 2


def chamfer(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], truth: Truth
) -> Chamfer:
    """Vertex-to-face distances in both directions.

    Source: paper Sec. 4.1, Cham.
    Departs: the authors' code squares and adds both directions; here distances are unsquared, and
        vertices of the truth that lie buried in its folds are not missed by anybody.
    """
    outmost = truth.vertices[truth.is_outmost]
    return Chamfer(
        float(truth.closest(vertices).distances.mean()),
        float(distance_to_mesh(vertices, faces, outmost).mean()),
    )


@dataclass(frozen=True)
class Seams:
    """How a surface deviates from the truth at the borders of parts, and elsewhere.

    Attributes:
        angle: mean angle between its normals and those of the truth within ``SEAM_REACH`` of a
            border, radians.
        angle_elsewhere: the same for the rest of the surface.
        worst_angle: 95th percentile at the borders.
        step: mean over the connections of parts of how much farther out the surface lies on one
            side of the border than on the other, metres.
    """

    angle: float
    angle_elsewhere: float
    worst_angle: float
    step: float

    @property
    def excess(self) -> float:
        """By how much borders are worse than the rest, radians; what is even all over cancels."""
        return self.angle - self.angle_elsewhere


def seams(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], truth: Truth
) -> Seams:
    """Kinks and steps where parts join.

    Compared with the smooth normals of the truth, so that the hand's own curvature does not
    count. Left out are the sealed wrist and places within ``CONTACT_REACH`` of a contact: the
    crevice between touching fingers has no one normal. Every face counts by its area.

    Source: paper Sec. 4.2 and Fig. 4 (non-smooth part connections), which gives no figure.
    """
    cross = face_cross_products(vertices, faces)
    area = cross.norm(dim=-1)
    kept = area > 0
    middles, normals = vertices[faces[kept]].mean(1), cross[kept] / area[kept, None]
    area = area[kept]
    closest = truth.closest(middles)
    corners = truth.faces[closest.faces]
    weights = _barycentric(closest.positions, truth.vertices[corners])
    expected = (weights[..., None] * truth.normals[corners]).sum(1)
    expected = torch.nn.functional.normalize(expected, dim=-1, eps=1e-20)
    angle = torch.acos((normals * expected).sum(-1).clamp(-1, 1))

    is_counted = (corners != len(truth.vertices) - 1).all(-1)
    if len(truth.contacts):
        is_counted &= distance_between_sets(middles, truth.contacts) > 2 * CONTACT_REACH
    ends = truth.vertices[truth.skin.borders]
    border = torch.cat([ends[:, 0].lerp(ends[:, 1], share) for share in (0.25, 0.5, 0.75)])
    is_near = distance_between_sets(closest.positions, border) < SEAM_REACH
    near, rest = is_counted & is_near, is_counted & ~is_near
    labels = truth.skin.labels[corners.gather(1, weights.argmax(-1, keepdim=True))[:, 0]]
    outward = ((middles - closest.positions) * expected).sum(-1)
    return Seams(
        _weighted_mean(angle[near], area[near]),
        _weighted_mean(angle[rest], area[rest]),
        _weighted_quantile(angle[near], area[near], 0.95),
        _mean_step(outward[near], labels[near], area[near], closest.positions[near], truth),
    )


def _mean_step(
    outward: Tensor, labels: Tensor, area: Tensor, positions: Tensor, truth: Truth
) -> float:
    """Mean absolute difference of the mean offset on both sides of each pair's border."""
    pairs = truth.skin.labels[truth.skin.borders].sort(-1).values
    steps = []
    for first, second in torch.unique(pairs, dim=0).tolist():
        ends = truth.vertices[
            truth.skin.borders[(pairs == torch.tensor([first, second])).all(-1)]
        ].mean(1)
        is_here = distance_between_sets(positions, ends) < SEAM_REACH
        sides = [is_here & (labels == part) for part in (first, second)]
        if all(int(side.sum()) >= 10 for side in sides):
            means = [_weighted_mean(outward[side], area[side]) for side in sides]
            steps.append(abs(means[0] - means[1]))
    return sum(steps) / len(steps) if steps else math.nan


def _barycentric(
    positions: Float[Tensor, "points 3"], corners: Float[Tensor, "points 3 3"]
) -> Float[Tensor, "points 3"]:
    """Weights of points on their triangles, rows sum to 1; even on triangles without area."""
    towards = corners - positions[:, None]
    areas = torch.linalg.cross(towards.roll(-1, 1), towards.roll(-2, 1)).norm(dim=-1) + 1e-20
    return areas / areas.sum(-1, keepdim=True)


def _weighted_mean(values: Tensor, weights: Tensor) -> float:
    return float((values * weights).sum() / weights.sum()) if len(values) else math.nan


def _weighted_quantile(values: Tensor, weights: Tensor, share: float) -> float:
    if len(values) == 0:
        return math.nan
    order = values.argsort()
    reached = weights[order].cumsum(0) >= share * weights.sum()
    return float(values[order[int(reached.int().argmax())]])


@dataclass(frozen=True)
class ContactErrors:
    """Shares of points near contacts whose inside or outside is wrong, in [0, 1].

    Attributes:
        whole: of all judged points.
        flesh: of those that are inside: a share of holes where parts meet or overlap.
        gap: of those that are outside: a share of webbing between parts.
    """

    whole: float
    flesh: float
    gap: float


def contact_errors(
    occupancy_of: Field, truth: Truth, generator: torch.Generator, count: int = 4096
) -> ContactErrors | None:
    """Errors in balls of ``CONTACT_REACH`` about the contacts; none where no parts touch.

    Source: paper Sec. 1 and 4.2 (self-contact), which gives no figure.
    """
    contacts = truth.contacts
    if len(contacts) == 0:
        return None
    chosen = torch.randint(len(contacts), (count,), generator=generator)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    radius = CONTACT_REACH * torch.rand(count, 1, generator=generator) ** (1 / 3)
    points = contacts[chosen] + radius * direction
    is_true = truth.contains(points)
    wrong = (occupancy_of(points) > 0.5) != is_true

    def share(of: Tensor) -> float:
        return float(wrong[of].float().mean()) if bool(of.any()) else 0.0

    return ContactErrors(float(wrong.float().mean()), share(is_true), share(~is_true))
