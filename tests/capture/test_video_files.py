"""Every kind of file that cameras write gives the right picture, or a right refusal."""

import io
import math
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from priorities import is_ordinary, ordinary_afterwards
from videos import CASES, add_silence, needs_cases, save_sound

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling, VideoFrame, video_frames

PATCH, COLUMNS, ROWS = 40, 4, 3
SIZE = (COLUMNS * PATCH, ROWS * PATCH)
# Skins, and colours in the corners of the range.
COLORS = np.array(
    [
        [[224, 172, 105], [241, 206, 162], [141, 85, 36], [60, 35, 20]],
        [[200, 40, 40], [40, 160, 60], [50, 80, 200], [128, 128, 128]],
        [[20, 20, 20], [235, 235, 235], [180, 160, 40], [120, 60, 140]],
    ]
)


def painted() -> np.ndarray:
    return COLORS.repeat(PATCH, 0).repeat(PATCH, 1).astype(np.uint8)


def seen_colors(image: np.ndarray) -> np.ndarray:
    """The middle of every patch, whatever the size of the picture."""
    height, width = image.shape[:2]
    rows = ((np.arange(ROWS) + 0.5) * height / ROWS).astype(int)
    columns = ((np.arange(COLUMNS) + 0.5) * width / COLUMNS).astype(int)
    around = [
        image[row - 3 : row + 4, column - 3 : column + 4].reshape(-1, 3).mean(0)
        for row in rows
        for column in columns
    ]
    return np.array(around).reshape(ROWS, COLUMNS, 3)


# The way into a file, as cameras go it; written down here from the standards.
_XY = {
    1: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    5: ((0.64, 0.33), (0.29, 0.60), (0.15, 0.06)),
    6: ((0.63, 0.34), (0.31, 0.595), (0.155, 0.07)),
    9: ((0.708, 0.292), (0.17, 0.797), (0.131, 0.046)),
    12: ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06)),
}
_KR_KB = {1: (0.2126, 0.0722), 4: (0.3, 0.11), 5: (0.299, 0.114), 6: (0.299, 0.114)}
_KR_KB |= {7: (0.212, 0.087), 9: (0.2627, 0.0593)}


def _xyz(primaries: int) -> np.ndarray:
    matrix = np.array([[x, y, 1 - x - y] for x, y in _XY[primaries]]).T
    white = np.array([0.3127 / 0.329, 1, (1 - 0.3127 - 0.329) / 0.329])
    return matrix * np.linalg.solve(matrix, white)


def _signal(light: np.ndarray, transfer: int) -> np.ndarray:
    if transfer == 16:
        nits = (light * 203 / 10000) ** 0.1593017578125
        return ((0.8359375 + 18.8515625 * nits) / (1 + 18.6875 * nits)) ** 78.84375
    if transfer == 18:
        display = light * 0.203
        luminance = display @ np.array([0.2627, 0.678, 0.0593])
        scene = display * luminance[..., None] ** (1 / 1.2 - 1)
        high = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
        return np.where(scene <= 1 / 12, np.sqrt(3 * scene), high)
    if transfer in (4, 5):
        return light ** (1 / {4: 2.2, 5: 2.8}[transfer])
    if transfer == 8:
        return light
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def signal_of(srgb: np.ndarray, primaries: int, transfer: int) -> np.ndarray:
    value = srgb / 255
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    if primaries != 2:
        light = (light @ _xyz(1).T @ np.linalg.inv(_xyz(primaries)).T).clip(0)
    return _signal(light, transfer)


