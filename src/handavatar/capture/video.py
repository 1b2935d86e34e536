"""A person's own video of one hand, made into a capture: track, mask, fit, crop, write."""

import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from safetensors.torch import save_file
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling
from handavatar.capture.exposure import exposure_gains
from handavatar.capture.fitted_hand import HandFit, HandModel
from handavatar.capture.fitting import (
    FitOptions,
    Observations,
    fit_hands,
    fit_poses,
    landmark_errors,
    with_skin,
)
from handavatar.capture.frames import SPLITS, Capture, CaptureWriter, Frame, read_capture
from handavatar.capture.guided_masks import (
    GuidedMask,
    WristLine,
    cut_at_wrist,
    find_guided_mask,
    is_cut_unsure,
    learn_guided_colors,
    placed_mesh,
    wrist_line,
)
from handavatar.capture.masks import (
    HandMask,
    covered_shares,
    find_mask,
    grey_picture,
    inside_picture,
    learn_colors,
    mask_coverage,
    pixels_per_metre,
)
from handavatar.capture.outlines import silhouette
from handavatar.capture.overview import Tile, contact_sheet, outlined
from handavatar.capture.own_finder import OwnFinder
from handavatar.capture.picture_folders import frames_of
from handavatar.capture.registration import (
    observe_hands,
    posed_vertices,
    register_hands,
    see_landmarks,
    window_view,
)
from handavatar.capture.seen_skin import SeenSkin, count_seen_skin
from handavatar.capture.skin_points import see_points, world_places
from handavatar.capture.tracking import (
    NO_HAND,
    OTHER_HAND,
    TWO_HANDS,
    Track,
    TrackedHand,
    UnusableTrackError,
    has_mediapipe,
    track_hand,
)
from handavatar.capture.windows import Window, resampled, window_camera
from handavatar.fit.energy import VIDEO_TEXTURE_SHARE, EnergyOptions
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.fit.register import RegisterOptions
from handavatar.geometry.cameras import Camera, project
from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.hand.rig import Rig
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import FolderKind, files_named, mark_folder
from handavatar.jobs.threads import one_thread
from handavatar.tracker.model import shipped_tracker

Piece = TypeVar("Piece")
Result = TypeVar("Result")
TrackerChoice = Literal["auto", "own", "mediapipe", "both"]
"""Who finds hands and their landmarks in a video."""
Progress = Callable[[float, str], None]
"""Told the share of the work that is done, in [0, 1], and what is being done."""

_BOX_SCALE = 1.3
_SIZES = (256, 512)
# Pixels along a side at which the fitted mesh is compared with its mask, at least.
_MESH_SIDE = 768
_WRIST_MARGIN = 0.008
"""Metres before the rig's end from where on masks are believed."""
_HELD_OUT = ((0.28, 0.08), (0.68, 0.08))
_MIN_KEPT = 8
_SEEN_SHARE = 0.9
# Side of the little picture in which it is counted how much of the hand was seen.
_COUNTED_SIDE = 96
# Pixels of the video between the farthest landmarks of a hand.
_SMALLEST_HAND = 48.0
# Of a video's pictures, 0 to 255.
_DARK = 30.0
# Of the mesh: as much of it beyond the picture is contact with the border.
_TOUCHES = 0.01
# Of the tracker's votes for one side.
_CLEAR_VOTE = 0.75


