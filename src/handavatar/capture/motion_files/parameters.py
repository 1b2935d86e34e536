"""What all layouts have in common: rotations from arrays, sides told apart, frames counted."""

import math
import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion_files.stored import (
    Fields,
    Part,
    array_field,
    first_of,
    rows_of,
    text_value,
)
from handavatar.capture.motion_files.track import (
    Conventions,
    HandTrack,
    Rows,
    Skeleton,
    Space,
    mirrored_points,
    mirrored_rotations,
)
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.mano import Side
from handavatar.hand.pose import NUM_BONES

SIDE_NAMES = ("right", "is_right", "is_rhand", "hand_type", "hand_side", "side")
FPS_NAMES = ("fps", "mocap_framerate", "mocap_frame_rate", "frame_rate")
SHAPE_NAMES = ("betas", "shape")
FRAME_NAMES = ("frame", "frames", "frame_idx", "frame_id")
_FINGERS = NUM_BONES - 1
_NUM_SHAPES = 10
_MAX_FPS = 1000.0
_NUMBER = re.compile(r"[0-9]{1,15}")


def bone_matrices(
    root: np.ndarray, fingers: np.ndarray, names: tuple[str, str], path: Path
) -> Float[Tensor, "rows bones 3 3"]:
    """Rotations of sixteen bones; the shape of the fingers' says whether they are matrices.

    Rows that hold nothing but zeros, where a program saw no hand, stay zeros.

    Args:
        root: of the wrist, (3, 3) or 3 a row.
        fingers: (15, 3, 3), (15, 3) or 45 a row, MANO's order.
        names: of both, for messages.
        path: of the file.

    Raises:
        CaptureError: other shapes or lengths, no rotations, or degrees.
    """
    if fingers.shape[-3:] == (_FINGERS, 3, 3):
        matrices = np.concatenate(
            _of_one_length(
                [
                    rows_of(root, (3, 3), names[0], path)[:, None],
                    rows_of(fingers, (_FINGERS, 3, 3), names[1], path),
                ],
                names,
                path,
            ),
            axis=1,
        )
        return checked_matrices(torch.from_numpy(matrices), path)
    if fingers.shape[-2:] == (_FINGERS, 3):
        fingers = fingers.reshape(*fingers.shape[:-2], 3 * _FINGERS)
    pieces = _of_one_length(
        [rows_of(root, (3,), names[0], path), rows_of(fingers, (45,), names[1], path)], names, path
    )
    vectors = checked_vectors(torch.from_numpy(np.concatenate(pieces, axis=1)), path)
    is_empty = (vectors == 0).all(-1).all(-1)
    return matrix_from_axis_angle(vectors) * (~is_empty[:, None, None, None])


def checked_vectors(
    values: Float[Tensor, "rows values"], path: Path
) -> Float[Tensor, "rows bones 3"]:
    """Numbers as axis-angle vectors of radians.

    Raises:
        CaptureError: a vector is longer than a full turn.
    """
    vectors = values.unflatten(-1, (-1, 3))
    longest = float(vectors.norm(dim=-1).max())
    if longest > 2 * math.pi + 1e-3:
        raise CaptureError(
            f"{path}: a joint turns by {longest:.3g}, more than a full circle in radians",
            "these are degrees, or no axis-angle vectors: write radians",
        )
    return vectors


