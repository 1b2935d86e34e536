"""The skin's detail: a texture on the rig's chart that multiplies what the albedo's codes say.

Codes lie millimetres apart; lines of the palm, nails and creases are finer. What the texture holds
is the logarithm of a factor: zero changes nothing, and the light's own errors, factors too, add.
"""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn

from handavatar.field.anchors import Neighbours
from handavatar.geometry.meshes import SurfacePoints
from handavatar.hand.rig import Rig

_AROUND = 5
"""An anchor knows the vertices of so many times its own share of the surface."""
_FEWEST_AROUND = 16
_POINTS_AT_ONCE = 16384
"""Points whose faces are looked for at a time: what they need then stays in a CPU's cache."""


class DetailTexture(nn.Module):
    """A residual of the albedo on the chart of the fine rig, per channel.

    A point off the surface takes what its nearest place of the surface has, as it takes the codes
    of the nearest anchors, so that the texture sticks to the skin in every view, wherever beside
    the mesh the occupancy ends.

    Attributes:
        texels: logarithms of factors of the albedo; row ``i`` and column ``j`` lie at
            ``v = (i + 0.5) / size`` and ``u = (j + 0.5) / size``.

    Departs: the paper's albedo is that of the anchors' codes alone, 2 to 4 mm apart.
    """

    faces: Tensor
    corners: Tensor
    around: Tensor
    incident: Tensor

    def __init__(self, rig: Rig, anchors: SurfacePoints, size: int) -> None:
        """A texture that changes nothing.

        Args:
            rig: the fine one, with a chart that can carry a texture.
            anchors: of the albedo, on this rig.
            size: texels along a side.
        """
        super().__init__()
        self.texels = nn.Parameter(torch.zeros(size, size, 3, device=rig.faces.device))
        self.register_buffer("faces", rig.faces, persistent=False)
        self.register_buffer("corners", rig.uv_coordinates[rig.uv_faces], persistent=False)
        around = vertices_around(rig, anchors)
        self.register_buffer("around", around, persistent=False)
        self.register_buffer("incident", incident_faces(rig), persistent=False)

    @property
    def size(self) -> int:
        """Texels along a side."""
        return len(self.texels)

    def forward(self, places: Float[Tensor, "points 2"]) -> Float[Tensor, "points 3"]:
        """The logarithm of the factor at places of the chart, between texels linear."""
        return texture_at(self.texels, places)

    @torch.no_grad()
    def places(
        self,
        vertices: Float[Tensor, "vertices 3"],
        points: Float[Tensor, "points 3"],
        neighbours: Neighbours,
    ) -> Float[Tensor, "points 2"]:
        """Where on the chart (u, v) the surface is nearest to points, without gradient.

        Args:
            vertices: of the posed fine mesh, metres.
            points: near the surface, metres.
            neighbours: nearest anchors of the points.
        """
        faces, weights = self.nearest(vertices, points, neighbours)
        return (self.corners[faces] * weights[..., None]).sum(1)

    @torch.no_grad()
    def nearest(
        self,
        vertices: Float[Tensor, "vertices 3"],
        points: Float[Tensor, "points 3"],
        neighbours: Neighbours,
    ) -> tuple[Int[Tensor, "points"], Float[Tensor, "points 3"]]:
        """The face nearest to each point, and where on it, as weights of its corners.

        Of the vertices around the nearest anchor the two nearest are taken, and of their faces the
        nearest; where faces meet at an angle, the place on it is nearly the nearest one. Where
        fingers touch, the place is on that of the nearest anchor, as the codes are.
        """
        first, second, third = vertices[self.faces].unbind(1)
        along, across = second - first, third - first
        dual_along, dual_across = _dual_sides(along, across)
        found, weights = [], []
        for start in range(0, max(len(points), 1), _POINTS_AT_ONCE):
            part = points[start : start + _POINTS_AT_ONCE]
            near = self.around[neighbours.indices[start : start + _POINTS_AT_ONCE, 0]]
            distances = (vertices[near] - part[:, None]).square().sum(-1)
            closest = distances.topk(2, dim=1, largest=False).indices
            faces = self.incident[near.gather(1, closest)].flatten(1)
            away = part[:, None] - first[faces]
            u = (away * dual_along[faces]).sum(-1).clamp_min(0)
            v = (away * dual_across[faces]).sum(-1).clamp_min(0)
            total = (u + v).clamp_min(1)
            u, v = u / total, v / total
            off = away - u[..., None] * along[faces] - v[..., None] * across[faces]
            best = off.square().sum(-1).argmin(1, keepdim=True)
            u, v = u.gather(1, best), v.gather(1, best)
            found.append(faces.gather(1, best)[:, 0])
            weights.append(torch.cat([1 - u - v, u, v], dim=1))
        return torch.cat(found), torch.cat(weights)


