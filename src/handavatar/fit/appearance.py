"""The skin's texture: what fine differences of colour each of its points shows in all frames.

Compared is a band of each picture: the logarithm of its colours, blurred, less the same blurred
more. Exposure, white balance and soft light multiply colours by factors that change slowly from
place to place, and so do not touch it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from handavatar.fit.pictures import FramePicture, PictureBand, drawing_camera
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.meshes import SurfacePoints, vertex_normals
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import rasterize

_NEAR = 0.003
"""Metres behind the nearest surface at which a point still counts as seen."""
_LEAST_FACING = 0.2
"""Cosine between normal and view below which a point is not compared."""
_LEAST_DEPTH = 1.0
"""Pixels inside the outline."""
_ROUNDS = 4
_SHYNESS = 0.3
"""Views from the front that say a point has no texture."""


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
class PointsInBand:
    """What a band of a picture has where points of the skin are.

    Attributes:
        seen: the points.
        values: of the band.
        slopes: of the values, per pixel.
        is_compared: visible, known, and well inside the mask.
    """

    seen: SeenPoints
    values: Float[Tensor, "points 3"]
    slopes: Float[Tensor, "points 3 2"]
    is_compared: Bool[Tensor, "points"]


def look_up_points(
    rig: Rig,
    vertices: Float[Tensor, "vertices 3"],
    points: SurfacePoints,
    picture: FramePicture,
    band: PictureBand,
) -> PointsInBand:
    """Points of a posed mesh, looked up in a band of a picture.

    Args:
        rig: of the mesh.
        vertices: posed, metres, world.
        points: on the mesh.
        picture: the frame.
        band: of it.
    """
    seen = see_points(rig, vertices, points, picture.camera)
    values, slopes = band.sample(seen.pixels)
    is_inside = (values[:, 3] < -_LEAST_DEPTH) & picture.is_known(seen.pixels)
    return PointsInBand(seen, values[:, :3], slopes[:, :3], seen.is_visible & is_inside)


@dataclass(frozen=True, eq=False)
class SkinTexture:
    """What every point shows in one band of the pictures.

    Attributes:
        values: of the points: logarithms of ratios of colours.
        trust: how much was seen of each point: 0 for one never seen.
    """

    values: Float[Tensor, "points 3"]
    trust: Float[Tensor, "points"]


@dataclass(frozen=True, eq=False)
class SeenTexture:
    """What one frame shows of the points that it sees.

    Attributes:
        index: of the points.
        values: as of :class:`SkinTexture`.
        facing: cosine to the view; what is seen edge-on counts less.
    """

    index: Int[Tensor, "seen"]
    values: Float[Tensor, "seen 3"]
    facing: Float[Tensor, "seen"]


def see_texture(
    rig: Rig,
    vertices: Float[Tensor, "vertices 3"],
    points: SurfacePoints,
    picture: FramePicture,
    band: PictureBand,
) -> SeenTexture:
    """What a frame shows of all visible points well inside the mask.

    Args:
        rig: of the mesh.
        vertices: posed, metres, world.
        points: on the mesh.
        picture: the frame.
        band: of it.
    """
    found = look_up_points(rig, vertices, points, picture, band)
    index = found.is_compared.nonzero()[:, 0]
    return SeenTexture(index, found.values[index], found.seen.facing[index])


def fit_texture(seen: list[SeenTexture], num_points: int) -> tuple[SkinTexture, float]:
    """A robust mean of what all frames show of every point.

    Args:
        seen: by the frames.
        num_points: of the surface.

    Returns:
        The texture, and the median error of a channel.
    """
    index = torch.cat([part.index for part in seen])
    values = torch.cat([part.values for part in seen])
    facing = torch.cat([part.facing for part in seen])
    if len(index) == 0:
        return SkinTexture(torch.zeros(num_points, 3), torch.zeros(num_points)), math.inf
    trust = facing
    for _ in range(_ROUNDS):
        total = torch.zeros(num_points, 3).index_add_(0, index, values * trust[:, None])
        weight = torch.zeros(num_points).index_add_(0, index, trust)
        # A point that is hardly seen shows no more than the skin around it: nothing.
        mean = total / (weight[:, None] + _SHYNESS)
        errors = (values - mean[index]).norm(dim=-1)
        scale = 1.5 * errors.median() + 1e-4
        trust = facing / (1 + (errors / scale).square()).square()
    return SkinTexture(mean, weight), float(errors.median()) / math.sqrt(3)
