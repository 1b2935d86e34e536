"""AMASS: bodies with hands, of which the fingers of one hand are taken."""

import numpy as np
import torch

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion_files.parameters import checked_vectors, rate_of
from handavatar.capture.motion_files.stored import Part, array_field, rows_of
from handavatar.capture.motion_files.track import Conventions, HandTrack, mirrored_rotations
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import NUM_BONES

_VALUES = 156
_HANDS = {"left": slice(66, 111), "right": slice(111, 156)}
_STILL = 1e-4


def is_amass(fields: dict[str, object]) -> bool:
    """Whether a file is of AMASS, with SMPL+H bodies, for certain."""
    poses = fields.get("poses")
    has_names = {"poses", "trans"} <= set(fields)
    has_rate = "mocap_framerate" in fields or "mocap_frame_rate" in fields
    is_whole = isinstance(poses, np.ndarray) and poses.ndim == 2 and poses.shape[1] == _VALUES
    return has_names and has_rate and is_whole


def read_amass(part: Part, conventions: Conventions) -> HandTrack:
    """The fingers of one hand of an SMPL+H body; the wrist stays as it rests.

    The place and the turn of a wrist follow from the whole body and its shape, which a hand has
    not. Finger poses count from the flat hand: AMASS's own body model adds no mean pose.

    Args:
        part: npz with ``poses`` (frames, 156).
        conventions: the side must be named, for both hands are there.

    Raises:
        CaptureError: it is another layout, or no side was named.
    """
    values = array_field(part.fields, ("poses",), part.path)
    if values.shape[-1] != _VALUES:
        raise CaptureError(
            f"{part.path}: poses has shape {values.shape}, expected (frames, {_VALUES})",
            "take AMASS's SMPL+H files; a hand's own parameters are `layout='mano'`",
        )
    if conventions.side == "auto":
        raise CaptureError(
            f"{part.path}: it holds both hands", "name one: `side='left'` or `side='right'`"
        )
    poses = rows_of(values, (_VALUES,), "poses", part.path)
    fingers = torch.from_numpy(poses[:, _HANDS[conventions.side]].copy())
    rotations = torch.eye(3, dtype=torch.float64).repeat(len(fingers), NUM_BONES, 1, 1)
    rotations[:, 1:] = matrix_from_axis_angle(checked_vectors(fingers, part.path))
    if conventions.side == "left":
        rotations = mirrored_rotations(rotations)
    notes = ["AMASS: fingers alone; the wrist stays where it rests"]
    if float((fingers - fingers[:1]).abs().max()) < _STILL:
        notes.append(
            f"the {conventions.side} hand's fingers do not move: many of AMASS's recordings have "
            "no fingers"
        )
    return HandTrack(
        side=conventions.side,
        frames=torch.arange(len(fingers)),
        rotations=rotations,
        translations=torch.zeros(len(fingers), 3, dtype=torch.float64),
        shape=torch.zeros(len(fingers), 10, dtype=torch.float64),
        fps=rate_of(part.fields, part.path),
        space="hand",
        turns_wrist=False,
        notes=tuple(notes),
    )
