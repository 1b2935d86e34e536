"""What colour each point of the skin has, and the light on it, learned from all frames at once."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from handavatar.fit.pictures import BlurredPicture, FramePicture, drawing_camera
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.meshes import SurfacePoints, vertex_normals
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import rasterize

NUM_HARMONICS = 9
_NEAR = 0.003
"""Metres behind the nearest surface at which a point still counts as seen."""
_LEAST_FACING = 0.2
"""Cosine between normal and view below which a point is not compared."""
_LEAST_DEPTH = 1.0
"""Pixels inside the outline."""


def harmonics(normals: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 9"]:
    """Spherical harmonics up to the second order, not normalised: what diffuse light depends on."""
    x, y, z = normals.unbind(-1)
    return torch.stack(
        [torch.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=-1
    )


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of the skin as one camera sees them.

    Attributes:
        pixels: image positions.
        normals: unit, world.
        facing: cosine between normal and the way to the camera.
        is_visible: in front of everything else, and facing the camera.
    """

    pixels: Float[Tensor, "points 2"]
    normals: Float[Tensor, "points 3"]
    facing: Float[Tensor, "points"]
    is_visible: Bool[Tensor, "points"]


@torch.no_grad()
def see_points(
    rig: Rig, vertices: Float[Tensor, "vertices 3"], points: SurfacePoints, camera: Camera
) -> SeenPoints:
    """Which points of a posed mesh a camera sees, by a z-buffer.

    Args:
        rig: of the mesh.
        vertices: posed, metres, world.
        points: on the mesh.
        camera: the view.
    """
    positions = points.positions(vertices)
    normals = normalize(points.positions(vertex_normals(vertices, rig.faces)), dim=-1)
    pixels, depth = project(camera, positions)
    small = drawing_camera(camera)
    drawn = rasterize(rig.sealed(vertices), rig.sealed_faces, small)
    places = pixels * pixels.new_tensor([small.width / camera.width, small.height / camera.height])
    column, row = places.floor().long().unbind(-1)
    is_inside = (column >= 0) & (row >= 0) & (column < small.width) & (row < small.height)
    nearest = drawn.depth[row.clamp(0, small.height - 1), column.clamp(0, small.width - 1)]
    rotation, shift = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    facing = (normals * normalize(-(shift @ rotation) - positions, dim=-1)).sum(-1)
    is_visible = is_inside & (depth < nearest + _NEAR) & (facing > _LEAST_FACING)
    return SeenPoints(pixels, normals, facing, is_visible)


@dataclass(frozen=True, eq=False)
class SkinColors:
    """Colour of every point, and a light that depends on the normal in the world.

    Attributes:
        albedo: of the points, sRGB.
        light: by harmonics and channel.
        trust: how much was seen of each point: 0 for one never seen.
    """

    albedo: Float[Tensor, "points 3"]
    light: Float[Tensor, "9 3"]
    trust: Float[Tensor, "points"]

    def select(self, index: Int[Tensor, "selected"]) -> "SkinColors":
        """Of some of the points."""
        return SkinColors(self.albedo[index], self.light, self.trust[index])

    def colors(self, normals: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """What the points look like with given normals."""
        return self.albedo * (harmonics(normals) @ self.light).clamp_min(_DARKEST)


@dataclass(frozen=True, eq=False)
class SeenColors:
    """Colours that one frame shows of the points that it sees.

    Attributes:
        index: of the points.
        values: sRGB, at the capture's average exposure.
        normals: unit, world.
        facing: cosine to the view; what is seen edge-on counts less.
    """

    index: Int[Tensor, "seen"]
    values: Float[Tensor, "seen 3"]
    normals: Float[Tensor, "seen 3"]
    facing: Float[Tensor, "seen"]


def see_colors(
    rig: Rig,
    vertices: Float[Tensor, "vertices 3"],
    points: SurfacePoints,
    picture: FramePicture,
    blurred: BlurredPicture,
) -> SeenColors:
    """The colours of all visible points well inside the mask."""
    seen = see_points(rig, vertices, points, picture.camera)
    values, _ = blurred.sample(seen.pixels)
    is_used = seen.is_visible & (values[:, 3] < -_LEAST_DEPTH) & picture.is_known(seen.pixels)
    index = is_used.nonzero()[:, 0]
    return SeenColors(index, values[index, :3], seen.normals[index], seen.facing[index])


def fit_colors(seen: list[SeenColors], num_points: int) -> tuple[SkinColors, float]:
    """Albedo of every point and one light for all frames, in turn, by robust least squares.

    Returns:
        Both, and the median error of a channel.
    """
    index = torch.cat([part.index for part in seen])
    values = torch.cat([part.values for part in seen])
    basis = harmonics(torch.cat([part.normals for part in seen]))
    facing = torch.cat([part.facing for part in seen])
    light = torch.zeros(NUM_HARMONICS, 3)
    light[0] = 1.0
    trust = facing.clone()
    for _ in range(_ROUNDS):
        shading = (basis @ light).clamp_min(_DARKEST)
        weighted = shading * trust[:, None]
        total = torch.zeros(num_points, 3).index_add_(0, index, values * weighted)
        weight = torch.zeros(num_points, 3).index_add_(0, index, shading * weighted)
        mean = total.sum(0) / weight.sum(0).clamp_min(1e-9)
        # A point that is hardly seen is as the others are.
        albedo = (total + _SHYNESS * mean) / (weight + _SHYNESS)
        errors = (values - albedo[index] * shading).norm(dim=-1)
        scale = 1.5 * errors.median() + 1e-3
        trust = facing / (1 + (errors / scale).square()).square()
        for channel in range(3):
            lit = basis * albedo[index, channel, None]
            normal = lit.T @ (lit * trust[:, None]) + 1e-2 * torch.eye(NUM_HARMONICS)
            right = lit.T @ (values[:, channel] * trust)
            light[:, channel] = torch.linalg.solve(normal, right)
        light = light / light[0].mean()
    return SkinColors(albedo, light, weight.mean(-1)), float(errors.median()) / math.sqrt(3)


_ROUNDS = 4
_DARKEST = 0.08
_SHYNESS = 0.3
