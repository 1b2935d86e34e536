"""Unwraps the training pictures onto the rig's chart: what the albedo's codes are too coarse for.

Every frame sees some texels; what it says of one is the residual that would have made the rendered
pixel as the photograph is. A weighted median over the frames that see it best is the texel's value.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.meshes import face_cross_products
from handavatar.geometry.rotations import invert_rigid
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.threads import mapped
from handavatar.render.chart import Texels
from handavatar.render.rasterize import rasterize

_FIT_SCALE = 1.5
"""Pixels (of 256) of a frame's fit error that leave it a weight of exp(-1)."""
_SAME_DEPTH = 4e-3
"""Metres that a texel may lie behind the nearest surface within a pixel (of 256) around it."""
_LARGEST_SHIFT = 3.0
"""Pixels (of 256) between a point of the mesh and where the picture shows it, at most."""
_LEAST_COSINE = 0.1
_WHOLE = 0.999
_FRAMES = 24
"""So many frames, those that see a texel best, have a say in its median."""
_LARGEST = 1.0
_TEXELS_AT_ONCE = 32768
_VALUES_AT_ONCE = 150 * _TEXELS_AT_ONCE
"""Texels times views whose values are held at once by each thread: 16 bytes each."""
_LEAST = 1e-4


@dataclass(frozen=True, eq=False)
class UnwrapView:
    """A picture to unwrap; of hundreds, only what is known is held.

    Attributes:
        residual: logarithm of what the albedo is to be multiplied by, so that the rendered
            colours are the photograph's; of the known pixels, row by row.
        places: where on the chart (u, v) each of them is.
        is_known: pixels that have a residual and a place.
        camera: of these pixels.
        vertices: of the posed fine mesh, metres, world.
        sharpness: of the picture, relative to others.
        fit_error: mean distance between the outlines of mesh and mask, pixels of 256.
        pixel: as many of the view's pixels are one of a picture 256 wide.
    """

    residual: Float[Tensor, "known 3"]
    places: Float[Tensor, "known 2"]
    is_known: Bool[Tensor, "height width"]
    camera: Camera
    vertices: Float[Tensor, "vertices 3"]
    sharpness: float
    fit_error: float
    pixel: float = 1.0


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """What the pictures say of each texel of a chart.

    Attributes:
        residual: weighted median over the frames; zero where none saw the texel.
        seen: sum of the frames' weights: about 1 for each good view from the front, 0 for none.
    """

    residual: Float[Tensor, "texels 3"]
    seen: Float[Tensor, "texels"]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Of one view: weights of faces, and from what depth on all is hidden."""

    weights: Float[Tensor, "faces"]
    depth: Float[Tensor, "height width"]


@torch.no_grad()
def unwrap_pictures(
    views: list[UnwrapView],
    faces: Int[Tensor, "faces 3"],
    texels: Texels,
    corners: Float[Tensor, "faces 3 2"],
    progress: Progress = SILENT,
) -> Unwrapped:
    """The residual of every texel, from all pictures.

    A frame's weight: max(cosine to the camera, 0)^4, pixels per texel over their mean, how sharp
    the picture is among the others, and exp(-(e / 1.5)^2) for a fit error that is ``e`` pixels
    larger than the smallest one. Only texels that the z-buffer shows, in known pixels, count.

    Args:
        views: in a fixed order, on a CPU.
        faces: of the fine mesh.
        texels: of its chart.
        corners: of the faces on the chart, (u, v).
        progress: told how far it is.

    Departs: the paper has no texture; mean values of frames that are a pixel off are blurred,
        medians less so.
    """
    count = len(texels.faces)
    residual, seen = torch.zeros(count, 3), torch.zeros(count)
    if not views:
        return Unwrapped(residual, seen)
    chart = _ChartFaces.of(corners)
    seers = mapped(lambda view: _seen_faces(view, faces, chart), views)
    scale = torch.cat([part.weights[part.weights > 0] for part in seers]).mean()
    sharpest = max(max(view.sharpness for view in views), 1e-12)
    smallest = min(view.fit_error for view in views)
    factors = [
        view.sharpness
        / sharpest
        * float(torch.exp(torch.tensor(-(((view.fit_error - smallest) / _FIT_SCALE) ** 2))))
        / float(scale)
        for view in views
    ]

    def median_of(window: slice) -> tuple[Tensor, Tensor]:
        chosen, barycentric = texels.faces[window], texels.barycentric[window]
        texel_places = (corners[chosen] * barycentric[..., None]).sum(1)
        values = torch.zeros(len(views), len(chosen), 3)
        weights = torch.zeros(len(views), len(chosen))
        for number, (view, part, factor) in enumerate(zip(views, seers, factors, strict=True)):
            if not len(view.places):
                continue
            facing = (part.weights[chosen] > 0).nonzero()[:, 0]
            on_faces = chosen[facing]
            points = (view.vertices[faces[on_faces]] * barycentric[facing][..., None]).sum(1)
            pixels, _ = project(view.camera, view.vertices)
            per_uv = chart.pixels_per_uv(pixels[faces[on_faces]], on_faces)
            found, is_seen = _looked_up(view, part, points, texel_places[facing], per_uv)
            values[number, facing] = found
            weights[number, facing] = factor * part.weights[on_faces] * is_seen
        total = weights.sum(0)
        if len(views) > _FRAMES:
            weights, best = weights.topk(_FRAMES, dim=0)
            values = values.gather(0, best[..., None].expand(-1, -1, 3))
        return weighted_median(values, weights), total

    at_once = min(_TEXELS_AT_ONCE, max(_VALUES_AT_ONCE // len(views), 1))
    windows = [slice(at, at + at_once) for at in range(0, count, at_once)]
    medians = mapped(median_of, windows, progress=progress)
    for window, (value, total) in zip(windows, medians, strict=True):
        is_seen = total > _LEAST
        seen[window] = torch.where(is_seen, total, 0.0)
        residual[window] = torch.where(is_seen[:, None], value.clamp(-_LARGEST, _LARGEST), 0.0)
    return Unwrapped(residual, seen)


def known_numbers(is_known: Bool[Tensor, "height width"]) -> Int[Tensor, "height width"]:
    """How many known pixels come before each, row by row; of the unknown ones 0."""
    before = is_known.flatten().cumsum(0, dtype=torch.int32).view_as(is_known) - 1
    return torch.where(is_known, before, 0)


def weighted_median(
    values: Float[Tensor, "frames items channels"], weights: Float[Tensor, "frames items"]
) -> Float[Tensor, "items channels"]:
    """The value up to which half of the weight lies, per item and channel."""
    ordered, order = values.sort(dim=0)
    sorted_weights = weights[..., None].expand_as(values).gather(0, order).cumsum(0)
    half = sorted_weights[-1:] / 2
    place = (sorted_weights < half).sum(0, keepdim=True).clamp_max(len(values) - 1)
    return ordered.gather(0, place)[0]


@dataclass(frozen=True, eq=False)
class _ChartFaces:
    """The chart's faces: areas, those without any, and texture coordinates to sides."""

    areas: Float[Tensor, "faces"]
    is_flat: Bool[Tensor, "faces"]
    sides_per_uv: Float[Tensor, "faces 2 2"]

    @classmethod
    def of(cls, corners: Float[Tensor, "faces 3 2"]) -> "_ChartFaces":
        sides = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], dim=-1)
        areas = (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).abs() / 2
        is_flat = areas < 1e-12
        sides = torch.where(is_flat[:, None, None], torch.eye(2), sides)
        return cls(areas, is_flat, torch.linalg.inv(sides))

    def pixels_per_uv(
        self, corner_pixels: Float[Tensor, "points 3 2"], faces: Int[Tensor, "points"]
    ) -> Float[Tensor, "points 2 2"]:
        """Of faces whose corners project to these pixels."""
        first, second, third = corner_pixels.unbind(1)
        return torch.stack([second - first, third - first], dim=-1) @ self.sides_per_uv[faces]


