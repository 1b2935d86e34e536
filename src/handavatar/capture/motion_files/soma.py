"""SOMA-X: npz files of NVIDIA's body and hand layers, read and written.

SOMA's hand has 25 joints: the wrist, four of the thumb, and for each finger a metacarpal, three
joints and an end. A joint's own axes are, in both hands alike up to a mirror: -x along the bone,
-y its axis of flexion, +z out of the back of the hand (for the thumb, out of its nail). The bones
here are those that SOMA's joints carry; its metacarpals turn with the wrist.

A file's rotations are absolute (each joint's axes in its parent's) or count from a T pose whose
orientations ``joint_orient`` O the file then holds: absolute = O_parent^T R O.

Numbers of the palm below: SOMA-X, Copyright (c) 2026 NVIDIA CORPORATION & AFFILIATES, Apache 2.0,
as in ``data/soma/soma_rig.pt`` of the package anny 0.6.2.

Source: py-soma-x 0.3.4, save_soma_npz and SOMAHandLayer (their documentation).
"""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion import Motion
from handavatar.capture.motion_files.parameters import (
    checked_matrices,
    checked_vectors,
    choose_side,
    frame_numbers,
    rate_of,
    track_of_rows,
)
from handavatar.capture.motion_files.stored import (
    Part,
    array_field,
    rows_of,
    text_value,
)
from handavatar.capture.motion_files.track import (
    UNITS,
    Conventions,
    HandTrack,
    Rows,
    mirrored_points,
)
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.mano import Side
from handavatar.hand.pose import BONE_NAMES, NUM_BONES
from handavatar.hand.retargeting import (
    chain_rotations,
    local_rotations,
    palm_frame,
    rest_frames,
)
from handavatar.hand.rig import Rig
from handavatar.jobs.files import write_atomically

FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
JOINTS: tuple[str, ...] = (
    "",
    *("Thumb1", "Thumb2", "Thumb3", "ThumbEnd"),
    *(f"{f}{part}" for f in FINGERS[1:] for part in ("1", "2", "3", "4", "End")),
)
"""SOMA's 25 joints in its order, after ``RightHand`` or ``LeftHand``."""
_UNIT_NAMES = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}
_NUM_IDENTITY = 20
_TOLD_BEND = 2.0
# Which of SOMA's joints carries each bone.
_JOINT_OF_BONE = tuple(
    ""
    if bone == 0
    else f"Thumb{name[-1]}"
    if name.startswith("thumb")
    else f"{ {'little': 'Pinky'}.get(name[:-1], name[:-1].title()) }{int(name[-1]) + 1}"
    for bone, name in enumerate(BONE_NAMES)
)
# In the wrist's axes, centimetres: the joints at the roots of the fingers.
_KNUCKLES = {
    "index": (-9.48968, -2.45526, -0.07779),
    "middle": (-9.07260, 0.0, 0.0),
    "little": (-7.89304, 3.13064, -2.15595),
}
# Axes of the metacarpals in the wrist's, of the hand at rest.
_METACARPALS = {
    "Index1": (
        (0.99961, -0.02742, 0.00595),
        (0.02726, 0.99932, 0.02464),
        (-0.00663, -0.02447, 0.99968),
    ),
    "Middle1": (
        (0.98628, 0.15435, -0.05856),
        (-0.15056, 0.98650, 0.06437),
        (0.06771, -0.05467, 0.99621),
    ),
    "Ring1": (
        (0.97036, 0.21965, -0.10075),
        (-0.21095, 0.97332, 0.09027),
        (0.11789, -0.06634, 0.99081),
    ),
    "Pinky1": (
        (0.91680, 0.31328, -0.24767),
        (-0.27422, 0.94469, 0.17988),
        (0.29032, -0.09700, 0.95200),
    ),
}
_FINGER_FRAME = ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0))


def soma_frames() -> Float[Tensor, "bones 3 3"]:
    """Flexion, abduction and twist of every bone as rows, in the axes of SOMA's own joints.

    The wrist's are those of the palm, as of :func:`~handavatar.hand.retargeting.rest_frames`.
    """
    frames = torch.tensor(_FINGER_FRAME, dtype=torch.float64).repeat(NUM_BONES, 1, 1)
    knuckles = {name: torch.tensor(p, dtype=torch.float64) for name, p in _KNUCKLES.items()}
    frames[0] = palm_frame(torch.zeros(3, dtype=torch.float64), **knuckles)
    return frames