def planes_of(signal: np.ndarray, matrix: int, is_full: bool) -> np.ndarray:
    """Y, Cb and Cr of 16 bits whose upper eight are those of pictures of eight bits."""
    if matrix == 8:
        luma = signal @ np.array([0.25, 0.5, 0.25])
        blue = signal @ np.array([-0.25, 0.5, -0.25])
        red = signal @ np.array([0.5, 0, -0.5])
    else:
        kr, kb = _KR_KB[matrix]
        luma = signal @ np.array([kr, 1 - kr - kb, kb])
        blue = (signal[..., 2] - luma) / (2 * (1 - kb))
        red = (signal[..., 0] - luma) / (2 * (1 - kr))
    if is_full:
        levels = [luma * 255, blue * 255 + 128, red * 255 + 128]
    else:
        levels = [luma * 219 + 16, blue * 224 + 128, red * 224 + 128]
    return (256 * np.stack(levels, -1)).round().clip(0, 65535).astype(np.uint16)


@dataclass(frozen=True)
class Kind:
    """A file to be written."""

    name: str
    codec: str = "libx264"
    pixels: str = "yuv420p"
    matrix: int = 1
    is_full: bool = False
    primaries: int = 1
    transfer: int = 1
    is_tagged: bool = True
    tolerance: float = 3.0

    def __str__(self) -> str:
        return self.name


_TAGS = [
    Kind(
        f"tags-{matrix}-{'full' if is_full else 'limited'}.mp4",
        "libx264",
        "yuv444p",
        matrix,
        is_full,
    )
    for matrix in (1, 4, 5, 6, 7, 8, 9)
    for is_full in (False, True)
]
_PIXELS = [
    Kind("420.mp4"),
    Kind("422.mp4", pixels="yuv422p"),
    Kind("j420.mp4", pixels="yuvj420p", is_full=True),
    Kind("nv12.mp4", pixels="nv12"),
    Kind("420-10.mp4", pixels="yuv420p10le"),
    Kind("422-10.mp4", pixels="yuv422p10le"),
    Kind("444-10.mp4", pixels="yuv444p10le"),
    Kind("444-10-full.mp4", pixels="yuv444p10le", is_full=True),
    Kind("hevc.mp4", "libx265"),
    Kind("hevc-10.mov", "libx265", "yuv420p10le"),
    Kind("hevc-12.mkv", "libx265", "yuv420p12le"),
    Kind("hevc-rgb.mkv", "libx265", "gbrp"),
    Kind("alpha.mkv", "ffv1", "yuva444p"),
    Kind("rgb.mov", "qtrle", "rgb24"),
    Kind("png.mov", "png", "rgb24"),
    Kind("deep-png.mov", "png", "rgb48be"),
]
_CONTAINERS = [
    Kind("h264.mov"),
    Kind("h264.mkv"),
    Kind("h264.ts"),
    Kind("h264.flv"),
    Kind("mpeg4.mp4", "mpeg4"),
    Kind("mpeg4.avi", "mpeg4", is_tagged=False, matrix=6),
    Kind("mjpeg.avi", "mjpeg", "yuvj420p", matrix=6, is_full=True, is_tagged=False, tolerance=4),
    Kind("mjpeg.mov", "mjpeg", "yuvj444p", matrix=6, is_full=True, is_tagged=False),
    Kind("mpeg2.ts", "mpeg2video", tolerance=4),
    Kind("mpeg2.mpg", "mpeg2video", tolerance=4),
    Kind("vp8.webm", "libvpx", is_tagged=False, matrix=6, tolerance=4),
    Kind("vp9.webm", "libvpx-vp9", tolerance=4),
    Kind("vp9-444.webm", "libvpx-vp9", "yuv444p"),
    Kind("av1.mp4", "libsvtav1", tolerance=5),
    Kind("av1-10.webm", "libsvtav1", "yuv420p10le", tolerance=5),
    Kind("prores.mov", "prores_ks", "yuv422p10le"),
    Kind("ffv1.mkv", "ffv1", "yuv444p"),
    Kind("wmv.asf", "wmv2", is_tagged=False, matrix=6, tolerance=4),
    Kind("untagged-small.mp4", is_tagged=False, matrix=6),
]
_LIGHT = [
    Kind("pq.mp4", "libx265", "yuv420p10le", 9, False, 9, 16),
    Kind("pq.mkv", "libx265", "yuv444p10le", 9, True, 9, 16),
    Kind("hlg.mov", "libx265", "yuv420p10le", 9, False, 9, 18),
    Kind("hlg.webm", "libvpx-vp9", "yuv444p", 9, False, 9, 18, tolerance=7),
    Kind("hlg-709.mp4", "libx264", "yuv444p10le", 1, False, 1, 18),
    Kind("p3.mov", "libx265", "yuv420p10le", 1, False, 12, 1),
    Kind("p3-srgb.mp4", "libx264", "yuv444p", 1, True, 12, 13),
    Kind("wide.mp4", "libx265", "yuv444p10le", 9, False, 9, 14),
    Kind("pal.mp4", "libx264", "yuv444p", 5, False, 5, 6),
    Kind("ntsc.mp4", "libx264", "yuv444p", 6, False, 6, 6),
    Kind("gamma22.mp4", "libx264", "yuv444p10le", 1, False, 1, 4),
    Kind("gamma28.mp4", "libx264", "yuv444p10le", 1, False, 1, 5),
    Kind("linear.mkv", "ffv1", "yuv444p16le", 1, True, 1, 8),
]
KINDS = [*_TAGS, *_PIXELS, *_CONTAINERS, *_LIGHT]


