"""Exposure and white balance between recordings of one hand, by skin that several of them show."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.frames import Frame
from handavatar.capture.seen_skin import seen_vertices
from handavatar.geometry.cameras import project
from handavatar.hand.rig import Rig

_FEWEST_SHARED = 40
"""Vertices that two recordings have to show in common."""
_MOST_FRAMES = 24
"""Of a recording, that are looked at."""
_DARKEST = 8.0
"""Of 255: below, a camera stores noise."""


@torch.no_grad()
def match_clips(
    frames: Sequence[Frame], rig: Rig, coefficients: Float[Tensor, "shapes"]
) -> tuple[list[Frame], list[int]]:
    """Gains by which the same skin has the same colour in all recordings, on the median.

    The gains within each recording stay relative to each other. Light and exposure are not told
    apart: a recording in dimmer light gets a smaller gain.

    Args:
        frames: of all recordings, with the gains that each has found for itself.
        rig: the poses' own.
        coefficients: of its shape.

    Returns:
        The frames, and the numbers of the recordings that share too little skin with the others.
    """
    numbers = sorted({frame.clip for frame in frames})
    colors = {
        number: _skin_colors([frame for frame in frames if frame.clip == number], rig, coefficients)
        for number in numbers
    }
    logarithms = {numbers[0]: torch.zeros(3)}
    known, waiting, lone = colors[numbers[0]], numbers[1:], []
    while waiting:
        # The one that shares most with those before it.
        shared = {number: _shared(colors[number], known) for number in waiting}
        number = max(waiting, key=lambda number: int(shared[number].sum()))
        waiting.remove(number)
        if int(shared[number].sum()) < _FEWEST_SHARED:
            lone.append(number)
            logarithms[number] = torch.zeros(3)
            continue
        own = colors[number]
        logarithms[number] = (own - known)[shared[number]].median(0).values
        known = torch.where(known.isfinite(), known, own - logarithms[number])
    return (
        [replace(frame, gain=frame.gain * logarithms[frame.clip].exp()) for frame in frames],
        sorted(lone),
    )


def _shared(first: Float[Tensor, "vertices 3"], second: Float[Tensor, "vertices 3"]) -> Tensor:
    return (first.isfinite() & second.isfinite()).all(-1)


def _skin_colors(
    frames: Sequence[Frame], rig: Rig, coefficients: Float[Tensor, "shapes"]
) -> Float[Tensor, "vertices 3"]:
    """Logarithms of stored values at the vertices, the median over frames; NaN where unseen."""
    hand = rig.shaped(coefficients)
    every = max(1, len(frames) // _MOST_FRAMES)
    found = []
    for frame in frames[::every]:
        vertices = hand.posed(frame.pose).vertices
        is_seen = seen_vertices(vertices, rig.faces, frame.camera, frame.known)
        x, y = project(frame.camera, vertices)[0].floor().long().unbind(-1)
        x, y = x.clamp(0, frame.camera.width - 1), y.clamp(0, frame.camera.height - 1)
        values = frame.image[y, x].float()
        is_sound = is_seen & frame.mask[y, x] & (values > _DARKEST).all(-1) & (values < 250).all(-1)
        colors = (values / frame.gain).log()
        found.append(torch.where(is_sound[:, None], colors, torch.nan))
    return torch.stack(found).nanmedian(0).values
