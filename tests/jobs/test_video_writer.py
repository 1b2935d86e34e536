"""Films that are written say which colours they have, and are the same each time."""

import subprocess
import sys
import time
from pathlib import Path

import av
import numpy as np
import pytest

from handavatar.capture.decoding import Sampling, video_frames
from handavatar.jobs.video_writer import VideoWriter


def _moving(number: int) -> np.ndarray:
    rows, columns = np.mgrid[:240, :320]
    image = np.stack([rows, columns, rows + columns], axis=-1) + 12 * number
    image[60:120, 20 + 5 * number : 80 + 5 * number] = (224, 172, 105)
    return (image % 256).astype(np.uint8)


def _write(path: Path) -> Path:
    with VideoWriter(path, 12.5, 240, 320) as writer:
        for number in range(20):
            writer.add(_moving(number))
    return path


def test_a_film_is_bt709_and_says_so(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mp4")
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        tags = context.colorspace, context.color_primaries, context.color_trc
        assert [int(tag) for tag in tags] == [1, 1, 1] and int(context.color_range) == 1
    frames = list(video_frames(path, Sampling(12.5)))
    assert len(frames) == 20 and frames[-1].time == 19 / 12.5
    assert np.abs(frames[7].image[90, 85].astype(int) - (224, 172, 105)).max() <= 3


def test_the_same_pictures_give_the_same_film(tmp_path: Path) -> None:
    first = _write(tmp_path / "a.mp4").read_bytes()
    assert first == _write(tmp_path / "b.mp4").read_bytes()


@pytest.mark.slow
def test_another_process_on_one_core_writes_the_same_film_at_another_time(tmp_path: Path) -> None:
    first = _write(tmp_path / "a.mp4").read_bytes()
    program = (
        "import os, sys\n"
        "if hasattr(os, 'sched_setaffinity'):\n"
        "    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from pathlib import Path; from test_video_writer import _write\n"
        f"_write(Path({str(tmp_path / 'other.mp4')!r}))"
    )
    time.sleep(1.1)  # Films may say when they were made, to the second.
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
    assert (tmp_path / "other.mp4").read_bytes() == first


def test_odd_sizes_lose_a_row_and_a_column(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", 10.0, 121, 131) as writer:
        writer.add(_moving(0)[:121, :131])
    assert next(video_frames(tmp_path / "a.mp4")).image.shape == (120, 130, 3)
