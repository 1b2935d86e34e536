"""The demonstration, from the shipped capture to the edited picture, on a budget of steps."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from handavatar import demo
from handavatar.avatar import HandAvatar
from handavatar.capture.checks import CaptureError
from handavatar.capture.default import default_capture
from handavatar.capture.frames import Capture, read_capture
from handavatar.capture.video import VideoOptions
from handavatar.demo import DemoOptions, run_demo
from handavatar.errors import ArgumentError
from handavatar.jobs.progress import Progress
from handavatar.jobs.signals import Interrupted
from handavatar.train.loop import METHODS


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(ValueError, match="not empty"):
        run_demo(DemoOptions(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


def _shorter(folder: Path, out: Path, counts: dict[str, int]) -> Capture:
    """A copy of a capture with so many frames of each split."""
    shutil.copytree(folder, out)
    header = json.loads((out / "transforms.json").read_text())
    header["frames"] = [
        frame
        for split, count in counts.items()
        for frame in [one for one in header["frames"] if one["split"] == split][:count]
    ]
    (out / "transforms.json").write_text(json.dumps(header))
    return read_capture(out)


def test_a_demonstration_is_of_one_thing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once a capture is made; after one that failed, other seconds of the video may be tried."""
    made: list[VideoOptions] = []

    def capture_video(options: VideoOptions, progress: Progress) -> Capture:
        made.append(options)
        if options.start == 0:
            raise CaptureError("no hand in the first seconds", "show it")
        shutil.copytree(default_capture().folder, options.out)
        (options.out / "fit.json").write_text('{"summary": {}}')
        return read_capture(options.out)

    def train(*_: object) -> None:
        raise Interrupted("amid the training")

    monkeypatch.setattr(demo, "capture_video", capture_video)
    monkeypatch.setattr(demo, "summary_lines", lambda _: ["hand: right"])
    monkeypatch.setattr(demo, "train", train)
    video, other = tmp_path / "a.mp4", tmp_path / "b.mp4"
    video.write_bytes(b"film")
    other.write_bytes(b"another film")
    own = DemoOptions(tmp_path / "out", video=video, fps=5.0)
    with pytest.raises(CaptureError, match="first seconds"):
        run_demo(own)
    later = replace(own, start=2.0)
    for _ in range(2):
        with pytest.raises(Interrupted):
            run_demo(later)
    assert [(one.start, one.fps, one.file) for one in made] == [(0, 5, video), (2, 5, video)]
    for wrong, said in (
        (own, "a.mp4 with other start"),
        (replace(later, fps=10.0), "a.mp4 with other fps"),
        (replace(later, video=other), "demonstration of a.mp4, expected one of b.mp4"),
        (DemoOptions(own.out), "demonstration of a.mp4, expected one of the capture that ships"),
    ):
        with pytest.raises(ArgumentError, match=said):
            run_demo(wrong)
    with pytest.raises(Interrupted):
        run_demo(DemoOptions(tmp_path / "plain"))
    (tmp_path / "plain" / "run").mkdir()
    with pytest.raises(ArgumentError, match="of the capture that ships, expected one of a"):
        run_demo(replace(own, out=tmp_path / "plain"))
    with pytest.raises(ArgumentError, match="`end`"):
        replace(own, end=-1.0)
    with pytest.raises(ArgumentError, match="`fps`: found 5"):
        DemoOptions(fps=5.0)


@pytest.mark.slow
def test_the_demonstration_leaves_everything_it_promises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Its method on a tenth of the budget before the first step, which `steps` does not shorten,
    # and a part of the frames.
    quick = replace(
        METHODS["quick"], personal_steps=60, border_steps=45, detail_size=128, detail_steps=20
    )
    monkeypatch.setitem(METHODS, "quick", quick)
    shorter = _shorter(default_capture().folder, tmp_path / "capture", {"train": 12, "test": 2})
    monkeypatch.setattr(demo, "default_capture", lambda: shorter)
    evaluate = demo.evaluate_run
    monkeypatch.setattr(demo, "evaluate_run", lambda o, p: evaluate(replace(o, max_frames=1), p))
    out = run_demo(DemoOptions(tmp_path / "out", steps=4, frames=2, size=32, device="cpu"))
    names = {path.name for path in out.iterdir()}
    promised = {"avatar.safetensors", "metrics.json", "report.html", "novel_poses.mp4"}
    assert names == promised | {"edits.png", "overview.png", "run", ".handavatar"}
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["mask_iou"] > 0.7 and metrics["truth"] is not None
    with av.open(str(out / "novel_poses.mp4")) as container:
        assert len(list(container.decode(video=0))) == 2
    with Image.open(out / "edits.png") as picture:
        assert picture.size == (5 * 128, 128)
    HandAvatar.load(out / "avatar.safetensors")

    # Told again, it continues: nothing is left to train.
    monkeypatch.setattr(demo, "edited_pictures", lambda *_: np.zeros((4, 4, 3), np.uint8))
    before = (out / "avatar.safetensors").read_bytes()
    # What somebody has put there meanwhile stays.
    notes = out / "notes.txt", out / "run" / "renders" / "novel_poses" / "rgb" / "notes.txt"
    for path in notes:
        path.write_text("mine")
    run_demo(DemoOptions(out, steps=4, frames=2, size=32, device="cpu"))
    assert (out / "avatar.safetensors").read_bytes() == before
    assert [path.read_text() for path in notes] == ["mine", "mine"]
    assert (out / "run" / "renders" / "novel_poses-2" / "rgb.mp4").is_file()
