"""Which pixels a mesh covers, as a Triton kernel; see :mod:`handavatar.render.fused_rays`."""

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar.geometry.cameras import Camera, project
from handavatar.render.rasterize import NEAR_PLANE

_FACES = 32
"""At a time in one program."""


@triton.jit
def _corner(faces, pixels, depths, face, number, is_face):
    vertex = tl.load(faces + 3 * face + number, mask=is_face, other=0)
    x = tl.load(pixels + 2 * vertex).to(tl.float64)
    y = tl.load(pixels + 2 * vertex + 1).to(tl.float64)
    return x, y, tl.load(depths + vertex)


@triton.jit
def _first_and_end(least, most, size):
    """Pixels whose centres lie between two places, as far as there are pixels."""
    first = tl.minimum(tl.maximum(tl.ceil(least - 0.5), 0.0), size).to(tl.int32)
    end = tl.minimum(tl.maximum(tl.floor(most - 0.5) + 1, 0.0), size).to(tl.int32)
    return first, tl.maximum(end, first)


@triton.jit(do_not_specialize=["count", "width", "height"])
def _covered(
    pixels, depths, faces, covered, count, width, height, nearest, BLOCK: tl.constexpr
):  # fmt: skip
    face = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_face = face < count
    x0, y0, depth0 = _corner(faces, pixels, depths, face, 0, is_face)
    x1, y1, depth1 = _corner(faces, pixels, depths, face, 1, is_face)
    x2, y2, depth2 = _corner(faces, pixels, depths, face, 2, is_face)
    # Comparisons with what is not a number are false.
    is_drawn = is_face & (depth0 > nearest) & (depth1 > nearest) & (depth2 > nearest)
    is_drawn &= (depth0 < float("inf")) & (depth1 < float("inf")) & (depth2 < float("inf"))
    left, right = tl.minimum(x0, tl.minimum(x1, x2)), tl.maximum(x0, tl.maximum(x1, x2))
    top, bottom = tl.minimum(y0, tl.minimum(y1, y2)), tl.maximum(y0, tl.maximum(y1, y2))
    column, columns_end = _first_and_end(left, right, width.to(tl.float64))
    row, rows_end = _first_and_end(top, bottom, height.to(tl.float64))
    columns = columns_end - column
    num_pixels = tl.where(is_drawn, columns * (rows_end - row), 0)
    columns = tl.maximum(columns, 1)
    for number in range(tl.max(num_pixels, axis=0)):
        x, y = column + number % columns, row + number // columns
        across, down = x.to(tl.float64) + 0.5, y.to(tl.float64) + 0.5
        u0, v0 = x0 - across, y0 - down
        u1, v1 = x1 - across, y1 - down
        u2, v2 = x2 - across, y2 - down
        first, second, third = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        is_one_sided = (first >= 0) & (second >= 0) & (third >= 0)
        is_one_sided |= (first <= 0) & (second <= 0) & (third <= 0)
        holds = is_one_sided & (first + second + third != 0) & (number < num_pixels)
        here = tl.full((BLOCK,), 1, tl.uint8)
        tl.store(covered + y * width + x, here, mask=holds)


@torch.no_grad()
def mesh_coverage(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"], camera: Camera
) -> Bool[Tensor, "height width"]:
    """As :func:`handavatar.render.rasterize.covered_pixels`.

    A pixel's centre that lies on an edge, to the last bit, may be missed.

    Args:
        vertices: metres, world.
        faces: either winding.
        camera: the view.
    """
    pixels, depths = project(camera, vertices)
    covered = torch.zeros(camera.height, camera.width, dtype=torch.uint8, device=vertices.device)
    if len(faces):
        _covered[(triton.cdiv(len(faces), _FACES),)](
            pixels.contiguous(), depths.contiguous(), faces.contiguous(), covered, len(faces),
            camera.width, camera.height, NEAR_PLANE, BLOCK=_FACES,
        )  # fmt: skip
    return covered.bool()
