"""Pictures of a recording as the capture keeps them: cropped, cut at the wrist, judged."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.capture.clips import LaidClip
from handavatar.capture.frames import Frame
from handavatar.capture.guided_masks import (
    GuidedMask,
    cut_at_wrist,
    is_cut_unsure,
    pixels_per_metre_at,
    wrist_in,
)
from handavatar.capture.left_out import LeftOut
from handavatar.capture.masks import (
    covered_shares,
    grey_picture,
    inside_picture,
    mask_coverage,
    pixels_per_metre,
)
from handavatar.capture.outlines import silhouette
from handavatar.capture.tracking import NO_HAND, TrackedHand
from handavatar.capture.windows import Window, resampled, window_camera
from handavatar.hand.rig import Rig

_BOX_SCALE = 1.3
_SIZES = (256, 512)
# Pixels along a side at which the fitted mesh is compared with its mask, at least.
_MESH_SIDE = 768
_SEEN_SHARE = 0.9
# Side of the little picture in which it is counted how much of the hand was seen.
_COUNTED_SIDE = 96
# Pixels of the video between the farthest landmarks of a hand.
_SMALLEST_HAND = 48.0


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """What became of one picture in which the hand was found.

    Attributes:
        frame: cropped picture, cut mask, camera, pose; its split is set when it is written.
        mesh: pixels that the fitted hand covers.
        mask_iou: agreement of mask and mesh in front of the wrist, intersection over union.
        landmark_error: mean distance of fitted and tracked landmarks, pixels of a crop of 256.
        mask_quality: how far the mask's border follows edges of the picture, in [0, 1].
        outside_share: of the fitted mesh, beyond the camera's picture.
        unknown_share: of the fitted mesh, in the picture but hidden or not told apart.
        reason: why it is to be left out; None if it is good.
    """

    frame: Frame
    mesh: Bool[np.ndarray, "height width"]
    mask_iou: float
    landmark_error: float
    mask_quality: float
    outside_share: float
    unknown_share: float
    reason: LeftOut | None


def picture_name(clip: int, index: int) -> str:
    """Of a frame: the number of its picture in the file, behind that of the file from the second.

    Args:
        clip: number of the recording.
        index: of the picture.
    """
    return f"{clip}-{index:06d}" if clip else f"{index:06d}"


@dataclass(frozen=True)
class Box:
    """The square of a picture that is stored.

    Attributes:
        corner: upper left one, pixels of the video's picture.
        side: pixels of the video's picture.
    """

    corner: tuple[float, float]
    side: float

    def seen_in(self, window: Window) -> tuple[tuple[float, float], float]:
        """Its corner and side in pixels of a window."""
        x, y = (
            (at - start) * window.scale
            for at, start in zip(self.corner, window.corner, strict=True)
        )
        return (x, y), self.side * window.scale


def box_in_front(laid: LaidClip, number: int, rig: Rig) -> Box:
    """About the mask in front of the wrist.

    Args:
        laid: the recording.
        number: of the hand.
        rig: that was laid onto it.
    """
    window, fitted = laid.clip.track.hands[number].window, laid.fitted
    line = wrist_in(window.camera(fitted.fit.focal), rig, fitted.vertices[number])
    before = line.before_pixels(window.image.shape[0]) > 0
    corner, box = _box(laid.masks[number].mask.pixels & before & inside_picture(window))
    x, y = (start + at / window.scale for start, at in zip(window.corner, corner, strict=True))
    return Box((x, y), box / window.scale)


def stored_size(sides: Sequence[float]) -> int:
    """Pixels along a side of the stored pictures: as many as most of the video's hands have.

    Args:
        sides: of the squares about the hands, pixels of the video.
    """
    return _SIZES[1] if float(np.median(sides)) >= _SIZES[1] else _SIZES[0]


def crop_frame(
    laid: LaidClip,
    number: int,
    box: Box,
    rig: Rig,
    size: int,
    min_confidence: float,
    clip: int = 0,
) -> FittedFrame:
    """One picture's crop, with its mask cut where the mesh ends.

    Args:
        laid: the recording.
        number: of the hand.
        box: of the picture.
        rig: that was laid onto it.
        size: side of the crop, pixels.
        min_confidence: of a pose that is kept.
        clip: number of the recording.
    """
    hand, guided, fitted = laid.clip.track.hands[number], laid.masks[number], laid.fitted
    window = hand.window
    fit, vertices = fitted.fit, fitted.vertices[number]
    camera = window_camera(fit.focal, window.principal_point, box.corner, box.side, size)
    fine_corner, fine_side = box.seen_in(hand.stored_from)
    image = resampled(
        hand.stored_from.image, np.eye(2) * (fine_side / size), np.array(fine_corner), size
    ).copy()
    corner, side = box.seen_in(window)
    zoom = np.eye(2) * (side / size)
    shares = mask_coverage(guided.mask.level, zoom, np.array(corner), size)
    known = resampled(grey_picture(guided.known), zoom, np.array(corner), size)[..., 0] == 255
    was_seen = _is_in_view(window, corner, side, size)
    image[~was_seen] = 128

    samples = -(-_MESH_SIDE // size)
    fine_camera = camera.resized(samples * size, samples * size)
    mesh = covered_shares(silhouette(rig, vertices, fine_camera), samples)
    line = wrist_in(camera, rig, vertices)
    scale = pixels_per_metre_at(camera, vertices)
    cut = cut_at_wrist(shares, line)
    is_end = is_cut_unsure(mesh > 0.5, line, scale)
    counted = was_seen & ~is_end
    iou = float(
        np.minimum(mesh, cut)[counted].sum() / max(1.0, np.maximum(mesh, cut)[counted].sum())
    )
    known &= was_seen & ~(is_end & (shares > 0))
    outside, unknown = _missing(window, guided, rig, vertices, fit.focal)
    error = float(fitted.landmark_errors[number])
    factors = _confidence(hand, guided, iou, error)
    cameras = laid.clip.world_cameras
    frame = Frame(
        name=picture_name(clip, hand.index),
        image=torch.from_numpy(image),
        coverage=torch.from_numpy((255 * cut * known).round().astype(np.uint8)),
        camera=camera if cameras is None else replace(camera, camera_from_world=cameras[number]),
        pose=laid.world.pose(number),
        confidence=float(np.prod(list(factors.values()))),
        split="train",
        time=laid.clip.start + hand.time,
        known=torch.from_numpy(known),
        gain=torch.from_numpy(laid.clip.gains[number]).float(),
        covariance=fitted.covariances[number],
        landmarks=fitted.landmarks[number],
        clip=clip,
    )
    pixels = float(np.ptp(hand.landmarks, axis=0).max())
    reason = _reason(pixels, outside, unknown, guided, factors, iou, error, min_confidence)
    return FittedFrame(
        frame,
        mesh > 0.5,
        iou,
        error * scale * 256 / size,
        guided.edge_quality,
        outside,
        unknown,
        reason,
    )


def _is_in_view(
    window: Window, corner: tuple[float, float], box: float, size: int
) -> Bool[np.ndarray, "size size"]:
    """Pixels of a crop of a window that lie wholly in the camera's picture, and in the window."""
    step = box / size
    sides = []
    for axis in range(2):
        first = corner[axis] + np.arange(size) * step
        begin, end = (edge / window.scale + window.corner[axis] for edge in (first, first + step))
        is_inside = (begin > -1e-6) & (end < window.picture_size[axis] + 1e-6)
        sides.append(is_inside & (first > -1e-6) & (first + step < len(window.image) + 1e-6))
    return sides[1][:, None] & sides[0][None, :]


