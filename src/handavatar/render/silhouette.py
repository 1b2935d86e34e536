"""Differentiable silhouette of a mesh, and the loss that fits it to a mask.

Image positions and distances in pixels, pixel centres at +0.5.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.geometry.cameras import Camera, project
from handavatar.render.rasterize import NEAR_PLANE, pixels_in_boxes, rasterize

WINDOW = 3.0
"""In units of the softness: farther from the outline the coverage is 0 or 1, which is wrong by
at most ``sigmoid(-WINDOW ** 2)`` = 1.2e-4."""

# A straight outline through the pixel grid leaves an uncovered centre at most this far behind it.
_GRID_STEP = 1.0


def soft_silhouette(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    camera: Camera,
    softness: float = 1.0,
) -> Float[Tensor, "height width"]:
    """Coverage of each pixel by the mesh: ``sigmoid(sign * distance ** 2 / softness ** 2)``.

    The distance runs from the pixel's centre to the outline of the whole projected mesh, positive
    inside: coverage exceeds 0.5 just where :func:`rasterize` finds a face, however fine the mesh
    is. Outside, the value is exact up to the error of ``WINDOW``. Inside, an edge that another
    part of the mesh hides may stand for an outline at most one pixel farther away.

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
    radius = WINDOW * softness
    margin = math.ceil(radius + _GRID_STEP) + 1
    width, height = camera.width, camera.height
    padded = camera.cropped(-margin, -margin, width + 2 * margin, height + 2 * margin)
    covered = rasterize(vertices, faces, padded).mask
    pixels, depths = project(camera, vertices)
    edges = _contour_edges(pixels.detach(), depths.detach(), faces)
    pixel, edge = _nearest_edges(pixels.detach()[edges], covered, margin, radius, width, height)

    inside = covered[margin : margin + height, margin : margin + width].reshape(-1)
    centers = torch.stack([pixel % width, torch.div(pixel, width, rounding_mode="floor")], dim=-1)
    squared = _squared_distance(centers.to(pixels) + 0.5, pixels[edges[edge]])
    sign = torch.where(inside[pixel], 1.0, -1.0).to(squared)
    soft = torch.sigmoid(sign * squared / softness**2)
    return inside.to(soft).index_put((pixel,), soft).reshape(height, width)


def silhouette_loss(
    coverage: Float[Tensor, "*pixels"], mask: Bool[Tensor, "*pixels"]
) -> Float[Tensor, ""]:
    """One minus the soft intersection over union; 0 if both are empty.

    To leave pixels out, such as those below the wrist, index both arguments alike.

    Source: paper Sec. 3.1, L_shape.
    """
    intersection = coverage[mask].sum()
    union = coverage.sum() + mask.sum() - intersection
    return 1 - intersection / union if bool(union > 0) else union


def _contour_edges(
    pixels: Float[Tensor, "vertices 2"],
    depths: Float[Tensor, "vertices"],
    faces: Int[Tensor, "faces 3"],
) -> Int[Tensor, "edges 2"]:
    """Edges that end the front side or the back side of the mesh as seen in the image.

    They contain the outline; the rest of them lies hidden inside it.
    """
    a, b, c = pixels[faces].unbind(1)
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    side = torch.where((depths[faces] > NEAR_PLANE).all(-1), area.sign(), 0).long()
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=-1).values
    keys, index = torch.unique(ends[:, 0] * len(pixels) + ends[:, 1], return_inverse=True)
    num_front, num_back = (
        torch.zeros_like(keys).index_add(0, index, has_side.long().repeat(3))
        for has_side in (side > 0, side < 0)
    )
    contour = keys[(num_front == 1) | (num_back == 1)]
    first = torch.div(contour, len(pixels), rounding_mode="floor")
    return torch.stack([first, contour - first * len(pixels)], dim=-1)


def _nearest_edges(
    segments: Float[Tensor, "edges 2 2"],
    covered: Bool[Tensor, "padded_height padded_width"],
    margin: int,
    radius: float,
    width: int,
    height: int,
) -> tuple[Int[Tensor, "pixels"], Int[Tensor, "pixels"]]:
    """For each pixel within the radius of the outline, the edge that is nearest to it.

    Returns:
        Flat pixel indices, each once, and indices of edges.
    """
    nearest = torch.full(
        (height * width,),
        torch.iinfo(torch.int64).max,
        dtype=torch.int64,
        device=segments.device,
    )
    to_empty = _distance_to_empty(covered, margin, radius + _GRID_STEP)
    lower, upper = segments.amin(1) - radius, segments.amax(1) + radius
    for edge, x, y in pixels_in_boxes(lower, upper, width, height):
        pixel = y * width + x
        squared = _squared_distance(torch.stack([x, y], -1).to(segments) + 0.5, segments[edge])
        # No outline lies much nearer than the nearest uncovered pixel: the edge is a hidden one.
        hidden = squared < (to_empty[pixel] - _GRID_STEP).clamp_min(0).square()
        kept = (squared <= radius**2) & ~hidden
        key = (squared[kept].float().view(torch.int32).long() << 32) | edge[kept]
        nearest.scatter_reduce_(0, pixel[kept], key, "amin")
    pixel = (nearest != torch.iinfo(torch.int64).max).nonzero()[:, 0]
    return pixel, nearest[pixel] & 0xFFFFFFFF


def _distance_to_empty(
    covered: Bool[Tensor, "padded_height padded_width"], margin: int, limit: float
) -> Float[Tensor, "pixels"]:
    """Distance from each covered pixel to the nearest uncovered one, at most the limit."""
    height, width = covered.shape[0] - 2 * margin, covered.shape[1] - 2 * margin
    distance = torch.full((height, width), limit, device=covered.device)
    reach = range(-math.floor(limit), math.floor(limit) + 1)
    for step in ((x, y) for y in reach for x in reach if math.hypot(x, y) < limit):
        top, left = margin + step[1], margin + step[0]
        shifted = covered[top : top + height, left : left + width]
        distance = torch.where(shifted, distance, distance.clamp_max(math.hypot(*step)))
    return distance.reshape(-1)


def _squared_distance(
    points: Float[Tensor, "pairs 2"], segments: Float[Tensor, "pairs 2 2"]
) -> Float[Tensor, "pairs"]:
    """Squared distance of each point to its segment."""
    start, end = segments.unbind(1)
    along = end - start
    length = along.square().sum(-1)
    ratio = ((points - start) * along).sum(-1) / length.clamp_min(1e-12)
    foot = start + ratio.clamp(0, 1)[:, None] * along
    return (points - foot).square().sum(-1)
