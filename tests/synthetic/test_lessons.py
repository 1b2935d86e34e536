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
from two_processes import ended, two_begun

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
    further = replace(options, start_from=options.out, out=tmp_path / "f.safetensors", rate=1e-9)
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


@pytest.mark.slow
def test_two_processes_keep_equal_weights_share_files_and_stop_together(tmp_path: Path) -> None:
    """Each makes a file and is taught with its own; the first one writes."""
    words = ["tracker", "train", "--out", str(tmp_path / "t.safetensors"), "--processes", "1"]
    words += ["--pictures", str(tmp_path / "pictures"), "--count", "20", "--steps", "4"]
    codes, text = ended(two_begun([*words, str(tmp_path)], _program(stopped_at=2)))
    assert codes == [130, 130], text
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == [
        "made-000000.safetensors",
        "made-000001.safetensors",
    ]
    assert int(load_file(tmp_path / "t.state")["step"]) == 2
    codes, text = ended(two_begun([*words, "--resume", str(tmp_path)], _program()))
    assert codes == [0, 0], text
    first, second = (load_file(tmp_path / f"weights-{rank}") for rank in range(2))
    assert len(first) > 50 and all(torch.equal(first[name], second[name]) for name in first)
    assert read_tracker(tmp_path / "t.safetensors").network.num_points == 85
    # More processes than files are refused before anything is made.
    few = [*words, "--overwrite", "--count", "10", str(tmp_path)]
    codes, text = ended(two_begun(few, _program()))
    assert codes == [2, 2] and "at least 10 for each" in text, text


def _program(stopped_at: int = 0) -> list[str]:
    """The command with small files; the second process is told to stop in one step.

    Every process leaves its weights in the folder that the last word names.
    """
    return [
        "-c",
        f"""
import os, signal, sys
from functools import partial
from pathlib import Path

sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from conftest import coarse_skin
from safetensors.torch import save_file
from handavatar import cli
from handavatar.synthetic import lessons
from handavatar.tracker.training import TrackerOptions, TrackerTraining

class Here:
    map = staticmethod(map)
    def __enter__(self): return self
    def __exit__(self, *_): pass

lessons.IN_A_FILE = 10
lessons.TrackerOptions = partial(TrackerOptions, batch=8)
lessons.ProcessPoolExecutor = lambda *_: Here()
rank = os.environ["RANK"]
teach = TrackerTraining.teach

def taught(training, batch):
    assert len(batch.images) == 4
    loss = teach(training, batch)
    if training.step == {stopped_at} and rank == "1":
        os.kill(os.getpid(), signal.SIGTERM)
    if training.step == 4:
        named = training.network.named_parameters()
        weights = {{name: value.detach().contiguous() for name, value in named}}
        save_file(weights, Path(sys.argv[-1]) / f"weights-{{rank}}")
    return loss

TrackerTraining.teach = taught
with coarse_skin():
    sys.exit(cli.main(sys.argv[1:-1]))
""",
    ]


class _Here:
    """As a pool of processes, in this one."""

    map = staticmethod(map)

    def __enter__(self) -> "_Here":
        return self

    def __exit__(self, *_: object) -> None:
        pass
