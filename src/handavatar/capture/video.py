"""A person's own video of one hand, made into a capture: track, mask, fit, crop, write."""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import video_frames
from handavatar.capture.fitted_hand import HandFit, HandModel
from handavatar.capture.fitting import (
    FitOptions,
    Observations,
    fit_hands,
    landmark_errors,
    single_threaded,
)
from handavatar.capture.frames import Capture, CaptureWriter, Frame, read_capture
from handavatar.capture.masks import HandMask, find_mask, learn_colors, pixels_per_metre
from handavatar.capture.outlines import (
    OutlineMatcher,
    is_behind_wrist,
    mask_outline,
    silhouette,
)
from handavatar.capture.tracking import Track, TrackedHand, track_hand
from handavatar.capture.windows import resampled, window_camera
from handavatar.geometry.cameras import project
from handavatar.hand.rig import Rig
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import files_named

Piece = TypeVar("Piece")
Result = TypeVar("Result")
Progress = Callable[[float, str], None]
"""Told the share of the work that is done, in [0, 1], and what is being done."""

_BOX_SCALE = 1.3
_SUBPIXELS = 3
_WRIST_BAND = 0.020
_WRIST_SLACK = 0.004
_HELD_OUT = ((0.28, 0.08), (0.68, 0.08))
_MIN_KEPT = 8
_SHEET_TILE = 192
_SHEET_COLUMNS = 9
_SHEET_FRAMES = 63


@dataclass(frozen=True)
class VideoOptions:
    """From a video file to a capture."""

    file: Path
    """The video: mp4, mov, mkv or webm; one bare hand, whole, well lit."""
    out: Path
    """Folder of the capture."""
    fps: float = 10.0
    """Pictures taken per second of video."""
    max_frames: int = 600
    """Stop after this many pictures."""
    side: Literal["auto", "left", "right"] = "auto"
    """Which hand it is; auto takes the video as not mirrored."""
    size: int = 256
    """Side of the stored pictures, pixels."""
    min_confidence: float = 0.5
    """Frames whose pose is less sure are left out, by name."""
    subject: str = "unnamed"
    """Whose hand it is."""
    licence: str = "private"
    """Terms under which the video may be used."""
    overwrite: bool = False
    """Replace a capture that is already in the folder."""
    rig: str = "open-hand"
    """The hand to lay onto the pictures: open-hand, an imported one (mano-right) or its file."""
    fit: FitOptions = field(default_factory=FitOptions)
    """How the hand is fitted."""


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """What became of one picture in which the hand was found.

    Attributes:
        frame: cropped picture, cut mask, camera, pose; its split is set when it is written.
        mesh: pixels that the fitted hand covers.
        mask_iou: agreement of mask and mesh in front of the wrist, intersection over union.
        landmark_error: mean distance of fitted and tracked landmarks, pixels of the crop.
    """

    frame: Frame
    mesh: Bool[np.ndarray, "height width"]
    mask_iou: float
    landmark_error: float


