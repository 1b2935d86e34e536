"""One hand laid onto all its recordings: what each shows, one shape, a pose for every picture."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.capture.camera_path import in_metres, metres_of_unit
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
from handavatar.capture.guided_masks import (
    GuidedMask,
    find_guided_mask,
    guided_by_given,
    learn_guided_colors,
    pixels_before_wrist,
    placed_mesh,
)
from handavatar.capture.masks import (
    HandMask,
    find_mask,
    inside_picture,
    learn_colors,
    pixels_per_metre,
)
from handavatar.capture.registration import (
    observe_hands,
    posed_vertices,
    register_hands,
    see_landmarks,
)
from handavatar.capture.skin_points import see_points, world_places
from handavatar.capture.tracking import Track, TrackedHand
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.fit.register import RegisterOptions
from handavatar.geometry.rotations import apply_rigid, invert_rigid
from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig
from handavatar.hand.rigs import load_rig
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import heed, heeds, stop_point
from handavatar.jobs.threads import one_thread
from handavatar.tracker.model import shipped_tracker

Piece = TypeVar("Piece")
Result = TypeVar("Result")
_WRIST_MARGIN = 0.008
"""Metres before the rig's end from where on masks are believed."""
_PAUSE = 1.0
"""Seconds between two recordings: neighbours across it say nothing of each other."""


@dataclass(frozen=True, eq=False)
class Clip:
    """One recording of the hand.

    Attributes:
        track: the hand in its pictures.
        seen: landmarks and skin.
        gains: exposure and white balance of each picture.
        start: seconds at which its time begins, behind the recordings before it.
        focal: length that is known, pixels; None if it is found.
        camera_from_world: of each picture in which the hand was found, OpenCV axes, in units of
            which ``unit`` says the length; None where the camera stands still: its axes are the
            world's.
        unit: metres; None if it is found.
        masks: that the user gives; None where they are found.
    """

    track: Track
    seen: Observations
    gains: Float[np.ndarray, "hands 3"]
    start: float = 0.0
    focal: float | None = None
    camera_from_world: Float[Tensor, "hands 4 4"] | None = None
    unit: float | None = None
    masks: list[HandMask] | None = None

    @property
    def world_cameras(self) -> Float[Tensor, "hands 4 4"] | None:
        """``camera_from_world`` in metres.

        Raises:
            ValueError: nobody knows the unit's length yet.
        """
        if self.camera_from_world is None:
            return None
        if self.unit is None:
            raise ValueError("the cameras' unit is not known yet")
        return in_metres(self.camera_from_world, self.unit)


@dataclass(frozen=True, eq=False)
class FittedHands:
    """The hand laid onto all pictures of a recording in which it was found.

    Attributes:
        fit: shape, poses in camera axes, focal length.
        vertices: of the rig in every frame, metres, camera axes.
        landmark_errors: mean distance of fitted and tracked landmarks, metres.
        covariances: of the poses' errors in the world's axes as far as motion tells them; zeros
            where nothing was asked.
        landmarks: of the tracker, with their offsets from joints as found.
    """

    fit: HandFit
    vertices: Float[Tensor, "frames vertices 3"]
    landmark_errors: Float[Tensor, "frames"]
    covariances: Float[Tensor, "frames 51 51"]
    landmarks: list[LandmarkSightings]


@dataclass(frozen=True, eq=False)
class LaidClip:
    """A recording with the hand laid onto it.

    Attributes:
        clip: the recording; the unit of its cameras is known.
        fitted: the hand.
        world: its fit with the poses in the world's axes.
        masks: found with the hand's help, or those that the user gives.
    """

    clip: Clip
    fitted: FittedHands
    world: HandFit
    masks: list[GuidedMask]


def clip_of(track: Track) -> Clip:
    """A recording of a camera that stands still, of which nothing is known."""
    gains = exposure_gains(track.glances, track.hands, track.picture_size)
    return Clip(track, observations_of(track), gains)


def one_after_the_other(clips: Sequence[Clip]) -> list[Clip]:
    """The recordings with times that go on from one to the next."""
    found: list[Clip] = []
    start = 0.0
    for clip in clips:
        found.append(replace(clip, start=start))
        last = max((glance.time for glance in clip.track.glances), default=0.0)
        start += max([last, *(hand.time for hand in clip.track.hands)]) + _PAUSE
    return found


