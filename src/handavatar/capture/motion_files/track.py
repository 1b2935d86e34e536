"""What a file says of one hand, whatever its layout; and what the user says of the file."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from handavatar.hand.mano import ManoModel, Side

Space = Literal["camera", "world", "hand"]
Skeleton = Literal["mano", "soma"]
ModelFinder = Callable[[Side, str], ManoModel]
"""Gives the user's own MANO file of a side, or refuses with what it was needed for."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
LayoutName = Literal[
    "auto", "hamer", "wilor", "wilor-mini", "hawor", "mano", "arctic", "interhand", "amass", "soma"
]


@dataclass(frozen=True)
class Conventions:
    """What a user says of a file; what the file itself says must agree.

    Attributes:
        layout: which program wrote it.
        side: the hand that is meant; ``auto``: the only one in the file.
        flat_hand_mean: as in smplx: ``true`` if poses count from the flat hand, ``false`` if from
            MANO's mean pose; ``auto``: as the layout has it.
        use_pca: as in smplx: the hand pose is given in MANO's principal components.
        unit: of lengths.
        axes: of the camera: ``opengl`` has y up and z backwards.
        focal: true focal length of the pictures in pixels.
    """

    layout: LayoutName = "auto"
    side: Literal["auto", "left", "right"] = "auto"
    flat_hand_mean: Literal["auto", "true", "false"] = "auto"
    use_pca: bool = False
    unit: Literal["m", "cm", "mm"] = "m"
    axes: Literal["opencv", "opengl"] = "opencv"
    focal: float | None = None


@dataclass(frozen=True, eq=False)
class HandTrack:
    """Poses of one hand out of a file, a left one mirrored into a right one; of no rig yet.

    Attributes:
        side: of the hand in the file.
        frames: numbers of the frames that show it, growing; others in between hold no hand.
        rotations: relative to the parent bone, the wrist's to the world, absolute; double.
        translations: metres; moves the wrist joint from its rest place.
        shape: MANO's coefficients, per frame; zero if the file has none.
        fps: frames a second, None if the file does not say it.
        space: what the translations are relative to; ``hand``: the file places no hand.
        skeleton: whose rest pose the rotations count from.
        turns_wrist: whether the file turns the wrist; else it stays as it rests.
        notes: what a person should know.
    """

    side: Side
    frames: Int[Tensor, "steps"]
    rotations: Float[Tensor, "steps bones 3 3"]
    translations: Float[Tensor, "steps 3"]
    shape: Float[Tensor, "steps 10"]
    fps: float | None
    space: Space
    skeleton: Skeleton = "mano"
    turns_wrist: bool = True
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Rows:
    """Hands as a file lists them: of either side, several to a frame, empty ones among them.

    Attributes:
        frames: number of the frame of each row.
        is_right: one for a right hand, zero for a left one.
        rotations: relative to the parent bone; nothing but zeros where there is no hand.
        translations: in the file's unit; no rows if the file places no hand.
        shape: MANO's coefficients.
    """

    frames: Int[Tensor, "rows"]
    is_right: Int[Tensor, "rows"]
    rotations: Float[Tensor, "rows bones 3 3"]
    translations: Float[Tensor, "placed 3"]
    shape: Float[Tensor, "rows 10"]


def mirrored_rotations(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotations seen in a mirror across x: axis-angle (x, -y, -z)."""
    sign = torch.tensor([-1.0, 1.0, 1.0], dtype=rotations.dtype, device=rotations.device)
    return rotations * sign[:, None] * sign


def mirrored_points(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Points seen in a mirror across x."""
    return points * torch.tensor([-1.0, 1.0, 1.0], dtype=points.dtype, device=points.device)