def is_soma(fields: dict[str, Any]) -> bool:
    """Whether a file is of SOMA-X for certain."""
    return {"poses", "transl", "joint_names", "rotation_repr"} <= set(fields)


# --- reading --------------------------------------------------------------------------------------


def read_soma(part: Part, conventions: Conventions) -> HandTrack:
    """One hand out of a file of SOMA-X, a hand's own or a body's.

    Of a body the fingers alone are taken, the wrist stays as it rests: its place follows from the
    whole body and its shape.

    Raises:
        CaptureError: joints are missing, the unit is unknown or not the one that the user says,
            or the T pose that the rotations count from is not there.
    """
    fields, path = part.fields, part.path
    names = _joint_names(part)
    sides = [s for s in ("left", "right") if any(n.startswith(f"{s.title()}Hand") for n in names)]
    told = text_value(fields.get("hand_type"))
    if told in ("left", "right"):
        if sides and told not in sides:
            raise CaptureError(
                f"{path}: hand_type is {told}, the joints are of the {sides[0]} hand",
                "correct hand_type or joint_names",
            )
        sides = [told]
    if not sides:
        raise CaptureError(
            f"{path}: no joint is called LeftHand... or RightHand...",
            "write SOMA's joint_names, such as RightHandIndex2",
        )
    side = choose_side("left" in sides, "right" in sides, conventions, path)
    is_body = "Hips" in names
    local, is_seen = _absolute_rotations(part, names, side, is_body)
    rotations = local_rotations(_bones_in_world(local))
    if side == "left":
        rotations[:, 0] = _right_axes(rotations.dtype) @ rotations[:, 0]
    places = torch.zeros(0, 3, dtype=torch.float64)
    notes = []
    if is_body:
        notes.append("SOMA-X body: fingers alone; the wrist stays where it rests")
    else:
        values = array_field(fields, ("transl",), path)
        places = torch.from_numpy(rows_of(values, (3,), "transl", path))
        if conventions.unit != "m" and UNITS[conventions.unit] != _unit(part):
            raise CaptureError(
                f"{path}: its unit is {text_value(fields['unit'])}, `unit` says {conventions.unit}",
                "leave `unit` out",
            )
        places = places * (_unit(part) / UNITS[conventions.unit])
        if len(places) != len(rotations):
            raise CaptureError(
                f"{path}: the arrays differ in length: poses {len(rotations)}, "
                f"transl {len(places)}",
                "give one row for each frame",
            )
    bend = _metacarpal_bend(local)
    if bend > _TOLD_BEND:
        notes.append(
            f"SOMA-X: its metacarpals bend by up to {bend:.0f} degrees; fingers point where they "
            "did, the palm here stays rigid"
        )
    rows = Rows(
        frames=frame_numbers([part], [len(rotations)])[0],
        is_right=torch.full((len(rotations),), int(side == "right")),
        rotations=rotations * is_seen[:, None, None, None],
        translations=places,
        shape=torch.zeros(len(rotations), 10, dtype=torch.float64),
    )
    return track_of_rows(
        rows,
        conventions,
        path,
        space="world",
        fps=rate_of(fields, path),
        describes_right=True,
        skeleton="soma",
        turns_wrist=not is_body and f"{side.title()}Hand" in names,
        notes=tuple(notes),
    )


def _metacarpal_bend(local: dict[str, Tensor]) -> float:
    """The largest angle, in degrees, of a metacarpal from its place at rest."""
    turns = [
        local[name] @ torch.tensor(axes, dtype=torch.float64).T
        for name, axes in _METACARPALS.items()
    ]
    angles = axis_angle_from_matrix(torch.stack(turns)).norm(dim=-1)
    return math.degrees(float(angles.max()))


