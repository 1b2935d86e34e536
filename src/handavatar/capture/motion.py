"""Motions: hand poses over time, as files and by name.

A motion file is JSON: ``{"schema": 1, "fps": 30, "rotations": [T][16][3], "translations": [T][3]}``
with axis-angle rotations in radians in the order of ``BONE_NAMES`` and translations in metres, as
in :class:`HandPose`. Named motions are made for a given start: they turn the hand about its own
middle, so that whatever camera sees the start goes on seeing the hand.
"""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError, load_json, number, numbers
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import (
    GESTURES,
    Gesture,
    interpolate_rotations,
    resolve_penetration,
    rotations_from_angles,
)
from handavatar.hand.rig import Rig

SCHEMA = 1
MAX_STEPS = 100_000

_OPEN = (0.0, 3.0, 1.0, 0.0)
_BENT = (82.0, 90.0, 42.0, 0.0)
_TUCKED = (22.0, 18.0, -22.0, 32.0, 42.0)

MORE_GESTURES: dict[str, Gesture] = {
    "thumb_to_middle": Gesture(
        (20, 22, 10, 3), (54, 46, 22, 0), (24, 26, 12, -2), (18, 20, 10, -6), (24, 17, -24, 14, 22)
    ),
    "thumb_to_ring": Gesture(
        (14, 18, 8, 4), (22, 24, 12, 0), (60, 50, 26, 0), (26, 24, 12, -4), (30, 18, -30, 24, 28)
    ),
    "thumb_to_little": Gesture(
        (8, 12, 6, 5), (14, 18, 8, 0), (30, 28, 14, 0), (66, 52, 28, 0), (34, 18, -34, 34, 34)
    ),
    "claw": Gesture(
        (-6, 55, 32, 9), (-6, 58, 34, 1), (-6, 58, 34, -7), (-6, 55, 32, -15), (-8, 4, 0, 18, 38)
    ),
    "hook": Gesture(
        (4, 95, 50, 0), (4, 98, 52, 0), (4, 98, 52, 0), (4, 94, 50, 0), (6, 2, -6, 18, 16)
    ),
    "table": Gesture((74, 6, 3, 0), (78, 6, 3, 0), (80, 6, 3, 0), (82, 6, 3, 0), (-4, 6, 0, 4, 6)),
    "loose_fist": Gesture(
        (52, 66, 32, 2), (58, 70, 34, 0), (62, 72, 36, 0), (64, 70, 34, -2), (14, 14, -14, 22, 26)
    ),
    "purse": Gesture(
        (58, 34, 16, 0), (62, 32, 14, 0), (64, 34, 16, 0), (66, 36, 18, 0), (24, 18, -22, 14, 20)
    ),
    "horns": Gesture(_OPEN, _BENT, _BENT, (0, 4, 2, -10), _TUCKED),
    "gun": Gesture(_OPEN, _BENT, _BENT, _BENT, (-20, -4, 4, -4, -8)),
    "three": Gesture((-2, 3, 1, 12), (-2, 3, 1, 0), (-2, 4, 2, -10), _BENT, (28, 18, -28, 34, 42)),
    "four": Gesture(
        (-2, 3, 1, 9), (-2, 3, 1, 1), (-2, 3, 1, -7), (-2, 3, 1, -16), (32, 16, -32, 38, 40)
    ),
    "little_out": Gesture(_BENT, _BENT, _BENT, (0, 3, 1, -12), _TUCKED),
    "shaka": Gesture(_BENT, _BENT, _BENT, (0, 3, 1, -16), (-22, -6, 4, -6, -10)),
    "wave_low": Gesture(
        (64, 70, 34, 0), (46, 54, 26, 0), (26, 32, 16, 0), (8, 12, 6, -4), (4, 8, -6, 10, 12)
    ),
    "wave_high": Gesture(
        (8, 12, 6, 4), (26, 32, 16, 0), (46, 54, 26, 0), (64, 70, 34, 0), (10, 10, -10, 14, 16)
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
    """

    fps: float
    rotations: Float[Tensor, "steps bones 3"]
    translations: Float[Tensor, "steps 3"]

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
        steps = content.get("rotations")
        if not isinstance(steps, list) or not 0 < len(steps) <= MAX_STEPS:
            raise CaptureError(
                f"rotations is not a list of 1 to {MAX_STEPS} steps", "give a pose per step"
            )
        rotations = torch.from_numpy(numbers(steps, (len(steps), NUM_BONES, 3), "rotations"))
        if float(rotations.norm(dim=-1).max()) > 2 * math.pi + 1e-3:
            raise CaptureError(
                "a joint turns by more than a full circle", "write radians, not degrees"
            )
        translations = numbers(content.get("translations"), (len(steps), 3), "translations")
        fps = number(content.get("fps"), "fps", 0.01, 1000.0)
    except CaptureError as error:
        raise CaptureError(f"{path}: {error.what}", error.remedy) from error
    return Motion(fps, rotations.float(), torch.from_numpy(translations).float())


def write_motion(path: Path, motion: Motion) -> None:
    """Writes a motion file; it appears whole or not at all.

    Raises:
        CaptureError: if a pose is not finite.
    """
    path = Path(path)
    content = {
        "schema": SCHEMA,
        "fps": motion.fps,
        "rotations": motion.rotations.double().tolist(),
        "translations": motion.translations.double().tolist(),
    }
    try:
        text = json.dumps(content, allow_nan=False)
    except ValueError as error:
        raise CaptureError(f"{path}: a pose is not finite", "write finite poses") from error
    aside = path.with_name(f".{path.name}.part")
    try:
        aside.write_text(text, encoding="utf-8")
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


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
    turns = torch.stack([reach[0] * sway, reach[1] * sway.abs(), reach[2] * sway.roll(7)], dim=-1)
    first = matrix_from_axis_angle(start.rotations[0])
    return placed(
        rig, fingers, first @ matrix_from_axis_angle(turns), middle_of_hand(rig, start), fps
    )


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
