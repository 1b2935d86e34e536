"""The outline of the hand: in the mask, in the fitted mesh, and which point goes with which."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from handavatar.capture.fitting import OutlinePairs
from handavatar.capture.windows import Window
from handavatar.geometry.cameras import Camera
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import covered_pixels

_MAX_FROM_MASK = 128
_MAX_TO_MASK = 128
_TURN_COST = 0.012
_REACH = 0.035
_GRAZING = 0.35


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """Outline of one mask, in pixels of the picture.

    Attributes:
        points: on the border between skin and not skin.
        normals: unit, away from the skin.
        tree: of the points.
        mask: skin in the window.
        window: where the mask lies.
        pixels_per_metre: picture pixels per metre at the hand.
    """

    points: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]
    tree: cKDTree
    mask: Bool[np.ndarray, "side side"]
    window: Window
    pixels_per_metre: float

    def covers(self, places: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Whether picture points lie on skin, or where the picture shows nothing."""
        side = self.mask.shape[0]
        pixel = np.floor(self.window.from_picture(places)).astype(int)
        is_known = ((pixel >= 0) & (pixel < side)).all(-1)
        is_known &= (places > 1).all(-1) & (places < np.array(self.window.picture_size) - 1).all(-1)
        pixel = pixel.clip(0, side - 1)
        return ~is_known | self.mask[pixel[:, 1], pixel[:, 0]]


