"""Differentiable silhouette of a mesh, and the loss that fits it to a mask.

Image positions and distances in pixels, pixel centres at +0.5.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, distance_transform_edt
from torch import Tensor
from torch.nn.functional import interpolate

from handavatar.geometry.cameras import Camera, project
from handavatar.render.rasterize import (
    covered_pixels,
    is_before_camera,
    numbered_copies,
    pixels_in_boxes,
)

WINDOW = 3.0
"""In units of the softness: farther from the outline the coverage is 0 or 1, which is wrong by
at most ``sigmoid(-WINDOW ** 2)`` = 1.2e-4."""

# Pixels; the middle of a piece speaks for all of it.
_LONGEST_PIECE = 1.0
# Of one edge: a face just in front of the camera plane projects to millions of pixels.
_MOST_PIECES = 4096
# Pixels; how far beside a contour is looked for other parts of the mesh.
_STEP_ACROSS = 0.01


def soft_silhouette(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    camera: Camera,
    softness: float = 1.0,
) -> Float[Tensor, "height width"]:
    """Coverage of each pixel by the mesh: ``sigmoid(sign * distance ** 2 / softness ** 2)``.

    The distance runs from the pixel's centre to the outline of the whole projected mesh; the sign
    is positive where :func:`rasterize` finds a face. Errors: that of ``WINDOW``; and inside, where
    one part of the mesh passes behind another, the ends of the outline are known to half a pixel.

    Differentiable in the vertices at the ends of the outline's edges. Only pixels within
    ``WINDOW * softness`` of the outline carry gradient; under :func:`silhouette_loss` all of these
    push towards the mask, however far its border is.

    Args:
        vertices: metres, world.
        faces: consistently wound; the mesh may be open.
        camera: the view.
        softness: pixels; about 1 lets every stretch of the outline meet some pixels.

    Source: paper Sec. 3.1, the silhouette rendering D of the shape loss.
    Departs: SoftRas multiplies ``1 - sigmoid`` over all faces, which swells the silhouette as the
        mesh gets finer: with softness 1 and faces of one pixel the half level lies 1.8 pixels
        outside the mesh, and a fitted finger becomes too thin by twice that. Here the projected
        mesh counts as one polygon; for a single triangle both are equal.
    """
    width, height = camera.width, camera.height
    covered = covered_pixels(vertices, faces, camera).reshape(-1)
    pixels, depths = project(camera, vertices)
    seen = faces[is_before_camera(depths[faces])]
    outline = _outline(pixels.detach(), seen, WINDOW * softness, width, height)
    pixel, piece = _nearest_pieces(outline, pixels.detach(), WINDOW * softness, width, height)

    centers = torch.stack([pixel % width, torch.div(pixel, width, rounding_mode="floor")], dim=-1)
    squared = outline.squared_distance(piece, centers.to(pixels) + 0.5, pixels)
    sign = torch.where(covered[pixel], 1.0, -1.0).to(squared)
    soft = torch.sigmoid(sign * squared / softness**2)
    return covered.to(soft).index_put((pixel,), soft).reshape(height, width)


def silhouette_loss(
    coverage: Float[Tensor, "*pixels"], mask: Float[Tensor, "*pixels"]
) -> Float[Tensor, ""]:
    """One minus the soft intersection over union; 0 if both are empty.

    To leave pixels out, such as those below the wrist, index both arguments alike.

    Args:
        coverage: of the mesh, in [0, 1].
        mask: of the picture, in [0, 1]; see :func:`soft_mask`.

    Source: paper Sec. 3.1, L_shape.
    Departs: minimum and maximum instead of product and sum less product. For a mask of zeros and
        ones both are the same; but against one a soft outline is best outside of it: by 0.35 pixels
        in a picture of 192 pixels, by 0.65 in one of 64. Against a soft mask it is best on it.
    """
    union = torch.maximum(coverage, mask).sum()
    return 1 - torch.minimum(coverage, mask).sum() / union if bool(union > 0) else union


def soft_mask(
    coverage: Float[Tensor, "height width"],
    size: int,
    softness: float = 1.0,
    known: Bool[Tensor, "height width"] | None = None,
) -> Float[Tensor, "size size"]:
    """A mask with ``size`` pixels along a side, as :func:`soft_silhouette` would cover it.

    Args:
        coverage: of each pixel by the hand, in [0, 1].
        size: pixels along a side of the result.
        softness: pixels of the result.
        known: where the coverage means anything; elsewhere the nearest known pixel speaks, and
            :func:`known_at` tells which pixels of the result may be used.
    """
    distance = interpolate(
        known_distance(coverage, known)[0][None, None],
        (size, size),
        mode="bilinear",
        antialias=True,
    )[0, 0]
    distance = distance * (size / coverage.shape[-1])
    return torch.sigmoid(-distance * distance.abs() / softness**2)


def known_at(
    coverage: Float[Tensor, "height width"],
    known: Bool[Tensor, "height width"],
    size: int,
    softness: float = 1.0,
) -> Bool[Tensor, "size size"]:
    """Which pixels of a :func:`soft_mask` follow from known pixels alone.

    All pixels that it covers are known; and the outline that softens it, if one is so near, is.

    Args:
        coverage: as there.
        known: as there.
        size: as there.
        softness: as there.
    """
    distance, has_outline = known_distance(coverage, known)
    reach = WINDOW * softness * coverage.shape[-1] / size
    usable = known & (has_outline | (distance.abs() > reach))
    shares = interpolate(usable.float()[None, None], (size, size), mode="area")[0, 0]
    return shares > 0.999


@dataclass(frozen=True, eq=False)
class OutlinePoints:
    """Points on the edges of a mesh that lie on its outline in the image.

    Attributes:
        ends: the vertices at the two ends of the point's edge.
        ratio: where on the edge it lies: 0 at the first vertex, 1 at the second.
        lengths: of the stretch of outline that it stands for, pixels.
    """

    ends: Int[Tensor, "points 2"]
    ratio: Float[Tensor, "points"]
    lengths: Float[Tensor, "points"]

    def of(self, values: Float[Tensor, "vertices channels"]) -> Float[Tensor, "points channels"]:
        """Values of the vertices, interpolated along the edges."""
        first, second = values[self.ends].unbind(1)
        return first + self.ratio[:, None] * (second - first)


@torch.no_grad()
def outline_points(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], camera: Camera
) -> OutlinePoints:
    """A point on every pixel's length of the outline of the whole projected mesh.

    Args:
        vertices: metres, world.
        faces: consistently wound; the mesh may be open.
        camera: the view; parts outside the picture are left out.
    """
    pixels, depths = project(camera, vertices)
    seen = faces[is_before_camera(depths[faces])]
    pieces = _outline(pixels, seen, 0.0, camera.width, camera.height)
    start, end = pieces.corners(pixels).unbind(1)
    return OutlinePoints(pieces.ends, (pieces.low + pieces.high) / 2, (end - start).norm(dim=-1))


def signed_distance(coverage: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Pixels from each pixel's centre to the outline of what covers them, negative inside.

    A pixel that is covered in part tells by how much where the outline passes it; with none such,
    it runs between the pixels. Without an outline it is nowhere near: plus or minus the
    picture's size.

    Args:
        coverage: in [0, 1].
    """
    distance, _ = _distance_and_nearest(coverage.cpu().numpy())
    return torch.from_numpy(distance).to(coverage)


