"""Frames out of a person's video file: bounded, upright, in sRGB, a few per second.

What a file says of its pictures is honoured frame by frame, as a player would: colours
(:mod:`handavatar.capture.color_spaces`), rotation and mirrors of the display matrix, the shape of
its pixels, times of the frames, edit lists. What had to be guessed, changed or left out is told.
"""

import errno
import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from av.video.reformatter import Colorspace
from jaxtyping import UInt8

from handavatar.capture.checks import CaptureError
from handavatar.capture.color_spaces import ColorTags, srgb_from_planes, srgb_from_rgb
from handavatar.errors import ArgumentError, require_ranges

# FFmpeg's names of mp4, mov, mkv, webm and others that cameras write. Nothing else is opened:
# playlists and image patterns name other files or network addresses.
_DEMUXERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,gif,asf,flv,ogg,mxf"
KINDS = "mp4, mov, mkv, webm, avi, ts or gif"
# Titles may be in any encoding, and nobody reads them here; from 19 on PyAV takes them as they are.
_ANY_TITLE: dict[str, Any] = (
    {} if int(av.__version__.split(".")[0]) >= 19 else {"metadata_errors": "replace"}
)
_MAX_BYTES = 8 << 30
MAX_PIXELS = 64_000_000
"""Of a picture."""
_MIN_SIDE = 96
_MAX_WORKING_SIDE = 1920
# Of what a header promises, and seconds: less is cut short.
_WHOLE_SHARE, _SLACK = 0.9, 0.2
# Difference of width by height up to which pictures have the same shape.
_SAME_SHAPE = 0.03
# Degrees from a quarter turn that are nobody's intention.
_TURN_TOLERANCE = 2.0
_LONGEST_RATIO = 8.0
# Seconds between the frames that are decoded to learn of changes.
_SCAN_STEP = 0.3