def stored(kind: Kind, srgb: np.ndarray) -> av.VideoFrame:
    """A frame as the encoder takes it."""
    is_rgb = kind.pixels.startswith(("rgb", "gbr", "pal"))
    signal = signal_of(srgb.astype(float), kind.primaries, kind.transfer)
    if is_rgb:
        levels = (65535 * signal).round().astype(np.uint16)
        frame = av.VideoFrame.from_ndarray(levels, format="rgb48le").reformat(format=kind.pixels)
    else:
        planes = planes_of(signal, kind.matrix, kind.is_full)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv444p16le")
        same = 2 if kind.is_full else 1
        frame = frame.reformat(format=kind.pixels, src_color_range=same, dst_color_range=same)
    frame.color_range = 2 if kind.is_full or is_rgb else 1
    if kind.is_tagged and not is_rgb:
        frame.colorspace = kind.matrix
        frame.color_primaries, frame.color_trc = kind.primaries, kind.transfer
    return frame


def write(path: Path, kind: Kind, pictures: list[np.ndarray], rate: int = 25) -> Path:
    with ordinary_afterwards(), av.open(str(path), "w") as container:
        stream = container.add_stream(kind.codec, rate=rate)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = kind.pixels
        context = stream.codec_context
        if kind.codec in ("libx264", "libx265", "libvpx-vp9"):
            stream.options = {"crf": "4"}
        elif kind.codec == "libsvtav1":
            stream.options = {"preset": "12", "svtav1-params": "crf=10"}
        else:
            context.bit_rate = 20_000_000
        if kind.codec == "libx265":
            stream.options |= {"x265-params": "log-level=none"}
        if kind.codec in ("libvpx", "libvpx-vp9"):
            stream.options |= {"deadline": "realtime", "cpu-used": "4"}
        if kind.codec in ("mpeg4", "mpeg2video", "wmv2", "mjpeg"):
            context.qmin = context.qmax = 2
        is_rgb = kind.pixels.startswith(("rgb", "gbr", "pal"))
        context.color_range = 2 if kind.is_full or is_rgb else 1
        if kind.is_tagged and not is_rgb:
            context.colorspace = kind.matrix
            context.color_primaries, context.color_trc = kind.primaries, kind.transfer
        for number, picture in enumerate(pictures):
            frame = stored(kind, picture)
            frame.pts, frame.time_base = number, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def test_writing_av1_leaves_the_process_an_ordinary_one(tmp_path: Path) -> None:
    """Without care it would keep the cores from all else, and so would what it starts."""
    (kind,) = (kind for kind in KINDS if kind.name == "av1.mp4")
    write(tmp_path / kind.name, kind, [painted()])
    assert is_ordinary()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_colours_are_those_that_were_filmed(tmp_path: Path, kind: Kind) -> None:
    path = write(tmp_path / kind.name, kind, [painted()] * 4)
    notes: list[str] = []
    frames = list(video_frames(path, Sampling(25.0), notes.append))
    assert len(frames) == 4
    assert frames[0].image.shape == (SIZE[1], SIZE[0], 3)
    found = seen_colors(frames[1].image)
    is_high = kind.transfer in (16, 18)
    # Beyond three quarters of white, light makes room for what is brighter than white.
    tolerance = kind.tolerance + 4 * is_high
    assert np.abs(found - COLORS).max() <= tolerance, found - COLORS
    assert any("HLG" in note or "PQ" in note for note in notes) == is_high