def capture_video(
    options: VideoOptions,
    rig: Rig | None = None,
    progress: Progress | None = None,
    track: Track | None = None,
) -> Capture:
    """Makes a capture of a video of one hand.

    Poses come from landmarks and masks alone, in held-out frames as in all others. World axes are
    those of the camera, which is taken as standing still.

    Args:
        options: which video, where to, how.
        rig: the hand to lay onto the pictures; the one that the options name if None.
        progress: called now and then.
        track: what the tracker found in the video already; it is tracked if None.

    Returns:
        The capture as written. Frames that were left out stand with their reason in its
        ``skipped.json``, the agreement of every frame in ``fit.json``.

    Raises:
        CaptureError: the video cannot be used, the folder is in use, or an extra is missing.
    """
    report = progress or (lambda share, doing: None)
    rig = rig or load_rig(options.rig)
    header = {
        "rig_name": rig.name,
        "rig_sha256": rig.sha256,
        "subject": options.subject,
        "source": options.file.name,
        "licence": options.licence,
        "overwrite": options.overwrite,
        "inputs": (options.file, *files_named(options.rig)),
    }
    CaptureWriter(options.out, **header)  # type: ignore[arg-type]  # refuses a folder in use now
    track = track or track_hand(
        video_frames(options.file, options.fps, options.max_frames),
        options.side,
        lambda done, _: report(0.4 * done / (done + 60), "finding the hand"),
    )
    masks = _found_masks(track, report)
    fit, results = _fitted(track, masks, rig, options, report)
    report(0.95, "writing")
    skipped = {f"{index:06d}": reason for index, reason in track.skipped.items()}
    for result in results:
        if result.frame.confidence < options.min_confidence:
            skipped[result.frame.name] = f"unsure pose: confidence {result.frame.confidence:.2f}"
    kept = [result for result in results if result.frame.name not in skipped]
    if len(kept) < _MIN_KEPT:
        raise CaptureError(
            f"{options.file}: only {len(kept)} of {len(results) + len(track.skipped)} pictures "
            f"could be fitted with confidence; at least {_MIN_KEPT} are needed",
            "record slower movements, in better light, before a plain background",
        )
    splits = held_out_splits(len(kept))
    with CaptureWriter(
        options.out,
        side=track.side,
        shape_coefficients=fit.shape_coefficients,
        **header,  # type: ignore[arg-type]
    ) as writer:
        for result, split in zip(kept, splits, strict=True):
            writer.add(_with_split(result.frame, split))
        _save_json(writer.file("skipped.json"), skipped)
        _save_json(writer.file("fit.json"), _summary(results, fit))
        _overview(results, set(skipped)).save(writer.file("overview.png"))
    report(1.0, "done")
    return read_capture(options.out)


def _found_masks(track: Track, report: Progress) -> list[HandMask]:
    report(0.4, "learning the colour of the skin")
    colors = learn_colors(track.hands)
    return _on_all_cores(
        lambda hand: find_mask(hand, colors),
        track.hands,
        lambda share: report(0.4 + 0.25 * share, "cutting out the hand"),
    )


