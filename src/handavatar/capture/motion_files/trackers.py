"""Results of networks that see hands: HaMeR, WiLoR, WiLoR-mini, HaWoR.

HaMeR and WiLoR describe a left hand as the right hand of the mirrored picture and un-mirror
vertices alone; WiLoR-mini and HaWoR change the signs of y and z and so describe a left MANO hand.
A file does not tell the two apart. All of them count poses from the flat hand.
"""

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion_files.parameters import (
    bone_matrices,
    frame_numbers,
    joined_rows,
    per_row,
    rate_of,
    refuse_mixed_rows,
    shape_rows,
    side_rows,
    told_sides,
    track_of_rows,
)
from handavatar.capture.motion_files.stored import (
    Part,
    array_field,
    first_of,
    read_part,
    rows_of,
)
from handavatar.capture.motion_files.track import Conventions, HandTrack, Rows

ROOT_NAMES = ("global_orient",)
HAND_NAMES = ("hand_pose",)
PLACE_NAMES = ("cam_t_full", "pred_cam_t_full", "cam_t")
FOCAL_NAMES = ("scaled_focal_length", "focal_length", "focal")
OWN_NAMES = (*PLACE_NAMES, "pred_cam", "box_center", "box_size", "scaled_focal_length")
"""Names that these programs alone use."""
_DEFAULT_FOCAL = 5000.0
_CROP = 256.0


def read_hamer(
    parts: list[Part], conventions: Conventions, describes_right: bool, source: Path
) -> HandTrack:
    """Arrays as HaMeR, WiLoR and WiLoR-mini return them, which users save themselves.

    Args:
        parts: a file with one row for each frame, or a file for each frame.
        conventions: side, and the true focal length.
        describes_right: whether left hands are described as mirrored right ones.
        source: for messages.

    Raises:
        CaptureError: it is another layout, or says too little.
    """
    pieces = []
    for part in parts:
        root = array_field(part.fields, ROOT_NAMES, part.path)
        fingers = array_field(part.fields, HAND_NAMES, part.path)
        rotations = bone_matrices(root, fingers, (ROOT_NAMES[0], HAND_NAMES[0]), part.path)
        count = len(rotations)
        sides = side_rows(part.fields, count, part.path)
        if sides is None:
            sides = told_sides(conventions, count, part.path)
        refuse_mixed_rows(part, sides, is_alone=len(parts) == 1)
        pieces.append(
            Rows(
                frames=torch.zeros(count, dtype=torch.long),
                is_right=sides,
                rotations=rotations,
                translations=_places(part, sides, conventions),
                shape=shape_rows(part.fields, count, part.path),
            )
        )
    numbers = frame_numbers(parts, [len(piece.frames) for piece in pieces])
    rows = joined_rows(pieces, source)
    rows = Rows(torch.cat(numbers), rows.is_right, rows.rotations, rows.translations, rows.shape)
    return track_of_rows(
        rows,
        conventions,
        source,
        space="camera",
        fps=rate_of(parts[0].fields, parts[0].path),
        describes_right=describes_right,
    )


def _places(part: Part, sides: Tensor, conventions: Conventions) -> Float[Tensor, "placed 3"]:
    """Translations in the camera of the whole picture, at the depth of the true focal length."""
    fields, path, count = part.fields, part.path, len(sides)
    if first_of(fields, PLACE_NAMES):
        places = per_row(fields, PLACE_NAMES, (3,), count, path)
    elif first_of(fields, ("pred_cam",)):
        places = _place_of_box(part, sides)
    else:
        return torch.zeros(0, 3, dtype=torch.float64)
    if conventions.focal is None:
        return places
    depth = places[:, 2] * conventions.focal / _stored_focal(part, count)
    return torch.cat([places[:, :2], depth[:, None]], dim=1)


def _place_of_box(part: Part, sides: Tensor) -> Float[Tensor, "rows 3"]:
    """From the weak perspective camera (scale, x, y) of the square crop to the whole picture."""
    fields, path, count = part.fields, part.path, len(sides)
    if bool((sides == 0).any()):
        raise CaptureError(
            f"{path}: pred_cam of a left hand may be of the mirrored picture or not",
            "save cam_t_full (pred_cam_t_full), the translation in the whole picture",
        )
    needed = {"box_center": (2,), "box_size": (), "img_size": (2,)}
    missing = [name for name in needed if not first_of(fields, (name,))]
    if missing:
        raise CaptureError(
            f"{path}: pred_cam is there without {', '.join(missing)}",
            "save cam_t_full (pred_cam_t_full), the translation in the whole picture",
        )
    camera = per_row(fields, ("pred_cam",), (3,), count, path)
    center, size, picture = (
        per_row(fields, (name,), shape, count, path) for name, shape in needed.items()
    )
    width = camera[:, 0] * size
    if bool((width.abs() < 1e-9).any()):
        raise CaptureError(f"{path}: pred_cam has a scale of zero", "leave that frame out")
    shift = 2 * (center - picture / 2) / width[:, None]
    depth = 2 * _stored_focal(part, count) / width
    return torch.cat([camera[:, 1:] + shift, depth[:, None]], dim=1)