def _missing(
    window: Window,
    guided: GuidedMask,
    rig: Rig,
    vertices: Float[Tensor, "vertices 3"],
    focal: float,
) -> tuple[float, float]:
    """Shares of the mesh's pixels beyond the camera's picture, and unknown inside of it."""
    size, center = np.array(window.picture_size), np.array(window.principal_point)
    seen = vertices.double().numpy()
    places = seen[:, :2] / np.maximum(seen[:, 2:], 0.02) * focal + center
    low, high = places.min(0), places.max(0)
    side = float((high - low).max())
    start = (low + high) / 2 - side / 2
    camera = window_camera(
        focal, window.principal_point, (float(start[0]), float(start[1])), side, _COUNTED_SIDE
    )
    rows, columns = np.nonzero(silhouette(rig, vertices, camera))
    if len(rows) == 0:
        return 1.0, 0.0
    points = (np.stack([columns, rows], axis=-1) + 0.5) * (side / _COUNTED_SIDE) + start
    is_outside = ~((points >= 0) & (points <= size)).all(-1)
    pixel = np.floor(window.from_picture(points)).astype(int)
    is_far = ((pixel < 0) | (pixel >= len(guided.known))).any(-1)
    pixel = pixel.clip(0, len(guided.known) - 1)
    is_unknown = is_far | ~guided.known[pixel[:, 1], pixel[:, 0]]
    return float(is_outside.mean()), float((is_unknown & ~is_outside).mean())


