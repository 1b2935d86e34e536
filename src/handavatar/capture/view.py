"""The typical view of a capture."""

from typing import Any

import torch

from handavatar.capture.frames import Frame
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import HandPose


def view_of(frames: list[Frame]) -> dict[str, Any]:
    """The typical view of a capture, as JSON: what an avatar keeps of where its hand was seen.

    It is the training frame whose wrist orientation is nearest to all others'. Light is part of
    what an avatar learned, so new poses look right when they are seen under the same light.
    """
    wrists = matrix_from_axis_angle(torch.stack([frame.pose.rotations[0] for frame in frames]))
    likeness = torch.einsum("aij,bij->ab", wrists, wrists).sum(1)
    frame = frames[int(likeness.argmax())]
    return {
        "camera_from_world": frame.camera.camera_from_world.tolist(),
        "rotations": frame.pose.rotations.tolist(),
        "translation": frame.pose.translation.tolist(),
    }


def start_of(view: dict[str, Any] | None) -> HandPose:
    """The hand in the typical view of an avatar's capture; flat, at the origin, if unknown."""
    if view is None:
        return HandPose.flat()
    return HandPose(torch.tensor(view["rotations"]), torch.tensor(view["translation"]))