def _right_axes(dtype: torch.dtype) -> Float[Tensor, "3 3"]:
    """From a left wrist's axes in the world to those of the right wrist that it mirrors.

    A left joint's axes are a right one's mirrored and all reversed, so that relative to their
    parents both turn alike; the wrist's alone, which count from the world, are mirrored.
    """
    return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=dtype))


def _joint_names(part: Part) -> list[str]:
    names = part.fields.get("joint_names")
    if not isinstance(names, np.ndarray) or names.dtype.kind not in "US" or names.ndim != 1:
        raise CaptureError(
            f"{part.path}: joint_names is no list of names", "save it as an array of text"
        )
    return [name.decode() if isinstance(name, bytes) else str(name) for name in names]


def _unit(part: Part) -> float:
    unit = text_value(part.fields.get("unit"))
    if unit not in _UNIT_NAMES:
        raise CaptureError(
            f"{part.path}: unit is {unit[:20]!r}, expected one of {', '.join(_UNIT_NAMES)}",
            "write the unit of transl",
        )
    return _UNIT_NAMES[unit]


def _absolute_rotations(
    part: Part, names: list[str], side: Side, is_body: bool
) -> tuple[dict[str, Tensor], Tensor]:
    """Of every joint of a hand its axes in its parent's; and which frames hold any."""
    path, prefix = part.path, f"{side.title()}Hand"
    stored = _stored_rotations(part, len(names))
    is_seen = (stored != 0).flatten(1).any(1)
    places = {joint: names.index(prefix + joint) for joint in JOINTS if prefix + joint in names}
    needed = [j for j in JOINTS if j and not j.endswith("End")]
    missing = [prefix + joint for joint in needed if joint not in places]
    if missing:
        raise CaptureError(
            f"{path}: the joints {', '.join(missing[:4])} are not there",
            "save all joints of SOMA's hand",
        )
    local = {joint: stored[:, place] for joint, place in places.items()}
    orient = _rest_orientations(part, names, prefix)
    if orient:
        local = {
            joint: orient[_parent(joint)].mT @ turn @ orient[joint] for joint, turn in local.items()
        }
    if is_body or "" not in local:
        local[""] = torch.eye(3, dtype=torch.float64).expand(len(stored), 3, 3)
    return local, is_seen


def _stored_rotations(part: Part, count: int) -> Float[Tensor, "steps joints 3 3"]:
    poses = torch.from_numpy(array_field(part.fields, ("poses",), part.path))
    kind = text_value(part.fields.get("rotation_repr"))
    expected = {"rotvec": (count, 3), "matrix": (count, 3, 3)}
    if kind not in expected or tuple(poses.shape[1:]) != expected[kind]:
        raise CaptureError(
            f"{part.path}: poses has shape {tuple(poses.shape)} for {count} joints and "
            f"rotation_repr {kind[:20]!r}",
            "save rotvec as (frames, joints, 3) or matrix as (frames, joints, 3, 3)",
        )
    if kind == "matrix":
        return checked_matrices(poses, part.path)
    return matrix_from_axis_angle(checked_vectors(poses.flatten(1), part.path))


def _rest_orientations(part: Part, names: list[str], prefix: str) -> dict[str, Tensor]:
    """Orientations of the T pose that rotations count from; none if they are absolute."""
    fields, path = part.fields, part.path
    flag = fields.get("absolute_pose")
    if not isinstance(flag, np.ndarray) or flag.size != 1:
        raise CaptureError(
            f"{path}: it does not say whether its poses are absolute", "save absolute_pose"
        )
    if bool(flag.reshape(-1)[0]):
        return {}
    if "joint_orient" not in fields:
        raise CaptureError(
            f"{path}: its poses count from a T pose, which is not in it",
            "save joint_orient as well, or absolute poses",
        )
    stored = torch.from_numpy(array_field(fields, ("joint_orient",), path))[..., :3, :3]
    # Without its root, a file still has the root's orientation.
    skipped = len(stored) - len(names)
    if stored.ndim != 3 or skipped not in (0, 1):
        raise CaptureError(
            f"{path}: joint_orient has {len(stored)} rows for {len(names)} joints",
            "save one for each joint",
        )
    stored = checked_matrices(stored, path)
    orient = {
        joint: stored[names.index(prefix + joint) + skipped]
        for joint in JOINTS
        if prefix + joint in names
    }
    if "" not in orient:
        if not skipped:
            raise CaptureError(
                f"{path}: the wrist's joint_orient is not there", "save it with keep_root=True"
            )
        orient[""] = stored[0]
    return orient


