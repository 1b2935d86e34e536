"""Motions from what was filmed, or from other programs' files, at equal steps of time."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Tell
from handavatar.capture.frames import Capture, read_capture
from handavatar.capture.motion import Motion, evenly_spaced
from handavatar.capture.motion_files.conversion import motion_of_file
from handavatar.capture.motion_files.stored import is_motion_file
from handavatar.capture.motion_files.track import Conventions, LayoutName
from handavatar.capture.motion_files.trackers import is_hawor
from handavatar.capture.motion_values import MAX_STEPS
from handavatar.capture.tracking import has_mediapipe
from handavatar.capture.video import VideoOptions, capture_video
from handavatar.errors import require_ranges
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import refuse_file_in_use
from handavatar.jobs.progress import SILENT, Progress

_MOST_FPS = 240.0


@dataclass(frozen=True)
class MotionFromOptions:
    """From a capture, a video or another program's file to a motion that drives any avatar."""

    source: Path
    """A capture; a video or a folder of pictures as capture video reads them; or a file, or a
    folder of files, of HaMeR, WiLoR, HaWoR, MANO, ARCTIC, InterHand2.6M, AMASS or SOMA-X."""
    out: Path
    """Motion file, such as wave.json."""
    fps: float | None = None
    """Steps a second; by default those of the source. A file that does not say its own needs it."""
    keep: Path | None = None
    """Folder in which the capture of a video is kept."""
    rig: str = "open-hand"
    """The hand to lay onto a video, and that a file's poses are carried over to: that of the avatar
    to be driven: open-hand, an imported one (mano-right) or its file."""
    layout: LayoutName = "auto"
    """What wrote a file; auto takes it only from files that tell it for certain."""
    side: Literal["auto", "left", "right"] = "auto"
    """Which hand of a file; must be said where it holds both or does not tell."""
    mano: str | None = None
    """Your own MANO_RIGHT.pkl or MANO_LEFT.pkl, or an imported rig; by default the imported one."""
    flat_hand_mean: Literal["auto", "true", "false"] = "auto"
    """As in smplx: true if a file's finger poses count from the flat hand, false if from MANO's
    mean pose. Must be said for MANO's parameters."""
    use_pca: bool = False
    """As in smplx: a file's finger poses are MANO's principal components."""
    unit: Literal["m", "cm", "mm"] = "m"
    """Of a file's translations."""
    axes: Literal["opencv", "opengl"] = "opencv"
    """Of a file's camera; opengl has y up and z backwards."""
    focal: float | None = None
    """True focal length in pixels of the pictures that HaMeR or WiLoR saw, for their depths."""
    overwrite: bool = False
    """Replace a file at OUT."""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, fps=(0.001, 1000), focal=(1, 1e6))


def motion_from(
    options: MotionFromOptions,
    tell: Tell,
    progress: Progress = SILENT,
) -> Motion:
    """The motion of a hand that was filmed, or that another program's file holds.

    Args:
        options: of what.
        tell: called with what a person should know.
        progress: told how far it is.

    Raises:
        CaptureError: there is no hand in it, the poses have no times, or a file is not what it is
            said to be.
        FolderInUse: there is a file at ``out`` already.
        LicensedRigMissing: a file cannot be read without the user's own MANO file.
    """
    refuse_file_in_use(options.out, options.overwrite, [options.source])
    if (options.source / "transforms.json").is_file():
        return motion_of_capture(read_capture(options.source), options.fps, tell)
    is_told = options.layout != "auto"
    if is_told or is_motion_file(options.source) or is_hawor(options.source, {}):
        conventions = Conventions(
            options.layout,
            options.side,
            options.flat_hand_mean,
            options.use_pca,
            options.unit,
            options.axes,
            options.focal,
        )
        rig = load_rig(options.rig)
        return motion_of_file(options.source, rig, conventions, options.mano, options.fps, tell)
    with tempfile.TemporaryDirectory() as aside:
        out = options.keep or Path(aside) / "capture"
        # For a motion ten pictures a second are few.
        fps = options.fps or 30.0
        asked = VideoOptions(
            options.source,
            out,
            fps=fps,
            max_frames=MAX_STEPS,
            # Depths matter here more than pictures.
            tracker="both" if has_mediapipe() else "auto",
            rig=options.rig,
        )
        capture = capture_video(asked, progress=progress)
        return motion_of_capture(capture, options.fps, tell)


def motion_of_capture(capture: Capture, fps: float | None, tell: Tell) -> Motion:
    """The poses of a capture at equal steps of time; turns between two of them are the shortest.

    Args:
        capture: frames with times.
        fps: steps a second; as many as most frames are apart if None.
        tell: called where poses are missing for long.

    Raises:
        CaptureError: fewer than two frames, or no times.
    """
    records = sorted(capture.records, key=lambda record: record.time)
    times = torch.tensor([record.time for record in records], dtype=torch.float64)
    gaps = times.diff()
    if len(records) < 2 or float(gaps.min()) <= 0:
        raise CaptureError(
            f"{capture.folder}: its {len(records)} frames do not have times that grow",
            "give a capture of a video, or one whose frames have their time in seconds",
        )
    rate = fps or min(_MOST_FPS, 1 / float(gaps.median()))
    rotations = torch.stack([record.pose.rotations for record in records]).float()
    translations = torch.stack([record.pose.translation for record in records]).float()
    try:
        return evenly_spaced(times, matrix_from_axis_angle(rotations), translations, rate, tell)
    except CaptureError as error:
        raise CaptureError(f"{capture.folder}: {error.what}", error.remedy) from error