def checked_matrices(
    matrices: Float[Tensor, "*batch 3 3"], path: Path
) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices; hands of nothing but zeros pass.

    Raises:
        CaptureError: some are no rotations: scaled, sheared, or mirrored.
    """
    is_empty = (matrices == 0).all(-1).all(-1)
    identity = torch.eye(3, dtype=matrices.dtype)
    error = (matrices @ matrices.mT - identity).abs().amax((-1, -2))
    is_wrong = (error > 1e-2) & ~is_empty
    if bool(is_wrong.any()):
        first = is_wrong.nonzero()[0].tolist()
        raise CaptureError(
            f"{path}: the matrix at {first} is no rotation: its rows differ from unit length and "
            f"right angles by {float(error[tuple(first)]):.2g}",
            "save rotation matrices of 3 x 3 as the program gave them",
        )
    is_mirrored = (torch.linalg.det(matrices) < 0) & ~is_empty
    if bool(is_mirrored.any()):
        first = is_mirrored.nonzero()[0].tolist()
        raise CaptureError(
            f"{path}: the matrix at {first} mirrors (its determinant is -1)",
            "mirror a hand by changing the signs of y and z of its axis-angle vectors",
        )
    # Rounded ones, as of half precision, made whole again.
    left, _, right = torch.linalg.svd(matrices)
    return (left @ right) * (~is_empty[..., None, None])


def _of_one_length(
    arrays: list[np.ndarray], names: tuple[str, ...], path: Path
) -> list[np.ndarray]:
    counts = [len(array) for array in arrays]
    if len(set(counts)) > 1:
        listed = ", ".join(f"{n} {c}" for n, c in zip(names, counts, strict=True))
        raise CaptureError(
            f"{path}: the arrays differ in length: {listed}", "give one row for each frame"
        )
    return arrays


# --- what stands beside the rotations -------------------------------------------------------------


def per_row(
    fields: Fields, names: tuple[str, ...], shape: tuple[int, ...], count: int, path: Path
) -> Tensor:
    """A quantity for each row; one that is given once holds for all. No rows if it is not there.

    Raises:
        CaptureError: it has another length, or another shape.
    """
    name = first_of(fields, names)
    if not name:
        return torch.zeros(0, *shape, dtype=torch.float64)
    values = rows_of(array_field(fields, names, path), shape, name, path)
    if len(values) not in (1, count):
        raise CaptureError(
            f"{path}: {name} has {len(values)} rows for {count} hands",
            "give one row for each frame",
        )
    return torch.from_numpy(np.broadcast_to(values, (count, *shape)).copy())


def shape_rows(fields: Fields, count: int, path: Path) -> Float[Tensor, "rows 10"]:
    """Shape coefficients for each row, the first ten; zero if the file has none."""
    name = first_of(fields, SHAPE_NAMES)
    if not name:
        return torch.zeros(count, _NUM_SHAPES, dtype=torch.float64)
    size = int(np.shape(fields[name])[-1]) if np.ndim(fields[name]) else 0
    if size < _NUM_SHAPES:
        raise CaptureError(f"{path}: {name} ends with {size} values, expected 10", "save all ten")
    return per_row(fields, SHAPE_NAMES, (size,), count, path)[:, :_NUM_SHAPES]


def side_rows(fields: Fields, count: int, path: Path) -> Tensor | None:
    """One for right hands and zero for left ones, if the file says it.

    Raises:
        CaptureError: it says something else.
    """
    name = first_of(fields, SIDE_NAMES)
    if not name:
        return None
    word = text_value(fields[name]).strip().lower()
    if word in ("left", "right"):
        return torch.full((count,), int(word == "right"))
    if word:
        raise CaptureError(f"{path}: {name} is {word[:20]!r}, expected left or right", "correct it")
    values = per_row(fields, SIDE_NAMES, (), count, path)
    if bool(((values != 0) & (values != 1)).any()):
        raise CaptureError(
            f"{path}: {name} is neither 0 (left) nor 1 (right) somewhere", "correct it"
        )
    return values.long()


def told_sides(conventions: Conventions, count: int, path: Path) -> Tensor:
    """As :func:`side_rows`, by what the user says of a file that does not say it.

    Raises:
        CaptureError: the user does not say it either.
    """
    if conventions.side == "auto":
        raise CaptureError(
            f"{path}: it does not say which hand it is", "say `side='left'` or `side='right'`"
        )
    return torch.full((count,), int(conventions.side == "right"))


def rate_of(fields: Fields, path: Path) -> float | None:
    """Frames a second, if the file says it.

    Raises:
        CaptureError: it is no number of frames.
    """
    name = first_of(fields, FPS_NAMES)
    if not name:
        return None
    values = array_field(fields, FPS_NAMES, path)
    rate = float(values.reshape(-1)[0])
    if values.size != 1 or not 0.01 <= rate <= _MAX_FPS:
        raise CaptureError(f"{path}: {name} is {rate:g}", "give frames a second, 0.01 to 1000")
    return rate


def frame_numbers(parts: list[Part], counts: list[int]) -> list[Tensor]:
    """Number of the frame of every row, part by part.

    Rows of a single file are frames unless the file numbers them. A folder's files are frames,
    numbered by the last number in their names, or by the one before it where that differs too
    (``000012_1``: the second hand of picture 12); else they are frames in their order.

    Args:
        parts: files.
        counts: rows in each.
    """
    numbers = _numbers_of_names(parts)
    found = []
    for place, (part, count) in enumerate(zip(parts, counts, strict=True)):
        name = first_of(part.fields, FRAME_NAMES)
        if name:
            own = per_row(part.fields, FRAME_NAMES, (), count, part.path)
            found.append(own.round().long())
        elif len(parts) == 1:
            found.append(torch.arange(count))
        else:
            found.append(torch.full((count,), numbers[place]))
    return found


def _numbers_of_names(parts: list[Part]) -> list[int]:
    names = [[int(found) for found in _NUMBER.findall(part.path.stem)] for part in parts]
    if min(len(numbers) for numbers in names) >= 2:
        pictures = [numbers[-2] for numbers in names]
        if pictures == sorted(pictures) and len(set(pictures)) > 1:
            return pictures
    lasts = [numbers[-1] for numbers in names if numbers]
    is_growing = len(lasts) == len(parts) and lasts == sorted(set(lasts))
    return lasts if is_growing else list(range(len(parts)))


def refuse_mixed_rows(part: Part, sides: Tensor, is_alone: bool) -> None:
    """Refuses left and right rows in one file that does not say which frame each belongs to.

    Args:
        part: the file.
        sides: one for right, zero for left, for each row.
        is_alone: there are no files for single frames.

    Raises:
        CaptureError: it is so.
    """
    if is_alone and len(set(sides.tolist())) > 1 and not first_of(part.fields, FRAME_NAMES):
        raise CaptureError(
            f"{part.path}: it holds left and right hands, and not which frame each belongs to",
            "save a file for each side, or add an array named frame with a number for each row",
        )


# --- from rows to one hand ------------------------------------------------------------------------


def choose_side(has_left: bool, has_right: bool, conventions: Conventions, path: Path) -> Side:
    """The side that is meant, by the file and by what the user says.

    Raises:
        CaptureError: the file holds both and none was named, or not the one that was named.
    """
    told = conventions.side
    if has_left and has_right:
        if told == "auto":
            raise CaptureError(
                f"{path}: it holds both hands", "name one: `side='left'` or `side='right'`"
            )
        return told
    held: Side = "right" if has_right else "left"
    if told not in ("auto", held):
        raise CaptureError(
            f"{path}: it holds a {held} hand, `side` says {told}",
            f"leave `side` out, or name the file of the {told} hand",
        )
    return held


def track_of_rows(
    rows: Rows,
    conventions: Conventions,
    path: Path,
    *,
    space: Space,
    fps: float | None,
    describes_right: bool = False,
    skeleton: Skeleton = "mano",
    turns_wrist: bool = True,
    notes: tuple[str, ...] = (),
) -> HandTrack:
    """One hand's rows in the order of the frames, a left one mirrored into a right one.

    Args:
        rows: hands of either side.
        conventions: which side is meant.
        path: for messages.
        space: what the translations are relative to.
        fps: frames a second, if it is known.
        describes_right: rotations of left hands are those of a right hand in a mirrored picture
            already, while the translation is the left hand's.
        skeleton: whose rest pose the rotations count from.
        turns_wrist: whether the file turns the wrist.
        notes: what a person should know.

    Raises:
        CaptureError: no frame shows the hand, or one shows two of the same side.
    """
    is_seen = (rows.rotations != 0).flatten(1).any(1)
    # Files may be numbered every third frame, say: what lies between was never looked at.
    step = max(math.gcd(*(rows.frames - rows.frames[0]).tolist()), 1)
    if not bool(is_seen.any()):
        raise CaptureError(
            f"{path}: no frame holds a hand: all {len(rows.frames)} are zeros",
            "name the file of a hand that was seen",
        )
    sides = rows.is_right[is_seen]
    side = choose_side(bool((sides == 0).any()), bool((sides == 1).any()), conventions, path)
    is_chosen = is_seen & (rows.is_right == int(side == "right"))
    frames, order = rows.frames[is_chosen].sort(stable=True)
    if bool((frames.diff() == 0).any()):
        twice = int(frames[:-1][frames.diff() == 0][0])
        raise CaptureError(
            f"{path}: frame {twice} holds two {side} hands",
            "save one track, or number the frames of the rows in an array named frame",
        )
    rotations = rows.rotations[is_chosen][order]
    is_placed = len(rows.translations) > 0
    translations = (
        rows.translations[is_chosen][order]
        if is_placed
        else torch.zeros(len(frames), 3, dtype=torch.float64)
    )
    if side == "left":
        translations = mirrored_points(translations)
        rotations = rotations if describes_right else mirrored_rotations(rotations)
    return HandTrack(
        side=side,
        frames=torch.div(frames - frames[0], step, rounding_mode="floor"),
        rotations=rotations,
        translations=translations,
        shape=rows.shape[is_chosen][order],
        fps=fps,
        space=space if is_placed else "hand",
        skeleton=skeleton,
        turns_wrist=turns_wrist,
        notes=notes,
    )


def joined_rows(pieces: list[Rows], path: Path) -> Rows:
    """Rows of several files one after another.

    Raises:
        CaptureError: some place the hand and others do not.
    """
    placed = [len(piece.translations) > 0 for piece in pieces]
    if any(placed) and not all(placed):
        raise CaptureError(
            f"{path}: some files say where the hand is, others do not",
            "save the translation in all of them",
        )
    return Rows(
        *(
            torch.cat([getattr(piece, name) for piece in pieces])
            for name in ("frames", "is_right", "rotations", "translations", "shape")
        )
    )