@dataclass(frozen=True)
class VideoOptions:
    """From a video file to a capture."""

    file: Path
    """The video (mp4, mov, mkv, webm, avi, ts, gif), or its pictures: a folder, or a pattern such
    as frames/%04d.png. One bare hand, whole, well lit."""
    out: Path
    """Folder of the capture."""
    fps: float = 10.0
    """Pictures taken per second of video: the nearest frame to each of these times."""
    max_frames: int = 600
    """Stop after this many pictures."""
    start: float = 0.0
    """Seconds of the video from which pictures are taken."""
    end: float | None = None
    """Seconds until which they are; the end of the video by default."""
    side: Literal["auto", "left", "right"] = "auto"
    """Which hand it is; auto takes the video as not mirrored."""
    hand: Literal["only", "left", "right", "larger", "both"] = "only"
    """Which of two hands that are seen together is taken; only: there is one; both: two captures,
    OUT-left and OUT-right."""
    tracker: TrackerChoice = "auto"
    """Who finds the hand and tells where its landmarks are: our own tracker, mediapipe, or both,
    mediapipe finding the hand; auto: both where mediapipe is installed, else our own."""
    size: int | None = None
    """Side of the stored pictures, pixels; by default 512 where hands are as large, else 256."""
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
    """How the hand is first fitted, to landmarks alone."""
    register: RegisterOptions = field(
        default_factory=lambda: RegisterOptions(
            coefficient_sigma=1.0,
            tilts=(25.0,),
            restarts=1,
            texture_rounds=2,
            energy=EnergyOptions(texture_share=VIDEO_TEXTURE_SHARE),
        )
    )
    """How the hand is laid onto masks and texture."""

    def sampling(self) -> Sampling:
        """Which pictures of the video are taken.

        Raises:
            ValueError: none would be.
        """
        return Sampling(self.fps, self.max_frames, self.start, self.end)

    def of_each_hand(self) -> list["VideoOptions"]:
        """One for every capture that is asked for."""
        if self.hand != "both":
            return [self]
        sides: tuple[Literal["left", "right"], ...] = ("left", "right")
        return [
            replace(self, hand=side, out=self.out.with_name(f"{self.out.name}-{side}"))
            for side in sides
        ]


@dataclass(frozen=True, eq=False)
class FittedHands:
    """The hand laid onto all pictures in which it was found.

    Attributes:
        fit: shape, poses, focal length.
        vertices: of the rig in every frame, metres, camera axes.
        landmark_errors: mean distance of fitted and tracked landmarks, metres.
        covariances: of the poses' errors as far as motion tells them; zeros where nothing was
            asked.
        landmarks: of the tracker, with their offsets from joints as found.
    """

    fit: HandFit
    vertices: Float[Tensor, "frames vertices 3"]
    landmark_errors: Float[Tensor, "frames"]
    covariances: Float[Tensor, "frames 51 51"]
    landmarks: list[LandmarkSightings]


@dataclass(frozen=True)
class LeftOut:
    """Why a picture is not in the capture.

    Attributes:
        kind: a key of ``CAUSES``.
        text: the same with figures.
    """

    kind: str
    text: str


CAUSES: dict[str, tuple[str, str]] = {
    "border": (
        "the hand leaves the picture",
        "keep the whole hand and the wrist in the picture: step back, or move to its middle",
    ),
    "hidden": (
        "something hides the hand",
        "push the sleeve back, and let nothing come before the hand",
    ),
    "background": (
        "what is behind the hand looks like skin (a face, clothes, wood)",
        "hold the hand before something of another colour",
    ),
    "pose": (
        "hand and tracked pose do not fit together",
        "move slowly; turn fists and edge-on hands so that the fingers are seen",
    ),
    "side": (
        "the hand may have been taken for the other one",
        "if the side is wrong, name it with --side left or --side right",
    ),
    "small": ("the hand is too small", "come closer to the camera"),
    "dark": ("the pictures are too dark", "record in more light"),
    TWO_HANDS: (
        "there are two hands",
        "choose one with --hand left, --hand right or --hand larger, or record one alone",
    ),
    OTHER_HAND: (
        "it is the other hand",
        "record one hand, or choose it with --side left or --side right",
    ),
    NO_HAND: ("no hand is seen", "record one bare hand, whole, larger than a sixth of the picture"),
}
"""What goes wrong with a picture, and what to do about it."""

FAILED_CAPTURE = FolderKind("failed capture", ("overview.png", "reasons.json"))
"""The folder that shows why a video could not be used."""


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


