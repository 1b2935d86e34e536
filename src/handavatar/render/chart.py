"""Texture charts: whether one serves, an atlas where none does, and what each texel shows."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import face_cross_products
from handavatar.hand.detail import subdivided
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import rasterize

_JUDGED_AT = 1024
"""Texels along a side where a chart is judged."""
_LARGEST_OVERLAP = 0.01
_LEAST_DENSITY = 0.1
_LEAST_SHARE = 0.97
_GAP = 0.06
"""Room around an atlas's triangles, in cells: two texels and a half where a cell has forty."""


@dataclass(frozen=True, eq=False)
class Texels:
    """The texels whose centre a chart covers.

    Attributes:
        size: texels along a side of the texture.
        rows: of each, from the top.
        columns: of each.
        faces: face of the rig that each shows.
        barycentric: where on the face.
    """

    size: int
    rows: Int[Tensor, "texels"]
    columns: Int[Tensor, "texels"]
    faces: Int[Tensor, "texels"]
    barycentric: Float[Tensor, "texels 3"]

    def filled(self, values: Float[Tensor, "texels channels"]) -> Float[Tensor, "size size _"]:
        """A picture of values; beyond the chart each texel repeats the nearest one of the chart.

        So no border shows, however coarsely a renderer samples the texture.
        """
        picture = values.new_zeros(self.size, self.size, values.shape[1])
        picture[self.rows, self.columns] = values
        is_empty = np.ones((self.size, self.size), dtype=bool)
        is_empty[self.rows.numpy(), self.columns.numpy()] = False
        nearest = ndimage.distance_transform_edt(
            is_empty, return_distances=False, return_indices=True
        )
        row, column = torch.from_numpy(nearest.astype(np.int64))
        return picture[row, column]


def texels_of(rig: Rig, size: int) -> Texels:
    """Which face lies under each texel of a square texture.

    Args:
        rig: with a chart; row ``i`` and column ``j`` lie at ``v = (i + 0.5) / size`` and
            ``u = (j + 0.5) / size``.
        size: texels along a side.
    """
    # A camera that sees the chart as it is: pixels are texels, all depths are one.
    flat = torch.cat([rig.uv_coordinates, torch.ones(len(rig.uv_coordinates), 1)], dim=-1)
    camera = Camera((float(size),) * 2, (0.0, 0.0), size, size, torch.eye(4))
    fragments = rasterize(flat, rig.uv_faces, camera)
    rows, columns = fragments.mask.nonzero().unbind(-1)
    faces = fragments.face_index[rows, columns]
    return Texels(size, rows, columns, faces, fragments.barycentric[rows, columns])


def is_fair(rig: Rig) -> bool:
    """Whether a chart can carry a texture: no two faces on one texel, none that is all but lost."""
    corners = rig.uv_coordinates[rig.uv_faces].double()
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).abs() / 2
    covered = len(texels_of(rig, _JUDGED_AT).faces) / _JUDGED_AT**2
    on_skin = face_cross_products(rig.template_vertices, rig.faces).norm(dim=-1).double()
    density = (areas / areas.sum()) / (on_skin / on_skin.sum()).clamp_min(1e-12)
    is_dense = density > _LEAST_DENSITY
    share = float((on_skin * is_dense).sum() / on_skin.sum())
    return float(areas.sum()) < (1 + _LARGEST_OVERLAP) * covered and share > _LEAST_SHARE


def packed_atlas(num_faces: int) -> tuple[Float[Tensor, "uvs 2"], Int[Tensor, "faces 3"]]:
    """An atlas of separate triangles, two in each cell of a square grid: any mesh has one.

    Returns:
        Texture coordinates, three a face, and which are whose.
    """
    cells = -(-num_faces // 2)
    side = int(np.ceil(np.sqrt(cells)))
    cell = torch.arange(num_faces) // 2
    is_second = (torch.arange(num_faces) % 2).bool()[:, None, None]
    least, most = _GAP, 1 - 2.5 * _GAP
    lower = torch.tensor([[least, least], [most, least], [least, most]])
    corners = torch.where(is_second, 1 - lower, lower)
    origin = torch.stack([cell % side, torch.div(cell, side, rounding_mode="floor")], dim=-1)
    places = (origin[:, None] + corners) / side
    return places.reshape(-1, 2), torch.arange(3 * num_faces).view(-1, 3)


def charted(base: Rig, fine: Rig, rounds: int) -> Rig:
    """The fine rig with a chart that can carry a texture: its own, or an atlas.

    Args:
        base: before subdivision.
        fine: after it.
        rounds: of midpoint subdivision; an atlas has a triangle for each face of the base.
    """
    if is_fair(base):
        return fine
    coordinates, corners = packed_atlas(len(base.faces))
    atlas = subdivided(replace(base, uv_coordinates=coordinates, uv_faces=corners), rounds)
    return replace(fine, uv_coordinates=atlas.uv_coordinates, uv_faces=atlas.uv_faces)
