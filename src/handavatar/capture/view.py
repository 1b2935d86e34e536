"""The typical view of a capture."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.frames import Frame
from handavatar.geometry.cameras import Camera, look_at, project
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import HandPose


def view_of(frames: Sequence[Frame]) -> dict[str, Any]:
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


def camera_holding(
    view: dict[str, Any] | None,
    points: Float[Tensor, "points 3"],
    middle: Float[Tensor, "3"],
    size: int,
    room: float = 0.15,
) -> Camera:
    """A square camera where the capture's was, that holds all the points.

    Args:
        view: of the capture; over the middle, if unknown.
        points: to be held, metres, world.
        middle: of the hand, metres, world.
        size: pixels along a side.
        room: around the points, as a share of their longer side, half of it on either side.
    """
    if view is None:
        eye = middle + torch.tensor([0.0, -0.6, 0.0])
        placed = look_at(eye, middle, torch.tensor([-1.0, 0, 0]))
    else:
        placed = torch.tensor(view["camera_from_world"])
    wide = Camera((1.0, 1.0), (0.0, 0.0), 1, 1, placed)
    seen = project(wide, points)[0]
    lower, upper = seen.amin(0), seen.amax(0)
    side = float((upper - lower).max()) * (1 + room)
    left, top = ((lower + upper) / 2 - side / 2).tolist()
    focal = size / side
    return Camera((focal, focal), (-left * focal, -top * focal), size, size, placed)
