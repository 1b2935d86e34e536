"""Which part of the sky a point sees: one depth picture of the mesh from every direction of light.

Shadows of distant light depend on pose and light alone, not on who looks. Seen from the light, a
mesh hides what lies behind its nearest surface: a z-buffer per direction answers for all points at
once, on any device, and costs a hand some milliseconds.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.cameras import Camera, look_at, project
from handavatar.render.rasterize import rasterize

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
        raise ValueError(f"even_directions: found {count}, expected at least 1")
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
    light = points.new_zeros(len(points), len(directions))
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    reach = 1.02 * float((vertices - middle).norm(dim=-1).max())
    lifted = points + LIFT * normals
    for number, direction in enumerate(directions):
        cosine = normals @ direction
        facing = (cosine > 0).nonzero()[:, 0]
        camera = _camera_from(direction, middle, reach)
        nearest = rasterize(vertices, faces, camera).depth
        pixels, depths = project(camera, lifted[facing])
        hidden_behind = nearest.flatten() + SLACK
        light[facing, number] = cosine[facing] * _lit_share(hidden_behind, pixels, depths)
    return light


def _camera_from(direction: Float[Tensor, "3"], middle: Float[Tensor, "3"], reach: float) -> Camera:
    up = torch.zeros_like(direction)
    up[direction.abs().argmin()] = 1
    focal = SIZE / 2 * _DISTANCE / reach
    pose = look_at(middle + _DISTANCE * direction, middle, up)
    return Camera((focal, focal), (SIZE / 2, SIZE / 2), SIZE, SIZE, pose)


def _lit_share(
    hidden_behind: Float[Tensor, "pixels"],
    places: Float[Tensor, "points 2"],
    depths: Float[Tensor, "points"],
) -> Float[Tensor, "points"]:
    corner = (places - 0.5).floor()
    share = places - 0.5 - corner
    total = torch.zeros_like(depths)
    for right in (0, 1):
        for down in (0, 1):
            x, y = (corner + corner.new_tensor([right, down])).long().clamp(0, SIZE - 1).unbind(-1)
            weight = (share[:, 0] if right else 1 - share[:, 0]) * (
                share[:, 1] if down else 1 - share[:, 1]
            )
            total += weight * (depths <= hidden_behind[y * SIZE + x])
    return total
