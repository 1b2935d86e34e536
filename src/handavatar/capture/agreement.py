"""Where a frame's picture, mask and posed mesh say that the hand is, small enough for many frames.

Three parties, two comparisons: the mask is laid on the projected mesh, and the borders of both on
the edges of the picture. Everything here measures; :mod:`handavatar.capture.soundness` judges.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d, pad

from handavatar.capture.frames import Frame, FrameRecord
from handavatar.geometry.cameras import Camera, project
from handavatar.hand.rig import ShapedHand
from handavatar.render.rasterize import covered_pixels

_HAND_PIXELS = 48
"""Along a hand in the small pictures: a finger is about five wide."""
_SAMPLES = 8
"""Stored pixels in a row that make one of a small picture, at most about twice as many."""
_COLOR_BINS = 16
"""Of each channel."""
_SIDES = (64, 256)
"""Of the small pictures, pixels along the longer side: at least, at most."""

TURNS: dict[str, Callable[[Tensor], Tensor]] = {
    "mirrored left to right": lambda values: values.flip(-1),
    "upside down and mirrored": lambda values: values.flip(-2),
    "turned by 180 degrees": lambda values: values.flip(-1, -2),
    "turned by 90 degrees clockwise": lambda values: values.transpose(-1, -2).flip(-1),
    "turned by 90 degrees counterclockwise": lambda values: values.transpose(-1, -2).flip(-2),
    "transposed": lambda values: values.transpose(-1, -2),
    "transposed and turned by 180 degrees": lambda v: v.transpose(-1, -2).flip(-1, -2),
}
"""What may happen to a picture on its way; the last four keep the shape of squares alone."""

TURNED_BACK = {
    "turned by 90 degrees clockwise": "turned by 90 degrees counterclockwise",
    "turned by 90 degrees counterclockwise": "turned by 90 degrees clockwise",
}
"""The turns that are not their own inverse."""


@dataclass(frozen=True, eq=False)
class SmallFrame:
    """One frame in few pixels, padded to a square.

    Attributes:
        mask: where the stored mask says hand.
        mesh: what the posed mesh covers.
        known: where the mask means anything, in the picture.
        colors: of the picture at the capture's average exposure, in [0, 1] or a little above.
        edges: how much the picture's colours change there, at least 0; 0 where not known.
        height: of the picture in it, pixels.
        width: of the picture in it, pixels.
        scale: pixels of the stored picture along one of these.
    """

    mask: Bool[Tensor, "side side"]
    mesh: Bool[Tensor, "side side"]
    known: Bool[Tensor, "side side"]
    colors: Float[Tensor, "3 side side"]
    edges: Float[Tensor, "side side"]
    height: int
    width: int
    scale: float


def small_side(hand: ShapedHand, records: Sequence[FrameRecord]) -> int:
    """Pixels along the longer side of small pictures in which the hands are large enough.

    Args:
        hand: of the capture.
        records: of its frames.
    """
    shares = []
    for record in records[:: max(1, len(records) // 32)]:
        camera = record.camera
        pixels, depths = project(camera, hand.posed(record.pose).vertices)
        pixels = pixels[depths > 0]
        if len(pixels) and bool(pixels.isfinite().all()):
            extent = (pixels.amax(0) - pixels.amin(0)).amax()
            shares.append(float(extent) / max(camera.width, camera.height))
    share = sorted(shares)[len(shares) // 2] if shares else 1.0
    return round(min(max(_HAND_PIXELS / max(share, 1e-3), _SIDES[0]), _SIDES[1]))


def small_frame(frame: Frame, hand: ShapedHand, side: int) -> SmallFrame:
    """A frame's picture, mask and posed mesh in few pixels.

    Args:
        frame: of the capture.
        hand: its shape.
        side: pixels along the longer side.
    """
    camera = small_camera(frame.camera, side)
    size = (camera.height, camera.width)
    # Of large pictures a few pixels for each small one tell enough.
    step = max(1, max(frame.camera.width, frame.camera.height) // (_SAMPLES * side))
    image, coverage, known = (
        each[::step, ::step] for each in (frame.image, frame.coverage, frame.known)
    )
    mesh = covered_pixels(hand.posed(frame.pose).vertices, hand.rig.faces, camera)
    known = _resized(known.float(), size) > 0.999
    mask = (_resized(coverage.float() / 255, size) >= 0.5) & known
    colors = _resized(image.float().permute(2, 0, 1) / 255, size)
    room = (0, side - size[1], 0, side - size[0])
    return SmallFrame(
        mask=pad(mask, room),
        mesh=pad(mesh & known, room),
        known=pad(known, room),
        colors=pad(colors / frame.gain[:, None, None], room),
        edges=pad(_edges(colors, known), room),
        height=size[0],
        width=size[1],
        scale=frame.camera.width / size[1],
    )


def small_camera(camera: Camera, side: int) -> Camera:
    """The same view in few pixels.

    Args:
        camera: of the stored picture.
        side: pixels along the longer side.
    """
    longest = max(camera.width, camera.height)
    return camera.resized(
        max(1, round(camera.width * side / longest)), max(1, round(camera.height * side / longest))
    )


def overlap(
    first: Bool[Tensor, "*batch height width"], second: Bool[Tensor, "*batch height width"]
) -> Float[Tensor, "*batch"]:
    """Intersection over union; 1 if both are empty."""
    union = (first | second).sum((-2, -1))
    shared = (first & second).sum((-2, -1))
    return torch.where(union > 0, shared / union.clamp_min(1), 1.0)


def border(mask: Bool[Tensor, "*batch height width"]) -> Bool[Tensor, "*batch height width"]:
    """Pixels of either side of a mask's border; the picture's own is none."""
    values = mask.float()
    flat = values.reshape(-1, 1, *values.shape[-2:])
    grown = max_pool2d(flat, 3, 1, 1)
    shrunk = 1 - max_pool2d(1 - flat, 3, 1, 1)
    return ((grown - shrunk) > 0).reshape(mask.shape)


def turned(
    values: Tensor, turn: Callable[[Tensor], Tensor], height: int, width: int
) -> Tensor | None:
    """Turns the picture in a padded square; None where it does not keep its shape.

    Args:
        values: side x side.
        turn: of :data:`TURNS`.
        height: of the picture in it.
        width: of the picture in it.
    """
    result = turn(values[..., :height, :width])
    if result.shape[-2:] != (height, width):
        return None
    side = values.shape[-1]
    return pad(result, (0, side - width, 0, side - height))


def shifted_overlap(
    moved: Bool[Tensor, "side side"], fixed: Bool[Tensor, "side side"]
) -> tuple[float, tuple[int, int]]:
    """The best intersection over union that shifts can reach, and the shift: right and down.

    Args:
        moved: what is shifted, past the border if need be.
        fixed: what stays.
    """
    side = moved.shape[-1]
    room = (2 * side, 2 * side)
    spectra = [torch.fft.rfft2(each.float(), s=room) for each in (moved, fixed)]
    shared = torch.fft.irfft2(spectra[0].conj() * spectra[1], s=room)
    union = moved.sum() + fixed.sum() - shared
    scores = shared / union.clamp_min(1)
    best = int(scores.argmax())
    down, right = divmod(best, 2 * side)
    down, right = (each - 2 * side if each >= side else each for each in (down, right))
    return float(scores.flatten()[best]), (right, down)


def shifted_border(
    edges: Float[Tensor, "side side"], mask: Bool[Tensor, "side side"]
) -> tuple[float, tuple[int, int]]:
    """The best of :func:`edge_scores` that shifts of the mask can reach, and the shift.

    Args:
        edges: of :class:`SmallFrame`.
        mask: shifted right and down, past the border if need be.
    """
    side = mask.shape[-1]
    room = (2 * side, 2 * side)
    line = border(mask)
    spectra = [torch.fft.rfft2(each.float(), s=room) for each in (line, edges)]
    scores = torch.fft.irfft2(spectra[0].conj() * spectra[1], s=room)
    # Most of the border must stay in the picture: else it may hide outside of all edges.
    inside = torch.fft.irfft2(
        spectra[0].conj() * torch.fft.rfft2(torch.ones(side, side), s=room), s=room
    )
    scores = torch.where(inside > 0.7 * line.sum(), scores / inside.clamp_min(1), 0.0)
    best = int(scores.argmax())
    down, right = divmod(best, 2 * side)
    down, right = (each - 2 * side if each >= side else each for each in (down, right))
    return float(scores.flatten()[best] / edges.mean().clamp_min(1e-6)), (right, down)


def shifted(mask: Bool[Tensor, "side side"], right: int, down: int) -> Bool[Tensor, "side side"]:
    """A mask moved by whole pixels; what leaves the square is lost.

    Args:
        mask: to be moved.
        right: pixels; negative to the left.
        down: pixels; negative upwards.
    """
    height, width = mask.shape
    moved = pad(mask, (max(right, 0), max(-right, 0), max(down, 0), max(-down, 0)))
    return moved[max(-down, 0) :, max(-right, 0) :][:height, :width]


class SkinColors:
    """How much more often a colour is seen inside the masks of all frames than outside of them."""

    def __init__(self, frames: Sequence[SmallFrame]) -> None:
        """Counts the colours of known pixels.

        Args:
            frames: of one capture.
        """
        counts = torch.ones(2, _COLOR_BINS**3)
        for frame in frames:
            bins = self._bins(frame)
            for place, region in enumerate((frame.mask, ~frame.mask & frame.known)):
                counts[place] += torch.bincount(bins[region], minlength=_COLOR_BINS**3)
        shares = counts / counts.sum(1, keepdim=True)
        self._log_ratios = (shares[0] / shares[1]).log()

    def contrast(self, frame: SmallFrame, mask: Bool[Tensor, "side side"]) -> float:
        """How clearly a mask parts hand from background in a frame, by their colours.

        Args:
            frame: one of those that were counted, or of the same capture.
            mask: any.

        Returns:
            Mean logarithm of the ratio inside less that outside; 0 where one of both is empty.
        """
        inside, outside = mask & frame.known, ~mask & frame.known
        if not bool(inside.any()) or not bool(outside.any()):
            return 0.0
        ratios = self._log_ratios[self._bins(frame)]
        return float(ratios[inside].mean() - ratios[outside].mean())

    def _bins(self, frame: SmallFrame) -> Int[Tensor, "side side"]:
        red, green, blue = (frame.colors * _COLOR_BINS).long().clamp(0, _COLOR_BINS - 1)
        return (red * _COLOR_BINS + green) * _COLOR_BINS + blue


def edge_scores(
    edges: Float[Tensor, "pictures side side"], masks: Bool[Tensor, "masks side side"]
) -> Float[Tensor, "pictures masks"]:
    """How much colours change along each mask's border, against the whole picture's change.

    1 for a mask that has nothing to do with the picture; several for the picture's own.

    Args:
        edges: of :class:`SmallFrame`.
        masks: any.
    """
    lines = border(masks).flatten(1).float()
    lines = lines / lines.sum(1, keepdim=True).clamp_min(1)
    mean = edges.flatten(1).mean(1, keepdim=True).clamp_min(1e-6)
    return (edges.flatten(1) / mean) @ lines.T


def _edges(
    colors: Float[Tensor, "3 height width"], known: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """The largest difference of a pixel to its neighbours, in any channel."""
    grown = max_pool2d(colors[None], 3, 1, 1)[0]
    shrunk = -max_pool2d(-colors[None], 3, 1, 1)[0]
    unsure = max_pool2d((~known).float()[None], 3, 1, 1)[0] > 0
    return (grown - shrunk).amax(0) * ~unsure


def _resized(values: Float[Tensor, "*channels height width"], size: tuple[int, int]) -> Tensor:
    flat = values.reshape(1, -1, *values.shape[-2:])
    return interpolate(flat, size, mode="area").reshape(*values.shape[:-2], *size)