def mask_outline(
    mask: Bool[np.ndarray, "side side"], window: Window, pixels_per_metre: float
) -> MaskOutline:
    """Border points of a mask where the picture, not its edge, ends the skin."""
    smooth = ndimage.gaussian_filter(mask.astype(np.float32), 2.0)
    row_slope, column_slope = np.gradient(smooth)
    border = mask & ~ndimage.binary_erosion(mask, border_value=1)
    rows, columns = np.nonzero(border)
    normals = -np.stack([column_slope[rows, columns], row_slope[rows, columns]], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-9
    # The last skin pixel's centre lies half a pixel inside the border.
    in_window = np.stack([columns, rows], axis=-1) + 0.5 + 0.5 * normals
    points = in_window / window.scale + np.array(window.corner)
    size = np.array(window.picture_size)
    side = mask.shape[0]
    is_real = (points > 2).all(-1) & (points < size - 2).all(-1)
    is_real &= (in_window > 2).all(-1) & (in_window < side - 2).all(-1)
    points, normals = points[is_real], normals[is_real]
    if len(points) == 0:
        # Nothing to draw the mesh to: one point that no vertex will be near.
        points, normals = np.full((1, 2), -1e6), np.array([[1.0, 0.0]])
    return MaskOutline(points, normals, cKDTree(points), mask, window, pixels_per_metre)


class OutlineMatcher:
    """Finds :class:`OutlinePairs` between posed hands and the outlines of their masks."""

    def __init__(
        self, rig: Rig, outlines: Sequence[MaskOutline], principal_point: tuple[float, float]
    ) -> None:
        """One outline per frame, in the order of the frames, of a camera with a principal point."""
        self._rig = rig
        self._outlines = outlines
        self._principal_point = principal_point
        self._center = np.array(principal_point)
        self._rim = rig.rim.numpy()
        self._generator = np.random.default_rng(0)

    def chosen(self, frames: Int[Tensor, "chosen"]) -> "OutlineMatcher":
        """The same for some frames; they may repeat."""
        outlines = [self._outlines[frame] for frame in frames.tolist()]
        return OutlineMatcher(self._rig, outlines, self._principal_point)

    def __call__(self, vertices: Float[Tensor, "frames vertices 3"], focal: float) -> OutlinePairs:
        """Pairs for vertices in camera axes (metres) and a focal length (pixels)."""
        normals = vertex_normals(vertices, self._rig.faces)
        facing = (normals * torch.nn.functional.normalize(vertices, dim=-1)).sum(-1)
        found = [
            self._pairs(outline, v, n, f, focal)
            for outline, v, n, f in zip(
                self._outlines,
                vertices.double().numpy(),
                normals.double().numpy(),
                facing.numpy(),
                strict=True,
            )
        ]
        chosen, targets, directions, weights = (
            torch.from_numpy(np.stack(column)) for column in zip(*found, strict=True)
        )
        return OutlinePairs(chosen, targets.float(), directions.float(), weights.float())

    def _pairs(
        self,
        outline: MaskOutline,
        vertices: Float[np.ndarray, "vertices 3"],
        normals: Float[np.ndarray, "vertices 3"],
        facing: Float[np.ndarray, "vertices"],
        focal: float,
    ) -> tuple[np.ndarray, ...]:
        """Padded arrays: vertex, target, normal, weight."""
        size = _MAX_FROM_MASK + _MAX_TO_MASK
        chosen, targets = np.zeros(size, dtype=np.int64), np.zeros((size, 2))
        directions, weights = np.zeros((size, 2)), np.zeros(size)
        places = vertices[:, :2] / np.maximum(vertices[:, 2:], 0.02) * focal + self._center
        is_behind = is_behind_wrist(outline.points, places[self._rim], places.mean(0))
        usable = np.nonzero(~is_behind)[0]
        if len(usable) > _MAX_FROM_MASK:
            usable = self._generator.choice(usable, _MAX_FROM_MASK, replace=False)
        vertex, is_near = self._nearest_grazing(outline, usable, places, normals, facing)
        usable, vertex = usable[is_near], vertex[is_near]
        count = len(usable)
        chosen[:count], weights[:count] = vertex, 1.0
        targets[:count], directions[:count] = outline.points[usable], outline.normals[usable]

        outside = np.nonzero(~outline.covers(places))[0]
        if len(outside):
            if len(outside) > _MAX_TO_MASK:
                outside = self._generator.choice(outside, _MAX_TO_MASK, replace=False)
            _, nearest = outline.tree.query(places[outside])
            end = _MAX_FROM_MASK + len(outside)
            chosen[_MAX_FROM_MASK:end], weights[_MAX_FROM_MASK:end] = outside, 1.0
            targets[_MAX_FROM_MASK:end] = outline.points[nearest]
            directions[_MAX_FROM_MASK:end] = outline.normals[nearest]
        return chosen, targets, directions, weights

    def _nearest_grazing(
        self,
        outline: MaskOutline,
        points: Int[np.ndarray, "points"],
        places: Float[np.ndarray, "vertices 2"],
        normals: Float[np.ndarray, "vertices 3"],
        facing: Float[np.ndarray, "vertices"],
    ) -> tuple[Int[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
        """For outline points the vertex seen edge-on that is near and faces the same way."""
        grazing = np.nonzero(np.abs(facing) < _GRAZING)[0]
        if len(points) == 0 or len(grazing) == 0:
            return np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=bool)
        # A turn of the normal by a radian costs as much as about a finger's width.
        turn = _TURN_COST * outline.pixels_per_metre
        flat = normals[grazing, :2]
        flat = flat / (np.linalg.norm(flat, axis=-1, keepdims=True) + 1e-9)
        tree = cKDTree(np.concatenate([places[grazing], turn * flat], axis=1))
        queries = np.concatenate([outline.points[points], turn * outline.normals[points]], axis=1)
        distance, nearest = tree.query(queries)
        return grazing[nearest], distance < _REACH * outline.pixels_per_metre


def is_behind_wrist(
    points: Float[np.ndarray, "*n 2"],
    rim: Float[np.ndarray, "rim 2"],
    hand: Float[np.ndarray, "2"],
    margin: float = 0.0,
) -> Bool[np.ndarray, "*n"]:
    """Whether image points lie on the forearm's side of the line through the mesh's end.

    Args:
        points: pixels.
        rim: where the mesh ends, pixels.
        hand: centre of the hand, pixels; the line is perpendicular to the way there.
        margin: pixels by which the line is moved towards the hand.
    """
    center = rim.mean(0)
    towards = (hand - center) / (np.linalg.norm(hand - center) + 1e-9)
    return (points - center) @ towards < margin


def silhouette(
    rig: Rig, vertices: Float[Tensor, "vertices 3"], camera: Camera
) -> Bool[np.ndarray, "height width"]:
    """Which pixels the hand covers, its wrist closed."""
    return covered_pixels(rig.sealed(vertices), rig.sealed_faces, camera).numpy()