def lay_hand(
    clips: Sequence[Clip],
    rig: Rig,
    fit: FitOptions,
    register: RegisterOptions,
    progress: Progress,
) -> list[LaidClip]:
    """Lays one hand onto all recordings: landmarks first, then masks, then masks and texture.

    Args:
        clips: of one hand.
        rig: to lay onto them.
        fit: how it is first fitted, to landmarks alone.
        register: how it is laid onto masks and texture.
        progress: told how far it is.

    Raises:
        CaptureError: colours or the cameras' unit cannot be told from these pictures.
    """
    stages = progress.stages(
        {
            "cutting out the hand": 25.0,
            "fitting the hand": 4.0,
            "laying the hand onto the masks": 82.0,
            "cutting out the hand again": 29.0,
            "laying the hand onto masks and texture": 73.0,
        }
    )
    parts = stages["cutting out the hand"].equal_parts(len(clips))
    masks = [_found_masks(clip, part) for clip, part in zip(clips, parts, strict=True)]
    stages["fitting the hand"](0.0)
    fitted = _fitted_to_landmarks(clips, rig, fit)
    clips = [_with_unit(clip, hands) for clip, hands in zip(clips, fitted, strict=True)]
    known = [_known_before_wrist(*pair, rig) for pair in zip(clips, fitted, strict=True)]
    fitted = _registered(
        clips,
        masks,
        fitted,
        known,
        rig,
        replace(register, texture_sigmas=()),
        stages["laying the hand onto the masks"],
    )
    parts = stages["cutting out the hand again"].equal_parts(len(clips))
    guided = [
        _guided_masks(clip, hands, rig, part)
        for clip, hands, part in zip(clips, fitted, parts, strict=True)
    ]
    before = [_known_before_wrist(*pair, rig) for pair in zip(clips, fitted, strict=True)]
    fitted = _registered(
        clips,
        [[mask.mask for mask in masks] for masks in guided],
        fitted,
        [
            [first & mask.known for first, mask in zip(firsts, masks, strict=True)]
            for firsts, masks in zip(before, guided, strict=True)
        ],
        rig,
        replace(register, is_wide=False, tilts=(), restarts=0),
        stages["laying the hand onto masks and texture"],
    )
    return [
        LaidClip(clip, hands, _in_world(hands.fit, clip, rig), masks)
        for clip, hands, masks in zip(clips, fitted, guided, strict=True)
    ]


def _found_masks(clip: Clip, progress: Progress) -> list[HandMask]:
    if clip.masks is not None:
        return clip.masks
    hands = clip.track.hands
    progress(0.0, 1.0, "learning the colour of the skin")
    colors = learn_colors(hands)
    return on_all_cores(
        lambda hand: find_mask(hand, colors),
        hands,
        progress,
    )


@one_thread()
def _guided_masks(
    clip: Clip, fitted: FittedHands, rig: Rig, progress: Progress
) -> list[GuidedMask]:
    progress(0.0, 1.0, "learning the colours again")
    hands, gains = clip.track.hands, clip.gains
    meshes = on_all_cores(
        lambda number: placed_mesh(rig, fitted.vertices[number], fitted.fit.focal, hands[number]),
        range(len(hands)),
    )
    given = clip.masks
    if given is not None:
        return [guided_by_given(*parts) for parts in zip(hands, meshes, given, strict=True)]
    colors = learn_guided_colors(hands, meshes, gains)
    return on_all_cores(
        lambda number: find_guided_mask(hands[number], meshes[number], colors, gains[number]),
        range(len(hands)),
        progress,
    )