def known_distance(
    coverage: Float[Tensor, "height width"], known: Bool[Tensor, "height width"] | None
) -> tuple[Float[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """:func:`signed_distance`, and where it is the distance to an outline that was seen.

    What the coverage says of unknown pixels has no influence: there the mask goes on as the nearest
    known pixel has it, so that no outline runs along the end of what is known. Where the nearest
    outline lies in the unknown, or the pixel itself does, the second result is false.

    Args:
        coverage: in [0, 1].
        known: where it means anything; None for everywhere.
    """
    if known is None or bool(known.all()):
        return signed_distance(coverage), torch.ones_like(coverage, dtype=torch.bool)
    is_seen = known.cpu().numpy()
    if not is_seen.any():
        nothing = torch.zeros_like(coverage)
        return signed_distance(nothing), nothing.bool()
    beside = distance_transform_edt(~is_seen, return_distances=False, return_indices=True)
    covered = coverage.cpu().numpy()[tuple(beside)]
    covered = np.where(is_seen, covered, covered >= 0.5)
    distance, nearest = _distance_and_nearest(covered)
    # An outline beside the unknown may be its end: one pixel further in it is believed.
    is_believed = ~binary_dilation(~is_seen)
    has_outline = is_seen if nearest is None else is_seen & is_believed[tuple(nearest)]
    return (
        torch.from_numpy(distance).to(coverage),
        torch.from_numpy(has_outline).to(coverage.device),
    )


def _distance_and_nearest(
    covered: Float[np.ndarray, "height width"],
) -> tuple[Float[np.ndarray, "height width"], Int[np.ndarray, "2 height width"] | None]:
    """As :func:`signed_distance`, and the nearest pixel of the outline; None if there is none."""
    inside = covered >= 0.5
    if inside.all() or not inside.any():
        size = float(sum(covered.shape))
        return np.full(covered.shape, -size if inside.any() else size), None
    is_partial = (covered > 0) & (covered < 1)
    is_border = is_partial | ((covered == 1) & binary_dilation(covered == 0))
    away, nearest = distance_transform_edt(~is_border, return_indices=True)
    passing = 0.5 - covered[tuple(nearest)]
    return np.where(inside, passing - away, passing + away), nearest


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Stretches of edges in the image.

    Attributes:
        ends: the vertices at the two ends of the edge.
        low: where on the edge the piece begins, from 0 at its first vertex to 1 at its second.
        high: where it ends.
    """

    ends: Int[Tensor, "pieces 2"]
    low: Float[Tensor, "pieces"]
    high: Float[Tensor, "pieces"]

    def chosen(self, index: Bool[Tensor, "pieces"]) -> "_Pieces":
        return _Pieces(self.ends[index], self.low[index], self.high[index])

    def corners(self, pixels: Float[Tensor, "vertices 2"]) -> Float[Tensor, "pieces 2 2"]:
        """Begin and end of every piece."""
        start, end = pixels[self.ends].unbind(1)
        ratios = torch.stack([self.low, self.high], dim=1)[..., None]
        return start[:, None] + ratios * (end - start)[:, None]

    def squared_distance(
        self,
        piece: Int[Tensor, "pairs"],
        points: Float[Tensor, "pairs 2"],
        pixels: Float[Tensor, "vertices 2"],
    ) -> Float[Tensor, "pairs"]:
        """Of each point to its piece; differentiable in the vertices."""
        start, end = pixels[self.ends[piece]].unbind(1)
        along = end - start
        length = along.square().sum(-1).clamp_min(1e-12)
        ratio = ((points - start) * along).sum(-1) / length
        ratio = ratio.maximum(self.low[piece]).minimum(self.high[piece])
        return (start + ratio[:, None] * along - points).square().sum(-1)


def _outline(
    pixels: Float[Tensor, "vertices 2"],
    faces: Int[Tensor, "faces 3"],
    radius: float,
    width: int,
    height: int,
) -> _Pieces:
    """The pieces of contours with nothing on one side, as far as the image sees them."""
    contours = _contours(pixels, faces)
    pieces = _split(contours.ends, pixels)
    start, end = pieces.corners(pixels).unbind(1)
    limit = pixels.new_tensor([width, height]) + radius
    is_near = (start.maximum(end) > -radius) & (start.minimum(end) < limit)
    is_near = is_near[:, 0] & is_near[:, 1]
    pieces, start, end = pieces.chosen(is_near), start[is_near].double(), end[is_near].double()

    along = torch.nn.functional.normalize(end - start, dim=-1)
    across = _STEP_ACROSS * torch.stack([-along[:, 1], along[:, 0]], dim=-1)
    middle = (start + end) / 2
    is_covered = contours.cover(torch.cat([middle + across, middle - across]), pixels.double())
    first, second = is_covered.chunk(2)
    return pieces.chosen(~(first & second))


@dataclass(frozen=True, eq=False)
class _Contours:
    """Edges that end the front side or the back side of the mesh as seen in the image.

    They contain the outline; the rest of them lies hidden inside it.

    Attributes:
        ends: the vertices at the two ends.
        turns: how often the border of the front side runs along the edge from its first end to its
            second, less how often it runs back; then the same of the back side.
    """

    ends: Int[Tensor, "edges 2"]
    turns: Int[Tensor, "edges 2"]

    def cover(
        self, points: Float[Tensor, "points 2"], pixels: Float[Tensor, "vertices 2"]
    ) -> Bool[Tensor, "points"]:
        """Whether any face holds the point; a point on an edge may count either way.

        As many faces of one side hold a point as its border winds around it.

        Args:
            points: in the image.
            pixels: image positions of the vertices.
        """
        if len(points) == 0:
            return torch.zeros(0, dtype=torch.bool, device=points.device)
        top = points[:, 1].amin().floor()
        row = (points[:, 1] - top).floor().long()
        by_row = row.argsort()
        num_points = torch.bincount(row)
        first_point = num_points.cumsum(0) - num_points

        start, end = pixels[self.ends].unbind(1)
        low, high = (start[:, 1] - top).floor(), (end[:, 1] - top).floor()
        first = low.minimum(high).clamp(0, len(num_points)).long()
        last = low.maximum(high).clamp(-1, len(num_points) - 1).long()
        edge, rank = numbered_copies((last - first + 1).clamp_min(0))
        crossed = first[edge] + rank
        copy, rank = numbered_copies(num_points[crossed])
        point, edge = by_row[first_point[crossed[copy]] + rank], edge[copy]

        height = points[:, 1][point]
        is_below, is_end_below = start[:, 1][edge] <= height, end[:, 1][edge] <= height
        is_crossed = is_below != is_end_below
        point, edge, is_rising = point[is_crossed], edge[is_crossed], is_below[is_crossed]
        along, away = (end - start)[edge], points[point] - start[edge]
        turn = along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]
        # Whether a ray from the point towards larger x meets the edge, and which way that runs.
        way = torch.where(is_rising, turn > 0, turn < 0) * torch.where(is_rising, 1, -1)
        winding = way[:, None] * self.turns[edge]
        around = winding.new_zeros(len(points), 2).index_add_(0, point, winding)
        return (around[:, 0] != 0) | (around[:, 1] != 0)


def _contours(pixels: Float[Tensor, "vertices 2"], faces: Int[Tensor, "faces 3"]) -> _Contours:
    """The contours of a mesh in the image."""
    a, b, c = pixels[faces].unbind(1)
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    one, other = ends.unbind(1)
    ways = torch.where(one < other, 1, -1)
    keys, index = torch.unique(
        one.minimum(other) * len(pixels) + one.maximum(other), return_inverse=True
    )
    sides = torch.stack([area > 0, area < 0], dim=1).repeat(3, 1)
    turns = keys.new_zeros(len(keys), 2).index_add_(0, index, ways[:, None] * sides)
    is_contour = (turns[:, 0] != 0) | (turns[:, 1] != 0)
    keys = keys[is_contour]
    first = torch.div(keys, len(pixels), rounding_mode="floor")
    return _Contours(torch.stack([first, keys - first * len(pixels)], dim=-1), turns[is_contour])


def _split(edges: Int[Tensor, "edges 2"], pixels: Float[Tensor, "vertices 2"]) -> _Pieces:
    """Pieces of at most one pixel; edges of absurd length get longer ones."""
    start, end = pixels[edges].unbind(1)
    count = ((end - start).norm(dim=-1) / _LONGEST_PIECE).ceil().clamp(1, _MOST_PIECES).long()
    edge, number = numbered_copies(count)
    return _Pieces(
        edges[edge],
        number.to(pixels) / count[edge],
        (number + 1).to(pixels) / count[edge],
    )


def _nearest_pieces(
    outline: _Pieces,
    pixels: Float[Tensor, "vertices 2"],
    radius: float,
    width: int,
    height: int,
) -> tuple[Int[Tensor, "pixels"], Int[Tensor, "pixels"]]:
    """For each pixel within the radius of the outline, the piece that is nearest to it.

    Returns:
        Flat pixel indices, each once, and indices of pieces.
    """
    none = torch.iinfo(torch.int64).max
    nearest = torch.full((height * width,), none, dtype=torch.int64, device=pixels.device)
    corners = outline.corners(pixels)
    lower, upper = corners.amin(1) - radius, corners.amax(1) + radius
    for piece, x, y in pixels_in_boxes(lower, upper, width, height):
        centers = torch.stack([x, y], dim=-1).to(pixels) + 0.5
        squared = outline.squared_distance(piece, centers, pixels)
        near = squared <= radius**2
        # Positive floats order like their bits: one integer holds distance first, then the piece.
        key = (squared[near].float().view(torch.int32).long() << 32) | piece[near]
        nearest.scatter_reduce_(0, (y * width + x)[near], key, "amin")
    pixel = (nearest != none).nonzero()[:, 0]
    return pixel, nearest[pixel] & 0xFFFFFFFF
