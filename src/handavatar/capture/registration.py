"""The hand of a video laid onto its landmarks, masks and texture by the one fit (:mod:`fit`).

First the landmarks alone say about where it is; then outlines, and at last the texture, join them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.fitted_hand import HandFit
from handavatar.capture.fitting import LANDMARK_ERROR, Observations
from handavatar.capture.frames import FITTED_SIDE, LANDMARKS, Capture, Frame
from handavatar.capture.masks import HandMask, mask_coverage
from handavatar.capture.tracking import TrackedHand
from handavatar.capture.windows import resized
from handavatar.fit.energy import Observation
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.fit.pictures import FramePicture
from handavatar.fit.register import Registered, RegisterOptions, register
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import Rig, ShapedHand
from handavatar.hand.rigs import find_rig
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.stage_states import NOT_KEPT, StageState

DEPTH_ERROR = 0.025
"""Metres by which its depth is off: measured on made films."""
_POSE_ERROR = np.radians(90.0) / 3**0.5
"""Radians by which joints are off where only the landmarks have spoken: they do so once more."""
_PLACE_ERROR = 0.05
"""Metres."""
_COMPARED_SIDE = 224
"""Pixels of the hand's surroundings that the fit looks at: 1.5 to 2 mm each."""


def see_landmarks(seen: Observations, fit: HandFit) -> list[LandmarkSightings]:
    """What the tracker says of every frame, with its expected errors.

    Args:
        seen: the tracker's landmarks.
        fit: focal length, and where landmarks lie beside joints.
    """
    center = torch.tensor(seen.principal_point)
    if seen.skin is None:
        vertices = torch.zeros(0, dtype=torch.long)
        places = seen.landmarks
        errors = torch.hypot(seen.uncertainty, LANDMARK_ERROR * seen.scale[:, None])
        depths = seen.world_landmarks[..., 2]
        depth_errors = torch.full_like(depths, DEPTH_ERROR)
    else:
        vertices = seen.skin.vertices
        places = torch.cat([seen.landmarks, seen.skin.places], dim=1)
        errors = torch.cat([seen.uncertainty, seen.skin.errors], dim=1)
        depths, depth_errors = seen.skin.depths, seen.skin.depth_errors
    return [
        LandmarkSightings(
            (place - center) / fit.focal,
            error / fit.focal,
            depth - depth.mean(),
            depth_error,
            fit.offsets,
            vertices,
        )
        for place, error, depth, depth_error in zip(
            places, errors, depths, depth_errors, strict=True
        )
    ]


def observe_hands(
    hands: Sequence[TrackedHand],
    masks: Sequence[HandMask],
    known: Sequence[Bool[np.ndarray, "_ _"]],
    gains: Float[np.ndarray, "hands 3"],
    landmarks: Sequence[LandmarkSightings],
    focal: float,
    camera_from_world: Float[Tensor, "hands 4 4"] | None = None,
    start: float = 0.0,
) -> list[Observation]:
    """What every frame of a video says: landmarks, mask and colours of the hand's surroundings.

    Args:
        hands: tracked.
        masks: of their windows.
        known: false outside of the picture, behind the wrist, and where the mask is unsure.
        gains: of the channels, frame by frame.
        landmarks: of the tracker.
        focal: length, pixels of the whole picture.
        camera_from_world: OpenCV axes, metres; None where the camera's axes are the world's.
        start: seconds that are added to their times.
    """
    found = []
    for number, (hand, mask, is_known) in enumerate(zip(hands, masks, known, strict=True)):
        window = hand.window
        full = hand.window.image.shape[0]
        side = min(_COMPARED_SIDE, full)
        zoom = np.eye(2) * (full / side)
        view = hand.window.camera(focal).resized(side, side)
        picture = FramePicture.of(
            view
            if camera_from_world is None
            else replace(view, camera_from_world=camera_from_world[number]),
            resized(torch.from_numpy(window.image).float() / 255, side),
            torch.from_numpy(mask_coverage(mask.level, zoom, np.zeros(2), side)).float(),
            resized(torch.from_numpy(is_known).float()[..., None], side)[..., 0] > 0.999,
            torch.from_numpy(gains[number]).float(),
        )
        found.append(Observation(picture, start + hand.time, landmarks[number]))
    return found