def _confidence(
    hand: TrackedHand, guided: GuidedMask, iou: float, error_metres: float
) -> dict[str, float]:
    """How far a pose is to be trusted: the product is 1 if outline, landmarks, tracker agree."""
    spread_metres = float(hand.spread.mean()) / pixels_per_metre(hand)
    return {
        "outline": float(np.clip((iou - 0.65) / 0.25, 0, 1)),
        "landmarks": float(np.exp(-((error_metres / 0.012) ** 2))),
        "looks": float(np.exp(-((spread_metres / 0.015) ** 2))),
        "edges": float(np.clip((guided.edge_quality - 0.45) / 0.3, 0, 1)),
        "presence": float(np.clip(hand.presence / 0.9, 0, 1)),
    }


def _reason(
    pixels: float,
    outside: float,
    unknown: float,
    guided: GuidedMask,
    factors: dict[str, float],
    iou: float,
    error_metres: float,
    min_confidence: float,
) -> LeftOut | None:
    """Why a frame is to be left out, by what is most to blame."""
    percent = round(100 * (1 - outside - unknown))
    if outside + unknown > 1 - _SEEN_SHARE:
        if outside >= unknown:
            return LeftOut("border", f"only {percent} % of the hand is in the picture")
        if guided.covered_share > unknown / 2:
            return LeftOut("hidden", f"only {percent} % of the hand is seen, something hides it")
        return LeftOut(
            "background", f"only {percent} % of the hand can be told from what is behind it"
        )
    if pixels < _SMALLEST_HAND:
        return LeftOut("small", f"the hand is {pixels:.0f} pixels large")
    confidence = float(np.prod(list(factors.values())))
    if confidence >= min_confidence:
        return None
    worst = min(factors, key=lambda name: factors[name])
    texts = {
        "outline": ("pose", f"mask and fitted hand overlap by {100 * iou:.0f} %"),
        "landmarks": ("pose", f"landmarks and fitted hand are {1000 * error_metres:.0f} mm apart"),
        "looks": ("pose", "the tracker's looks disagree (a fist, or a hand seen edge-on?)"),
        "edges": ("background", "the hand's border follows no edge of the picture"),
        "presence": (NO_HAND, "the tracker is not sure of a hand"),
    }
    kind, text = texts[worst]
    return LeftOut(kind, f"{text}; confidence {confidence:.2f}")


def _box(mask: Bool[np.ndarray, "side side"]) -> tuple[tuple[float, float], float]:
    """Corner and side of the square about a mask, with room on every side."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return (0.0, 0.0), float(mask.shape[0])
    low = np.array([columns.min(), rows.min()])
    high = np.array([columns.max(), rows.max()]) + 1
    side = float((high - low).max()) * _BOX_SCALE
    x, y = (low + high) / 2 - side / 2
    return (float(x), float(y)), side