def test_there_are_sixty_kinds_of_files() -> None:
    assert len({kind.name for kind in KINDS}) == len(KINDS) >= 60


_ONE = 1 << 16
# Display matrices as mp4 has them (right and down become a right + c down, b right + d down), and
# what becomes of a picture.
_MATRICES = {
    "upright": ((_ONE, 0, 0, _ONE), lambda p: p),
    "quarter": ((0, _ONE, -_ONE, 0), lambda p: np.rot90(p, -1)),
    "half": ((-_ONE, 0, 0, -_ONE), lambda p: np.rot90(p, 2)),
    "three-quarters": ((0, -_ONE, _ONE, 0), lambda p: np.rot90(p, 1)),
    "mirrored": ((-_ONE, 0, 0, _ONE), lambda p: p[:, ::-1]),
    "upside-down": ((_ONE, 0, 0, -_ONE), lambda p: p[::-1]),
    "transposed": ((0, _ONE, _ONE, 0), lambda p: p.transpose(1, 0, 2)),
    "other-diagonal": ((0, -_ONE, -_ONE, 0), lambda p: np.rot90(p, 2).transpose(1, 0, 2)),
}


@pytest.mark.parametrize("name", _MATRICES)
def test_the_whole_display_matrix_is_applied(tmp_path: Path, name: str) -> None:
    (a, b, c, d), shown = _MATRICES[name]
    path = write(tmp_path / "a.mp4", Kind("a"), [painted()] * 2)
    content = bytearray(path.read_bytes())
    # tkhd version 0: size, type, version and flags, 36 bytes of times, ids and layers, the matrix.
    start = content.index(b"tkhd") + 4 + 4 + 36
    content[start : start + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    notes: list[str] = []
    frame = next(video_frames(path, Sampling(25.0), notes.append))
    expected = shown(painted())
    assert frame.image.shape == expected.shape
    assert np.abs(frame.image.astype(int) - expected).mean() < 4
    is_mirrored = a * d - b * c < 0
    assert any("mirrored" in note for note in notes) == is_mirrored


@pytest.mark.parametrize(
    ("ratio", "size"),
    [((4, 3), (213, 120)), ((3, 4), (160, 160)), ((2, 1), (320, 120)), ((1, 1), (160, 120))],
)
def test_pixels_become_square(
    tmp_path: Path, ratio: tuple[int, int], size: tuple[int, int]
) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height = SIZE
        stream.codec_context.sample_aspect_ratio = Fraction(*ratio)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(painted(), format="rgb24")))
        container.mux(stream.encode(None))
    image = next(video_frames(path)).image
    assert (image.shape[1], image.shape[0]) == size
    assert np.abs(seen_colors(image) - COLORS).max() < 8


