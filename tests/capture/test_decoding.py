"""What is read from a video file, and what is refused."""

import os
import random
import struct
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
from PIL import Image
from videos import grey_levels, save_sound, save_video

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling, _Decoder, _Scan, _Source, video_frames


def test_every_third_picture_of_thirty_per_second(tmp_path: Path) -> None:
    path = save_video(tmp_path / "a.mp4", grey_levels(30))
    frames = list(video_frames(path, Sampling(fps=10.0)))
    assert [frame.index for frame in frames] == list(range(0, 30, 3))
    assert np.allclose([frame.time for frame in frames], np.arange(10) / 10, atol=1e-3)
    levels = [float(frame.image[90:, :, 2].mean()) for frame in frames]
    # Limited-range YUV and compression move a grey by a few steps.
    assert np.allclose(levels, [4 * frame.index for frame in frames], atol=6)


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv", "a.avi", "a.ts"])
def test_common_containers_open(tmp_path: Path, name: str) -> None:
    path = save_video(tmp_path / name, grey_levels(6))
    assert len(list(video_frames(path, Sampling(fps=30.0)))) == 6


def test_an_animated_picture_is_a_video(tmp_path: Path) -> None:
    pictures = [Image.fromarray(image) for image in grey_levels(6)]
    path = tmp_path / "a.gif"
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=100, loop=0)
    frames = list(video_frames(path, Sampling(fps=10.0)))
    assert [round(frame.time, 3) for frame in frames] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert [int(frame.image[90, 80, 2]) for frame in frames] == pytest.approx(
        [4 * number for number in range(6)], abs=3
    )


def test_stops_at_the_greatest_number_of_pictures(tmp_path: Path) -> None:
    path = save_video(tmp_path / "a.mp4", grey_levels(20))
    assert len(list(video_frames(path, Sampling(30.0, max_frames=4)))) == 4


def test_times_that_jump_are_no_endless_film(tmp_path: Path) -> None:
    """Every moment between two frames was looked at: here 30,000 years of them."""
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height = 160, 120
        for number, image in enumerate(grey_levels(4)):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = number
            for packet in stream.encode(frame):
                if number == 3:
                    packet.pts = packet.dts = 10**12 * 30
                container.mux(packet)
    begin = time.process_time()
    frames = list(video_frames(path, Sampling(fps=30.0)))
    assert [frame.index for frame in frames] == [0, 1, 2, 3] and frames[3].time > 1e11
    assert time.process_time() - begin < 5.0


def test_pictures_that_become_too_large_are_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A small file made 2 GB of them: its first pictures were as large as the file says."""
    monkeypatch.setattr("handavatar.capture.decoding.MAX_PIXELS", 30_000)
    small = save_video(tmp_path / "small.ts", grey_levels(6), codec="mpeg2video")
    assert len(list(video_frames(small, Sampling(fps=30.0)))) == 6
    large = save_video(tmp_path / "large.ts", grey_levels(6, (320, 240)), codec="mpeg2video")
    (tmp_path / "both.ts").write_bytes(small.read_bytes() + large.read_bytes())
    assert "breaks off" in _refusal(tmp_path / "both.ts")


def test_damaged_files_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """PyAV printed tracebacks of seeks to places before the beginning."""
    with (tmp_path / "a.bin").open("wb+") as file:
        source = _Source(file)
        assert source.seek(-5) < 0 and source.seek(-1, os.SEEK_CUR) < 0
        assert source.seek(7) == 7 and source.tell() == 7
    whole = save_video(tmp_path / "a.avi", grey_levels(6)).read_bytes()
    chance = random.Random(0)
    for _ in range(30):
        damaged = bytearray(whole)
        for _ in range(3):
            place = chance.randrange(len(damaged) - 8)
            damaged[place : place + 8] = chance.choice((b"\xff" * 8, bytes(8)))
        (tmp_path / "a.avi").write_bytes(damaged)
        with suppress(CaptureError):
            list(video_frames(tmp_path / "a.avi"))
    assert capfd.readouterr().err == ""


def test_pictures_of_an_unknown_kind_are_refused(tmp_path: Path) -> None:
    path = save_video(tmp_path / "a.mp4", grey_levels(3))
    content = path.read_bytes()
    assert content.count(b"mp4v") == 1
    path.write_bytes(
        content.replace(b"mp4v", b"xyzw").replace(b"\x04\x80\x80\x80", b"\x05\x80\x80\x80")
    )
    assert "compressed in a way that is not known" in _refusal(path)


@pytest.mark.parametrize("seed", range(20))
def test_the_frames_nearest_to_the_wanted_times_are_taken(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if every wanted time were looked at by itself."""
    chance = random.Random(seed)
    times = sorted(chance.choice((0.1, 1.0)) * chance.randrange(40) / 10 for _ in range(12))
    times = [time - times[0] for time in times]
    end = chance.choice((None, 2.0))
    sampling = Sampling(chance.choice((0.7, 3.0, 30.0)), start=chance.choice((0.0, 0.5)), end=end)
    wanted, number = [], 0
    while (at := sampling.wanted(number)) <= times[-1] + 1e-6 and not sampling.is_over(at):
        after = next(place for place, time in enumerate(times) if time >= at - 1e-6)
        before = max(after - 1, 0)
        is_nearer = at - times[before] <= times[after] - at + 1e-6
        wanted.append(before if is_nearer else after)
        number += 1
    stream, scan = SimpleNamespace(average_rate=30), _Scan((160, 120), 1, 4.0, 4.0, None)
    decoder = _Decoder(tmp_path, None, stream, scan, sampling, print)
    decoded = [(place, time, None) for place, time in enumerate(times)]
    monkeypatch.setattr(decoder, "decoded", lambda: iter(decoded))
    found = [index for index, _, _ in decoder.wanted()]
    expected = [index for index in dict.fromkeys(wanted) if not sampling.is_over(times[index])]
    # The last frame is taken besides if the next time is less than half a frame away.
    assert found in (expected, [*expected, len(times) - 1])


