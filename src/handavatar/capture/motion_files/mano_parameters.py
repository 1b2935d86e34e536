"""MANO's own parameters: as smplx names them, ARCTIC's raw files, InterHand2.6M's JSON.

Poses count from the flat hand or from MANO's mean pose, component by component, and are axis-angle
vectors or principal components. Which of these, no file says; ARCTIC's and InterHand2.6M's are
known to count from the mean pose. Mean pose and components are in the user's own MANO file alone.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion_files.parameters import (
    checked_vectors,
    choose_side,
    frame_numbers,
    per_row,
    rate_of,
    refuse_mixed_rows,
    shape_rows,
    side_rows,
    told_sides,
    track_of_rows,
)
from handavatar.capture.motion_files.stored import Fields, Part, array_field, first_of, rows_of
from handavatar.capture.motion_files.track import Conventions, HandTrack, ModelFinder, Rows
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.mano import ManoModel, Side, absolute_rotations

ROOT_NAMES = ("global_orient", "root_orient", "rot")
HAND_NAMES = ("hand_pose", "pose_hand")
WHOLE_NAMES = ("pose", "poses", "full_pose", "mano_pose", "thetas")
PLACE_NAMES = ("transl", "trans", "translation")
_FINGER_VALUES = 45
_SIDES: tuple[Side, Side] = ("left", "right")
_FRAME = re.compile(r"[0-9]{1,15}")
_NAMED_SIDE = re.compile(r".*[_-](left|right)", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class _Stored:
    """Numbers of one hand, or of several one after another, as they are stored.

    Attributes:
        root: axis-angle of the wrist, 3 a row.
        fingers: axis-angle or principal components.
        places: metres or another unit, 3 a row; no rows if there are none.
        shape: ten a row.
        is_right: per row.
        frames: per row.
    """

    root: Tensor
    fingers: Tensor
    places: Tensor
    shape: Tensor
    is_right: Tensor
    frames: Tensor


def read_parameters(
    parts: list[Part], conventions: Conventions, find_model: ModelFinder, source: Path
) -> HandTrack:
    """Arrays of MANO's parameters, one row a frame, or one file a frame.

    Args:
        parts: with ``global_orient`` and ``hand_pose``, or ``pose`` of both, or a dictionary of
            these for each of ``left`` and ``right``.
        conventions: side, mean pose, principal components.
        find_model: gives mean pose and components.
        source: for messages.

    Raises:
        CaptureError: it is another layout, or neither file nor user say what must be known.
        LicensedRigMissing: the mean pose or the components are needed and no MANO file was named.
    """
    fps = rate_of(parts[0].fields, parts[0].path)
    held = {s for part in parts for s in _SIDES if isinstance(part.fields.get(s), dict)}
    own_side: Side | None = None
    if held:
        own_side = choose_side("left" in held, "right" in held, conventions, source)
        parts = [
            Part(part.path, part.number, part.fields[own_side])
            for part in parts
            if isinstance(part.fields.get(own_side), dict)
        ]
    stored = [_stored_hand(part, own_side, conventions) for part in parts]
    for part, hand in zip(parts, stored, strict=True):
        refuse_mixed_rows(part, hand.is_right, is_alone=len(parts) == 1)
    numbers = frame_numbers(parts, [len(hand.root) for hand in stored])
    whole = _joined(stored, torch.cat(numbers), source)
    return _track(whole, conventions, find_model, source, fps)


def read_interhand(
    parts: list[Part], conventions: Conventions, find_model: ModelFinder, source: Path
) -> HandTrack:
    """InterHand2.6M's and Re:InterHand's JSON: pose[48], shape[10], trans[3] a hand and frame.

    Args:
        parts: one file ``{frame: {left|right: hand | null}}``, with or without a level of one
            capture around it, or a file ``{frame}_{side}.json`` for each hand and frame.
        conventions: side; the poses count from the mean pose.
        find_model: gives the mean pose.
        source: for messages.

    Raises:
        CaptureError: it is another layout, or holds several captures.
        LicensedRigMissing: no MANO file was named.
    """
    hands: list[tuple[int, Side, Fields]] = []
    for part in parts:
        if first_of(part.fields, WHOLE_NAMES):
            found = _NAMED_SIDE.fullmatch(part.path.stem)
            if found is None:
                raise CaptureError(
                    f"{part.path}: its name does not end with _left or _right",
                    "name it as Re:InterHand does, 000123_right.json",
                )
            hands.append(
                (part.number, "left" if found[1].lower() == "left" else "right", part.fields)
            )
        else:
            hands += _hands_of_frames(part)
    if not hands:
        raise CaptureError(f"{source}: no frame holds a hand", "name another capture's file")
    held = {side for _, side, _ in hands}
    side = choose_side("left" in held, "right" in held, conventions, source)
    chosen = sorted((h for h in hands if h[1] == side), key=lambda hand: hand[0])
    stored = [_stored_hand(Part(source, n, fields), side, conventions) for n, _, fields in chosen]
    for (number, _, _), hand in zip(chosen, stored, strict=True):
        if len(hand.root) != 1:
            raise CaptureError(
                f"{source}: frame {number} holds {len(hand.root)} poses of one hand",
                "write one pose of 48 numbers for each frame",
            )
    step = max(math.gcd(*(number - hands[0][0] for number, _, _ in hands)), 1)
    frames = torch.tensor([(number - chosen[0][0]) // step for number, _, _ in chosen])
    whole = _joined(stored, frames, source)
    return _track(whole, conventions, find_model, source, None)


def _hands_of_frames(part: Part) -> list[tuple[int, Side, Fields]]:
    content: Any = part.fields
    if not _is_table_of_frames(content):
        inner = [value for value in content.values() if isinstance(value, dict)]
        if len(inner) != 1 or not _is_table_of_frames(inner[0]):
            raise CaptureError(
                f"{part.path}: it is no table of frames, or holds {len(inner)} captures",
                'write {"frame": {"left": hand or null, "right": hand or null}} of one capture',
            )
        content = inner[0]
    return [
        (int(frame), side, hands[side])
        for frame, hands in content.items()
        for side in _SIDES
        if isinstance(hands.get(side), dict)
    ]


def _is_table_of_frames(content: dict[str, Any]) -> bool:
    return bool(content) and all(
        _FRAME.fullmatch(name) and isinstance(hands, dict) and set(hands) & set(_SIDES)
        for name, hands in content.items()
    )


def is_interhand(fields: Fields, stem: str) -> bool:
    """Whether a JSON file is InterHand2.6M's or Re:InterHand's for certain."""
    if {"pose", "shape", "trans"} <= set(fields):
        return _NAMED_SIDE.fullmatch(stem) is not None
    tables = [fields, *(value for value in fields.values() if isinstance(value, dict))]
    return any(_is_table_of_frames(table) for table in tables)


# --- numbers of one hand --------------------------------------------------------------------------


def _stored_hand(part: Part, side: Side | None, conventions: Conventions) -> _Stored:
    fields, path = part.fields, part.path
    root_name = first_of(fields, ROOT_NAMES)
    if root_name:
        root = rows_of(array_field(fields, ROOT_NAMES, path), (3,), root_name, path)
        names: tuple[str, ...] = (*HAND_NAMES, *WHOLE_NAMES)
        fingers = _flat_rows(fields, names, path)
    else:
        names = WHOLE_NAMES
        whole = _flat_rows(fields, names, path)
        size = whole.shape[1]
        # 45 without a wrist may be the fingers alone, or 42 components behind the wrist's 3.
        may_be_components = 3 < size < 48 and (conventions.use_pca or size < 45)
        if size != 48 and not may_be_components:
            raise CaptureError(
                f"{path}: {first_of(fields, names)} has {size} values a frame, expected 48: the "
                "wrist's 3 and the fingers' 45",
                "save the wrist's rotation as global_orient, the fingers' as hand_pose",
            )
        root, fingers = whole[:, :3], whole[:, 3:]
    if len(root) != len(fingers):
        raise CaptureError(
            f"{path}: the arrays differ in length: {root_name} {len(root)}, "
            f"{first_of(fields, names)} {len(fingers)}",
            "give one row for each frame",
        )
    count = len(root)
    sides = torch.full((count,), int(side == "right")) if side else None
    sides = side_rows(fields, count, path) if sides is None else sides
    if sides is None:
        sides = told_sides(conventions, count, path)
    return _Stored(
        root=torch.from_numpy(root),
        fingers=torch.from_numpy(fingers),
        places=per_row(fields, PLACE_NAMES, (3,), count, path),
        shape=shape_rows(fields, count, path),
        is_right=sides,
        frames=torch.zeros(count, dtype=torch.long),
    )


def _flat_rows(fields: Fields, names: tuple[str, ...], path: Path) -> np.ndarray:
    """Rows of a pose, joint by joint if it is stored so."""
    values, name = array_field(fields, names, path), first_of(fields, names)
    if values.shape[-3:] == (15, 3, 3):
        raise CaptureError(
            f"{path}: {name} holds matrices, whose mean pose cannot be told",
            "name the tracker that wrote them with `layout`, or save axis-angle vectors",
        )
    if values.ndim >= 2 and values.shape[-2:] in ((15, 3), (16, 3)):
        values = values.reshape(*values.shape[:-2], -1)
    if values.ndim == 0:
        raise CaptureError(f"{path}: {name} is a single number", "save a row for each frame")
    return rows_of(values, values.shape[-1:], name, path)


def _joined(stored: list[_Stored], frames: Tensor, source: Path) -> _Stored:
    sizes = {hand.fingers.shape[1] for hand in stored}
    placed = {len(hand.places) > 0 for hand in stored}
    if len(sizes) > 1 or len(placed) > 1:
        raise CaptureError(
            f"{source}: the files differ in what they hold", "give files of one kind"
        )
    names = ("root", "fingers", "places", "shape", "is_right")
    joined = {name: torch.cat([getattr(hand, name) for hand in stored]) for name in names}
    return _Stored(frames=frames, **joined)


def _track(
    stored: _Stored,
    conventions: Conventions,
    find_model: ModelFinder,
    source: Path,
    fps: float | None,
) -> HandTrack:
    """Absolute rotations of the hand that is meant, as a right one."""
    raw = (
        torch.cat([stored.root, stored.fingers, stored.places], dim=1)
        if len(stored.places)
        else torch.cat([stored.root, stored.fingers], dim=1)
    )
    is_seen = (raw != 0).any(1)
    sides = stored.is_right[is_seen] if bool(is_seen.any()) else stored.is_right
    side = choose_side(bool((sides == 0).any()), bool((sides == 1).any()), conventions, source)
    is_own = stored.is_right == int(side == "right")
    vectors, notes = _absolute_vectors(
        stored.root[is_own], stored.fingers[is_own], side, conventions, find_model, source
    )
    rotations = matrix_from_axis_angle(checked_vectors(vectors, source))
    rows = Rows(
        frames=stored.frames[is_own],
        is_right=stored.is_right[is_own],
        rotations=rotations * is_seen[is_own][:, None, None, None],
        translations=stored.places[is_own] if len(stored.places) else stored.places,
        shape=stored.shape[is_own],
    )
    return track_of_rows(
        rows,
        conventions,
        source,
        space="world",
        fps=fps,
        describes_right=True,
        notes=notes,
    )


def _absolute_vectors(
    root: Tensor,
    fingers: Tensor,
    side: Side,
    conventions: Conventions,
    find_model: ModelFinder,
    source: Path,
) -> tuple[Tensor, tuple[str, ...]]:
    """Axis-angle of sixteen bones of a right hand, counted from flat, and notes."""
    size = fingers.shape[1]
    has_components = conventions.use_pca or size < _FINGER_VALUES
    if size > _FINGER_VALUES:
        raise CaptureError(
            f"{source}: {size} values for the fingers, expected 45 or fewer components",
            "save the fifteen finger bones alone",
        )
    if conventions.flat_hand_mean == "auto":
        raise CaptureError(
            f"{source}: it does not say what its finger poses count from",
            "say `flat_hand_mean='true'` (the flat hand: HO-3D, trackers) or false (MANO's mean "
            "pose: InterHand2.6M, FreiHAND, DexYCB, ARCTIC raw)",
        )
    notes: list[str] = []
    # A left hand in the mirror: the MANO file of its side is read as its mirror image too.
    sign = torch.tensor([1.0, -1.0, -1.0] if side == "left" else [1.0, 1.0, 1.0]).to(root)
    if has_components:
        model = find_model(side, "the finger poses are principal components, which it holds")
        components = model.hands_components.to(root).flatten(1)
        fingers = fingers @ components[:size]
        notes.append(f"{size} principal components of MANO's finger poses")
    else:
        fingers = fingers * sign.repeat(_FINGER_VALUES // 3)
    vectors = torch.cat([root * sign, fingers], dim=1)
    if conventions.flat_hand_mean == "false":
        model = find_model(side, "the finger poses count from MANO's mean pose, which it holds")
        mean = model.hands_mean.to(vectors)
        vectors = absolute_rotations(vectors.unflatten(-1, (-1, 3)), mean).flatten(-2)
    return vectors, tuple(notes)


def with_mean(rotations: Tensor, model: ManoModel) -> Tensor:
    """Rotations counted from flat, of those that count from the mean pose."""
    return _beside_mean(rotations, model, 1.0)


def without_mean(rotations: Tensor, model: ManoModel) -> Tensor:
    """The rotations that a pose would have had if a mean pose was added to it by mistake."""
    return _beside_mean(rotations, model, -1.0)


def _beside_mean(rotations: Tensor, model: ManoModel, share: float) -> Tensor:
    """MANO adds its mean pose to axis-angle vectors, component by component."""
    vectors = axis_angle_from_matrix(rotations)
    return matrix_from_axis_angle(absolute_rotations(vectors, share * model.hands_mean.to(vectors)))