def write_times(path: Path, times: list[float], codec: str = "libx264") -> Path:
    """Frames at certain times, whose grey is their number; written in milliseconds."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=1000)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, time in enumerate(times):
            image = np.full((SIZE[1], SIZE[0], 3), number, dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = round(1000 * time), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


_RATES = {
    "25-to-10": np.arange(50) / 25,
    "24-to-10": np.arange(48) / 24,
    "60-to-10": np.arange(120) / 60,
    "dropped": np.delete(np.arange(60) / 30, [7, 8, 9, 20, 21, 41]),
    "slowing": np.cumsum(np.linspace(0.01, 0.09, 40)) - 0.01,
    "unsteady": np.cumsum(0.02 + 0.03 * np.sin(np.arange(60)) ** 2) - 0.02,
}


@pytest.mark.parametrize("name", _RATES)
@pytest.mark.parametrize("container", ["mp4", "mkv"])
def test_the_frame_nearest_to_each_time_is_taken(tmp_path: Path, name: str, container: str) -> None:
    times = _RATES[name].round(3)
    path = write_times(tmp_path / f"a.{container}", list(times))
    frames = list(video_frames(path, Sampling(10.0)))
    wanted = np.arange(0, times[-1] + 1e-6, 0.1)
    found = [frame.index for frame in frames]
    assert found == sorted(set(found))
    assert np.allclose([frame.time for frame in frames], times[found], atol=2e-3)
    # No time has a nearer frame than one that is taken, and no frame is taken for nothing.
    apart = np.abs(times[:, None] - wanted)
    assert np.allclose(apart[found].min(0), apart.min(0), atol=2e-3)
    assert len(found) <= len(wanted) + 1


def test_a_part_is_taken_and_what_is_not_looked_at_is_said(tmp_path: Path) -> None:
    path = write_times(tmp_path / "a.mp4", list(np.arange(50) / 25))
    frames = list(video_frames(path, Sampling(25.0, start=0.4, end=1.0)))
    assert [frame.index for frame in frames] == list(range(10, 26))
    assert frames[0].time == pytest.approx(0.4)
    notes: list[str] = []
    assert len(list(video_frames(path, Sampling(10.0, max_frames=5), notes.append))) == 5
    assert len(notes) == 1 and "1.5 s after that were not looked at" in notes[0]
    notes.clear()
    list(video_frames(path, Sampling(10.0), notes.append))
    assert notes == []
    with pytest.raises(CaptureError, match=r"`start=7` lies behind its end at 2\.0 seconds"):
        list(video_frames(path, Sampling(10.0, start=7.0)))


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"fps": 0.0}, "`fps`: found 0"),
        ({"fps": math.nan}, "`fps`: found nan"),
        ({"max_frames": 0}, "`max_frames`: found 0"),
        ({"start": -1.0}, "`start`: found -1"),
        ({"start": 3.0, "end": 3.0}, "`end`: found 3, expected more than `start=3`"),
    ],
)
def test_what_selects_nothing_is_refused(wrong: dict[str, float], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        Sampling(**wrong)  # type: ignore[arg-type]


def test_sound_that_is_longer_is_no_fault(tmp_path: Path) -> None:
    for name in ("a.mp4", "a.mkv"):
        path = tmp_path / name
        with av.open(str(path), "w") as container:
            pictures = container.add_stream("libx264", rate=25)
            pictures.width, pictures.height = SIZE
            sound = container.add_stream("aac", rate=16000, layout="mono")
            for _ in range(10):
                frame = av.VideoFrame.from_ndarray(painted(), format="rgb24")
                container.mux(pictures.encode(frame))
            container.mux(pictures.encode(None))
            add_silence(container, sound, 3.0)
        assert len(list(video_frames(path, Sampling(25.0)))) == 10


def test_a_cover_is_no_video(tmp_path: Path) -> None:
    sound = save_sound(tmp_path / "sound.mp4")
    cover = io.BytesIO()
    Image.fromarray(painted()).save(cover, "JPEG")
    path = tmp_path / "song.mp4"
    with av.open(str(sound)) as source, av.open(str(path), "w") as container:
        stream = container.add_stream_from_template(source.streams.audio[0])
        picture = container.add_stream("mjpeg", rate=25)
        picture.width, picture.height, picture.pix_fmt = *SIZE, "yuvj420p"
        picture.disposition = av.stream.Disposition.attached_pic
        container.start_encoding()
        packet = av.Packet(cover.getvalue())
        packet.stream, packet.pts, packet.dts = picture, 0, 0
        packet.is_keyframe = True
        container.mux(packet)
        for packet in source.demux():
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)
    with pytest.raises(CaptureError, match="only a cover and audio"):
        list(video_frames(path))


def test_sizes_that_change_are_brought_to_the_largest(tmp_path: Path) -> None:
    """As calls write them when the network is slow: one stream, several resolutions."""
    parts = []
    for number, scale in enumerate((1, 2, 1)):
        picture = painted().repeat(scale, 0).repeat(scale, 1)
        parts.append(write(tmp_path / f"{number}.ts", Kind("a"), [picture] * 10))
    path = tmp_path / "all.ts"
    with av.open(str(path), "w") as container:
        with av.open(str(parts[0])) as source:
            stream = container.add_stream_from_template(source.streams.video[0])
        start = 0
        for part in parts:
            with av.open(str(part)) as source:
                packets = [p for p in source.demux(video=0) if p.pts is not None]
                first = min(packet.dts for packet in packets)
                for packet in packets:
                    packet.pts += start - first
                    packet.dts += start - first
                    packet.stream = stream
                    container.mux(packet)
                start += 10 * 3600
    notes: list[str] = []
    frames = list(video_frames(path, Sampling(25.0), notes.append))
    assert len(frames) == 30
    assert {frame.image.shape for frame in frames} == {(240, 320, 3)}
    assert all(np.abs(seen_colors(frame.image) - COLORS).max() < 5 for frame in frames)
    assert any("2 sizes" in note and "320 x 240" in note for note in notes)


def test_grey_and_interlaced_pictures_are_read_and_said(tmp_path: Path) -> None:
    grey = painted().mean(-1, keepdims=True).repeat(3, -1).astype(np.uint8)
    path = tmp_path / "grey.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "gray"
        frame = av.VideoFrame.from_ndarray(grey, format="rgb24").reformat(format="gray")
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    notes: list[str] = []
    frame = next(iter(list(video_frames(path, None, notes.append))))
    assert np.abs(frame.image.astype(int) - grey).max() <= 2
    assert any("grey" in note for note in notes)

    woven = painted()
    woven[1::2] = 0
    path = tmp_path / "woven.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv444p"
        stream.options = {"crf": "4", "x264-params": "interlaced=1"}
        stream.codec_context.flags |= av.codec.context.Flags.interlaced_dct
        frame = av.VideoFrame.from_ndarray(woven, format="rgb24")
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    notes.clear()
    frames = list(video_frames(path, None, notes.append))
    assert any("interlaced" in note for note in notes)
    assert np.abs(seen_colors(frames[0].image) - COLORS).max() < 6


@needs_cases
@pytest.mark.parametrize("name", ["c_hlg10.mp4", "c_pq10.mp4"])
def test_a_phone_s_skin_is_read_as_it_was(name: str) -> None:
    image = next(video_frames(CASES / name)).image
    assert np.abs(image[40, 200].astype(int) - (224, 172, 105)).max() <= 2


@needs_cases
def test_given_files_are_read(tmp_path: Path) -> None:
    def read(name: str, fps: float = 10.0) -> tuple[list[VideoFrame], list[str]]:
        notes: list[str] = []
        return list(video_frames(CASES / name, Sampling(fps), notes.append)), notes

    assert len(read("held_last.mp4", 30.0)[0]) == 45
    assert len(read("long_audio.mkv", 30.0)[0]) == 45
    assert len(read("video-latin1-title.mp4", 10.0)[0]) == 12
    slow, _ = read("v_mp4_slowdown.mp4")
    assert np.diff([frame.time for frame in slow]).max() < 0.21
    wide, notes = read("sar43.mp4")
    assert wide[0].image.shape == (720, 1280, 3) and "1.33 times as wide" in notes[0]
    mirrored, notes = read("hflip_matrix15.mp4")
    assert "mirrored" in notes[0]
    # Of the same film, by the way it was made.
    assert np.abs(mirrored[0].image.astype(int) - wide[0].image).mean() < 6
