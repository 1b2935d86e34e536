"""Which part of the sky a point sees: one depth picture of the mesh from every direction of light.

Shadows of distant light depend on pose and light alone, not on who looks. Seen from the light, a
mesh hides what lies behind its nearest surface: a z-buffer per direction answers for all points at
once, on any device, and costs a hand some milliseconds.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.errors import ArgumentError
from handavatar.geometry.cameras import look_at
from handavatar.render.rasterize import rasterize_projected

SIZE = 128
"""Pixels along a side of a depth picture: 1 to 2 mm each on a hand."""
LIFT = 1.5e-3
"""Points are looked at so far above their surface, metres; the mesh may be off by that."""
SLACK = 1e-3
"""Depths that differ by less, metres, are the same surface."""
_DISTANCE = 20.0
"""Of the cameras, metres: far enough for parallel rays (0.3 degrees across a hand)."""


def even_directions(count: int) -> Float[Tensor, "count 3"]:
    """Unit vectors spread evenly over the sphere (a Fibonacci lattice).

    Raises:
        ValueError: if there is to be none.
    """
    if count < 1:
        raise ArgumentError("count", str(count), "at least 1")
    number = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * number / count
    turn = number * math.pi * (3 - math.sqrt(5))
    radius = (1 - height.square()).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], dim=-1).float()


@torch.no_grad()
def sky_light(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    directions: Float[Tensor, "directions 3"],
) -> Float[Tensor, "points directions"]:
    """What a light of strength one in each direction brings to each point: cosine times visibility.

    Visibility is the share of the four depths around a point that do not hide it, by bilinear
    weights, so that shadows end softly over a pixel of the depth picture.

    Args:
        vertices: of what casts shadows, metres, world.
        faces: either winding; both sides hide.
        points: on or near the surface, metres.
        normals: unit, of the surface at the points.
        directions: unit, towards the lights.
    """
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    focal = SIZE / 2 * _DISTANCE / (1.02 * (vertices - middle).norm(dim=-1).max())
    lifted = points + LIFT * normals
    light = points.new_zeros(len(points), len(directions))
    # A GPU draws all pictures at once; a core's cache holds one.
    at_once = 1 if points.device.type == "cpu" else max(len(directions), 1)
    for start in range(0, len(directions), at_once):
        part = directions[start : start + at_once]
        views = look_at(middle + _DISTANCE * part, middle, _across(part))
        hidden_behind = _depth_pictures(vertices, faces, views, focal) + SLACK
        cosine = normals @ part.T
        point, number = (cosine > 0).nonzero().unbind(-1)
        rotation, shift = views[:, :3, :3], views[:, :3, 3]
        in_camera = torch.einsum("pij,pj->pi", rotation[number], lifted[point]) + shift[number]
        share = _lit_share(hidden_behind, number, _in_picture(in_camera, focal), in_camera[:, 2])
        light[point, start + number] = cosine[point, number] * share
    return light


def _across(directions: Float[Tensor, "directions 3"]) -> Float[Tensor, "directions 3"]:
    """An axis that no direction is near to."""
    return torch.nn.functional.one_hot(directions.abs().argmin(-1), 3).to(directions)


def _in_picture(
    in_camera: Float[Tensor, "*batch 3"], focal: Float[Tensor, ""]
) -> Float[Tensor, "*batch 2"]:
    return in_camera[..., :2] / in_camera[..., 2:] * focal + SIZE / 2


def _depth_pictures(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    views: Float[Tensor, "views 4 4"],
    focal: Float[Tensor, ""],
) -> Float[Tensor, "views size size"]:
    """A depth picture of the mesh from each view, all drawn as one, below each other."""
    in_camera = vertices @ views[:, :3, :3].mT + views[:, None, :3, 3]
    number = torch.arange(len(views), device=vertices.device)
    pixels = _in_picture(in_camera, focal).double()
    pixels[..., 1] += SIZE * number[:, None]
    all_faces = (faces + len(vertices) * number[:, None, None]).flatten(0, 1)
    drawn = rasterize_projected(
        pixels.flatten(0, 1), in_camera[..., 2].flatten(), all_faces, SIZE, SIZE * len(views)
    )
    return drawn.depth.unflatten(0, (len(views), SIZE))


def _lit_share(
    hidden_behind: Float[Tensor, "views size size"],
    views: Int[Tensor, "points"],
    places: Float[Tensor, "points 2"],
    depths: Float[Tensor, "points"],
) -> Float[Tensor, "points"]:
    """How much of the four depths around a place of a view's picture does not hide a point."""
    corner = (places - 0.5).floor()
    share = places - 0.5 - corner
    column, row = corner.long().unbind(-1)
    total = torch.zeros_like(depths)
    for right in (0, 1):
        for down in (0, 1):
            x, y = (column + right).clamp(0, SIZE - 1), (row + down).clamp(0, SIZE - 1)
            weight = (share[:, 0] if right else 1 - share[:, 0]) * (
                share[:, 1] if down else 1 - share[:, 1]
            )
            total += weight * (depths <= hidden_behind[views, y, x])
    return total