def capture_video(
    options: VideoOptions,
    rig: Rig | None = None,
    progress: Progress | None = None,
    track: Track | None = None,
) -> Capture:
    """Makes a capture of a video of one hand.

    Poses come from landmarks, masks and texture, in held-out frames as in all others. World axes
    are those of the camera, which is taken as standing still.

    Args:
        options: which video, where to, how.
        rig: the hand to lay onto the pictures; the one that the options name if None.
        progress: called now and then.
        track: what the tracker found in the video already; it is tracked if None.

    Returns:
        The capture as written. Frames that were left out stand with their reason in its
        ``skipped.json``, the agreement of every frame and a summary in ``fit.json``.

    Raises:
        CaptureError: the video cannot be used, the folder is in use, or an extra is missing. If the
            pictures are the cause, a folder beside the would-be capture shows them.
    """
    report = progress or (lambda share, doing: None)
    options.sampling()  # Refuses what selects nothing, before any work.
    rig = rig or load_rig(options.rig)
    header = _header(options, rig)
    CaptureWriter(options.out, **header)  # type: ignore[arg-type]  # refuses a folder in use now
    try:
        track = track or track_video(
            options, lambda done, _: report(0.4 * done / (done + 60), "finding the hand")
        )
    except UnusableTrackError as error:
        raise _failure(options, error.what, error.remedy, error.track, []) from error
    if track.is_own or options.tracker != "mediapipe":
        track = see_skin(track, rig)
    # By time, over all pictures, before anybody knows which of them can be fitted.
    splits = splits_by_index(track)
    fitted, results = _laid_on(track, rig, options, report)
    report(0.96, "writing")
    left_out = _left_out(track, results)
    kept = [result for result in results if result.frame.name not in left_out]
    if len(kept) < _MIN_KEPT:
        what, remedy = _cause(options, track, left_out, len(kept))
        raise _failure(options, what, remedy, track, results)
    kept_frames = _with_common_gain(
        [replace(result.frame, split=splits[int(result.frame.name)]) for result in kept]
    )
    seen = count_seen_skin(rig, fitted.fit.shape_coefficients, kept_frames)
    with CaptureWriter(
        options.out,
        side=track.side,
        shape_coefficients=fitted.fit.shape_coefficients,
        **header,  # type: ignore[arg-type]
    ) as writer:
        for frame in kept_frames:
            writer.add(frame)
        _save_json(writer.file("skipped.json"), _skipped(left_out))
        summary = _summary(track, splits, results, kept_frames, left_out, seen)
        _save_json(writer.file("fit.json"), _agreement(results, fitted.fit) | {"summary": summary})
        save_file({"counts": seen.counts.int()}, writer.file("seen.safetensors"))
        contact_sheet(_tiles(track, results)).save(writer.file("overview.png"))
    report(1.0, "done")
    return read_capture(options.out)


def refuse_capture_in_use(options: VideoOptions) -> None:
    """Refuses what :func:`capture_video` would refuse, before there is a video.

    Raises:
        CaptureError: the folder is in use.
        RigError: there is no such rig.
        ValueError: no picture would be selected.
    """
    options.sampling()
    CaptureWriter(options.out, **_header(options, load_rig(options.rig)))  # type: ignore[arg-type]


def _header(options: VideoOptions, rig: Rig) -> dict[str, object]:
    """What a capture says of itself, and what it may not be written over."""
    return {
        "rig_name": rig.name,
        "rig_sha256": rig.sha256,
        "subject": options.subject,
        "source": options.file.name,
        "licence": options.licence,
        "overwrite": options.overwrite,
        "inputs": (options.file, *files_named(options.rig)),
    }


