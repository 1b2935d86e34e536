"""Small films of every kind that is read, and mutants of their boxes, elements and packets."""

import os
import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from fuzzing import changed_bytes
from priorities import ordinary_afterwards

_SIZE = 96
_NUM_PICTURES = 6
_NUMBERS = (0, 1, 2, 96, 4096, 30_000, 65_535, 2**31 - 1, 2**31, 2**32 - 1)


@dataclass(frozen=True)
class Film:
    """A kind of video file.

    Attributes:
        name: of the file; its end says the container.
        codec: of the pictures.
        pixels: as FFmpeg names them.
        options: of the container.
        has_sound: besides the pictures.
        aspect: width of a pixel by its height.
        is_turned: a quarter, by the display matrix.
    """

    name: str
    codec: str
    pixels: str = "yuv420p"
    options: tuple[tuple[str, str], ...] = ()
    has_sound: bool = False
    aspect: Fraction = Fraction(1)
    is_turned: bool = False


FILMS = (
    Film("phone.mp4", "libx264", has_sound=True, is_turned=True),
    Film("parts.mp4", "libx264", options=(("movflags", "frag_keyframe+empty_moov"),)),
    Film("hevc.mp4", "libx265", "yuv420p10le"),
    Film("av1.mp4", "libsvtav1"),
    Film("camera.mov", "mjpeg", "yuvj422p", has_sound=True),
    Film("grey.mov", "png", "gray16be"),
    Film("wide.mkv", "libx264", aspect=Fraction(4, 3)),
    Film("vp9.webm", "libvpx-vp9"),
    Film("vp8.webm", "libvpx"),
    Film("old.avi", "mpeg4", has_sound=True),
    Film("moving.gif", "gif", "rgb8"),
    Film("stream.ts", "mpeg2video", has_sound=True),
    Film("h264.ts", "libx264"),
    Film("disc.mpg", "mpeg2video"),
    Film("h264.flv", "libx264"),
    Film("wmv.asf", "wmv2"),
    Film("mpeg2.mxf", "mpeg2video", "yuv422p"),
    Film("vp8.ogg", "libvpx"),
)


def save_film(folder: Path, film: Film) -> Path:
    """Writes a few small pictures, in which something moves."""
    path = folder / film.name
    os.environ.setdefault("SVT_LOG", "0")  # AV1's encoder is talkative.
    with ordinary_afterwards(), av.open(str(path), "w", options=dict(film.options)) as container:
        container.metadata["title"] = "a hand \x1b[31m"
        stream = container.add_stream(film.codec, rate=25)
        stream.width = stream.height = _SIZE
        stream.pix_fmt = film.pixels
        stream.options = {"x265-params": "log-level=none"} if film.codec == "libx265" else {}
        stream.codec_context.sample_aspect_ratio = film.aspect
        sound = container.add_stream("mp2", rate=16000) if film.has_sound else None
        for number in range(_NUM_PICTURES):
            image = np.full((_SIZE, _SIZE, 3), 90, np.uint8)
            image[20:60, 5 * number : 5 * number + 40] = (224, 172, 105)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame.reformat(format=film.pixels)))
        container.mux(stream.encode(None))
        if sound is not None:
            samples = av.AudioFrame.from_ndarray(np.zeros((1, 1152), np.int16), "s16", "mono")
            samples.sample_rate, samples.pts = 16000, 0
            container.mux(sound.encode(samples))
            container.mux(sound.encode(None))
    if film.is_turned:
        content = bytearray(path.read_bytes())
        # tkhd version 0: size, type, version and flags, 36 bytes of times, ids and layers.
        place = content.index(b"tkhd") + 4 + 4 + 36
        content[place : place + 36] = struct.pack(
            ">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, _SIZE << 16, 0, 1 << 30
        )
        path.write_bytes(content)
    return path


