"""What the numbers of a motion file mean: other layouts, units and skeletons are named.

A motion in millimetres or degrees is a list of numbers like any other; what gives it away is how
far the hand would be, how fast it would move, and how far its fingers would bend.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError, numbers
from handavatar.hand.pose import NUM_BONES

MAX_STEPS = 100_000
REACH = 20.0
"""Metres from the origin within which a hand is believed; as for other programs' motions."""
_NEAR = 3.0
"""Metres from the origin where most hands are: what another unit would have to give."""
_FASTEST = 50.0
"""Metres a second; a pitcher's hand reaches 40."""
_MOST_BEND = 2.6
"""Radians that a finger's joint turns by at most."""
_JUMP = 0.7
"""Radians from step to step that no finger joint turns by, beyond what a file of radians says."""
_TWO_TURNS = 4 * math.pi

_RADIANS = "write axis times angle, the angle in radians: degrees times 0.017453"
_LAYOUTS = {
    (NUM_BONES, 4): "quaternions",
    (NUM_BONES, 3, 3): "matrices",
    (NUM_BONES, 9): "matrices",
    (NUM_BONES, 4, 4): "matrices",
    (NUM_BONES, 6): "six numbers a joint",
    (NUM_BONES - 1, 3): "15 joints: the wrist is missing",
    (NUM_BONES - 1, 3, 3): "matrices of 15 joints: the wrist is missing",
    (NUM_BONES - 1, 4): "quaternions of 15 joints: the wrist is missing",
    (21, 3): "21 joints; these may be landmarks, which are positions",
    (NUM_BONES * 3,): "48 numbers in one list",
    ((NUM_BONES - 1) * 3,): "45 numbers in one list: the wrist is missing",
}
_REMEDIES = {
    "quaternions": "convert each quaternion to axis times angle, 3 numbers",
    "matrices": "convert each matrix to axis times angle, 3 numbers",
    "15 joints": "put the wrist's rotation before the 15 of the fingers",
    "48 numbers": "write 16 lists of 3 numbers each step",
}
_ORDER = "wrist, index, middle, little, ring, thumb, three joints a finger"


def rotations_of(steps: object) -> Float[Tensor, "steps bones 3"]:
    """The rotations of a motion, axis times angle in radians.

    Angles of more than a full circle are brought below it: they mean the same.

    Args:
        steps: nested lists, as JSON has them.

    Raises:
        CaptureError: they are no such rotations; what they may be instead.
    """
    if not isinstance(steps, list) or not 0 < len(steps) <= MAX_STEPS:
        found = f"{len(steps)} steps" if isinstance(steps, list) else type(steps).__name__
        raise CaptureError(
            f"rotations is {found}, expected a list of 1 to {MAX_STEPS} steps",
            "give a pose per step",
        )
    shape = _shape(steps[0])
    if shape in _LAYOUTS:
        what = _LAYOUTS[shape]
        remedies = [remedy for name, remedy in _REMEDIES.items() if name in what]
        remedies.append(f"expected are 16 x 3 numbers a step: {_ORDER}")
        raise CaptureError(f"rotations are {what}", "; ".join(remedies))
    values = torch.from_numpy(numbers(steps, (len(steps), NUM_BONES, 3), "rotations"))
    angles = values.norm(dim=-1)
    bend = float(angles[:, 1:].max())
    jump = float(values[:, 1:].diff(dim=0).norm(dim=-1).max()) if len(values) > 1 else math.inf
    largest = float(angles.max())
    is_too_far = bend > _MOST_BEND and jump > _JUMP and (len(values) > 1 or bend > 2 * math.pi)
    if is_too_far or largest > _TWO_TURNS:
        raise CaptureError(
            f"a joint turns by {largest:.3g}: that is degrees, where radians were expected",
            _RADIANS,
        )
    whole = (angles / (2 * math.pi)).floor() * 2 * math.pi
    reduced = (angles - whole) / angles.clamp_min(1e-12)
    return torch.where((angles > 2 * math.pi)[..., None], values * reduced[..., None], values)


def translations_of(value: Any, count: int, fps: float) -> Float[Tensor, "steps 3"]:
    """The translations of a motion, metres.

    Args:
        value: nested lists, as JSON has them.
        count: of steps.
        fps: steps a second.

    Raises:
        CaptureError: they are no such translations; what they may be instead.
    """
    if isinstance(value, list) and len(value) == 3 != count and _shape(value[0]) == ():
        raise CaptureError(
            f"translations is one place for {count} steps", "write a place for each step"
        )
    places = torch.from_numpy(numbers(value, (count, 3), "translations"))
    reach = float(places.norm(dim=-1).median())
    speed = float(places.diff(dim=0).norm(dim=-1).median()) * fps if count > 1 else 0.0
    if reach <= REACH and speed <= _FASTEST:
        return places
    found = (
        f"the hand is {reach:.4g} m from the origin, at most {REACH:g} m were expected"
        if reach > REACH
        else f"the hand moves at {speed:.4g} m a second, at most {_FASTEST:g} were expected"
    )
    units = [
        name
        for name, metres in (("centimetres", 1e-2), ("millimetres", 1e-3))
        if reach * metres <= _NEAR and speed * metres <= _FASTEST
    ]
    likely = f": that looks like {' or '.join(units)}" if units else ""
    raise CaptureError(found + likely, "write translations in metres")


def _shape(value: object) -> tuple[int, ...]:
    """Of nested lists, by their first entries; not deeper than anything here is."""
    shape: list[int] = []
    while isinstance(value, list) and len(shape) < 4:
        shape.append(len(value))
        value = value[0] if value else None
    return tuple(shape)
