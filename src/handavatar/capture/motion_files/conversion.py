"""From a track to a motion of a rig: placed, checked, carried over, at equal steps of time."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.capture.motion import Motion, evenly_spaced
from handavatar.capture.motion_files.layouts import read_track
from handavatar.capture.motion_files.plausibility import (
    check_bends,
    check_distance,
    check_reach,
)
from handavatar.capture.motion_files.soma import soma_frames
from handavatar.capture.motion_files.track import UNITS, Conventions, HandTrack
from handavatar.errors import argument
from handavatar.hand.mano import ManoModel, Side
from handavatar.hand.retargeting import rest_frames, retarget
from handavatar.hand.rig import LicensedRigMissing, Rig
from handavatar.hand.rigs import load_mano

Tell = Callable[[str], None]
_HINT = "name your own with `mano` MANO_RIGHT.pkl (MANO_LEFT.pkl), see docs/mano.md"


@dataclass(frozen=True)
class ManoFinder:
    """The user's own MANO files, as they are needed.

    Attributes:
        reference: file or imported rig that the user names; None: imported ones, by side.
    """

    reference: str | None

    def of_side(self, side: Side, purpose: str) -> ManoModel:
        """The MANO file of one side.

        Args:
            side: mean poses and components of the other side are not taken for it.
            purpose: why it is needed, for the message.

        Raises:
            LicensedRigMissing: there is none.
            CaptureError: the one that is named is of the other hand.
        """
        model = self._load(side, purpose)
        if model.side != side:
            raise CaptureError(
                f"{argument('mano', self.reference)}: it is of the {model.side} hand, the motion "
                f"of the {side} one",
                f"name MANO_{side.upper()}.pkl",
            )
        return model

    def of_any(self, preferred: Side, purpose: str) -> ManoModel:
        """A MANO file of either side, for what both have alike: the rest pose.

        Raises:
            LicensedRigMissing: there is none.
        """
        other: Side = "left" if preferred == "right" else "right"
        try:
            return self._load(preferred, purpose)
        except LicensedRigMissing as error:
            if self.reference is not None:
                raise
            try:
                return self._load(other, purpose)
            except LicensedRigMissing:
                raise error from None

    def _load(self, side: Side, purpose: str) -> ManoModel:
        if self.reference is not None:
            return load_mano(self.reference)
        try:
            return load_mano(f"mano-{side}")
        except LicensedRigMissing as error:
            raise LicensedRigMissing(f"MANO's file is needed: {purpose}\n{_HINT}") from error


def motion_of_file(
    source: Path,
    rig: Rig,
    conventions: Conventions,
    mano: str | None,
    fps: float | None,
    tell: Tell,
) -> Motion:
    """A motion for a rig out of another program's file.

    Args:
        source: a file, or a folder of files.
        rig: that is to move.
        conventions: what the user says of the file.
        mano: the user's MANO file or imported rig.
        fps: steps a second; by default those of the file.
        tell: called with what a person should know.

    Raises:
        CaptureError: what is wrong with the file, or what it does not say.
        LicensedRigMissing: a MANO file is needed.
    """
    finder = ManoFinder(mano)
    track, layout = read_track(source, conventions, finder.of_side)
    if conventions.layout == "auto":
        tell(f"taken for {layout.writer}: `layout={layout.name!r}`")
    for note in track.notes:
        tell(note)
    if track.side == "left":
        tell("a left hand, stored as the right hand that it mirrors, as left avatars are")
    placed = replace(track, translations=track.translations * UNITS[conventions.unit])
    rate = track.fps or fps
    if rate is None:
        raise CaptureError(
            f"{source}: it does not say how many frames a second it has", "say it with `fps`"
        )
    times = track.frames.double() / rate
    try:
        rotations, places = _for_rig(placed, rig, conventions, finder, layout.name, tell)
        _tell_missing(track, tell)
        return evenly_spaced(times, rotations, places, fps or rate, tell)
    except CaptureError as error:
        raise CaptureError(f"{source}: {error.what}", error.remedy) from error


def _for_rig(
    track: HandTrack,
    rig: Rig,
    conventions: Conventions,
    finder: ManoFinder,
    layout: str,
    tell: Tell,
) -> tuple[Float[Tensor, "steps bones 3 3"], Float[Tensor, "steps 3"]]:
    """Rotations and translations of a rig's bones that place it as the track says."""
    rotations = track.rotations.clone()
    own_rest = rig.shaped().rest_joints[0].double()
    carries_over = track.skeleton == "mano" and rig.is_licensed
    model: ManoModel | None = None
    if track.skeleton == "soma":
        source_rest = torch.zeros(len(rotations), 3, dtype=torch.float64)
    elif carries_over:
        source_rest = _rest_wrists(rig, track.shape)
    else:
        purpose = f"its rest pose is another than that of {rig.name}"
        model = finder.of_any(track.side, purpose)
        source_rest = _rest_wrists(model.rig, track.shape)
    wrists = source_rest + track.translations
    if conventions.axes == "opengl":
        turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
        wrists, rotations[:, 0] = wrists @ turn, turn @ rotations[:, 0]
    if track.space == "camera":
        check_distance(wrists, conventions, layout)
    elif track.space == "world":
        check_reach(wrists, conventions)

    frames = soma_frames() if model is None else rest_frames(model.rig)

    def carried(turns: Tensor) -> Tensor:
        return turns if carries_over else retarget(turns, frames, rest_frames(rig))

    check_bends(rig, rotations, carried, track, layout, _mean(track, finder), tell)
    if not carries_over:
        tell(
            f"carried over to {rig.name}, bone by bone: bones point where they did; where "
            "fingertips come to lie differs with the proportions of the hands"
        )
    turned = carried(rotations)
    if not track.turns_wrist:
        turned[:, 0] = torch.eye(3, dtype=torch.float64)
    if track.space == "hand":
        tell("the file does not place the hand: its wrist stays where it rests")
        return turned, torch.zeros(len(rotations), 3, dtype=torch.float64)
    target_rest = source_rest if carries_over else own_rest
    return turned, wrists - target_rest


def _rest_wrists(rig: Rig, shape: Float[Tensor, "steps 10"]) -> Float[Tensor, "steps 3"]:
    """Wrist joints of hands of given shapes, unposed and not moved."""
    directions = torch.einsum("v,vcs->cs", rig.joint_regressor[0], rig.shape_directions).double()
    count = directions.shape[-1]
    mean = rig.shaped().rest_joints[0].double()
    return mean + shape[:, :count] @ directions[:, : shape.shape[1]].T


def _mean(track: HandTrack, finder: ManoFinder) -> ManoModel | None:
    """A MANO file of this side, if there is one, to try its mean pose."""
    try:
        model = finder.of_any(track.side, "")
    except LicensedRigMissing:
        return None
    return model if model.side == track.side and track.skeleton == "mano" else None


def _tell_missing(track: HandTrack, tell: Tell) -> None:
    span = int(track.frames[-1] - track.frames[0]) + 1
    missing = span - len(track.frames)
    if missing:
        tell(f"no hand in {missing} of {span} frames: bridged")
