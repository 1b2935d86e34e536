"""Frames out of a person's video file: bounded, upright, a few per second."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

from handavatar.capture.checks import CaptureError

# FFmpeg's names of mp4, mov, mkv and webm. Nothing else is opened: playlists and image patterns
# name other files or network addresses.
_DEMUXERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm"
_MAX_BYTES = 8 << 30
_MAX_PIXELS = 64_000_000
_MIN_SIDE = 96
_MAX_WORKING_SIDE = 1920
_WHOLE_SHARE = 0.9


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One upright picture of a video.

    Attributes:
        index: number of the frame in the file, from 0.
        time: seconds from the first frame.
        image: sRGB.
    """

    index: int
    time: float
    image: UInt8[np.ndarray, "height width 3"]


def video_frames(path: Path, fps: float = 10.0, max_frames: int = 600) -> Iterator[VideoFrame]:
    """Decodes a video, thinned to about ``fps`` pictures per second, turned upright.

    The longer side is brought down to 1920 pixels, which leaves a hand more pixels than a capture
    keeps of it.

    Args:
        path: an mp4, mov, mkv or webm file.
        fps: pictures per second to keep, at most the video's own rate.
        max_frames: stop after this many kept pictures.

    Raises:
        CaptureError: not a video of these kinds, empty, without pictures, or cut short.
    """
    _check_file(path)
    with path.open("rb") as file:
        try:
            container = av.open(file, mode="r", options={"format_whitelist": _DEMUXERS})
        except av.error.FFmpegError as error:
            raise CaptureError(
                f"{path}: not a video that can be opened ({error.strerror}); expected a whole mp4, "
                "mov, mkv or webm file",
                "if it was copied or downloaded, do that again; else convert it to mp4",
            ) from error
        with container:
            if not container.streams.video:
                raise CaptureError(
                    f"{path}: holds no pictures, only {_stream_kinds(container)}",
                    "give a video that shows a hand",
                )
            yield from _decoded(path, container, fps, max_frames)


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise CaptureError(f"{path}: no such file", "give a video (mp4, mov, mkv or webm)")
    size = path.stat().st_size
    if size == 0:
        raise CaptureError(f"{path}: the file is empty (0 bytes)", "copy or record it again")
    if size > _MAX_BYTES:
        raise CaptureError(
            f"{path}: {size / 2**30:.1f} GiB, at most {_MAX_BYTES / 2**30:.0f} are read",
            "cut out the part that shows the hand",
        )


def _stream_kinds(container: av.container.InputContainer) -> str:
    kinds = sorted({stream.type for stream in container.streams})
    return " and ".join(kinds) or "nothing"


def _decoded(
    path: Path, container: av.container.InputContainer, fps: float, max_frames: int
) -> Iterator[VideoFrame]:
    stream = container.streams.video[0]
    width, height = stream.codec_context.width, stream.codec_context.height
    if not (min(width, height) >= _MIN_SIDE and width * height <= _MAX_PIXELS):
        raise CaptureError(
            f"{path}: pictures of {width} x {height} pixels; expected at least {_MIN_SIDE} on the "
            f"short side and at most {_MAX_PIXELS // 1_000_000} megapixels",
            "record or convert it at a common size such as 1280 x 720",
        )
    stream.thread_type = "AUTO"
    rate = float(stream.average_rate or 30)
    step = max(1, round(rate / fps))
    kept, index, time, first_time = 0, -1, 0.0, None
    problem = ""
    try:
        for index, frame in enumerate(container.decode(stream)):
            seconds = float(frame.time) if frame.time is not None else index / rate
            first_time = seconds if first_time is None else first_time
            time = seconds - first_time
            if index % step == 0:
                yield VideoFrame(index, time, _upright(frame))
                kept += 1
                if kept == max_frames:
                    return
    except av.error.FFmpegError as error:
        problem = f" ({error.strerror})"
    expected = _expected_seconds(container, stream)
    decoded = time + 1 / rate if index >= 0 else 0.0
    if index < 0:
        raise CaptureError(
            f"{path}: no picture could be decoded{problem}", "record or copy it again"
        )
    if problem or (expected is not None and decoded < _WHOLE_SHARE * expected):
        promised = f" of {expected:.1f}" if expected is not None else ""
        raise CaptureError(
            f"{path}: breaks off after {decoded:.1f}{promised} seconds{problem}",
            "the file is cut short: copy it again, or save the good part with a video editor",
        )


def _expected_seconds(
    container: av.container.InputContainer, stream: av.video.stream.VideoStream
) -> float | None:
    """What the header promises of the pictures; None where it is silent."""
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    if container.duration is not None:
        return container.duration / av.time_base
    return None


def _upright(frame: av.VideoFrame) -> UInt8[np.ndarray, "height width 3"]:
    """SRGB picture with the recording phone's rotation undone, at working size."""
    scale = min(1.0, _MAX_WORKING_SIDE / max(frame.width, frame.height))
    width, height = (2 * round(side * scale / 2) for side in (frame.width, frame.height))
    image = frame.to_ndarray(format="rgb24", width=width, height=height)
    return np.ascontiguousarray(np.rot90(image, round(frame.rotation / 90) % 4))
