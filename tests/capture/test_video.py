"""A video becomes a capture."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage
from videos import REAL_VIDEO, grey_levels, needs_real_video, save_video

from handavatar.capture.checks import CaptureError
from handavatar.capture.fitting import FitOptions
from handavatar.capture.frames import find_problems
from handavatar.capture.video import VideoOptions, capture_video, held_out_splits
from handavatar.geometry.cameras import project
from handavatar.hand.open_hand import load_open_hand


@pytest.mark.parametrize("count", [8, 30, 207, 600])
def test_two_blocks_of_time_are_held_out(count: int) -> None:
    splits = held_out_splits(count)
    assert len(splits) == count and set(splits) == {"train", "test"}
    assert 0.15 <= splits.count("test") / count <= 0.3
    changes = sum(a != b for a, b in pairwise(splits))
    assert changes == 4 and splits[0] == splits[-1] == "train"


def test_a_video_without_a_hand_leaves_nothing_behind(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe")
    video = save_video(tmp_path / "wall.mp4", grey_levels(12))
    with pytest.raises(CaptureError, match="a hand was found in 0 of 4"):
        capture_video(VideoOptions(video, tmp_path / "out"))
    assert [path.name for path in tmp_path.iterdir()] == ["wall.mp4"]


def test_a_folder_in_use_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(CaptureError, match="not empty"):
        capture_video(VideoOptions(tmp_path / "no.mp4", tmp_path))
    assert (tmp_path / "mine.txt").read_text() == "keep me"


@pytest.mark.real
@needs_real_video
def test_the_real_hand_becomes_a_sound_capture(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe")
    told: list[float] = []
    options = VideoOptions(
        REAL_VIDEO,
        tmp_path / "out",
        max_frames=10,
        fit=FitOptions(landmark_steps=120, outline_steps=90, retry_steps=20),
    )
    capture = capture_video(options, progress=lambda share, doing: told.append(share))
    assert find_problems(capture.folder) == []
    assert capture.side == "right" and len(capture.records) == 10
    assert told == sorted(told) and told[-1] == 1.0
    assert json.loads((capture.folder / "skipped.json").read_text()) == {}
    fit = json.loads((capture.folder / "fit.json").read_text())
    assert fit["mean_mask_iou"] > 0.88
    assert fit["mean_landmark_error_pixels"] < 6
    assert Image.open(capture.folder / "overview.png").size[0] > 1000

    hand = load_open_hand().shaped(capture.shape_coefficients)
    frame = capture.frame(0)
    # The mean hand is 184 mm from wrist to fingertip; nobody's is a quarter off.
    assert 0.14 < float(hand.rest_vertices[:, 0].abs().max()) < 0.23
    vertices, depth = project(frame.camera, hand.posed(frame.pose).vertices)
    assert 0.4 < float(depth.mean()) < 1.5
    x, y = vertices.round().long().clamp(0, 255).unbind(-1)
    near = torch.from_numpy(ndimage.binary_dilation(frame.mask.numpy(), iterations=4))
    assert near[y, x].float().mean() > 0.95
    # A box of 1.3 times the hand: the mask touches no side and fills the middle.
    rows, columns = np.nonzero(frame.mask.numpy())
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    assert 0.7 < extent / 256 < 0.85