def track_video(options: VideoOptions, progress: Callable[[int, str], None] | None = None) -> Track:
    """Finds the hand in the pictures of a video.

    Args:
        options: which video, pictures and hand.
        progress: called with the number of pictures done and a word.

    Raises:
        UnusableTrackError: there is no hand to go on with.
        CaptureError: the video cannot be read, or an extra is missing.
    """
    if options.hand == "both":
        raise ValueError("--hand both makes two captures: ask for one of VideoOptions.of_each_hand")
    notes: list[str] = []
    is_own = options.tracker == "own" or (options.tracker == "auto" and not has_mediapipe())
    if is_own and options.tracker == "auto":
        notes.append(
            "MediaPipe is not installed, so our own tracker alone finds the hand, less exactly "
            "(with Python 3.12 or older: pip install 'handavatar[video]')"
        )
    frames = frames_of(options.file, options.sampling(), notes.append)
    try:
        track = track_hand(
            frames, options.side, progress, options.hand, OwnFinder() if is_own else None
        )
    except UnusableTrackError as error:
        told = replace(error.track, notes=tuple(notes))
        raise UnusableTrackError(error.what, error.remedy, told) from error
    return replace(track, notes=tuple(notes), is_own=is_own)


def _laid_on(
    track: Track, rig: Rig, options: VideoOptions, report: Progress
) -> tuple[FittedHands, list[FittedFrame]]:
    try:
        masks = _found_masks(track, report)
        report(0.5, "fitting the hand")
        seen = observations_of(track)
        fitted = _fitted_to_landmarks(track, seen, rig, options)
        gains = exposure_gains(track.glances, track.hands, track.picture_size)
        fitted = _registered(
            track,
            seen,
            masks,
            fitted,
            _known_before_wrist(track, fitted, rig),
            gains,
            rig,
            replace(options.register, texture_sigmas=()),
            lambda share: report(0.55 + 0.15 * share, "laying the hand onto the masks"),
        )
        guided = _guided_masks(track, fitted, rig, gains, report)
        before = _known_before_wrist(track, fitted, rig)
        fitted = _registered(
            track,
            seen,
            [mask.mask for mask in guided],
            fitted,
            [first & mask.known for first, mask in zip(before, guided, strict=True)],
            gains,
            rig,
            replace(options.register, is_wide=False, tilts=(), restarts=0),
            lambda share: report(0.75 + 0.15 * share, "laying the hand onto masks and texture"),
        )
    except CaptureError as error:
        raise _failure(options, error.what, error.remedy, track, []) from error

    boxes = [
        _box_in_front(hand, mask, rig, fitted, number)
        for number, (hand, mask) in enumerate(zip(track.hands, guided, strict=True))
    ]
    size = options.size or stored_size([box.side for box in boxes])

    def cropped(number: int) -> FittedFrame:
        hand, mask, box = track.hands[number], guided[number], boxes[number]
        return _result(hand, mask, box, rig, fitted, number, gains[number], size, options)

    results = _on_all_cores(
        cropped, range(len(guided)), lambda share: report(0.9 + 0.05 * share, "cropping")
    )
    return fitted, results


def _found_masks(track: Track, report: Progress) -> list[HandMask]:
    report(0.4, "learning the colour of the skin")
    colors = learn_colors(track.hands)
    return _on_all_cores(
        lambda hand: find_mask(hand, colors),
        track.hands,
        lambda share: report(0.4 + 0.1 * share, "cutting out the hand"),
    )