Tell = Callable[[str], None]
"""Told what a person should know of a file, a sentence each."""


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One upright picture of a video.

    Attributes:
        index: number of the frame in the file, from 0.
        time: seconds from the first frame.
        image: sRGB.
        name: of its file, where it has one.
    """

    index: int
    time: float
    image: UInt8[np.ndarray, "height width 3"]
    name: str = ""


@dataclass(frozen=True)
class Sampling:
    """Which pictures of a video are taken.

    Attributes:
        fps: pictures per second; the frame nearest to each time is taken, each frame once.
        max_frames: stop after so many pictures.
        start: seconds from the first frame.
        end: the last moment, seconds from the first frame; the file's end if None.
    """

    fps: float = 10.0
    max_frames: int = 600
    start: float = 0.0
    end: float | None = None

    def __post_init__(self) -> None:
        """Refuses what selects nothing."""
        require_ranges(
            self, fps=(0.001, 1000), max_frames=(1, 1_000_000), start=(0, 1e6), end=(0, 1e7)
        )
        if self.end is not None and not self.end > self.start:
            raise ArgumentError(
                "end", f"{self.end:g}", f"more than `start={self.start:g}`, in seconds"
            )

    def wanted(self, number: int) -> float:
        """The time of which the nearest frame is taken, seconds."""
        return self.start + number / self.fps

    def number_until(self, time: float) -> int:
        """The last number that is wanted until a time, and until the end; negative if none is."""
        until = (time if self.end is None else min(time, self.end)) + 1e-6
        number = math.floor((until - self.start) * self.fps)
        if self.wanted(number + 1) <= until:
            return number + 1
        return number if self.wanted(number) <= until else number - 1

    def is_over(self, time: float) -> bool:
        """Whether a time is behind the end."""
        return self.end is not None and time > self.end + 1e-6


@dataclass(frozen=True)
class _Display:
    """How the pictures of a stream are shown.

    Attributes:
        is_transposed: rows become columns.
        is_flipped: left and right, then top and bottom, after that.
        stretch: width of a pixel by its height, before any of it.
    """

    is_transposed: bool = False
    is_flipped: tuple[bool, bool] = (False, False)
    stretch: float = 1.0

    @property
    def is_mirrored(self) -> bool:
        """Whether it is more than a turn."""
        return self.is_transposed ^ self.is_flipped[0] ^ self.is_flipped[1]

    def stored_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height with square pixels, before turning; nothing becomes smaller."""
        return round(width * max(1.0, self.stretch)), round(height * max(1.0, 1 / self.stretch))

    def shown(self, image: UInt8[np.ndarray, "_ _ 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
        """Turned and mirrored."""
        if self.is_transposed:
            image = image.transpose(1, 0, 2)
        image = image[:: -1 if self.is_flipped[1] else 1, :: -1 if self.is_flipped[0] else 1]
        return np.ascontiguousarray(image)


@dataclass(frozen=True)
class _Scan:
    """What a first reading of a file tells, without decoding more than a few frames a second.

    Attributes:
        size: in which the pictures are looked at, before they are turned.
        num_sizes: how many different sizes there are.
        end: seconds at which the last picture ends.
        reached: seconds until which there is anything, in what the header speaks of.
        promised: seconds that the header promises of it; None where it is silent.
    """

    size: tuple[int, int]
    num_sizes: int
    end: float
    reached: float
    promised: float | None

    @property
    def is_whole(self) -> bool:
        """Whether there is what the header promises."""
        return self.promised is None or self.reached + _SLACK >= _WHOLE_SHARE * self.promised


def video_frames(
    path: Path, sampling: Sampling | None = None, tell: Tell | None = None
) -> Iterator[VideoFrame]:
    """Decodes a video, thinned to a few pictures per second, upright, in sRGB.

    The longer side is brought down to 1920 pixels, which leaves a hand more pixels than a capture
    keeps of it.

    Args:
        path: a video file: mp4, mov, mkv, webm, avi, ts or gif.
        sampling: which pictures; ten a second if None.
        tell: called with what was guessed, changed or left out.

    Raises:
        CaptureError: not a video of these kinds, empty, without pictures, or cut short.
    """
    sampling = sampling or Sampling()
    tell = tell or (lambda text: None)
    _check_file(path)
    with _opened(path) as (container, stream):
        scan = _scanned(path, container, stream)
    with _opened(path) as (container, stream):
        yield from _Decoder(path, container, stream, scan, sampling, tell).frames()


def check_size(path: Path, width: int, height: int) -> None:
    """Refuses pictures that are too small to show a hand, or too large to be read.

    Raises:
        CaptureError: what they are and what was expected.
    """
    if not (min(width, height) >= _MIN_SIDE and width * height <= MAX_PIXELS):
        raise CaptureError(
            f"{path}: pictures of {width} x {height} pixels; expected at least {_MIN_SIDE} on the "
            f"short side and at most {MAX_PIXELS // 1_000_000} megapixels",
            "record or convert it at a common size such as 1280 x 720",
        )


def have_same_shape(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Whether two widths and heights differ by no more than a factor, nearly."""
    return abs(first[0] / first[1] * second[1] / second[0] - 1) <= _SAME_SHAPE


def working_size(sizes: Iterable[tuple[int, int]]) -> tuple[int, int]:
    """Width and height in which pictures of several sizes are looked at: the largest, bounded."""
    width, height = max(sizes, key=lambda size: (size[0] * size[1], size))
    scale = min(1.0, _MAX_WORKING_SIDE / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def say_other_shapes(count: int, tell: Tell) -> None:
    """Tells how many pictures were left out because they are wider or higher than the others."""
    if count:
        tell(f"{count} pictures were left out: their width by height is not that of the others")


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise CaptureError(f"{path}: no such file", f"give a video ({KINDS})")
    size = path.stat().st_size
    if size == 0:
        raise CaptureError(f"{path}: the file is empty (0 bytes)", "copy or record it again")
    if size > _MAX_BYTES:
        raise CaptureError(
            f"{path}: {size / 2**30:.1f} GiB, at most {_MAX_BYTES / 2**30:.0f} are read",
            "cut out the part that shows the hand",
        )


class _Source:
    """A file as FFmpeg reads it; damaged files send it to places that there are not.

    PyAV keeps an exception of such a call, raises it from a later one, and prints it if there are
    two. A negative number is what FFmpeg understands.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.name, self.read, self.tell, self._file = file.name, file.read, file.tell, file

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Goes to a place; tells which, or a negative number if there is none."""
        try:
            return self._file.seek(offset, whence)
        except (OSError, ValueError):
            return -errno.EINVAL


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its pictures."""
    with path.open("rb") as file:
        try:
            container = av.open(
                _Source(file),
                mode="r",
                options={"format_whitelist": _DEMUXERS},
                **_ANY_TITLE,
            )
        except av.error.FFmpegError as error:
            raise CaptureError(
                f"{path}: not a video that can be opened ({error.strerror}); expected a whole "
                f"{KINDS} file",
                "if it was copied or downloaded, do that again; else convert it to mp4",
            ) from error
        with container:
            # The best of several, and no cover of a sound file.
            stream = container.streams.best("video")
            if stream is None or _is_cover(stream):
                raise CaptureError(
                    f"{path}: holds no pictures, only {_stream_kinds(container)}",
                    "give a video that shows a hand",
                )
            if stream.codec_context is None:
                raise CaptureError(
                    f"{path}: its pictures are compressed in a way that is not known here",
                    "convert it to mp4 (H.264)",
                )
            stream.codec_context.thread_type = "AUTO"
            # Of what grows behind its header. Compressed pictures have some more rows and columns.
            stream.codec_context.options = {"max_pixels": str(MAX_PIXELS * 9 // 8)}
            yield container, stream


def _is_cover(stream: Any) -> bool:
    return bool(stream.disposition & av.stream.Disposition.attached_pic)


def _stream_kinds(container: Any) -> str:
    kinds = {"a cover" if s.type == "video" else s.type for s in container.streams}
    return " and ".join(sorted(kinds)) or "nothing"


def _scanned(path: Path, container: Any, stream: Any) -> _Scan:
    """Reads all packets, and decodes key frames that are not too close to each other."""
    context = stream.codec_context
    check_size(path, context.width, context.height)
    ends = {other.index: 0.0 for other in container.streams}
    firsts: dict[int, float] = {}
    sizes: set[tuple[int, int]] = set()
    context.skip_frame = "NONKEY"
    due = -math.inf
    try:
        for packet in container.demux():
            stamp = packet.pts if packet.pts is not None else packet.dts
            if stamp is None or packet.time_base is None:
                continue
            time = float(stamp * packet.time_base)
            length = float((packet.duration or 0) * packet.time_base)
            index = packet.stream.index
            firsts[index] = min(firsts.get(index, time), time)
            ends[index] = max(ends[index], time + length)
            if index == stream.index and packet.is_keyframe and time >= due:
                due = time + _SCAN_STEP
                sizes.update(_square_size(frame, stream) for frame in packet.decode())
        sizes.update(_square_size(frame, stream) for frame in context.decode(None))
    except av.error.FFmpegError:
        # Said when it is met again, after all pictures before it.
        pass
    sizes = sizes or {_square_size(context, stream)}
    for width, height in sizes:
        check_size(path, width, height)
    end = ends[stream.index] - firsts.get(stream.index, 0.0)
    if stream.duration is not None and stream.time_base is not None:
        promised = float(stream.duration * stream.time_base)
        return _Scan(working_size(sizes), len(sizes), end, end, promised)
    # Then the header speaks of the longest of pictures and sound.
    reached = max(ends.values()) - min(firsts.values(), default=0.0)
    of_all = None if container.duration is None else container.duration / av.time_base
    return _Scan(working_size(sizes), len(sizes), end, reached, of_all)


def _square_size(picture: Any, stream: Any) -> tuple[int, int]:
    """Width and height of a stored picture whose pixels have become squares."""
    display = _Display(stretch=_pixel_stretch(stream))
    return display.stored_size(picture.width, picture.height)


def _pixel_stretch(stream: Any) -> float:
    """Width of a pixel by its height, as the container says, else the pictures themselves."""
    for ratio in (stream.sample_aspect_ratio, stream.codec_context.sample_aspect_ratio):
        if ratio is not None and 1 / _LONGEST_RATIO <= ratio <= _LONGEST_RATIO:
            return float(ratio)
    return 1.0


class _Decoder:
    """One reading of a file, with what has to be known of the pictures before."""

    def __init__(
        self,
        path: Path,
        container: Any,
        stream: Any,
        scan: _Scan,
        sampling: Sampling,
        tell: Tell,
    ) -> None:
        self.path, self.container, self.stream = path, container, stream
        self.scan, self.sampling, self.tell = scan, sampling, tell
        self.rate = float(stream.average_rate or stream.guessed_rate or 30)
        self.said: set[str] = set()
        self.num_other_shapes = 0
        self.is_transposed: bool | None = None

    def frames(self) -> Iterator[VideoFrame]:
        """The pictures that are wanted."""
        number = 0
        for index, time, frame in self.wanted():
            image = self.image(frame)
            if image is None:
                self.num_other_shapes += 1
                continue
            yield VideoFrame(index, time, image)
            number += 1
            if number == self.sampling.max_frames:
                left = self.scan.end - time - 1.5 / self.sampling.fps
                if left > 0 and not self.sampling.is_over(time + 1 / self.sampling.fps):
                    self.say(
                        f"{number} pictures were taken, up to {time:.1f} s; the {left:.1f} s after "
                        "that were not looked at (`max_frames`, `start` and `end` choose others)"
                    )
                break
        if self.scan.num_sizes > 1:
            self.say(
                f"the pictures' size changes ({self.scan.num_sizes} sizes): all are brought to "
                f"{self.scan.size[0]} x {self.scan.size[1]}"
            )
        say_other_shapes(self.num_other_shapes, self.say)

    def say(self, text: str) -> None:
        """Tells it, once."""
        if text not in self.said:
            self.said.add(text)
            self.tell(text)

    def wanted(self) -> Iterator[tuple[int, float, Any]]:
        """Of all decoded frames the nearest to each time, with number and time."""
        number = 0
        before: tuple[int, float, Any] | None = None
        taken = -1
        for index, time, frame in self.decoded():
            last = self.sampling.number_until(time)
            # A frame that is over may still be the nearest to the last time that is not. Of all
            # times since the frame before, the first is the nearest to that one, and the last to
            # this one: there are millions between them where a damaged file's times jump.
            for at in map(self.sampling.wanted, sorted({number, last} if number <= last else ())):
                is_nearer = before is not None and at - before[1] <= time - at + 1e-6
                nearest = before if before is not None and is_nearer else (index, time, frame)
                if nearest[0] > taken and not self.sampling.is_over(nearest[1]):
                    taken = nearest[0]
                    yield nearest
            number = max(number, last + 1)
            if self.sampling.wanted(number) <= time + 1e-6:
                return
            before = (index, time, frame)
        if before is not None and before[0] > taken:
            at = self.sampling.wanted(number)
            if at - before[1] <= 0.5 / self.rate and not self.sampling.is_over(at):
                yield before
        if before is not None and taken < 0 and before[1] < self.sampling.start:
            raise CaptureError(
                f"{self.path}: `start={self.sampling.start:g}` lies behind its end at "
                f"{before[1]:.1f} seconds",
                "choose an earlier one",
            )

    def decoded(self) -> Iterator[tuple[int, float, Any]]:
        """All frames with number and time.

        Raises:
            CaptureError: there are none, or fewer than the file promises.
        """
        index, time, first_time = -1, 0.0, None
        problem = ""
        try:
            for index, frame in enumerate(self.container.decode(self.stream)):
                seconds = float(frame.time) if frame.time is not None else index / self.rate
                first_time = seconds if first_time is None else first_time
                # Times that run backwards are a fault of the file.
                time = max(time, seconds - first_time)
                yield index, time, frame
        except av.error.FFmpegError as error:
            problem = f" ({error.strerror})"
        if index < 0:
            raise CaptureError(
                f"{self.path}: no picture could be decoded{problem}", "record or copy it again"
            )
        promised = self.scan.promised
        if problem or not self.scan.is_whole:
            of = f" of {promised:.1f}" if promised is not None else ""
            raise CaptureError(
                f"{self.path}: breaks off after {time + 1 / self.rate:.1f}{of} seconds{problem}",
                "the file is cut short: copy it again, or save the good part with a video editor",
            )

    def image(self, frame: Any) -> UInt8[np.ndarray, "height width 3"] | None:
        """Upright, with square pixels, in sRGB; None if its shape is not that of the others."""
        display = self.display(frame)
        if self.is_transposed is None:
            self.is_transposed = display.is_transposed
        stored = display.stored_size(frame.width, frame.height)
        is_same = have_same_shape(stored, self.scan.size)
        if not is_same or display.is_transposed != self.is_transposed:
            return None
        return display.shown(self.srgb(frame, self.scan.size))

    def srgb(self, frame: Any, size: tuple[int, int]) -> UInt8[np.ndarray, "height width 3"]:
        """As stored, in sRGB."""
        layout = frame.format
        bits = min(16, layout.components[0].bits)
        is_rgb = layout.is_rgb or layout.has_palette
        is_grey = not is_rgb and len(layout.components) < 3
        tags = ColorTags.of_planes(
            int(frame.colorspace),
            int(frame.color_range),
            int(frame.color_primaries),
            int(frame.color_trc),
            (frame.width, frame.height),
            layout.name.startswith("yuvj") or (is_grey and int(frame.color_range) != 1),
        )
        for note in tags.notes():
            self.say(note)
        if frame.interlaced_frame:
            self.say("the pictures are interlaced: every second row is used")
        name = "rgb48le" if is_rgb else "gray16le" if is_grey else "yuv444p16le"
        # The same range in and out: numbers stay what they are.
        stays = 2 if tags.is_full else 1
        height = frame.height if frame.interlaced_frame else size[1]
        planes = frame.reformat(
            size[0],
            height,
            name,
            # Whatever it says; what the numbers mean is told by the tags.
            src_colorspace=Colorspace.ITU709,
            dst_colorspace=Colorspace.ITU709,
            src_color_range=stays,
            dst_color_range=stays,
        ).to_ndarray()
        if frame.interlaced_frame:
            rows = (np.arange(size[1]) + 0.5) * (height / 2 / size[1])
            planes = planes[::2][rows.astype(int).clip(0, (height + 1) // 2 - 1)]
        if is_grey:
            self.say("the pictures are grey: so will be the avatar")
            neutral = np.full_like(planes, 1 << 15)
            planes = np.stack([planes, neutral, neutral], axis=-1)
        return srgb_from_rgb(planes, bits, tags) if is_rgb else srgb_from_planes(planes, bits, tags)

    def display(self, frame: Any) -> _Display:
        """How a frame is shown, as the file says."""
        stretch = _pixel_stretch(self.stream)
        display = replace(_matrix_display(frame, self.say), stretch=stretch)
        if display.is_mirrored:
            self.say(
                "the file says that its pictures are shown mirrored, and so they are read "
                "(`side` overrules which hand it is)"
            )
        if abs(stretch - 1) > 0.01:
            self.say(f"pixels are {stretch:.3g} times as wide as high: pictures are resampled")
        return display


def _matrix_display(frame: Any, say: Tell) -> _Display:
    """The display matrix of a frame as the nearest quarter turn, mirrored or not."""
    side_data = frame.side_data.get(SideData.DISPLAYMATRIX)
    if side_data is None:
        return _Display()
    numbers = np.frombuffer(bytes(side_data), dtype="<i4")
    # Right and down become: a right + c down, b right + d down.
    a, b, c, d = (float(numbers[place]) for place in (0, 1, 3, 4))
    if max(abs(a), abs(b)) == 0 or max(abs(c), abs(d)) == 0:
        return _Display()
    is_transposed = abs(b) + abs(c) > abs(a) + abs(d)
    aside = math.degrees(math.atan2(*sorted((abs(a), abs(b)))))
    if aside > _TURN_TOLERANCE:
        say(f"pictures are turned by {aside:.0f} degrees from upright, which is left as it is")
    return _Display(is_transposed, (c < 0, b < 0) if is_transposed else (a < 0, d < 0))