def on_all_cores(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], progress: Progress = SILENT
) -> list[Result]:
    """The work on every piece, in order; each begins at a stop point.

    Args:
        work: on one piece.
        pieces: of the work.
        progress: told how many pieces are done.
    """
    does_heed = heeds()

    def on_piece(piece: Piece) -> Result:
        heed(does_heed)
        stop_point()
        return work(piece)

    results: list[Result] = []
    # Torch's number of threads belongs to a thread.
    with ThreadPoolExecutor(
        os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        for result in pool.map(on_piece, pieces):
            results.append(result)
            progress(len(results), len(pieces))
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
        principal_point=track.principal_point,
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

    hands = on_all_cores(seen_hand, track.hands)
    return replace(track, hands=tuple(hands))


@one_thread()
def _fitted_to_landmarks(clips: Sequence[Clip], rig: Rig, options: FitOptions) -> list[FittedHands]:
    """Where the landmarks alone have the hand, with its shape and the focal lengths."""
    fits, chosen = [], []
    for clip in clips:
        own = options
        if clip.focal is not None:
            share = clip.focal / max(clip.seen.picture_size)
            own = replace(options, focal_share=share, focal_tolerance=0.0)
        # What made pictures teach about a hand's shape is the shape of made hands: where another
        # tracker has found the hand, its landmarks alone tell it.
        seen = clip.seen if clip.track.is_own else _seen_by_finder(clip.track)
        fits.append(fit_hands(rig, seen, own))
        chosen.append(own)
    counts = torch.tensor([float(len(clip.track.hands)) for clip in clips])
    shares = counts / counts.sum()
    # Every recording has its own landmarks and its own focal length; the hand is the same one.
    shape = sum(share * fit.shape_coefficients for share, fit in zip(shares, fits, strict=True))
    offsets = sum(share * fit.offsets for share, fit in zip(shares, fits, strict=True))
    found = []
    for clip, fit, own in zip(clips, fits, chosen, strict=True):
        if len(clips) > 1:
            fit = replace(fit, shape_coefficients=shape, offsets=offsets)
        if len(clips) > 1 or clip.seen.skin is not None:
            fit = fit_poses(rig, clip.seen, fit, own)
        vertices = HandModel(rig).all_vertices(fit)
        nothing = torch.zeros(len(vertices), 51, 51)
        found.append(_judged_fit(rig, clip.seen, fit, vertices, nothing))
    return found


def _with_unit(clip: Clip, fitted: FittedHands) -> Clip:
    """The recording with the length of its cameras' unit."""
    if clip.camera_from_world is None or clip.unit is not None:
        return clip
    unit = metres_of_unit(clip.camera_from_world, fitted.vertices.mean(1))
    note = (
        f"the unit of the cameras' positions was taken as {unit:.4g} m: so the hand moves least "
        "(`camera_unit` says otherwise)"
    )
    track = replace(clip.track, notes=(*clip.track.notes, note))
    return replace(clip, track=track, unit=unit)


def _registered(
    clips: Sequence[Clip],
    masks: Sequence[Sequence[HandMask]],
    before: Sequence[FittedHands],
    known: Sequence[Sequence[Bool[np.ndarray, "_ _"]]],
    rig: Rig,
    options: RegisterOptions,
    progress: Progress,
) -> list[FittedHands]:
    """The hand laid onto landmarks, masks and texture: the one place that knows how."""
    observations, fits = [], []
    for clip, of_clip, hands, is_known in zip(clips, masks, before, known, strict=True):
        observations += observe_hands(
            clip.track.hands,
            of_clip,
            is_known,
            clip.gains,
            hands.landmarks,
            hands.fit.focal,
            clip.world_cameras,
            clip.start,
        )
        fits.append(_in_world(hands.fit, clip, rig))
    whole = replace(
        fits[0],
        rotations=torch.cat([fit.rotations for fit in fits]),
        translation=torch.cat([fit.translation for fit in fits]),
    )
    fit, registered = register_hands(rig, whole, observations, options, progress)
    covariances = torch.linalg.inv(registered.information.double()).float()
    vertices = posed_vertices(registered)
    wrist = rig.shaped(fit.shape_coefficients).rest_joints[0]
    found, first = [], 0
    for clip, hands in zip(clips, before, strict=True):
        own = slice(first, first + len(clip.track.hands))
        first = own.stop
        pose, posed = HandPose(fit.rotations[own], fit.translation[own]), vertices[own]
        cameras = clip.world_cameras
        if cameras is not None:
            pose, posed = pose.moved_to(cameras, wrist), apply_rigid(cameras, posed)
        of_clip_fit = replace(
            fit,
            rotations=pose.rotations,
            translation=pose.translation,
            log_focal=hands.fit.log_focal,
        )
        found.append(_judged_fit(rig, clip.seen, of_clip_fit, posed, covariances[own]))
    return found


def _in_world(fit: HandFit, clip: Clip, rig: Rig) -> HandFit:
    """A fit in camera axes, in the world's."""
    cameras = clip.world_cameras
    if cameras is None:
        return fit
    # As those have it who read the pose: without what is personal beyond the coefficients.
    wrist = rig.shaped(fit.shape_coefficients).rest_joints[0]
    pose = HandPose(fit.rotations, fit.translation).moved_to(invert_rigid(cameras), wrist)
    return replace(fit, rotations=pose.rotations, translation=pose.translation)


def _judged_fit(
    rig: Rig,
    observations: Observations,
    fit: HandFit,
    vertices: Float[Tensor, "frames vertices 3"],
    covariances: Float[Tensor, "frames 51 51"],
) -> FittedHands:
    errors = landmark_errors(HandModel(rig), observations, fit) / observations.scale
    return FittedHands(fit, vertices, errors, covariances, see_landmarks(observations, fit))


def _known_before_wrist(clip: Clip, fitted: FittedHands, rig: Rig) -> list[Bool[np.ndarray, "_ _"]]:
    """Pixels of the camera's picture in front of the wrist: what lies behind is the forearm's."""
    found = []
    for hand, vertices in zip(clip.track.hands, fitted.vertices, strict=True):
        view = hand.window.camera(fitted.fit.focal)
        before = pixels_before_wrist(view, rig, vertices, _WRIST_MARGIN)
        found.append(before & inside_picture(hand.window))
    return found
