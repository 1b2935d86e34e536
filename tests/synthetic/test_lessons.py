"""The tracker's training as a command: pictures on disk, going on, what is refused."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path

import pytest
import torch
from conftest import coarse_skin
from safetensors.torch import load_file, save_file
from told import Told

from handavatar.capture.checks import CaptureError
from handavatar.jobs.files import FolderInUse
from handavatar.jobs.finite import NotFinite, find_not_finite
from handavatar.synthetic import lessons
from handavatar.synthetic.lessons import TrackerTrainOptions, train_made_tracker
from handavatar.tracker.model import TrackerError, read_tracker
from handavatar.tracker.training import CropBatch, TrackerOptions, TrackerTraining


@pytest.fixture
def options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TrackerTrainOptions]:
    """Of ten pictures and lessons of eight."""
    monkeypatch.setattr(lessons, "IN_A_FILE", 10)
    monkeypatch.setattr(lessons, "TrackerOptions", partial(TrackerOptions, batch=8))
    with coarse_skin():
        yield TrackerTrainOptions(
            tmp_path / "t.safetensors", tmp_path / "pictures", count=10, steps=4, processes=1
        )


def test_a_training_makes_its_pictures_once_and_goes_on(
    options: TrackerTrainOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In this process: a spawned one would not know of the smaller files.
    monkeypatch.setattr(lessons, "ProcessPoolExecutor", lambda *_: _Here())
    told = Told()
    with pytest.raises(CaptureError, match="nothing to go on with"):
        train_made_tracker(replace(options, resume=True), told.progress)
    train_made_tracker(options, told.progress)
    assert told.counts[:2] == [("pictures", 0, 1), ("pictures", 1, 1)]
    assert told.counts[-1] == ("training", 4, 4)
    first = read_tracker(options.out)
    made = next(options.pictures.iterdir())
    written = made.stat().st_mtime_ns
    told = Told()
    train_made_tracker(replace(options, resume=True, steps=6), told.progress)
    assert told.counts == [
        ("pictures", 1, 1),
        ("training", 4, 6),
        ("training", 5, 6),
        ("training", 6, 6),
    ]
    assert made.stat().st_mtime_ns == written
    second = read_tracker(options.out)
    assert torch.equal(first.points.vertices, second.points.vertices)
    assert not torch.equal(first.network.at_point, second.network.at_point)
    # From given weights; a rate of nothing leaves them.
    further = replace(options, start=options.out, out=tmp_path / "f.safetensors", rate=1e-9)
    train_made_tracker(replace(further, steps=1))
    third = read_tracker(further.out)
    torch.testing.assert_close(third.network.at_point, second.network.at_point, atol=1e-4, rtol=0)
    with pytest.raises(TrackerError, match="other points"):
        monkeypatch.setattr(lessons, "NUM_SKIN_POINTS", 3)
        train_made_tracker(replace(further, overwrite=True))
    monkeypatch.setattr(lessons, "NUM_SKIN_POINTS", 64)
    options.out.with_suffix(".state").write_bytes(b"nothing")
    with pytest.raises(CaptureError, match="cannot be gone on with"):
        train_made_tracker(replace(options, resume=True))
    made.write_bytes(b"nothing")
    with pytest.raises(CaptureError, match="cannot be read"):
        train_made_tracker(replace(options, overwrite=True))
    with pytest.raises(FolderInUse, match="exists"):
        train_made_tracker(options)
    assert torch.equal(read_tracker(options.out).network.at_point, second.network.at_point)


@pytest.mark.slow
def test_a_training_that_diverges_keeps_the_last_good_state_and_says_how_to_go_on(
    options: TrackerTrainOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lessons, "ProcessPoolExecutor", lambda *_: _Here())
    monkeypatch.setattr(lessons, "_SAVED_EVERY", 0)
    teach = TrackerTraining.teach

    def spoiling(at: int) -> None:
        def spoilt(training: TrackerTraining, batch: CropBatch) -> float:
            loss = teach(training, batch)
            if training.step == at:
                with torch.no_grad():
                    training.network.verdict.bias[0] = float("nan")
            return loss

        monkeypatch.setattr(TrackerTraining, "teach", spoilt)

    spoiling(1)
    with pytest.raises(NotFinite, match=r"step 1: network\.verdict\.bias holds NaN") as caught:
        train_made_tracker(options)
    assert str(caught.value).endswith("give the same command again with `rate=0.001`")
    spoiling(4)  # The last one.
    with pytest.raises(NotFinite, match=r"t\.state holds step 3, which is good") as caught:
        train_made_tracker(options)
    assert str(caught.value).endswith("`resume=True` `rate=0.001`")
    assert not options.out.exists()
    monkeypatch.setattr(TrackerTraining, "teach", teach)
    train_made_tracker(replace(options, resume=True, rate=0.001))
    assert find_not_finite(read_tracker(options.out).network.state_dict()) is None
    state_file = options.out.with_suffix(".state")
    save_file(load_file(state_file) | {"network.verdict.bias": torch.full((2,), -inf)}, state_file)
    with pytest.raises(CaptureError, match=r"verdict\.bias holds -inf(.|\n)*without `resume=True`"):
        train_made_tracker(replace(options, resume=True, steps=5))


class _Here:
    """As a pool of processes, in this one."""

    map = staticmethod(map)

    def __enter__(self) -> "_Here":
        return self

    def __exit__(self, *_: object) -> None:
        pass
