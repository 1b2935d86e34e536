"""Motions from what was filmed: the poses of a capture, or of a video, at equal steps of time."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Tell
from handavatar.capture.frames import Capture, read_capture
from handavatar.capture.motion import MAX_STEPS, Motion
from handavatar.capture.video import VideoOptions, capture_video
from handavatar.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    rotations_between,
)

_LONG_GAP = 0.75
"""Seconds without a pose that are told."""
_MOST_FPS = 240.0


@dataclass(frozen=True)
class MotionFromOptions:
    """From a capture or a video to a motion that drives any avatar of the same rig."""

    source: Path
    """A capture, or a video or a folder of pictures as capture video reads them."""
    out: Path
    """Motion file, such as wave.json."""
    fps: float | None = None
    """Steps a second; by default those of the source."""
    keep: Path | None = None
    """Folder in which the capture of a video is kept."""
    rig: str = "open-hand"
    """The hand to lay onto a video: open-hand, an imported one (mano-right) or its file."""


def motion_from(
    options: MotionFromOptions,
    tell: Tell,
    progress: Callable[[float, str], None] | None = None,
) -> Motion:
    """The motion of a hand that was filmed.

    Args:
        options: of what.
        tell: called with what a person should know.
        progress: called with the share of a video's work that is done.

    Raises:
        CaptureError: there is no hand in it, or the poses have no times.
    """
    if (options.source / "transforms.json").is_file():
        return motion_of_capture(read_capture(options.source), options.fps, tell)
    with tempfile.TemporaryDirectory() as aside:
        out = options.keep or Path(aside) / "capture"
        # For a motion ten pictures a second are few.
        fps = options.fps or 30.0
        asked = VideoOptions(options.source, out, fps=fps, max_frames=MAX_STEPS, rig=options.rig)
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
    count = int(float(times[-1] - times[0]) * rate + 1e-6) + 1
    if count > MAX_STEPS:
        raise CaptureError(
            f"{capture.folder}: {count} steps at {rate:g} a second; {MAX_STEPS} at most",
            "choose a smaller --fps",
        )
    for start, gap in zip(times, gaps, strict=False):
        if float(gap) > _LONG_GAP:
            tell(f"no pose from {float(start):.1f} s for {float(gap):.1f} s: the hand glides there")
    moments = times[0] + torch.arange(count) / rate
    after = torch.searchsorted(times, moments).clamp(1, len(times) - 1)
    share = ((moments - times[after - 1]) / gaps[after - 1]).clamp(0, 1).float()
    rotations = torch.stack([record.pose.rotations for record in records]).float()
    translations = torch.stack([record.pose.translation for record in records]).float()
    matrices = matrix_from_axis_angle(rotations)
    between = rotations_between(matrices[after - 1], matrices[after], share[:, None, None])
    places = torch.lerp(translations[after - 1], translations[after], share[:, None])
    return Motion(rate, axis_angle_from_matrix(between), places)