def register_hands(
    rig: Rig,
    fit: HandFit,
    observations: list[Observation],
    options: RegisterOptions,
    progress: Progress = SILENT,
) -> tuple[HandFit, Registered]:
    """Goes on from a fit with all that the frames say; the focal length stays as it is.

    The fit's poses are in the axes of the observations' world.

    Args:
        rig: that is laid onto the pictures.
        fit: to begin with.
        observations: of the same frames.
        options: rounds, expected errors.
        progress: told how far it is.
    """
    sigmas = torch.cat(
        [torch.full((3 * NUM_BONES,), float(_POSE_ERROR)), torch.full((3,), _PLACE_ERROR)]
    )
    found = register(
        [rig.shaped(fit.shape_coefficients)],
        observations,
        HandPose(fit.rotations, fit.translation),
        torch.diag(sigmas**-2).expand(len(observations), -1, -1),
        options,
        is_sequence=True,
        progress=progress,
    )
    return (
        replace(
            fit,
            rotations=found.poses.rotations,
            translation=found.poses.translation,
            shape_coefficients=fit.shape_coefficients + found.shape_change,
            offsets=found.offsets.reshape(21, 3),
        ),
        found,
    )


def posed_vertices(found: Registered) -> Float[Tensor, "frames vertices 3"]:
    """The registered mesh in every frame, with its own shape: metres, camera axes."""
    return found.hand.posed(found.poses).vertices


def register_capture(capture: Capture, options: RegisterOptions | None = None) -> list[HandPose]:
    """Poses of all frames of a tracked capture, drawn to what the frames show.

    Args:
        capture: with poses to begin with.
        options: expected errors, rounds.

    Raises:
        RigError: if the rig that the poses belong to is not here.
        CaptureError: if a frame is damaged.
    """
    rig = find_rig(capture.rig_sha256, capture.rig_name)
    frames = [capture.frame(index) for index in range(len(capture.records))]
    hand = rig.shaped(capture.shape_coefficients)
    found = register_frames([hand], frames, options or RegisterOptions())
    return poses_of(found)


def register_frames(
    hands: Sequence[ShapedHand],
    frames: Sequence[Frame],
    options: RegisterOptions,
    learns_shape: bool = True,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> Registered:
    """Lays hands onto frames, held by what the capture says of landmarks and its poses' errors.

    Where it does not say how far poses are off, one error of all joints is learned from how far
    they had to move.

    Args:
        hands: rest hand to begin with, one for all frames or one for each.
        frames: with their poses as tracked.
        options: expected errors, rounds.
        learns_shape: whether the hand's shape moves.
        progress: told how far it is.
        kept: where it goes on, if it was interrupted.

    Raises:
        Interrupted: if the command was told to stop.
        CaptureError: if the skin that a tracker saw is another rig's.
    """
    for frame in frames:
        seen = frame.landmarks
        if seen is not None and bool((seen.vertices >= hands[0].rig.num_vertices).any()):
            raise CaptureError(
                f"{LANDMARKS}: vertex {int(seen.vertices.max())} is not one of the rig's "
                f"{hands[0].rig.num_vertices}",
                "make the capture again",
            )
    covariances = [frame.covariance for frame in frames if frame.covariance is not None]
    information = None
    if len(covariances) == len(frames):
        information = torch.linalg.inv(torch.stack(covariances).double()).float()
    tracked = HandPose(
        torch.stack([frame.pose.rotations for frame in frames]),
        torch.stack([frame.pose.translation for frame in frames]),
    )
    return register(
        hands,
        [observe_frame(frame) for frame in frames],
        tracked,
        information,
        options,
        learns_shape=learns_shape,
        progress=progress,
        kept=kept,
    )


def poses_of(found: Registered) -> list[HandPose]:
    """The poses found, frame by frame."""
    pairs = zip(found.poses.rotations, found.poses.translation, strict=True)
    return [HandPose(rotations, translation) for rotations, translation in pairs]


def observe_frame(frame: Frame) -> Observation:
    """What a frame of a capture shows, its picture binned if it is large."""
    frame = frame.binned(FITTED_SIDE)
    picture = FramePicture.of(frame.camera, frame.image, frame.alpha, frame.known, frame.gain)
    return Observation(picture, frame.time, frame.landmarks)