@one_thread()
def _guided_masks(
    track: Track,
    fitted: FittedHands,
    rig: Rig,
    gains: Float[np.ndarray, "hands 3"],
    report: Progress,
) -> list[GuidedMask]:
    report(0.7, "learning the colours again")
    focal = fitted.fit.focal
    meshes = _on_all_cores(
        lambda number: placed_mesh(rig, fitted.vertices[number], focal, track.hands[number]),
        range(len(track.hands)),
        lambda share: None,
    )
    colors = learn_guided_colors(track.hands, meshes, gains)
    return _on_all_cores(
        lambda number: find_guided_mask(track.hands[number], meshes[number], colors, gains[number]),
        range(len(track.hands)),
        lambda share: report(0.7 + 0.05 * share, "cutting out the hand again"),
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
    """What the trackers saw, as tensors."""
    seen = _seen_by_finder(track)
    points = [hand.points for hand in track.hands if hand.points is not None]
    if len(points) < len(track.hands):
        return seen
    if track.is_own:
        # What our tracker has found is what it says again.
        seen = replace(seen, uncertainty=torch.full_like(seen.uncertainty, torch.inf))
    tracked = shipped_tracker().points
    num_skin = len(points[0].places) - NUM_LANDMARKS
    nearest = tracked.nearest_landmarks(load_rig(tracked.rig_name))[:num_skin]
    return with_skin(seen, points, tracked.vertices[:num_skin], nearest)


def _seen_by_finder(track: Track) -> Observations:
    """The landmarks of what has found the hand."""

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


def see_skin(track: Track, rig: Rig) -> Track:
    """Asks our own tracker where landmarks and skin are in every picture of a track.

    Args:
        track: hands that were found.
        rig: to lay onto the pictures; of one that is not the tracker's, landmarks alone are told.
    """
    tracker = shipped_tracker()
    count = len(tracker.points) if tracker.points.fit(rig) else NUM_LANDMARKS

    def seen_hand(hand: TrackedHand) -> TrackedHand:
        seen = see_points(tracker, hand.window, hand.landmarks)
        if track.is_own:
            # It was found before anybody knew that it has to be mirrored, or not.
            seen = see_points(tracker, hand.window, seen.places[:NUM_LANDMARKS])
            landmarks = seen.places[:NUM_LANDMARKS]
            hand = replace(
                hand,
                landmarks=landmarks,
                spread=seen.spread[:NUM_LANDMARKS],
                world_landmarks=world_places(
                    tracker.points, landmarks, seen.depths[:NUM_LANDMARKS]
                ),
            )
        return replace(hand, points=seen.first(count))

    hands = _on_all_cores(seen_hand, track.hands, lambda share: None)
    return replace(track, hands=tuple(hands))


@one_thread()
def _fitted_to_landmarks(
    track: Track, observations: Observations, rig: Rig, options: VideoOptions
) -> FittedHands:
    """Where the landmarks alone have the hand, with its shape and the focal length."""
    # What made pictures teach about a hand's shape is the shape of made hands: where another
    # tracker has found the hand, its landmarks alone tell it.
    fit = fit_hands(rig, observations if track.is_own else _seen_by_finder(track), options.fit)
    if observations.skin is not None:
        fit = fit_poses(rig, observations, fit, options.fit)
    vertices = HandModel(rig).all_vertices(fit)
    return _judged_fit(rig, observations, fit, vertices, torch.zeros(len(vertices), 51, 51))


def _registered(
    track: Track,
    seen: Observations,
    masks: Sequence[HandMask],
    before: FittedHands,
    known: Sequence[Bool[np.ndarray, "_ _"]],
    gains: Float[np.ndarray, "hands 3"],
    rig: Rig,
    options: RegisterOptions,
    report: Callable[[float], None],
) -> FittedHands:
    """The hand laid onto landmarks, masks and texture: the one place that knows how."""
    observations = observe_hands(
        track.hands, masks, known, gains, before.landmarks, before.fit.focal
    )
    fit, found = register_hands(rig, before.fit, observations, options, report)
    covariances = torch.linalg.inv(found.information.double()).float()
    return _judged_fit(rig, seen, fit, posed_vertices(found), covariances)


def _judged_fit(
    rig: Rig,
    observations: Observations,
    fit: HandFit,
    vertices: Float[Tensor, "frames vertices 3"],
    covariances: Float[Tensor, "frames 51 51"],
) -> FittedHands:
    errors = landmark_errors(HandModel(rig), observations, fit) / observations.scale
    return FittedHands(fit, vertices, errors, covariances, see_landmarks(observations, fit))


def _known_before_wrist(
    track: Track, fitted: FittedHands, rig: Rig
) -> list[Bool[np.ndarray, "_ _"]]:
    """Pixels of the camera's picture in front of the wrist: what lies behind is the forearm's."""
    found = []
    for hand, vertices in zip(track.hands, fitted.vertices, strict=True):
        view = window_view(hand, fitted.fit.focal)
        line = _wrist_in(view, rig, vertices)
        margin = _WRIST_MARGIN * view.focal[0] / max(float(vertices[:, 2].median()), 0.02)
        before = line.before_pixels(view.width) > margin
        found.append(before & inside_picture(hand.window))
    return found


@dataclass(frozen=True)
class _Box:
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


def _wrist_in(camera: Camera, rig: Rig, vertices: Float[Tensor, "vertices 3"]) -> WristLine:
    """Where the fitted hand ends, in a view of it."""
    places = project(camera, vertices)[0].double().numpy()
    return wrist_line(places[rig.rim.numpy()], places.mean(0))


def _box_in_front(
    hand: TrackedHand, guided: GuidedMask, rig: Rig, fitted: FittedHands, number: int
) -> _Box:
    """About the mask in front of the wrist."""
    window = hand.window
    line = _wrist_in(window_view(hand, fitted.fit.focal), rig, fitted.vertices[number])
    before = line.before_pixels(window.image.shape[0]) > 0
    corner, box = _box(guided.mask.pixels & before & inside_picture(window))
    x, y = (start + at / window.scale for start, at in zip(window.corner, corner, strict=True))
    return _Box((x, y), box / window.scale)


def stored_size(sides: Sequence[float]) -> int:
    """Pixels along a side of the stored pictures: as many as most of the video's hands have.

    Args:
        sides: of the squares about the hands, pixels of the video.
    """
    return _SIZES[1] if float(np.median(sides)) >= _SIZES[1] else _SIZES[0]


def _result(
    hand: TrackedHand,
    guided: GuidedMask,
    box: _Box,
    rig: Rig,
    fitted: FittedHands,
    number: int,
    gain: Float[np.ndarray, "3"],
    size: int,
    options: VideoOptions,
) -> FittedFrame:
    """One frame's crop, with its mask cut where the mesh ends."""
    window = hand.window
    fit, vertices = fitted.fit, fitted.vertices[number]
    camera = window_camera(fit.focal, window.picture_size, box.corner, box.side, size)
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
    line = _wrist_in(camera, rig, vertices)
    scale = camera.focal[0] / max(float(vertices[:, 2].median()), 0.02)
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
    frame = Frame(
        name=f"{hand.index:06d}",
        image=torch.from_numpy(image),
        coverage=torch.from_numpy((255 * cut * known).round().astype(np.uint8)),
        camera=camera,
        pose=fit.pose(number),
        confidence=float(np.prod(list(factors.values()))),
        split="train",
        time=hand.time,
        known=torch.from_numpy(known),
        gain=torch.from_numpy(gain).float(),
        covariance=fitted.covariances[number],
        landmarks=fitted.landmarks[number],
    )
    pixels = float(np.ptp(hand.landmarks, axis=0).max())
    reason = _reason(pixels, outside, unknown, guided, factors, iou, error, options.min_confidence)
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
    size, center = np.array(window.picture_size), np.array(window.picture_size) / 2
    seen = vertices.double().numpy()
    places = seen[:, :2] / np.maximum(seen[:, 2:], 0.02) * focal + center
    low, high = places.min(0), places.max(0)
    side = float((high - low).max())
    start = (low + high) / 2 - side / 2
    camera = window_camera(
        focal, window.picture_size, (float(start[0]), float(start[1])), side, _COUNTED_SIDE
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


def held_out_splits(count: int) -> list[str]:
    """Two stretches of time are held out for tests, together at least 15 % of the frames."""
    splits = ["train"] * count
    for start, share in _HELD_OUT:
        first, length = round(start * count), int(np.ceil(share * count))
        splits[first : first + length] = ["test"] * length
    return splits


def splits_by_index(track: Track) -> dict[int, str]:
    """The split of every picture that was looked at, with a hand or without, by its index."""
    indices = sorted([hand.index for hand in track.hands] + list(track.skipped))
    return dict(zip(indices, held_out_splits(len(indices)), strict=True))


def _left_out(track: Track, results: list[FittedFrame]) -> dict[str, LeftOut]:
    """The reason of every picture that is not kept, by its name, in the order of time."""
    found = {
        f"{index:06d}": LeftOut(reason if reason in CAUSES else "pose", reason)
        for index, reason in track.skipped.items()
    }
    for result in results:
        if result.reason is not None:
            found[result.frame.name] = result.reason
    return dict(sorted(found.items()))


def _skipped(left_out: dict[str, LeftOut]) -> dict[str, object]:
    return {
        "frames": {name: reason.text for name, reason in left_out.items()},
        "reasons": dict(Counter(reason.kind for reason in left_out.values()).most_common()),
    }


def _with_common_gain(frames: list[Frame]) -> list[Frame]:
    """The gains relative to the average of these frames."""
    mean = torch.stack([frame.gain.double().log() for frame in frames]).mean(0)
    return [
        replace(frame, gain=((frame.gain.double().log() - mean).exp() * 1e4).round().float() / 1e4)
        for frame in frames
    ]


def _cause(
    options: VideoOptions, track: Track, left_out: dict[str, LeftOut], num_kept: int
) -> tuple[str, str]:
    """What to say where too few pictures are left: what was most often in the way."""
    kinds = Counter(reason.kind for reason in left_out.values())
    kind, count = kinds.most_common(1)[0]
    brightness = [float(glance.image.mean()) for glance in track.glances]
    if kind in ("pose", NO_HAND) and brightness and float(np.median(brightness)) < _DARK:
        kind = "dark"
    elif kind == "pose" and 1 - _CLEAR_VOTE < track.votes_right < _CLEAR_VOTE:
        kind = "side"
    total = len(track.hands) + len(track.skipped)
    cause, remedy = CAUSES[kind]
    return (
        f"{options.file}: only {num_kept} of {total} pictures can be used, at least {_MIN_KEPT} "
        f"are needed; in {count} of the others {cause}",
        remedy,
    )


def _failure(
    options: VideoOptions, what: str, remedy: str, track: Track, results: list[FittedFrame]
) -> CaptureError:
    """The error to raise; all pictures and their reasons lie beside the would-be capture."""
    folder = _fresh_folder(options.out)
    mark_folder(folder, FAILED_CAPTURE)
    left_out = _left_out(track, results)
    contact_sheet(_tiles(track, results)).save(folder / "overview.png")
    said = {"failed": what, "remedy": remedy, "notes": list(track.notes)}
    _save_json(folder / "reasons.json", said | _skipped(left_out))
    return CaptureError(what, f"{remedy}\neach picture and its reason: {folder / 'overview.png'}")


def _fresh_folder(out: Path) -> Path:
    """A folder beside a name that nobody has used yet: with ``.failed``, or a number behind it."""
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        ending = ".failed" if number == 1 else f".failed-{number}"
        folder = out.with_name(out.name + ending)
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
            continue
        return folder


def _tiles(track: Track, results: list[FittedFrame]) -> list[Tile]:
    """All pictures in the order of time: the fitted crop where there is one, else the whole."""
    tiles = {}
    for glance in track.glances:
        reason = track.skipped.get(glance.index, "")
        tiles[glance.index] = Tile(f"{glance.index:06d}", glance.image, reason)
    for result in results:
        frame = result.frame
        title = f"{frame.name}  {frame.confidence:.2f}"
        text = "" if result.reason is None else result.reason.text
        tiles[int(frame.name)] = Tile(title, outlined(frame, result.mesh), text)
    return [tiles[index] for index in sorted(tiles)]


def _agreement(results: list[FittedFrame], fit: HandFit) -> dict[str, Any]:
    return {
        "focal_pixels": fit.focal,
        "mean_mask_iou": float(np.mean([result.mask_iou for result in results])),
        "mean_landmark_error_pixels": float(np.mean([r.landmark_error for r in results])),
        "frames": {
            result.frame.name: {
                "confidence": round(result.frame.confidence, 4),
                "mask_iou": round(result.mask_iou, 4),
                "mask_quality": round(result.mask_quality, 4),
                "landmark_error_pixels": round(result.landmark_error, 3),
                "outside_share": round(result.outside_share, 4),
                "unknown_share": round(result.unknown_share, 4),
            }
            for result in results
        },
    }


def _summary(
    track: Track,
    splits: dict[int, str],
    results: list[FittedFrame],
    kept: list[Frame],
    left_out: dict[str, LeftOut],
    seen: SeenSkin,
) -> dict[str, Any]:
    """What a person wants to know of the capture, as JSON."""
    names = {frame.name for frame in kept}
    gains = torch.stack([frame.gain for frame in kept])
    of_splits = {
        split: {
            "pictures": sum(value == split for value in splits.values()),
            "kept": sum(frame.split == split for frame in kept),
        }
        for split in SPLITS
        if split in splits.values()
    }
    outside = [result.outside_share for result in results if result.frame.name in names]
    return {
        "notes": list(track.notes),
        "side": track.side,
        # Of the side that was taken: low where --side overruled the tracker.
        "side_votes": round(
            track.votes_right if track.side == "right" else 1 - track.votes_right, 3
        ),
        "pictures": len(splits),
        "kept": len(kept),
        "left_out": _skipped(left_out)["reasons"],
        "splits": of_splits,
        "border": {
            "frames": sum(share > _TOUCHES for share in outside),
            "largest_share": round(max(outside), 4),
        },
        "gain": {
            "smallest": [round(value, 4) for value in gains.amin(0).tolist()],
            "largest": [round(value, 4) for value in gains.amax(0).tolist()],
        },
        "skin_never_seen": {
            "share": round(seen.unseen_share, 4),
            "regions": seen.unseen_regions,
        },
    }


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """A capture's summary, as ``fit.json`` has it, for people to read.

    Args:
        summary: side, frames kept and left out, border, exposure, skin that nobody saw.
    """
    other = {"left": "right", "right": "left"}[summary["side"]]
    sure = round(100 * summary["side_votes"])
    lines = [
        *(f"note: {note}" for note in summary.get("notes", [])),
        f"hand: {summary['side']} ({sure} % of the tracker's votes; --side {other} overrules it)",
        f"frames: {summary['kept']} of {summary['pictures']} kept",
    ]
    for kind, count in summary["left_out"].items():
        lines.append(f"  {count} left out: {CAUSES[kind][0]}")
    parts = [
        f"{split} {counts['kept']} of {counts['pictures']}"
        for split, counts in summary["splits"].items()
    ]
    lines.append(f"splits: {', '.join(parts)}")
    border = summary["border"]
    lines.append(
        f"border: the hand reaches beyond the picture in {border['frames']} kept frames, by at "
        f"most {100 * border['largest_share']:.0f} % of it"
    )
    gain = summary["gain"]
    low, high = min(gain["smallest"]), max(gain["largest"])
    lines.append(f"exposure and white balance: {low:.2f} to {high:.2f} of the average")
    skin = summary["skin_never_seen"]
    names = "; ".join(skin["regions"])
    lines.append(
        f"skin never seen: {100 * skin['share']:.0f} %" + (f" (most of: {names})" if names else "")
    )
    return lines


def _save_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")
