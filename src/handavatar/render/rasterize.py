"""Hard rasterisation: which face each pixel sees, without gradient.

Image positions in pixels, pixel centres at +0.5, depths in metres along the optical axis.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.geometry.cameras import Camera, project

NEAR_PLANE = 1e-4
"""Metres; a face with a vertex at this depth or nearer is not drawn (nothing is clipped)."""

_PAIRS_AT_ONCE = 1 << 21


@dataclass(frozen=True, eq=False)
class Fragments:
    """The nearest surface point behind each pixel centre.

    Attributes:
        face_index: which face, -1 where there is none.
        depth: metres along the optical axis, infinity where there is no face.
        barycentric: perspective-correct weights of the face's corners: they interpolate
            quantities that are linear on the surface in space. Zero where there is no face.
    """

    face_index: Int[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    barycentric: Float[Tensor, "height width 3"]

    @property
    def mask(self) -> Bool[Tensor, "height width"]:
        """Pixels whose centre some face covers."""
        return self.face_index >= 0


@torch.no_grad()
def rasterize(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], camera: Camera
) -> Fragments:
    """Z-buffer of a mesh, both sides of its faces.

    A face covers a pixel if the pixel's centre lies in its closed projection; of several faces
    the nearest wins, of equally near ones (to float32) the first. Neighbouring faces leave no
    gap: the test of a shared edge is antisymmetric to the last bit. Faces without projected area,
    faces that reach ``NEAR_PLANE`` and faces with a vertex that is not finite are skipped.

    Args:
        vertices: metres, world.
        faces: either winding.
        camera: the view.
    """
    pixels, depths = project(camera, vertices)
    return rasterize_projected(pixels, depths, faces, camera.width, camera.height)


@torch.no_grad()
def rasterize_projected(
    pixels: Float[Tensor, "vertices 2"],
    depths: Float[Tensor, "vertices"],
    faces: Int[Tensor, "faces 3"],
    width: int,
    height: int,
) -> Fragments:
    """:func:`rasterize` of vertices that are projected already.

    Args:
        pixels: image positions, of 32 or 64 bits.
        depths: metres along the optical axis; their precision is that of the result.
        faces: either winding.
        width: of the image, pixels.
        height: of the image, pixels.
    """
    corners, corner_depths = pixels.double()[faces], depths.double()[faces]
    nearest = torch.full(
        (height * width,),
        torch.iinfo(torch.int64).max,
        dtype=torch.int64,
        device=depths.device,
    )
    drawn = is_before_camera(corner_depths).nonzero()[:, 0]
    lower, upper = corners[drawn].amin(1), corners[drawn].amax(1)
    for row, x, y in pixels_in_boxes(lower, upper, width, height):
        face = drawn[row]
        weights, covers = weights_in_image(corners[face], torch.stack([x, y], dim=-1) + 0.5)
        face, x, y = face[covers], x[covers], y[covers]
        depth = 1 / (weights[covers] / corner_depths[face]).sum(-1)
        # Positive floats order like their bits: one integer holds depth first, then the face.
        key = (depth.float().view(torch.int32).long() << 32) | face
        nearest.scatter_reduce_(0, y * width + x, key, "amin")
    return _fragments(nearest, corners, corner_depths, (height, width), depths.dtype)


@torch.no_grad()
def covered_pixels(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], camera: Camera
) -> Bool[Tensor, "height width"]:
    """The mask of :func:`rasterize`, without asking which face is the nearest.

    Args:
        vertices: metres, world.
        faces: either winding.
        camera: the view.
    """
    pixels, depths = project(camera, vertices)
    corners = pixels.double()[faces[is_before_camera(depths.double()[faces])]]
    covered = torch.zeros(camera.height * camera.width, dtype=torch.bool, device=pixels.device)
    lower, upper = corners.amin(1), corners.amax(1)
    for face, x, y in pixels_in_boxes(lower, upper, camera.width, camera.height):
        holds = holds_in_image(corners[face], torch.stack([x, y], dim=-1) + 0.5)
        covered[(y * camera.width + x)[holds]] = True
    return covered.view(camera.height, camera.width)


def interpolate(
    fragments: Fragments,
    faces: Int[Tensor, "faces 3"],
    vertex_values: Float[Tensor, "vertices channels"],
) -> Float[Tensor, "height width channels"]:
    """Per-vertex values at the surface points that the pixels see; zero where there is none.

    Differentiable in the values, not in the position of the surface.
    """
    corner_values = vertex_values[faces[fragments.face_index.clamp_min(0)]]
    weights = fragments.barycentric.to(vertex_values.dtype)
    return (corner_values * weights[..., None]).sum(-2)


def is_before_camera(corner_depths: Float[Tensor, "faces 3"]) -> Bool[Tensor, "faces"]:
    """Faces whose corners all lie beyond ``NEAR_PLANE``, at a finite depth."""
    return ((corner_depths > NEAR_PLANE) & (corner_depths < torch.inf)).all(-1)


def pixels_in_boxes(
    lower: Float[Tensor, "boxes 2"], upper: Float[Tensor, "boxes 2"], width: int, height: int
) -> Iterator[tuple[Int[Tensor, "pairs"], Int[Tensor, "pairs"], Int[Tensor, "pairs"]]]:
    """Every box of the image plane paired with every pixel whose centre lies in it.

    Work is proportional to the number of pairs, however unequal the boxes are.

    Args:
        lower: smallest (x, y) of each box, pixels; must be finite.
        upper: largest (x, y).
        width: image width; the boxes are clipped to the image.
        height: image height.

    Yields:
        Batches of (box, x, y), so that few pairs are in memory at once.
    """
    first, end = pixel_ranges(lower, upper, width, height)
    extent = end - first
    box = (extent.prod(-1) > 0).nonzero()[:, 0]
    first, extent = first[box], extent[box]
    count = extent.prod(-1)
    batch = (count.cumsum(0) - count) // _PAIRS_AT_ONCE
    start = 0
    for length in torch.unique_consecutive(batch, return_counts=True)[1].tolist():
        chosen = slice(start, start + length)
        start += length
        row, rank = numbered_copies(count[chosen])
        columns = extent[chosen][row, 0]
        x = first[chosen][row, 0] + rank % columns
        y = first[chosen][row, 1] + torch.div(rank, columns, rounding_mode="floor")
        yield box[chosen][row], x, y


def pixel_ranges(
    lower: Float[Tensor, "boxes 2"], upper: Float[Tensor, "boxes 2"], width: int, height: int
) -> tuple[Int[Tensor, "boxes 2"], Int[Tensor, "boxes 2"]]:
    """The first column and row of the pixels whose centres lie in each box, and those after them.

    Args:
        lower: smallest (x, y) of each box, pixels; what is not a number makes an empty box.
        upper: largest (x, y).
        width: image width; the boxes are clipped to the image.
        height: image height.
    """
    size = lower.new_tensor([width, height])
    # Clamped once more as integers, which numbers that are none become.
    first = (lower - 0.5).ceil().clamp_min(0).minimum(size).long().clamp_min(0)
    end = ((upper - 0.5).floor() + 1).clamp_min(0).minimum(size).long()
    return first, end.maximum(first)


def numbered_copies(
    counts: Int[Tensor, "items"],
) -> tuple[Int[Tensor, "copies"], Int[Tensor, "copies"]]:
    """Each index as often as its count says, and the running number of each copy from 0."""
    item = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    begin = counts.cumsum(0) - counts
    return item, torch.arange(len(item), device=counts.device) - begin[item]


def weights_in_image(
    corners: Float[Tensor, "pairs 3 2"], points: Float[Tensor, "pairs 2"]
) -> tuple[Float[Tensor, "pairs 3"], Bool[Tensor, "pairs"]]:
    """Barycentric weights, linear in the image, and whether the closed triangle holds the point.

    Triangles without area hold nothing. Weights of points outside have no meaning.
    """
    doubled_areas = _doubled_areas(corners, points)
    total = doubled_areas.sum(-1)
    holds = _holds(doubled_areas, total)
    return doubled_areas / torch.where(holds, total, 1.0)[:, None], holds


def holds_in_image(
    corners: Float[Tensor, "pairs 3 2"], points: Float[Tensor, "pairs 2"]
) -> Bool[Tensor, "pairs"]:
    """Whether the closed triangle holds the point; the second of :func:`weights_in_image`."""
    doubled_areas = _doubled_areas(corners, points)
    return _holds(doubled_areas, doubled_areas.sum(-1))


def _doubled_areas(
    corners: Float[Tensor, "pairs 3 2"], points: Float[Tensor, "pairs 2"]
) -> Float[Tensor, "pairs 3"]:
    """Of the triangles that the point makes with each side, with sign."""
    (x0, x1, x2), (y0, y1, y2) = (corners - points[:, None]).permute(2, 1, 0)
    return torch.stack([x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0], dim=-1)


def _holds(
    doubled_areas: Float[Tensor, "pairs 3"], total: Float[Tensor, "pairs"]
) -> Bool[Tensor, "pairs"]:
    is_one_sided = (doubled_areas.amin(-1) >= 0) | (doubled_areas.amax(-1) <= 0)
    return is_one_sided & (total != 0)


def _fragments(
    nearest: Int[Tensor, "pixels"],
    corners: Float[Tensor, "faces 3 2"],
    corner_depths: Float[Tensor, "faces 3"],
    shape: tuple[int, int],
    dtype: torch.dtype,
) -> Fragments:
    """Depth and weights of the winning faces, computed once more at full precision."""
    pixel = (nearest != torch.iinfo(torch.int64).max).nonzero()[:, 0]
    face = nearest[pixel] & 0xFFFFFFFF
    x = pixel % shape[1]
    y = torch.div(pixel, shape[1], rounding_mode="floor")
    weights, _ = weights_in_image(corners[face], torch.stack([x, y], dim=-1) + 0.5)
    per_depth = weights / corner_depths[face]
    inverse_depth = per_depth.sum(-1)
    face_index = torch.full_like(nearest, -1)
    face_index[pixel] = face
    depth = torch.full((len(nearest),), torch.inf, dtype=dtype, device=nearest.device)
    depth[pixel] = (1 / inverse_depth).to(dtype)
    barycentric = torch.zeros(len(nearest), 3, dtype=dtype, device=nearest.device)
    barycentric[pixel] = (per_depth / inverse_depth[:, None]).to(dtype)
    return Fragments(
        face_index.reshape(shape), depth.reshape(shape), barycentric.reshape(*shape, 3)
    )