def detailed(
    albedo: Float[Tensor, "points 3"], residual: Float[Tensor, "points 3"]
) -> Float[Tensor, "points 3"]:
    """Albedo times the factor that a texture holds the logarithm of; still at most 1."""
    return (albedo * residual.exp()).clamp_max(1)


def texture_at(
    texels: Float[Tensor, "size size channels"], places: Float[Tensor, "points 2"]
) -> Float[Tensor, "points channels"]:
    """A texture at places (u, v) of [0, 1], between texels linear, beyond its border as there."""
    size = len(texels)
    position = places * size - 0.5
    lower = position.floor()
    share = position - lower
    column, row = lower.long().unbind(-1)
    left, right = column.clamp(0, size - 1), (column + 1).clamp(0, size - 1)
    top, bottom = row.clamp(0, size - 1) * size, (row + 1).clamp(0, size - 1) * size
    indices = torch.stack([top + left, top + right, bottom + left, bottom + right], dim=1)
    x, y = share.unbind(-1)
    weights = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], dim=1)
    return Neighbours(indices, weights).interpolated(texels.flatten(0, 1))


def vertices_around(rig: Rig, anchors: SurfacePoints) -> Int[Tensor, "anchors around"]:
    """The vertices that are nearest to each anchor on the template, several times its share."""
    count = max(_FEWEST_AROUND, -(-_AROUND * rig.num_vertices // len(anchors.faces)))
    count = min(count, rig.num_vertices)
    places = anchors.positions(rig.template_vertices).cpu()
    _, found = cKDTree(rig.template_vertices.cpu().numpy()).query(places.numpy(), k=count)
    around = torch.from_numpy(found.astype("int64")).reshape(-1, count)
    return around.to(rig.faces.device)


def incident_faces(rig: Rig) -> Int[Tensor, "vertices most"]:
    """The faces at each vertex; where there are fewer than at others, its first one again."""
    vertices = rig.faces.flatten().cpu()
    order = vertices.argsort(stable=True)
    counts = torch.bincount(vertices, minlength=rig.num_vertices)
    begin = counts.cumsum(0) - counts
    rank = torch.arange(int(counts.max())).expand(rig.num_vertices, -1)
    rank = torch.where(rank < counts[:, None], rank, 0)
    # A vertex of no face is nearest to nothing; it stands for any.
    place = (begin[:, None] + rank).clamp_max(len(order) - 1)
    return torch.div(order[place], 3, rounding_mode="floor").to(rig.faces.device)


def _dual_sides(
    along: Float[Tensor, "faces 3"], across: Float[Tensor, "faces 3"]
) -> tuple[Float[Tensor, "faces 3"], Float[Tensor, "faces 3"]]:
    """Vectors whose products with a place in a face are its two barycentric coordinates."""
    long, wide = along.square().sum(-1), across.square().sum(-1)
    mixed = (along * across).sum(-1)
    area = (long * wide - mixed.square()).clamp_min(torch.finfo(long.dtype).tiny)[:, None]
    first = (wide[:, None] * along - mixed[:, None] * across) / area
    second = (long[:, None] * across - mixed[:, None] * along) / area
    return first, second
