"""Motions: hand poses over time, as files and by name.

A motion file is JSON: ``{"schema": 1, "fps": 30, "rotations": [T][16][3], "translations": [T][3]}``
with axis-angle rotations in radians in the order of ``BONE_NAMES`` and translations in metres, as
in :class:`HandPose`. Named motions are made for a given start: they turn the hand about its own
middle, so that whatever camera sees the start goes on seeing the hand.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError, load_json, number
from handavatar.capture.motion_values import MAX_STEPS, rotations_of, translations_of
from handavatar.errors import require_ranges
from handavatar.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    rotations_between,
)
from handavatar.geometry.tensors import require_tensor
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import (
    GESTURES,
    Gesture,
    interpolate_rotations,
    resolve_penetration,
    rotations_from_angles,
)
from handavatar.hand.rig import Rig
from handavatar.jobs.files import write_atomically
from handavatar.jobs.finite import find_not_finite

SCHEMA = 1
_LEAST_FPS, _MOST_FPS = 0.01, 1000.0
LONG_GAP = 0.75
"""Seconds without a pose that are told."""

_OPEN = (0.0, 3.0, 1.0, 0.0)
_BENT = (82.0, 90.0, 42.0, 0.0)
_TUCKED = (22.0, 18.0, -22.0, 32.0, 42.0)

MORE_GESTURES: dict[str, Gesture] = {
    "thumb_to_middle": Gesture(
        (20.0, 22.0, 10.0, 3.0),
        (54.0, 46.0, 22.0, 0.0),
        (24.0, 26.0, 12.0, -2.0),
        (18.0, 20.0, 10.0, -6.0),
        (24.0, 17.0, -24.0, 14.0, 22.0),
    ),
    "thumb_to_ring": Gesture(
        (14.0, 18.0, 8.0, 4.0),
        (22.0, 24.0, 12.0, 0.0),
        (60.0, 50.0, 26.0, 0.0),
        (26.0, 24.0, 12.0, -4.0),
        (30.0, 18.0, -30.0, 24.0, 28.0),
    ),
    "thumb_to_little": Gesture(
        (8.0, 12.0, 6.0, 5.0),
        (14.0, 18.0, 8.0, 0.0),
        (30.0, 28.0, 14.0, 0.0),
        (66.0, 52.0, 28.0, 0.0),
        (34.0, 18.0, -34.0, 34.0, 34.0),
    ),
    "claw": Gesture(
        (-6.0, 55.0, 32.0, 9.0),
        (-6.0, 58.0, 34.0, 1.0),
        (-6.0, 58.0, 34.0, -7.0),
        (-6.0, 55.0, 32.0, -15.0),
        (-8.0, 4.0, 0.0, 18.0, 38.0),
    ),
    "hook": Gesture(
        (4.0, 95.0, 50.0, 0.0),
        (4.0, 98.0, 52.0, 0.0),
        (4.0, 98.0, 52.0, 0.0),
        (4.0, 94.0, 50.0, 0.0),
        (6.0, 2.0, -6.0, 18.0, 16.0),
    ),
    "table": Gesture(
        (74.0, 6.0, 3.0, 0.0),
        (78.0, 6.0, 3.0, 0.0),
        (80.0, 6.0, 3.0, 0.0),
        (82.0, 6.0, 3.0, 0.0),
        (-4.0, 6.0, 0.0, 4.0, 6.0),
    ),
    "loose_fist": Gesture(
        (52.0, 66.0, 32.0, 2.0),
        (58.0, 70.0, 34.0, 0.0),
        (62.0, 72.0, 36.0, 0.0),
        (64.0, 70.0, 34.0, -2.0),
        (14.0, 14.0, -14.0, 22.0, 26.0),
    ),
    "purse": Gesture(
        (58.0, 34.0, 16.0, 0.0),
        (62.0, 32.0, 14.0, 0.0),
        (64.0, 34.0, 16.0, 0.0),
        (66.0, 36.0, 18.0, 0.0),
        (24.0, 18.0, -22.0, 14.0, 20.0),
    ),
    "horns": Gesture(_OPEN, _BENT, _BENT, (0.0, 4.0, 2.0, -10.0), _TUCKED),
    "gun": Gesture(_OPEN, _BENT, _BENT, _BENT, (-20.0, -4.0, 4.0, -4.0, -8.0)),
    "three": Gesture(
        (-2.0, 3.0, 1.0, 12.0),
        (-2.0, 3.0, 1.0, 0.0),
        (-2.0, 4.0, 2.0, -10.0),
        _BENT,
        (28.0, 18.0, -28.0, 34.0, 42.0),
    ),
    "four": Gesture(
        (-2.0, 3.0, 1.0, 9.0),
        (-2.0, 3.0, 1.0, 1.0),
        (-2.0, 3.0, 1.0, -7.0),
        (-2.0, 3.0, 1.0, -16.0),
        (32.0, 16.0, -32.0, 38.0, 40.0),
    ),
    "little_out": Gesture(_BENT, _BENT, _BENT, (0.0, 3.0, 1.0, -12.0), _TUCKED),
    "shaka": Gesture(_BENT, _BENT, _BENT, (0.0, 3.0, 1.0, -16.0), (-22.0, -6.0, 4.0, -6.0, -10.0)),
    "knock": Gesture(
        (80.0, 88.0, 40.0, 0.0),
        (84.0, 92.0, 42.0, 0.0),
        (86.0, 92.0, 42.0, 0.0),
        (84.0, 90.0, 40.0, -3.0),
        (2.0, 4.0, -6.0, 24.0, 30.0),
    ),
    "key_grip": Gesture(
        (44.0, 66.0, 34.0, 2.0),
        (56.0, 74.0, 36.0, 0.0),
        (62.0, 76.0, 38.0, 0.0),
        (64.0, 74.0, 36.0, -2.0),
        (10.0, 8.0, -10.0, 12.0, 10.0),
    ),
    "cupped": Gesture(
        (40.0, 34.0, 18.0, -3.0),
        (42.0, 36.0, 18.0, 0.0),
        (44.0, 38.0, 20.0, 1.0),
        (46.0, 38.0, 20.0, 4.0),
        (22.0, 12.0, -16.0, 10.0, 14.0),
    ),
    "wave_low": Gesture(
        (64.0, 70.0, 34.0, 0.0),
        (46.0, 54.0, 26.0, 0.0),
        (26.0, 32.0, 16.0, 0.0),
        (8.0, 12.0, 6.0, -4.0),
        (4.0, 8.0, -6.0, 10.0, 12.0),
    ),
    "wave_high": Gesture(
        (8.0, 12.0, 6.0, 4.0),
        (26.0, 32.0, 16.0, 0.0),
        (46.0, 54.0, 26.0, 0.0),
        (64.0, 70.0, 34.0, 0.0),
        (10.0, 10.0, -10.0, 14.0, 16.0),
    ),
}
"""Gestures beyond the best known ones, for training and test motions."""

MOTIONS: dict[str, tuple[str, ...]] = {
    "gestures": ("relaxed", "spread", "fist", "point", "victory", "ok", "thumbs_up", "relaxed"),
    "count": ("fist", "point", "victory", "three", "four", "spread", "fist"),
    "grasp": ("spread", "relaxed", "loose_fist", "fist", "loose_fist", "relaxed", "spread"),
    "pinch": ("relaxed", "pinch", "thumb_to_middle", "thumb_to_ring", "thumb_to_little", "relaxed"),
    "ripple": ("flat", "wave_low", "loose_fist", "wave_high", "flat", "wave_high", "wave_low"),
    "turn": ("relaxed", "relaxed", "relaxed"),
}
"""Built-in motions: the gestures they pass through."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of one hand at equal steps of time.

    Attributes:
        fps: steps per second.
        rotations: axis-angle, radians, wrist relative to the world.
        translations: metres.

    Raises:
        ArgumentError: if one is no tensor of floats of this shape, or there is no such speed.
    """

    fps: float
    rotations: Float[Tensor, "steps bones 3"]
    translations: Float[Tensor, "steps 3"]

    def __post_init__(self) -> None:
        """Refuses what is no motion."""
        require_ranges(self, fps=(_LEAST_FPS, _MOST_FPS))
        require_tensor("Motion.rotations", self.rotations, (-1, NUM_BONES, 3))
        require_tensor("Motion.translations", self.translations, (len(self.rotations), 3))

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.rotations)

    def pose(self, step: int) -> HandPose:
        """The pose at one step."""
        return HandPose(self.rotations[step], self.translations[step])


def read_motion(path: Path) -> Motion:
    """Reads a motion file.

    Raises:
        CaptureError: what is wrong with it and what to do.
    """
    path = Path(path)
    try:
        content = load_json(path)
        if content.get("schema") != SCHEMA:
            raise CaptureError(
                f"schema is {str(content.get('schema'))[:20]}, this program reads {SCHEMA}",
                'write "schema": 1, or update handavatar',
            )
        fps = number(content.get("fps"), "fps", _LEAST_FPS, _MOST_FPS)
        rotations = rotations_of(content.get("rotations"))
        translations = translations_of(content.get("translations"), len(rotations), fps)
    except CaptureError as error:
        raise CaptureError(f"{path}: {error.what}", error.remedy) from error
    return Motion(fps, rotations.float(), translations.float())


def write_motion(path: Path, motion: Motion) -> None:
    """Writes a motion file; it appears whole or not at all.

    Raises:
        CaptureError: if a number is not finite; it says which.
    """
    path = Path(path)
    if found := find_not_finite(vars(motion)):
        raise CaptureError(f"{path}: {found}", "write finite poses")
    content = {
        "schema": SCHEMA,
        "fps": motion.fps,
        "rotations": motion.rotations.double().tolist(),
        "translations": motion.translations.double().tolist(),
    }
    write_atomically({path: json.dumps(content, allow_nan=False).encode()})


def evenly_spaced(
    times: Float[Tensor, "seen"],
    rotations: Float[Tensor, "seen bones 3 3"],
    translations: Float[Tensor, "seen 3"],
    fps: float,
    tell: Callable[[str], None],
) -> Motion:
    """A motion at equal steps out of poses at given times; turns between two are the shortest.

    Args:
        times: seconds, growing.
        rotations: relative to the parent bone.
        translations: metres.
        fps: steps a second.
        tell: called where there is no pose for long.

    Raises:
        CaptureError: these are more steps than a motion may have, or too few or many a second.
    """
    if not _LEAST_FPS <= fps <= _MOST_FPS:
        raise CaptureError(
            f"{fps:.3g} steps a second, expected {_LEAST_FPS:g} to {_MOST_FPS:g}",
            "say another rate with `fps`",
        )
    span = float(times[-1] - times[0])
    if not span * fps < MAX_STEPS:
        raise CaptureError(
            f"{span * fps:.6g} steps at {fps:g} a second; {MAX_STEPS} at most",
            "choose a smaller `fps`",
        )
    count = int(span * fps + 1e-6) + 1
    if len(times) == 1:
        return Motion(fps, axis_angle_from_matrix(rotations).float(), translations.float())
    gaps = times.diff()
    for start, gap in zip(times, gaps, strict=False):
        if float(gap) > LONG_GAP:
            tell(f"no pose from {float(start):.1f} s for {float(gap):.1f} s: the hand glides there")
    moments = times[0] + torch.arange(count) / fps
    after = torch.searchsorted(times, moments).clamp(1, len(times) - 1)
    share = ((moments - times[after - 1]) / gaps[after - 1]).clamp(0, 1).to(rotations)
    between = rotations_between(rotations[after - 1], rotations[after], share[:, None, None])
    places = torch.lerp(translations[after - 1], translations[after], share[:, None])
    return Motion(fps, axis_angle_from_matrix(between).float(), places.float())


def gesture(rig: Rig, name: str) -> Float[Tensor, "bones 3"]:
    """Axis-angle rotations of any gesture, the wrist at zero.

    Raises:
        CaptureError: unknown name.
    """
    known = {**GESTURES, **MORE_GESTURES}
    if name not in known:
        raise CaptureError(f"there is no gesture {name!r}", f"choose among {', '.join(known)}")
    return rotations_from_angles(rig, known[name].angles())


def named_motion(
    rig: Rig, name: str, start: HandPose, fps: float = 30.0, seconds_per_gesture: float = 0.8
) -> Motion:
    """One of ``MOTIONS`` performed where a given hand is.

    Args:
        rig: whose joints move.
        name: key of ``MOTIONS``.
        start: its wrist gives the place and the orientation; its fingers do not matter.
        fps: steps per second.
        seconds_per_gesture: time from one gesture to the next.

    Raises:
        CaptureError: unknown name.
    """
    if name not in MOTIONS:
        raise CaptureError(f"there is no motion {name!r}", f"choose among {', '.join(MOTIONS)}")
    keys = torch.stack([gesture(rig, key) for key in MOTIONS[name]])
    last = len(keys) - 1
    steps = round(last * seconds_per_gesture * fps) + 1
    share = torch.linspace(0, 1, steps)
    fingers = resolve_penetration(rig, interpolate_rotations(keys, share * last))
    sway = torch.sin(2 * math.pi * share)
    # About the hand's own axes: along the fingers, across the back, across the palm.
    reach = (math.pi, 0.0, 0.0) if name == "turn" else (0.45, 0.12, 0.2)
    nod = torch.sin(4 * math.pi * share)
    turns = torch.stack([reach[0] * sway, reach[1] * nod, reach[2] * nod], dim=-1)
    first = matrix_from_axis_angle(start.rotations[0])
    return placed(
        rig, fingers, first @ matrix_from_axis_angle(turns), middle_of_hand(rig, start), fps
    )


def open_motion(reference: str, rig: Rig, start: HandPose) -> Motion:
    """A motion as a user calls it.

    Args:
        reference: key of ``MOTIONS``, or the path of a motion file.
        rig: whose joints move.
        start: where a motion of ``MOTIONS`` is performed.

    Raises:
        CaptureError: what is wrong with the file.
    """
    if reference in MOTIONS:
        return named_motion(rig, reference, start)
    return read_motion(Path(reference))


def middle_of_hand(rig: Rig, pose: HandPose) -> Float[Tensor, "3"]:
    """Where the middle of the palm is in the world, metres."""
    joints = rig.shaped().rest_joints
    offset = _palm_from_wrist(rig)
    return joints[0] + pose.translation + matrix_from_axis_angle(pose.rotations[0]) @ offset


def placed(
    rig: Rig,
    fingers: Float[Tensor, "steps bones 3"],
    world_from_wrist: Float[Tensor, "steps 3 3"],
    middle: Float[Tensor, "*steps 3"],
    fps: float,
) -> Motion:
    """A motion of given finger poses, wrist orientations and places of the palm's middle."""
    rotations = fingers.clone()
    rotations[:, 0] = axis_angle_from_matrix(world_from_wrist)
    wrist = middle - world_from_wrist @ _palm_from_wrist(rig)
    return Motion(fps, rotations, wrist - rig.shaped().rest_joints[0])


def _palm_from_wrist(rig: Rig) -> Float[Tensor, "3"]:
    """From the wrist joint to the middle finger's knuckle, in rest axes."""
    joints = rig.shaped().rest_joints
    return joints[4] - joints[0]