def _parent(joint: str) -> str:
    """The joint before one of SOMA's; the wrist, where a hand begins, counts as its own."""
    if joint in ("", "Thumb1") or joint.endswith("1"):
        return ""
    finger = next(name for name in FINGERS if joint.startswith(name))
    if joint.endswith("End"):
        return "Thumb3" if finger == "Thumb" else f"{finger}4"
    return f"{finger}{int(joint[-1]) - 1}"


def _bones_in_world(local: dict[str, Tensor]) -> Float[Tensor, "steps bones 3 3"]:
    """Axes of the sixteen bones' joints in the world."""
    world: dict[str, Tensor] = {}
    for joint in JOINTS:
        if not joint.endswith("End"):
            world[joint] = local[joint] if joint == "" else world[_parent(joint)] @ local[joint]
    return torch.stack([world[joint] for joint in _JOINT_OF_BONE], dim=1)


# --- writing --------------------------------------------------------------------------------------


def soma_arrays(motion: Motion, rig: Rig, side: Side) -> dict[str, np.ndarray]:
    """A motion as the arrays of a SOMA-X hand, as ``save_soma_npz`` names them.

    Rotations are absolute, so that no T pose is needed; metacarpals and ends are at rest. Where
    bones point is kept; lengths are those of whichever hand is posed.

    Args:
        motion: of a right hand, or of a left one that is stored mirrored.
        rig: that the motion is for.
        side: of the hand.
    """
    rotations = matrix_from_axis_angle(motion.rotations.double())
    # Bones' axes at rest are turned with the bones; SOMA's joints have axes of their own.
    frames = rest_frames(rig).mT @ soma_frames()
    world = chain_rotations(rotations) @ frames
    wrist = world[:, 0]
    joints = {joint: world[:, bone] for bone, joint in enumerate(_JOINT_OF_BONE)}
    for name, axes in _METACARPALS.items():
        joints[name] = wrist @ torch.tensor(axes, dtype=torch.float64)
    local = []
    for joint in JOINTS:
        if joint.endswith("End"):
            local.append(torch.eye(3, dtype=torch.float64).expand(len(motion), 3, 3))
        elif joint:
            local.append(joints[_parent(joint)].mT @ joints[joint])
        else:
            local.append(_right_axes(wrist.dtype) @ wrist if side == "left" else wrist)
    places = motion.translations.double() + rig.shaped().rest_joints[0].double()
    if side == "left":
        places = mirrored_points(places)
    prefix = f"{side.title()}Hand"
    return {
        "poses": axis_angle_from_matrix(torch.stack(local, dim=1)).float().numpy(),
        "transl": places.float().numpy(),
        "joint_names": np.array([prefix + joint for joint in JOINTS]),
        "identity_model_type": np.array("soma"),
        "identity_coeffs": np.zeros((1, _NUM_IDENTITY), dtype=np.float32),
        "keep_root": np.array(True),
        "absolute_pose": np.array(True),
        "rotation_repr": np.array("rotvec"),
        "unit": np.array("meters"),
        "hand_type": np.array(side),
        "fps": np.array(motion.fps, dtype=np.float32),
    }


def write_soma(path: Path, motion: Motion, rig: Rig, side: Side) -> None:
    """Writes a motion as an npz file of SOMA-X; it appears whole or not at all.

    Args:
        path: to write; ends with ``.npz``.
        motion: as of :func:`soma_arrays`, and so are the others.
        rig: that the motion is for.
        side: of the hand.

    Raises:
        CaptureError: the name does not end with ``.npz``.
    """
    if path.suffix.lower() != ".npz":
        raise CaptureError(f"{path}: SOMA-X's files end with .npz", "name it so")
    content = io.BytesIO()
    np.savez(content, **soma_arrays(motion, rig, side))  # type: ignore[arg-type]
    write_atomically({path: content.getvalue()})
