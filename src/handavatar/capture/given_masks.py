"""Masks that the user gives: a folder or pattern of pictures, or a video; white is hand."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from handavatar.capture.checks import CaptureError, decoded
from handavatar.capture.decoding import Sampling, have_same_shape, video_frames
from handavatar.capture.left_out import NO_MASK
from handavatar.capture.masks import HandMask
from handavatar.capture.picture_folders import (
    is_picture_source,
    open_picture_file,
    picture_files,
)
from handavatar.capture.tracking import Track, TrackedHand
from handavatar.capture.windows import resampled

# Of the landmarks, that lie in the masks of half of the pictures.
_LEAST_INSIDE = 0.6
Straighten = Callable[[UInt8[np.ndarray, "height width 3"]], UInt8[np.ndarray, "_ _ 3"]]
"""Makes a pinhole's picture of one of a lens."""


def give_masks(
    track: Track,
    masks: Path,
    names: dict[int, str],
    sampling: Sampling,
    straighten: Straighten,
) -> tuple[Track, list[HandMask]]:
    """The masks of all pictures in which the hand was found.

    Masks belong to pictures by their names (``0007.jpg`` has ``0007.png`` or ``0007.jpg.png``), to
    those of a video by the numbers in their names, counted from 0 or 1; masks in a video by time.

    Args:
        track: the hand in its pictures.
        masks: folder, pattern or video.
        names: of the pictures' files, by index; empty for a video.
        sampling: by which the pictures were taken.
        straighten: what was done to the pictures.

    Returns:
        The track without the pictures that have no mask, which are skipped by that name; the masks
        of its hands.

    Raises:
        CaptureError: masks cannot be read, have another shape, or do not lie on the hand.
    """
    found: dict[int, HandMask] = {}
    hands = {hand.index: hand for hand in track.hands}
    for index, picture in _pictures(masks, names, sampling, hands):
        if index in hands:
            picture = straighten(_as_large(picture, track.picture_size, masks))
            found[index] = _in_window(hands[index], picture, track.side)
    kept = tuple(hand for hand in track.hands if hand.index in found)
    _check(track, kept, found, masks)
    lacking = {index: NO_MASK for index in hands if index not in found}
    given = [found[hand.index] for hand in kept]
    return replace(track, hands=kept, skipped=track.skipped | lacking), given


def _pictures(
    masks: Path, names: dict[int, str], sampling: Sampling, hands: dict[int, TrackedHand]
) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Indices of pictures, and their masks."""
    if not is_picture_source(masks):
        times = {hand.index: hand.time for hand in hands.values()}
        for frame in video_frames(masks, sampling):
            if abs(times.get(frame.index, frame.time) - frame.time) > 0.5 / sampling.fps:
                raise CaptureError(
                    f"{masks}: frame {frame.index} is at {frame.time:.2f} s, that of the video at "
                    f"{times[frame.index]:.2f} s",
                    "give a video of masks with the same frames at the same times",
                )
            yield frame.index, frame.image
        return
    files = picture_files(masks, lambda text: None)
    by_index = _by_name(files, names) if names else _by_number(files, masks, max(hands, default=0))
    for index, file in by_index.items():
        if index in hands:
            yield index, read_mask(file)


def _by_name(files: list[Path], names: dict[int, str]) -> dict[int, Path]:
    by_name = {file.name: file for file in files}
    by_stem = {file.stem: file for file in files}
    found = {}
    for index, name in names.items():
        file = by_stem.get(name) or by_name.get(name) or by_stem.get(Path(name).stem)
        if file is not None:
            found[index] = file
    return found


def _by_number(files: list[Path], masks: Path, last: int) -> dict[int, Path]:
    """By the last number in a name, which counts the video's frames."""
    found: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"\d+", file.stem)
        if not digits:
            raise CaptureError(
                f"{file}: no number in its name", "name masks by the number of their frame"
            )
        found[int(digits[-1])] = file
    first = min(found)
    if first not in (0, 1) or max(found) - first < last:
        raise CaptureError(
            f"{masks}: masks have the numbers {first} to {max(found)}; those of the video's frames "
            f"go from 0 or 1 to {last + first if first in (0, 1) else last} at least",
            "give a mask for every frame of the video, or pictures and masks as two folders",
        )
    return {number - first: file for number, file in found.items()}


def read_mask(file: Path) -> UInt8[np.ndarray, "height width 3"]:
    """A mask as 0 and 255, whatever its levels.

    Args:
        file: a picture; its alpha, its labels (0 is none), or its grey levels say what is hand.

    Raises:
        CaptureError: it is damaged, or shows several objects.
    """
    picture = open_picture_file(file)
    if picture.mode in ("RGBA", "LA"):
        grey = decoded(picture, str(file))[..., -1]
    elif picture.mode == "P":
        # Labels of objects, as segmentation programs write them; 0 is none of them.
        labels = decoded(picture, str(file))
        objects = np.unique(labels[labels > 0])
        if len(objects) > 1:
            raise CaptureError(
                f"{file}: labels {', '.join(map(str, objects[:5].tolist()))}: several objects",
                "give masks of the hand alone",
            )
        grey = (labels > 0).astype(np.uint8) * np.uint8(255)
    else:
        grey = decoded(picture, str(file), "L")
    if grey.max() == 1:
        grey = grey * np.uint8(255)
    return np.repeat(grey[..., None], 3, axis=2)


def _as_large(
    mask: UInt8[np.ndarray, "height width 3"], size: tuple[int, int], masks: Path
) -> UInt8[np.ndarray, "_ _ 3"]:
    """A mask with as many pixels as the pictures."""
    own = (mask.shape[1], mask.shape[0])
    if not have_same_shape(own, size):
        raise CaptureError(
            f"{masks}: masks of {own[0]} x {own[1]} for pictures of {size[0]} x {size[1]}",
            "give masks of the pictures' own size",
        )
    if own == size:
        return mask
    return np.array(Image.fromarray(mask).resize(size, Image.Resampling.BILINEAR))


def _in_window(hand: TrackedHand, mask: UInt8[np.ndarray, "height width 3"], side: str) -> HandMask:
    """The mask of a hand's window."""
    if side == "left":
        mask = np.ascontiguousarray(mask[:, ::-1])
    window = hand.window
    zoom, pixels = np.eye(2) / window.scale, window.image.shape[0]
    level = resampled(mask, zoom, np.array(window.corner), pixels)[..., 0]
    soft: Float[np.ndarray, "side side"] = level.astype(np.float64) / 255
    return HandMask(soft > 0.5, soft, 1.0)


def _check(
    track: Track, kept: tuple[TrackedHand, ...], found: dict[int, HandMask], masks: Path
) -> None:
    """Refuses masks that belong to other pictures, or show what is not hand."""
    if not kept:
        raise CaptureError(
            f"{masks}: no mask for any of the {len(track.hands)} pictures that show a hand",
            "name masks like the pictures, or by the numbers of the video's frames",
        )
    shares = []
    for hand in kept:
        pixels = found[hand.index].pixels
        places = np.floor(hand.window.from_picture(hand.landmarks)).astype(int)
        places = places.clip(0, len(pixels) - 1)
        shares.append(float(pixels[places[:, 1], places[:, 0]].mean()))
    middle = float(np.median(shares))
    if middle < _LEAST_INSIDE:
        raise CaptureError(
            f"{masks}: of the hand's landmarks {100 * middle:.0f} % lie in its masks, in half of "
            "the pictures even fewer",
            "white has to be the hand and black the rest, and masks have to be those of exactly "
            "these pictures",
        )