def test_large_pictures_are_brought_down(tmp_path: Path) -> None:
    path = save_video(tmp_path / "a.mp4", grey_levels(2, size=(2400, 1200)))
    assert next(video_frames(path)).image.shape == (960, 1920, 3)


def test_the_phone_s_rotation_is_undone(tmp_path: Path) -> None:
    path = save_video(tmp_path / "a.mp4", grey_levels(6))
    content = bytearray(path.read_bytes())
    # tkhd version 0: size, type, version and flags, 36 bytes of times, ids and layers, the matrix.
    matrix = content.index(b"tkhd") + 4 + 4 + 36
    # A phone held upright: the player turns the picture clockwise by a quarter.
    quarter = (0, 1 << 16, 0, -1 << 16, 0, 0, 120 << 16, 0, 1 << 30)
    content[matrix : matrix + 36] = struct.pack(">9i", *quarter)
    path.write_bytes(content)
    image = next(video_frames(path)).image
    assert image.shape == (160, 120, 3)
    # The red upper half of the stored picture ends up on the right.
    assert image[:, 70:, 0].min() > 200
    assert image[:, :50, 0].max() < 60


def _refusal(path: Path) -> str:
    with pytest.raises(CaptureError) as caught:
        list(video_frames(path))
    assert caught.value.remedy
    return str(caught.value)


def test_refuses_what_is_no_video(tmp_path: Path) -> None:
    assert "no such file" in _refusal(tmp_path / "none.mp4")
    empty = tmp_path / "empty.mp4"
    empty.touch()
    assert "empty" in _refusal(empty)
    text = tmp_path / "text.mp4"
    text.write_text("this is a letter, not a video\n" * 100)
    assert "not a video" in _refusal(text)
    assert "no pictures, only audio" in _refusal(save_sound(tmp_path / "sound.mp4"))
    small = save_video(tmp_path / "small.mp4", grey_levels(3, size=(64, 48)))
    assert "64 x 48" in _refusal(small)


def test_refuses_playlists_and_other_containers(tmp_path: Path) -> None:
    good = save_video(tmp_path / "good.mp4", grey_levels(3))
    playlist = tmp_path / "list.mp4"
    playlist.write_text(f"#EXTM3U\n#EXTINF:1,\n{good}\n#EXT-X-ENDLIST\n")
    assert "not a video" in _refusal(playlist)
    assert "not a video" in _refusal(save_video(tmp_path / "a.nut", grey_levels(3)))


def test_refuses_files_cut_short(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    noise = [generator.integers(0, 256, (120, 160, 3), dtype=np.uint8) for _ in range(60)]
    content = save_video(tmp_path / "whole.mp4", noise).read_bytes()
    without_index = tmp_path / "half.mp4"
    without_index.write_bytes(content[: len(content) // 2])
    assert "not a video" in _refusal(without_index)
    whole = save_video(tmp_path / "whole.mkv", noise).read_bytes()
    half = tmp_path / "half.mkv"
    half.write_bytes(whole[: len(whole) // 2])
    assert "breaks off" in _refusal(half)