def changed_video(data: bytes, chance: random.Random) -> bytes:
    """Bytes changed at random, or whole parts of the file: boxes, elements, chunks, packets."""
    parts = list(_parts(data))
    if not parts or chance.random() < 0.3:
        return changed_bytes(data, chance)
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        begin, head, end, holders = chance.choice(parts)
        other_begin, _, other_end, _ = chance.choice(parts)
        match chance.randrange(7):
            case 0 | 1 | 2:  # Numbers of a header, which are sizes, times, counts and rates.
                wide = chance.choice((1, 2, 4, 4, 8))
                place = chance.randrange(head, max(head + 1, min(end, head + 120)))
                number = chance.choice(_NUMBERS) & (2 ** (8 * wide) - 1)
                order = chance.choice(("big", "little"))
                changed[place : place + wide] = number.to_bytes(wide, order)  # type: ignore[arg-type]
            case 3:  # Left out, and what holds it is that much smaller.
                _resize(changed, holders, begin - end)
                del changed[begin:end]
                break
            case 4:  # Twice.
                _resize(changed, holders, end - begin)
                changed[begin:begin] = data[begin:end]
                break
            case 5:  # Another in its place.
                _resize(changed, holders, (other_end - other_begin) - (end - begin))
                changed[begin:end] = data[other_begin:other_end]
                break
            case 6:  # Another kind or size.
                changed[begin:head] = chance.choice((bytes(head - begin), data[end - 8 : end]))
                break
    return bytes(changed)


_Part = tuple[int, int, int, tuple[int, ...]]
"""Where a part begins, its content begins, and it ends; where the boxes begin that hold it."""


def _parts(data: bytes) -> Iterator[_Part]:
    if data[4:8] == b"ftyp":
        yield from _boxes(data, 0, len(data), ())
    elif data[:4] == b"\x1aE\xdf\xa3":
        yield from _elements(data, 0, len(data), 0)
    elif data[:4] == b"RIFF":
        yield from _chunks(data, 12, len(data))
    elif data[:1] == b"G" and data[188:189] == b"G":
        yield from ((place, place + 4, place + 188, ()) for place in range(0, len(data), 188))


_HOLDERS = {b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf", b"mvex"} | {
    *(b"moof", b"traf", b"mfra")
}


def _boxes(data: bytes, begin: int, end: int, holders: tuple[int, ...]) -> Iterator[_Part]:
    while begin + 8 <= end:
        size = int.from_bytes(data[begin : begin + 4], "big")
        if not 8 <= size <= end - begin:
            return
        yield begin, begin + 8, begin + size, holders
        if data[begin + 4 : begin + 8] in _HOLDERS:
            yield from _boxes(data, begin + 8, begin + size, (*holders, begin))
        begin += size


def _resize(data: bytearray, holders: tuple[int, ...], by: int) -> None:
    """Boxes that hold a part say that they have become larger or smaller."""
    for place in holders:
        size = int.from_bytes(data[place : place + 4], "big")
        data[place : place + 4] = ((size + by) % 2**32).to_bytes(4, "big")


def _elements(data: bytes, begin: int, end: int, depth: int) -> Iterator[_Part]:
    """Of Matroska; any that might hold others is looked into."""
    while begin + 2 <= end:
        kind = 9 - data[begin].bit_length()
        place = begin + kind
        if kind > 4 or place >= end:
            return
        wide = 9 - data[place].bit_length()
        if wide > 8:
            return
        number = data[place : place + wide]
        size = int.from_bytes(number, "big") & (2 ** (7 * wide) - 1)
        head = place + wide
        if size > end - head:
            return
        yield begin, head, head + size, ()
        if depth < 5 and kind in (1, 4) and size > 4:
            yield from _elements(data, head, head + size, depth + 1)
        begin = head + size


def _chunks(data: bytes, begin: int, end: int) -> Iterator[_Part]:
    """Of RIFF."""
    while begin + 8 <= end:
        size = int.from_bytes(data[begin + 4 : begin + 8], "little")
        stop = min(end, begin + 8 + size + size % 2)
        yield begin, begin + 8, stop, ()
        if data[begin : begin + 4] == b"LIST":
            yield from _chunks(data, begin + 12, stop)
        begin = stop