def _on_all_cores(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], report: Callable[[float], None]
) -> list[Result]:
    """The work on every piece, in order; told is the share of the pieces that is done."""
    results: list[Result] = []
    # Torch's number of threads belongs to a thread.
    with ThreadPoolExecutor(
        os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        for result in pool.map(work, pieces):
            results.append(result)
            report(len(results) / len(pieces))
    return results


def observations_of(track: Track) -> Observations:
    """What the tracker saw, as tensors."""

    def stacked(values: list[object]) -> Tensor:
        return torch.from_numpy(np.array(values)).float()

    return Observations(
        landmarks=stacked([hand.landmarks for hand in track.hands]),
        uncertainty=stacked([hand.spread for hand in track.hands]),
        world_landmarks=stacked([hand.world_landmarks for hand in track.hands]),
        scale=stacked([pixels_per_metre(hand) for hand in track.hands]),
        times=stacked([hand.time for hand in track.hands]),
        picture_size=track.picture_size,
    )


@single_threaded()
def _fitted(
    track: Track, masks: list[HandMask], rig: Rig, options: VideoOptions, report: Progress
) -> tuple[HandFit, list[FittedFrame]]:
    report(0.65, "fitting the hand")
    observations = observations_of(track)
    outlines = [
        mask_outline(mask.pixels, hand.window, float(scale))
        for hand, mask, scale in zip(track.hands, masks, observations.scale, strict=True)
    ]
    matcher = OutlineMatcher(rig, outlines, track.picture_size)
    fit = fit_hands(rig, observations, options.fit, matcher)
    report(0.85, "cropping")
    model = HandModel(rig)
    vertices = model.all_vertices(fit)
    errors = landmark_errors(model, observations, fit)

    def cropped(number: int) -> FittedFrame:
        hand, mask = track.hands[number], masks[number]
        error_metres = float(errors[number] / observations.scale[number])
        return _result(hand, mask, rig, fit, number, vertices[number], error_metres, options.size)

    results = _on_all_cores(
        cropped, range(len(masks)), lambda share: report(0.85 + 0.1 * share, "cropping")
    )
    return fit, results


def _result(
    hand: TrackedHand,
    mask: HandMask,
    rig: Rig,
    fit: HandFit,
    number: int,
    vertices: Float[Tensor, "vertices 3"],
    error_metres: float,
    size: int,
) -> FittedFrame:
    """One frame's crop, with its mask cut where the mesh ends."""
    window = hand.window
    side = window.image.shape[0]
    whole = window_camera(fit.focal, window.picture_size, window.corner, side / window.scale, side)
    rim = rig.rim.numpy()
    places = project(whole, vertices)[0].numpy()
    corner, box = _box(_before_wrist(mask.pixels, places[rim], places.mean(0)))
    camera = window_camera(
        fit.focal,
        window.picture_size,
        (window.corner[0] + corner[0] / window.scale, window.corner[1] + corner[1] / window.scale),
        box / window.scale,
        size,
    )
    zoom = np.eye(2) * (box / size)
    image = resampled(window.image, zoom, np.array(corner), size)
    grey = np.repeat((255 * mask.level[..., None]).round().astype(np.uint8), 3, axis=-1)
    fine = _SUBPIXELS * size
    full = resampled(grey, zoom / _SUBPIXELS, np.array(corner), fine)[..., 0] > 127
    fine_camera = camera.resized(fine, fine)
    mesh = silhouette(rig, vertices, fine_camera)
    scale = pixels_per_metre(hand) * window.scale * fine / box
    cut = _cut_mask(full, mesh, project(fine_camera, vertices)[0].numpy(), rim, scale)
    iou = float((mesh & cut).sum() / max(1, int((mesh | cut).sum())))
    frame = Frame(
        name=f"{hand.index:06d}",
        image=torch.from_numpy(image.copy()),
        coverage=torch.from_numpy((255 * _shares(cut)).round().astype(np.uint8)),
        camera=camera,
        pose=fit.pose(number),
        confidence=_confidence(hand, mask, iou, error_metres),
        split="train",
        time=hand.time,
    )
    return FittedFrame(frame, _shares(mesh) > 0.5, iou, error_metres * scale / _SUBPIXELS)


def _shares(fine: Bool[np.ndarray, "fine fine"]) -> Float[np.ndarray, "side side"]:
    """How much of each pixel is true, in [0, 1], of a mask of ``_SUBPIXELS`` times the size."""
    side = len(fine) // _SUBPIXELS
    return fine.reshape(side, _SUBPIXELS, side, _SUBPIXELS).mean(axis=(1, 3))


def _confidence(hand: TrackedHand, mask: HandMask, iou: float, error_metres: float) -> float:
    """How far a pose is to be trusted: 1 if outline, landmarks and tracker all agree."""
    spread_metres = float(hand.spread.mean()) / pixels_per_metre(hand)
    outline = np.clip((iou - 0.65) / 0.25, 0, 1)
    landmarks = np.exp(-((error_metres / 0.008) ** 2))
    agreement = np.exp(-((spread_metres / 0.015) ** 2))
    is_clear = np.clip((mask.quality - 0.5) / 0.35, 0, 1)
    presence = np.clip(hand.presence / 0.9, 0, 1)
    return float(outline * landmarks * agreement * is_clear * presence)


def _before_wrist(
    mask: Bool[np.ndarray, "side side"],
    rim: Float[np.ndarray, "rim 2"],
    hand: Float[np.ndarray, "2"],
    margin: float = 0.0,
) -> Bool[np.ndarray, "side side"]:
    """The part of a mask in front of the wrist line, by at least ``margin`` pixels."""
    rows, columns = np.nonzero(mask)
    centers = np.stack([columns, rows], axis=-1) + 0.5
    before = ~is_behind_wrist(centers, rim, hand, margin)
    result = np.zeros_like(mask)
    result[rows[before], columns[before]] = True
    return result


def _cut_mask(
    mask: Bool[np.ndarray, "side side"],
    mesh: Bool[np.ndarray, "side side"],
    places: Float[np.ndarray, "vertices 2"],
    rim: Int[np.ndarray, "rim"],
    scale: float,
) -> Bool[np.ndarray, "side side"]:
    """The mask without the forearm.

    Behind the wrist line only what the mesh covers stays, just before it only what is close to
    the mesh: a forearm that leaves at an angle would leave a spur there.

    Args:
        mask: hand and forearm.
        mesh: pixels that the fitted hand covers.
        places: its vertices, pixels.
        rim: those at its end.
        scale: pixels per metre at the hand.
    """
    center = places.mean(0)
    sure = _before_wrist(mask, places[rim], center, _WRIST_BAND * scale)
    doubtful = _before_wrist(mask, places[rim], center) & ~sure
    close = ndimage.distance_transform_edt(~mesh) < _WRIST_SLACK * scale
    return sure | (doubtful & close) | (mask & mesh)


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


def held_out_splits(count: int) -> list[str]:
    """Two stretches of time are held out for tests, together at least 15 % of the frames."""
    splits = ["train"] * count
    for start, share in _HELD_OUT:
        first, length = round(start * count), int(np.ceil(share * count))
        splits[first : first + length] = ["test"] * length
    return splits


def _with_split(frame: Frame, split: str) -> Frame:
    return Frame(**{**vars(frame), "split": split})


def _summary(results: list[FittedFrame], fit: HandFit) -> dict[str, object]:
    return {
        "focal_pixels": fit.focal,
        "mean_mask_iou": float(np.mean([result.mask_iou for result in results])),
        "mean_landmark_error_pixels": float(np.mean([r.landmark_error for r in results])),
        "frames": {
            result.frame.name: {
                "confidence": round(result.frame.confidence, 4),
                "mask_iou": round(result.mask_iou, 4),
                "landmark_error_pixels": round(result.landmark_error, 3),
            }
            for result in results
        },
    }


def _save_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


def _overview(results: list[FittedFrame], skipped: set[str]) -> Image.Image:
    """Contact sheet: mask outline green, mesh outline red, what was left out framed in red."""
    step = max(1, -(-len(results) // _SHEET_FRAMES))
    shown = results[::step]
    rows = -(-len(shown) // _SHEET_COLUMNS)
    sheet = Image.new("RGB", (_SHEET_COLUMNS * _SHEET_TILE, rows * _SHEET_TILE))
    for place, result in enumerate(shown):
        tile = Image.fromarray(_drawn_outlines(result)).resize((_SHEET_TILE, _SHEET_TILE))
        draw = ImageDraw.Draw(tile)
        text = f"{result.frame.name}  {result.frame.confidence:.2f}"
        draw.text((4, 3), text, fill="white", stroke_width=1, stroke_fill="black")
        if result.frame.name in skipped:
            draw.rectangle((0, 0, _SHEET_TILE - 1, _SHEET_TILE - 1), outline="red", width=3)
        row, column = divmod(place, _SHEET_COLUMNS)
        sheet.paste(tile, (column * _SHEET_TILE, row * _SHEET_TILE))
    return sheet


def _drawn_outlines(result: FittedFrame) -> UInt8[np.ndarray, "height width 3"]:
    image = result.frame.image.numpy().copy()
    mask = result.frame.mask.numpy()
    image[mask ^ ndimage.binary_erosion(mask)] = (0, 255, 0)
    image[result.mesh ^ ndimage.binary_erosion(result.mesh)] = (255, 40, 40)
    return image
