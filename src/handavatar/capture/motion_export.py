"""Motions as files of other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from handavatar.capture.motion import Motion, read_motion
from handavatar.capture.motion_files.soma import write_soma
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import refuse_file_in_use


@dataclass(frozen=True)
class MotionToOptions:
    """From a motion file to one that SOMA-X plays."""

    source: Path
    """Motion file, such as wave.json."""
    out: Path
    """File to write, such as wave.npz: SOMA-X's hand, absolute rotations, metres."""
    side: Literal["left", "right"]
    """Which hand it becomes; motions of left avatars are stored mirrored and are mirrored back."""
    rig: str = "open-hand"
    """The hand that the motion is for: open-hand, an imported one (mano-right) or its file."""
    overwrite: bool = False
    """Replace a file at OUT."""


def motion_to(options: MotionToOptions) -> Motion:
    """Writes a motion as SOMA-X's npz; where bones point is kept, lengths are SOMA's.

    Args:
        options: of what.

    Returns:
        The motion.

    Raises:
        CaptureError: the source is no motion, or the name does not end with ``.npz``.
        FolderInUse: there is a file at ``out`` already.
    """
    refuse_file_in_use(options.out, options.overwrite, [options.source])
    motion = read_motion(options.source)
    write_soma(options.out, motion, load_rig(options.rig), options.side)
    return motion
