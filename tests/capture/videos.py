"""Small video files for tests, and the way to the real one."""

from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np
import pytest

REAL_VIDEO = Path(__file__).parents[3] / "shared/data/real_hand/human_hand_video.mp4"

CASES = Path(__file__).parents[3] / "shared/cases/video"

needs_cases = pytest.mark.skipif(
    not CASES.is_dir(), reason=f"{CASES} is only in the development folder"
)

needs_real_video = pytest.mark.skipif(
    not REAL_VIDEO.is_file(), reason=f"{REAL_VIDEO} is only in the development folder"
)


def save_video(
    path: Path, images: Iterable[np.ndarray], fps: int = 30, codec: str = "mpeg4"
) -> Path:
    """Writes pictures as a video; the container follows from the name."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=fps)
        stream.bit_rate = 8_000_000
        for number, image in enumerate(images):
            if number == 0:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def save_sound(path: Path) -> Path:
    """Writes half a second of silence."""
    with av.open(str(path), "w") as container:
        add_silence(container, container.add_stream("aac", rate=16000, layout="mono"), 0.5)
    return path


def add_silence(
    container: av.container.OutputContainer, stream: av.audio.stream.AudioStream, seconds: float
) -> None:
    """Fills a stream of 16,000 samples a second, and ends it."""
    for start in range(0, round(16000 * seconds), 1000):
        frame = av.AudioFrame.from_ndarray(
            np.zeros((1, 1000), dtype=np.float32), format="fltp", layout="mono"
        )
        frame.sample_rate, frame.pts = 16000, start
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def grey_levels(count: int, size: tuple[int, int] = (160, 120)) -> list[np.ndarray]:
    """Pictures that grow brighter by 4 of 255 each, upper half red."""
    images = []
    for number in range(count):
        image = np.full((size[1], size[0], 3), 4 * number, dtype=np.uint8)
        image[: size[1] // 2, :, 0] = 255
        images.append(image)
    return images