def _seen_faces(view: UnwrapView, faces: Int[Tensor, "faces 3"], chart: _ChartFaces) -> _Seen:
    """Cosine to the fourth times pixels per texel of every face; zero for those that look away."""
    eye = invert_rigid(view.camera.camera_from_world)[:3, 3]
    normals = normalize(face_cross_products(view.vertices, faces), dim=-1)
    away = normalize(eye - view.vertices[faces].mean(1), dim=-1)
    cosine = (normals * away).sum(-1).clamp_min(0)
    pixels, _ = project(view.camera, view.vertices)
    first, second, third = pixels[faces].unbind(1)
    along, across = second - first, third - first
    area = (along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]).abs() / 2
    weights = cosine**4 * area / chart.areas.clamp_min(1e-12)
    depth = rasterize(view.vertices, faces, view.camera).depth
    # The nearest within a pixel (of 256) around: what is half hidden is not seen.
    reach = max(1, round(view.pixel))
    nearest = -max_pool2d(
        -depth[None, None].clamp_max(1e6), 2 * reach + 1, stride=1, padding=reach
    )[0, 0]
    weights = torch.where((cosine > _LEAST_COSINE) & ~chart.is_flat, weights, 0.0)
    return _Seen(weights, nearest + _SAME_DEPTH)


def _looked_up(
    view: UnwrapView,
    part: _Seen,
    points: Float[Tensor, "points 3"],
    places: Float[Tensor, "points 2"],
    pixels_per_uv: Float[Tensor, "points 2 2"],
) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, "points"]]:
    """Residuals of points of the mesh, between pixels linear, and whether they are seen there.

    The surface that a picture shows ends beside the mesh, so a point is looked for where the
    pixel that it projects to says that its place on the chart must be.
    """
    height, width = view.is_known.shape
    pixels, depths = project(view.camera, points)
    pixels = pixels.nan_to_num(-1e6, -1e6, -1e6).clamp(-1e6, 1e6)
    x, y = pixels.floor().long().unbind(-1)
    nearest = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
    known = view.is_known.flatten()
    is_visible = (depths < part.depth.flatten()[nearest]) & known[nearest]
    number = known_numbers(view.is_known).flatten()
    away = places - view.places[number[nearest]]
    shifted = torch.stack([x, y], dim=-1) + 0.5 + (pixels_per_uv @ away[..., None])[..., 0]
    is_visible &= (shifted - pixels).square().sum(-1) < (_LARGEST_SHIFT * view.pixel) ** 2
    pixels = torch.where(is_visible[:, None], shifted, pixels) - 0.5
    lower = pixels.floor()
    share = pixels - lower
    x, y = lower.long().unbind(-1)
    is_inside = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    x, y = x.clamp(0, width - 2), y.clamp(0, height - 2)
    first = y * width + x
    across, down = share.unbind(-1)
    corner = first[:, None] + torch.tensor([0, 1, width, width + 1])
    weights = torch.stack(
        [
            (1 - across) * (1 - down),
            across * (1 - down),
            (1 - across) * down,
            across * down,
        ],
        dim=1,
    )
    weights = weights * known[corner]
    value = (view.residual[number[corner]] * weights[..., None]).sum(1)
    is_known = weights.sum(1) > _WHOLE
    return value, is_inside & is_known & is_visible
