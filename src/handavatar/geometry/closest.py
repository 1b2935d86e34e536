"""Closest points of triangles and meshes: exact, also where triangles have no area.

libigl 2.6 is not: of unit triangles with corners on a line it was found to be wrong by up to 4.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from handavatar.errors import HandAvatarError

_PAIRS_AT_ONCE = 1 << 19


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """For each of some points the nearest point of a surface.

    Attributes:
        distances: unsquared, metres.
        faces: which face holds it.
        positions: metres.
    """

    distances: Float[Tensor, "points"]
    faces: Int[Tensor, "points"]
    positions: Float[Tensor, "points 3"]


def closest_on_triangles(
    points: Float[Tensor, "*batch 3"], corners: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch 3"]:
    """The nearest point of each triangle to its own point; differentiable.

    The nearest of four candidates, each of them surely on the triangle: one on every edge, and the
    foot of the perpendicular where it falls inside. A triangle without area is its longest edge,
    or a point.

    Source: paper Sec. 4.1 and appendix A, the vertex-to-face distance of Cham. and L_surf.
    Departs: the authors' PyTorch3D takes faces below 0.005 square units for edges, which most
        faces of a hand in decimetres are; here a small face is a face.
    """
    ends = corners.roll(-1, dims=-2)
    along = ends - corners
    squares = along.square().sum(-1)
    share = ((points[..., None, :] - corners) * along).sum(-1)
    share = (share / torch.where(squares > 0, squares, 1.0)).clamp(0, 1)
    on_edges = corners + share[..., None] * along
    normal = torch.linalg.cross(along[..., 0, :], along[..., 1, :])
    # Each corner's weight is the area that the foot spans with the opposite edge.
    towards = points[..., None, :] - corners
    areas = (torch.linalg.cross(along, towards) * normal[..., None, :]).sum(-1).roll(-1, dims=-1)
    total = areas.sum(-1, keepdim=True)
    is_above = (areas >= 0).all(-1, keepdim=True) & (total > 0)
    weights = torch.where(is_above, areas / torch.where(is_above, total, 1.0), 1 / 3)
    foot = (weights[..., None] * corners).sum(-2, keepdim=True)
    foot = torch.where(is_above[..., None], foot, on_edges[..., :1, :])
    candidates = torch.cat([on_edges, foot], dim=-2)
    nearest = (candidates - points[..., None, :]).square().sum(-1).argmin(-1)
    index = nearest[..., None, None].expand(*nearest.shape, 1, 3)
    return candidates.gather(-2, index)[..., 0, :]


@torch.no_grad()
def closest_on_mesh(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    points: Float[Tensor, "points 3"],
) -> ClosestPoints:
    """Nearest points of a surface, on the CPU, without gradient.

    K-d trees over the faces' middles, one for each size of faces, offer candidates. A point is
    done with a size when the next middle is so far that no face about it can be nearer than the
    best found: middles are at most the largest face's radius from any of its points.

    Raises:
        HandAvatarError: if there is no face, or a coordinate is not finite.
    """
    if len(faces) == 0:
        raise HandAvatarError("cannot measure distances to a mesh without faces")
    for name, values in (("vertices", vertices), ("points", points)):
        bad = int((~torch.isfinite(values)).any(-1).sum())
        if bad:
            raise HandAvatarError(
                f"cannot measure distances: {bad} of {len(values)} {name} hold NaN or infinity; "
                "expected finite metres"
            )
    corners = vertices.detach().double().cpu()[faces.cpu()]
    places = points.detach().double().cpu()
    radii = (corners - corners.mean(1, keepdim=True)).norm(dim=-1).amax(1)
    found = ClosestPoints(
        torch.full((len(places),), torch.inf, dtype=torch.float64),
        torch.zeros(len(places), dtype=torch.int64),
        places.clone(),
    )
    # Few large faces, such as the fan that seals a wrist, must not widen the search for all.
    sizes = torch.frexp(radii).exponent
    sizes = sizes.clamp_min(int(sizes.max()) - 12)
    values, counts = sizes.unique(return_counts=True)
    for size in values[counts.argsort(descending=True)]:
        _improve(found, places, corners, (sizes == size).nonzero()[:, 0], radii)
    return ClosestPoints(
        found.distances.to(points), found.faces.to(points.device), found.positions.to(points)
    )


def _improve(
    best: ClosestPoints, places: Tensor, corners: Tensor, chosen: Tensor, radii: Tensor
) -> None:
    """Writes into ``best`` what is nearer on the chosen faces."""
    triangles, own_radii = corners[chosen], radii[chosen]
    radius = float(own_radii.max())
    tree = cKDTree(triangles.mean(1).numpy())
    waiting, done, count = torch.arange(len(places)), 0, 1
    while len(waiting):
        count = min(count, len(triangles))
        unsettled = []
        for own in waiting.split(max(_PAIRS_AT_ONCE // count, 1)):
            reach, near = tree.query(places[own].numpy(), k=np.arange(done + 1, count + 1))
            reach, candidates = torch.from_numpy(reach), torch.from_numpy(near)
            row, column = (reach - own_radii[candidates] < best.distances[own, None]).nonzero().T
            asked, faces = own[row], candidates[row, column]
            found = closest_on_triangles(places[asked], triangles[faces])
            distances = (found - places[asked]).norm(dim=-1)
            nearest = best.distances.scatter_reduce(0, asked, distances, "amin")
            wins = (distances == nearest[asked]) & (distances < best.distances[asked])
            # Of equally near faces the first; rows are in order, so equal points are neighbours.
            pair = wins.nonzero()[:, 0]
            pair = pair[asked[pair] != torch.cat([asked.new_tensor([-1]), asked[pair][:-1]])]
            best.distances[asked[pair]] = distances[pair]
            best.faces[asked[pair]] = chosen[faces[pair]]
            best.positions[asked[pair]] = found[pair]
            unsettled.append(own[reach[:, -1] < best.distances[own] + radius])
        if count == len(triangles):
            break
        waiting, done, count = torch.cat(unsettled), count, 4 * count
