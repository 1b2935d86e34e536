"""What a registration is off by: a clip's found hands against its true ones.

Camera axes (OpenCV), metres and radians inside; figures in millimetres, degrees, and pixels of a
crop of 256 pixels around the hand.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.render.rasterize import covered_pixels

CROP = 256
"""Pixels along the side of the picture in whose pixels distances are told."""
RIGHT = 0.008
"""Metres: a pose is right if its vertices lie laterally no farther off, in the mean, after a
similarity has laid the found hand onto the true one."""
WORST = 0.05
"""The share of all vertices of all frames whose mean distance is told as the worst."""
BLOCK = 10
"""Frames of a block of time: their means are the samples of an interval."""


@dataclass(frozen=True, eq=False)
class Hands:
    """A hand in some frames of a clip.

    Attributes:
        vertices: metres, camera axes.
        landmarks: joints and fingertips, metres, camera axes.
        rotations: axis-angle, each relative to its parent bone, the wrist's to the camera.
        bones: rotations of the bones' axes relative to the camera's.
        spread: mean distance of the landmarks of the flat hand from their mean, metres: its size.
    """

    vertices: Float[Tensor, "frames vertices 3"]
    landmarks: Float[Tensor, "frames landmarks 3"]
    rotations: Float[Tensor, "frames bones 3"]
    bones: Float[Tensor, "frames bones 3 3"]
    spread: float

    def chosen(self, frames: list[int]) -> "Hands":
        """The same in some of the frames."""
        return replace(
            self,
            vertices=self.vertices[frames],
            landmarks=self.landmarks[frames],
            rotations=self.rotations[frames],
            bones=self.bones[frames],
        )

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.vertices)


@dataclass(frozen=True)
class Displacements:
    """Distances of found from true vertices, millimetres.

    Attributes:
        mean: of all vertices of all frames.
        worst: mean of the worst twentieth of them.
        lateral: mean part across the line of sight: what the camera sees.
        sight: mean part along it.
        constant: what is the same in all frames, per vertex and in the axes of its bone: a texture
            moves along with it and is not blurred.
        varying: mean of what is left in each frame without that.
        of_frames: mean of each frame.
    """

    mean: float
    worst: float
    lateral: float
    sight: float
    constant: float
    varying: float
    of_frames: tuple[float, ...]


def measure_displacements(
    found: Float[Tensor, "frames vertices 3"],
    truth: Float[Tensor, "frames vertices 3"],
    bones: Float[Tensor, "frames bones 3 3"],
    bone_of_vertex: Int[Tensor, "vertices"],
) -> Displacements:
    """How far vertices are off, as a whole and in parts.

    Args:
        found: metres, camera axes.
        truth: the same of the true hand.
        bones: rotations of the true bones relative to the camera.
        bone_of_vertex: the bone that moves each vertex the most.
    """
    apart = (found - truth).double()
    ray = torch.nn.functional.normalize(truth.double(), dim=-1)
    sight = (apart * ray).sum(-1)
    lateral = (apart - sight[..., None] * ray).norm(dim=-1)
    distance = apart.norm(dim=-1)
    axes = bones.double()[:, bone_of_vertex]
    local = (axes.mT @ apart[..., None])[..., 0]
    constant = local.mean(0)
    worst = distance.flatten().topk(max(1, math.ceil(WORST * distance.numel()))).values
    return Displacements(
        mean=1000 * float(distance.mean()),
        worst=1000 * float(worst.mean()),
        lateral=1000 * float(lateral.mean()),
        sight=1000 * float(sight.abs().mean()),
        constant=1000 * float(constant.norm(dim=-1).mean()),
        varying=1000 * float((local - constant).norm(dim=-1).mean()),
        of_frames=tuple((1000 * distance.mean(-1)).tolist()),
    )


def joint_angles_apart(
    found: Float[Tensor, "frames bones 3"], truth: Float[Tensor, "frames bones 3"]
) -> Float[Tensor, "frames"]:
    """Root mean square over the bones of the angle between two rotations, degrees."""
    between = matrix_from_axis_angle(found.double()).mT @ matrix_from_axis_angle(truth.double())
    angle = axis_angle_from_matrix(between).norm(dim=-1)
    return angle.square().mean(-1).sqrt().rad2deg()


def brought_to_depth(found: Hands, truth: Hands, focal: float, true_focal: float) -> Hands:
    """Found hands, scaled so that they project as they did but lie as deep as the true ones.

    One video tells neither the focal length nor the size of the hand: a hand twice as large and
    twice as far looks the same. So the found hand is taken through the true camera (its picture
    stays), and then every frame is scaled about the camera's centre until its vertices' mean depth
    is the true one. What is left is what the registration is to blame for.

    Args:
        found: fitted with ``focal``.
        truth: the true hands.
        focal: pixels.
        true_focal: pixels.
    """
    stretch = found.vertices.new_tensor([focal / true_focal, focal / true_focal, 1.0])
    depth = truth.vertices[..., 2].mean(-1) / found.vertices[..., 2].mean(-1)
    scale = depth[:, None, None] * stretch
    return replace(found, vertices=found.vertices * scale, landmarks=found.landmarks * scale)


def are_right(
    found: Float[Tensor, "frames vertices 3"], truth: Float[Tensor, "frames vertices 3"]
) -> Bool[Tensor, "frames"]:
    """Whether each pose is right; see :data:`RIGHT`."""
    aligned = _by_similarity(found.double(), truth.double())
    ray = torch.nn.functional.normalize(truth.double(), dim=-1)
    apart = aligned - truth
    lateral = apart - (apart * ray).sum(-1, keepdim=True) * ray
    return lateral.norm(dim=-1).mean(-1) <= RIGHT


def _by_similarity(
    points: Float[Tensor, "frames points 3"], target: Float[Tensor, "frames points 3"]
) -> Float[Tensor, "frames points 3"]:
    """The points, turned, scaled and moved onto others in the sense of least squares (Umeyama)."""
    middle, goal = points.mean(1, keepdim=True), target.mean(1, keepdim=True)
    source, wanted = points - middle, target - goal
    u, singular, v = torch.linalg.svd(wanted.mT @ source)
    sign = torch.ones_like(singular)
    sign[:, 2] = torch.linalg.det(u @ v).sign()
    turn = (u * sign[:, None]) @ v
    scale = (singular * sign).sum(-1) / source.square().sum((-1, -2))
    return scale[:, None, None] * (source @ turn.mT) + goal


@dataclass(frozen=True)
class Overlap:
    """Agreement of a mesh with a mask, both within the picture.

    Attributes:
        iou: intersection over union.
        border: mean distance of the two outlines, either way, pixels of a crop of ``CROP``; None
            where one of the two has no outline.
    """

    iou: float
    border: float | None


def measure_overlap(
    mesh: Bool[np.ndarray, "side side"],
    mask: Bool[np.ndarray, "side side"],
    inside: Bool[np.ndarray, "side side"],
) -> Overlap:
    """Compares what a mesh covers with what the hand covers.

    Args:
        mesh: pixels of a crop that the mesh covers.
        mask: pixels that the hand covers.
        inside: pixels of the crop that lie in the picture; nothing is known of the others.
    """
    first, second = mesh & inside, mask & inside
    union = int((first | second).sum())
    iou = float((first & second).sum() / union) if union else 1.0
    edges = [_outline(picture, inside) for picture in (first, second)]
    if not all(edge.any() for edge in edges):
        return Overlap(iou, None)
    away = [ndimage.distance_transform_edt(~edge) for edge in edges]
    distances = (away[0][edges[1]].mean() + away[1][edges[0]].mean()) / 2
    return Overlap(iou, float(distances) * CROP / len(mesh))


def _outline(
    mask: Bool[np.ndarray, "side side"], inside: Bool[np.ndarray, "side side"]
) -> Bool[np.ndarray, "side side"]:
    """Pixels of the mask with a neighbour beside it that is in the picture, but not in the mask."""
    return mask & ndimage.binary_dilation(inside & ~mask)


def mesh_pixels(
    sealed_vertices: Float[Tensor, "vertices 3"],
    sealed_faces: Int[Tensor, "faces 3"],
    camera: Camera,
) -> Bool[np.ndarray, "height width"]:
    """Pixels that a closed mesh covers."""
    return covered_pixels(sealed_vertices, sealed_faces, camera).numpy()


def landmark_pixels_apart(
    found: Float[Tensor, "landmarks 3"],
    found_camera: Camera,
    truth: Float[Tensor, "landmarks 3"],
    true_camera: Camera,
) -> float:
    """Mean distance of projected landmarks, pixels of a crop of ``CROP``."""
    apart = project(found_camera, found)[0] - project(true_camera, truth)[0]
    return float(apart.norm(dim=-1).mean()) * CROP / found_camera.width


def in_crop(
    picture: Float[np.ndarray, "height width"], picture_camera: Camera, crop_camera: Camera
) -> tuple[Float[np.ndarray, "side side"], Bool[np.ndarray, "side side"]]:
    """A crop of a picture by two cameras of the same place and direction.

    Args:
        picture: values per pixel.
        picture_camera: of the whole picture.
        crop_camera: of the crop, in the picture camera's focal length: its zoom is the ratio.

    Returns:
        The values in the crop, zero outside the picture, and which pixels are inside.
    """
    zoom = crop_camera.focal[0] / picture_camera.focal[0]
    rows, columns = np.mgrid[0 : crop_camera.height, 0 : crop_camera.width] + 0.5
    x = (columns - crop_camera.center[0]) / zoom + picture_camera.center[0]
    y = (rows - crop_camera.center[1]) / zoom + picture_camera.center[1]
    height, width = picture.shape
    inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    # A crop with larger pixels than the picture's takes the mean of what lies in them.
    smooth = ndimage.gaussian_filter(picture, 0.4 / zoom) if zoom < 0.7 else picture
    values = ndimage.map_coordinates(smooth, [y - 0.5, x - 0.5], order=1, mode="nearest")
    return np.where(inside, values, 0.0), inside


Figures = dict[str, float | list[float] | None]
"""One row of the table for one case: figures by column, the interval as [low, high]."""

COLUMNS = (
    "vertices_mm",
    "worst_twentieth_mm",
    "lateral_mm",
    "sight_mm",
    "constant_mm",
    "varying_mm",
    "angle_deg",
    "landmarks_px",
    "landmarks_mm",
    "size_error",
    "focal_error",
    "mask_iou",
    "border_px",
    "cut_mask_iou",
    "frames_kept",
    "rejected_right",
    "kept_wrong",
)
"""Of every row, before its interval."""


@dataclass(frozen=True)
class ClipScores:
    """A row of one clip.

    Attributes:
        figures: by column; None does not apply.
        of_frames: mean vertex distance of each judged frame, millimetres, in the order of time.
    """

    figures: Mapping[str, float | None]
    of_frames: tuple[float, ...]

    def blocks(self) -> list[float]:
        """Means of successive stretches of time."""
        parts = [self.of_frames[i : i + BLOCK] for i in range(0, len(self.of_frames), BLOCK)]
        return [
            sum(part) / len(part) for part in parts if len(part) > BLOCK // 2 or len(parts) == 1
        ]
