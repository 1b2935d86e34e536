"""A mesh as a picture in grey clay, to look at its shape."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import vertex_normals
from handavatar.render.rasterize import interpolate, rasterize

_KEY = (-0.45, -0.65, -0.6)
_FILL = (0.8, 0.1, -0.6)
_CLAY = (0.82, 0.80, 0.77)
_GROUND = (1.0, 1.0, 1.0)


def shaded_mesh(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    camera: Camera,
    samples: int = 2,
    colors: Float[Tensor, "vertices 3"] | None = None,
) -> Float[Tensor, "height width 3"]:
    """The mesh under a grazing light that moves with the camera, sRGB in [0, 1], on white.

    Args:
        vertices: metres, world.
        faces: outward winding.
        camera: the view.
        samples: picture elements are averages of this many squared.
        colors: of the vertices, in place of clay.
    """
    fine = camera.resized(samples * camera.width, samples * camera.height)
    fragments = rasterize(vertices, faces, fine)
    normals = interpolate(fragments, faces, vertex_normals(vertices, faces))
    normals = torch.nn.functional.normalize(normals, dim=-1, eps=1e-20)
    normals = normals @ fine.camera_from_world[:3, :3].T
    light = torch.full(fragments.mask.shape, 0.12, dtype=normals.dtype, device=normals.device)
    for strength, towards in ((0.75, _KEY), (0.2, _FILL)):
        direction = torch.nn.functional.normalize(normals.new_tensor(towards), dim=0)
        light = light + strength * (normals @ direction).clamp_min(0)
    clay = normals.new_tensor(_CLAY)
    color = light[..., None] * (clay if colors is None else interpolate(fragments, faces, colors))
    color = torch.where(fragments.mask[..., None], color, normals.new_tensor(_GROUND))
    height, width = camera.height, camera.width
    return color.reshape(height, samples, width, samples, 3).mean((1, 3)).clamp(0, 1)
