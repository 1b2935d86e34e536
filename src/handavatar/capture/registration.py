"""The hand of a video laid onto its landmarks, masks and colours by the one fit (:mod:`fit`).

First the landmarks alone say about where it is; then outlines, and at last colours, join them.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from handavatar.capture.fitted_hand import HandFit
from handavatar.capture.fitting import Observations
from handavatar.capture.masks import HandMask
from handavatar.capture.tracking import TrackedHand
from handavatar.capture.windows import window_camera
from handavatar.fit.energy import LandmarkSightings, Observation
from handavatar.fit.pictures import FramePicture
from handavatar.fit.register import Registered, RegisterOptions, register
from handavatar.geometry.cameras import Camera
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import Rig

LANDMARK_ERROR = 0.004
"""Metres by which a landmark is off, beside what the tracker itself admits."""
DEPTH_ERROR = 0.025
"""Metres by which its depth is off: measured on made films."""
_POSE_ERROR = np.radians(20.0) / 3**0.5
"""Radians by which joints are off where only the landmarks have spoken: they do so once more."""
_PLACE_ERROR = 0.05
"""Metres."""


def window_view(hand: TrackedHand, focal: float) -> Camera:
    """The camera of a tracked hand's window; focal length in pixels of the whole picture."""
    window = hand.window
    side = window.image.shape[0]
    return window_camera(focal, window.picture_size, window.corner, side / window.scale, side)


def observe_hands(
    hands: Sequence[TrackedHand],
    masks: Sequence[HandMask],
    known: Sequence[Bool[np.ndarray, "side side"]],
    gains: Float[np.ndarray, "hands 3"],
    seen: Observations,
    focal: float,
) -> list[Observation]:
    """What every frame of a video says: landmarks, mask and colours of the hand's surroundings.

    Args:
        hands: tracked.
        masks: of their windows.
        known: false outside of the picture, behind the wrist, and where the mask is unsure.
        gains: of the channels, frame by frame.
        seen: the tracker's landmarks.
        focal: length, pixels of the whole picture.
    """
    found = []
    for number, (hand, mask, is_known) in enumerate(zip(hands, masks, known, strict=True)):
        window = hand.window
        picture = FramePicture.of(
            window_view(hand, focal),
            torch.from_numpy(window.image).float() / 255,
            torch.from_numpy(mask.level).float(),
            torch.from_numpy(is_known),
            torch.from_numpy(gains[number]).float(),
        )
        expected = torch.hypot(seen.uncertainty[number], LANDMARK_ERROR * seen.scale[number])
        depths = seen.world_landmarks[number, :, 2]
        landmarks = LandmarkSightings(
            torch.from_numpy(window.from_picture(hand.landmarks)).float(),
            expected * window.scale,
            depths - depths.mean(),
            torch.full_like(depths, DEPTH_ERROR),
        )
        found.append(Observation(picture, hand.time, landmarks))
    return found


def register_hands(
    rig: Rig,
    fit: HandFit,
    observations: list[Observation],
    options: RegisterOptions,
    progress: Callable[[float], None] | None = None,
) -> tuple[HandFit, Registered]:
    """Goes on from a fit with all that the frames say; the focal length stays as it is.

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
        start=fit.offsets.flatten(),
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
