"""Writing films that every player opens and shows in the same colours."""

import contextlib
import platform
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import UInt8

from handavatar.jobs.files import write_aside

# Of ITU-T H.273: matrix, primaries and transfer alike.
_BT709 = 1
# With AVX2 x264 now and then decides differently about the same pictures. What is named here is not
# asked of the processor: every one of 64 bits since 2009 has it. It is no slower.
_SAME_EVERYWHERE: dict[str, object] = (
    {"x264-params": "asm=SSE4.2"} if platform.machine().lower() in ("x86_64", "amd64") else {}
)


class VideoWriter:
    """Writes RGB pictures into an H.264 film that is BT.709 and says so; used in a ``with`` block.

    The film is at its place when the block ends, whole. The same pictures give the same film, bit
    by bit.
    """

    def __init__(
        self, path: Path, fps: float, size: int, width: int | None = None, crf: int = 18
    ) -> None:
        """Opens the file; pictures of odd size lose their last row or column.

        Args:
            path: ends in ``.mp4``.
            fps: pictures per second.
            size: pixels along a side.
            width: of a picture that is no square, which then is ``size`` high.
            crf: constant rate factor: smaller is nearer to the pictures.
        """
        self._height, self._width = size // 2 * 2, (width or size) // 2 * 2
        with contextlib.ExitStack() as whole:
            self._container = av.open(str(whole.enter_context(write_aside(path))), "w")
            whole.push(self._finish)
            self._stream = self._open_stream(fps, crf)
            self._whole = whole.pop_all()

    def _open_stream(self, fps: float, crf: int) -> Any:
        rate = Fraction(fps).limit_denominator(1000)
        stream: Any = self._container.add_stream("libx264", rate=rate)
        stream.width, stream.height = self._width, self._height
        stream.pix_fmt = "yuv420p"
        # One thread: with several, who comes first decides about bits.
        stream.options = {"crf": str(crf), "threads": "1"} | _SAME_EVERYWHERE
        context = stream.codec_context
        context.color_primaries = context.color_trc = context.colorspace = _BT709
        context.color_range = ColorRange.MPEG
        return stream

    def __enter__(self) -> "VideoWriter":
        """Itself."""
        return self

    def __exit__(self, *raised: Any) -> None:
        """Puts the whole film in place; if the block failed, nothing of it stays."""
        self._whole.__exit__(*raised)

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def add(self, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
        """Adds one picture, sRGB."""
        cut = np.ascontiguousarray(pixels[: self._height, : self._width])
        frame = av.VideoFrame.from_ndarray(cut, format="rgb24").reformat(
            format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        self._container.mux(self._stream.encode(frame))