def _stored_focal(part: Part, count: int) -> Float[Tensor, "rows"]:
    """The focal length in pixels that the depths in a file belong to."""
    fields, path = part.fields, part.path
    if first_of(fields, FOCAL_NAMES):
        return per_row(fields, FOCAL_NAMES, (), count, path)
    if first_of(fields, ("img_size",)):
        picture = per_row(fields, ("img_size",), (2,), count, path)
        return _DEFAULT_FOCAL / _CROP * picture.amax(-1)
    raise CaptureError(
        f"{path}: it does not say which focal length its depths belong to",
        "save scaled_focal_length or img_size as well, or leave out `focal`",
    )


# --- HaWoR ----------------------------------------------------------------------------------------

_CHUNK = re.compile(r"(\d+)_(\d+)")
_HAWOR = ("init_root_orient", "init_hand_pose", "init_trans", "init_betas")


def hawor_chunks(source: Path, conventions: Conventions) -> list[Path]:
    """Files of one hand in a folder ``cam_space``, in its ``0`` or ``1``, or one of them alone.

    Raises:
        CaptureError: both hands are there and none is named.
    """
    if source.is_file():
        return [source]
    hands = {"left": source / "0", "right": source / "1"}
    if any(folder.is_dir() for folder in hands.values()):
        held = {side: sorted(folder.glob("*.json")) for side, folder in hands.items()}
        if held["left"] and held["right"] and conventions.side == "auto":
            raise CaptureError(
                f"{source}: it holds both hands", "name one: `side='left'` or `side='right'`"
            )
        side = conventions.side
        if side == "auto":
            side = "left" if held["left"] else "right"
        if not held[side]:
            raise CaptureError(f"{source}: it holds no {side} hand", "name the other with `side`")
        return held[side]
    return sorted(source.glob("*.json"))


def read_hawor(source: Path, conventions: Conventions) -> HandTrack:
    """Files ``cam_space/{0 left, 1 right}/{first}_{last}.json`` of HaWoR.

    Raises:
        CaptureError: it is another layout, or the side is not known.
    """
    pieces = []
    for path in hawor_chunks(source, conventions):
        fields = read_part(path).fields
        root = rows_of(array_field(fields, _HAWOR[:1], path), (3, 3), _HAWOR[0], path)
        fingers = array_field(fields, _HAWOR[1:2], path)
        rotations = bone_matrices(root, fingers, (_HAWOR[0], _HAWOR[1]), path)
        count = len(rotations)
        found = _CHUNK.fullmatch(path.stem)
        first = int(found[1]) if found else 0
        pieces.append(
            Rows(
                frames=first + torch.arange(count),
                is_right=_hawor_side(path, conventions, count),
                rotations=rotations,
                translations=per_row(fields, _HAWOR[2:3], (3,), count, path),
                shape=shape_rows({"betas": fields.get(_HAWOR[3])}, count, path),
            )
        )
    if not pieces:
        raise CaptureError(f"{source}: no JSON file of HaWoR", "name its folder cam_space")
    return track_of_rows(joined_rows(pieces, source), conventions, source, space="camera", fps=None)


def _hawor_side(path: Path, conventions: Conventions, count: int) -> Tensor:
    """By the folder, 0 or 1 in one that is called cam_space; else by what the user says."""
    folder = path.absolute().parent
    if folder.name in ("0", "1") and folder.parent.name == "cam_space":
        return torch.full((count,), int(folder.name))
    return told_sides(conventions, count, path)


def is_hawor(source: Path, fields: dict[str, object]) -> bool:
    """Whether a file, or a folder, is of HaWoR for certain."""
    if source.is_dir():
        return any(
            _CHUNK.fullmatch(path.stem) is not None
            for name in ("0", "1")
            for path in (source / name).glob("*.json")
        )
    return all(isinstance(fields.get(name), np.ndarray) for name in _HAWOR[:2])
