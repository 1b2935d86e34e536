"""A user's own video in one command: capture, avatar, figures, films and edits of that hand."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from conftest import TINY
from moving_hand import FOCAL, FPS, HEIGHT, WIDTH, TruthfulFinder, make_moving_hand
from PIL import Image

from handavatar import demo
from handavatar.avatar import HandAvatar
from handavatar.capture.fitting import FitOptions
from handavatar.capture.frames import Capture, read_capture
from handavatar.capture.video import VideoOptions, capture_video
from handavatar.demo import DemoOptions, run_demo
from handavatar.fit.register import RegisterOptions
from handavatar.jobs.progress import Progress
from handavatar.train.loop import METHODS


@pytest.mark.slow
def test_a_video_becomes_everything_in_one_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cv2")
    film = make_moving_hand()
    video = film.save(tmp_path / "hand.mp4", is_mirrored=True)
    finder = TruthfulFinder(film, is_mirrored=True)
    captured: list[VideoOptions] = []

    def capture_quickly(options: VideoOptions, progress: Progress) -> Capture:
        captured.append(options)
        quick = replace(
            options,
            rig="open-hand-778",
            size=64,
            fit=FitOptions(focal_share=FOCAL / max(WIDTH, HEIGHT), landmark_steps=30),
            register=RegisterOptions(coefficient_sigma=1.0, restarts=0, texture_sigmas=()),
        )
        return capture_video(quick, film.rig, progress, open_finder=lambda: finder)

    monkeypatch.setattr(demo, "capture_video", capture_quickly)
    monkeypatch.setitem(METHODS, "quick", TINY)
    evaluate = demo.evaluate_run
    monkeypatch.setattr(demo, "evaluate_run", lambda o, p: evaluate(replace(o, max_frames=1), p))
    asked: dict[str, Any] = {"steps": 4, "frames": 2, "size": 32, "device": "cpu"}
    options = DemoOptions(tmp_path / "mine", video=video, fps=FPS / 2, **asked)
    out = run_demo(options)
    names = {path.name for path in out.iterdir()}
    assert names == {
        *("capture", "source.json", "run", ".handavatar", "avatar.safetensors", "metrics.json"),
        *("report.html", "own_motion.mp4", "novel_poses.mp4", "edits.png", "overview.png"),
    }
    capture = read_capture(out / "capture")
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 1 and len(capture.split("test")) > 0
    assert (
        capture.side == "left"
        and HandAvatar.load(out / "avatar.safetensors").info["side"] == "left"
    )
    for name, count in (("own_motion.mp4", 1), ("novel_poses.mp4", 2)):
        with av.open(str(out / name)) as container:
            assert len(list(container.decode(video=0))) == count
    assert np.asarray(Image.open(out / "edits.png")).shape == (128, 5 * 128, 3)
    assert "hand: left" in capsys.readouterr().err
    assert len(captured) == 1 and captured[0].fps == FPS / 2
    # Told again, it continues: the video is not looked at again.
    run_demo(options)
    assert len(captured) == 1
