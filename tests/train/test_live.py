"""What others see of a training, and that it is not touched by them."""

import json
import os
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import TINY, write_tiny_capture

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import read_capture
from handavatar.hand.open_hand import load_open_hand
from handavatar.jobs.progress import SILENT, Progress
from handavatar.train import live
from handavatar.train.corrections import PoseCorrections
from handavatar.train.live import (
    LiveState,
    live_avatar,
    live_folder,
    live_poses,
    look_on,
    read_live,
    shown_live,
)
from handavatar.train.loop import METHODS, TrainOptions, run_folder, train
from handavatar.train.runs import Run, open_run, read_log

STEPS = 6


@pytest.fixture(autouse=True)
def _tiny_method(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METHODS, "quick", TINY)


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything is told and shown at every step."""
    monkeypatch.setattr(live, "_TELL_EVERY", 0.0)
    monkeypatch.setattr(live, "_SHOW_EVERY", 0.0)
    monkeypatch.setattr(live, "_MOST_SHARE", 1e9)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    (tmp_path / "run").mkdir()
    return Run(tmp_path / "run")


def _options(capture: Path, out: Path) -> TrainOptions:
    return TrainOptions(capture, out, steps=STEPS, device="cpu", perceptual="substitute")


class _Onlooker:
    """Keeps looking on, and collects what it sees."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self.states: list[LiveState] = []
        self.avatars: dict[int, HandAvatar] = {}

    def __enter__(self) -> "_Onlooker":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._is_over.wait(0.002):
            look_on(self._run)
            state = read_live(self._run)
            if state is not None and (not self.states or state != self.states[-1]):
                self.states.append(state)
            try:
                version = live_avatar(self._run).stat().st_mtime_ns
                if version not in self.avatars:
                    self.avatars[version] = HandAvatar.load(live_avatar(self._run))
            except (OSError, ValueError):
                continue


@pytest.mark.slow
@pytest.mark.parametrize("confidence", [1.0, 0.9])
def test_who_looks_on_changes_no_bit(tmp_path: Path, eager: None, confidence: float) -> None:
    capture = write_tiny_capture(tmp_path / "capture", confidence=confidence)
    alone = train(_options(capture, tmp_path / "alone"))
    with _Onlooker(Run(tmp_path / "seen")) as onlooker:
        seen = train(_options(capture, tmp_path / "seen"))
    assert (alone / "avatar.safetensors").read_bytes() == (seen / "avatar.safetensors").read_bytes()
    assert read_log(open_run(alone)) == read_log(open_run(seen))
    assert len(onlooker.avatars) >= 2
    assert len({str(one.state_dict()) for one in onlooker.avatars.values()}) >= 2
    jobs = {state.job for state in onlooker.states}
    assert {"occupancy", "border", "train"} & jobs
    assert not [state for state in onlooker.states if not 0 <= state.step <= max(state.total, 0)]


def test_poses_of_a_tracked_capture_are_shown_as_training_has_them(
    tmp_path: Path, run: Run, eager: None
) -> None:
    capture = read_capture(write_tiny_capture(tmp_path / "capture", confidence=0.9))
    frames = [capture.frame(index) for index in capture.split("train")]
    avatar = _small()
    corrections = PoseCorrections(len(frames))
    moved = replace(frames[1].pose, translation=frames[1].pose.translation + 0.01)
    corrections.set(1, frames[1].pose, moved)
    with shown_live(run, avatar, corrections, frames, SILENT) as progress:
        look_on(run)
        _stage(progress)(2, 3, loss=0.5)
        shown = HandAvatar.load(live_avatar(run))
        poses = live_poses(shown)
    assert poses is not None
    torch.testing.assert_close(poses[1][1], moved.translation)
    torch.testing.assert_close(poses[0][2], frames[2].pose.rotations)
    assert shown.info["live"]["job"] == "train" and shown.info["live"]["step"] == 2
    assert "live" not in avatar.info
    assert live_poses(avatar) is None


def _stage(progress: Progress) -> Progress:
    return progress.stages({"train": 1.0})["train"]


def _small() -> HandAvatar:
    return HandAvatar(load_open_hand("778"), torch.zeros(10), rounds=0, num_anchors=64)


def test_how_far_it_is_is_said_from_beginning_to_end(run: Run) -> None:
    assert read_live(run) is None
    with shown_live(run, _small(), None, [], SILENT) as progress:
        state = read_live(run)
        assert state is not None and state.is_going_on and state.job == ""
        _stage(progress)(5, 10, loss=0.25, psnr=float("nan"))
        state = read_live(run)
        assert state is not None and state.share == 0.5
        assert (state.job, state.step, state.total, state.figures) == (
            "train",
            5,
            10,
            {"loss": 0.25},
        )
        assert (state.process, state.host) == (os.getpid(), socket.gethostname())
        assert not live_avatar(run).exists()  # Nobody has looked on.
    state = read_live(run)
    assert state is not None and state.phase == "finished" and not state.is_going_on
    assert [path.name for path in live_folder(run).iterdir()] == ["progress.json"]
    # What is told to nobody goes nowhere.
    _stage(SILENT)(1, 1)
    assert read_live(run) == state


def test_an_interrupted_training_says_so_and_leaves_its_avatar(run: Run, eager: None) -> None:
    with (
        pytest.raises(KeyboardInterrupt),
        shown_live(run, _small(), None, [], SILENT) as progress,
    ):
        look_on(run)
        _stage(progress)(1, 2)
        raise KeyboardInterrupt
    state = read_live(run)
    assert state is not None and state.phase == "stopped" and not state.is_going_on
    assert live_avatar(run).is_file()
    # Who begins anew takes it away.
    with shown_live(run, _small(), None, [], SILENT):
        assert not live_avatar(run).exists()


def test_a_killed_trainer_is_known_to_be_gone(run: Run) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    here = socket.gethostname()
    assert LiveState("training", process=os.getpid(), host=here).is_going_on
    assert not LiveState("training", process=dead.pid, host=here).is_going_on
    assert LiveState("training", process=dead.pid, host="elsewhere").is_going_on
    assert not LiveState("finished", process=os.getpid(), host=here).is_going_on


@pytest.mark.parametrize("content", ["", "{", "[]", '{"phase": "training", "x": 1}', "\xff"])
def test_a_spoilt_report_is_none(run: Run, content: str) -> None:
    live_folder(run).mkdir()
    (live_folder(run) / "progress.json").write_text(content, encoding="latin-1")
    assert read_live(run) is None


@pytest.mark.slow
def test_a_disk_that_refuses_is_told_of_and_training_goes_on(
    tiny_capture: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], eager: None
) -> None:
    out = tmp_path / "run"
    begun = train(replace(_options(tiny_capture, out), steps=2))
    folder = live_folder(Run(begun))
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    folder.write_text("in the way")
    capfd.readouterr()
    train(_options(tiny_capture, out))
    assert (out / "avatar.safetensors").is_file()
    assert [record["step"] for record in read_log(open_run(out))] == list(range(1, STEPS + 1))
    told = capfd.readouterr().err
    assert told.count("training goes on") == 1 and str(folder) in told


def test_copies_of_the_avatar_take_a_small_share_of_the_time(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Clock:
        now = 0.0

        def __call__(self) -> float:
            return self.now

    clock, saved = Clock(), []

    def slow_save(avatar: HandAvatar, path: Path) -> None:
        saved.append(clock.now)
        clock.now += 0.5

    monkeypatch.setattr(HandAvatar, "save", slow_save)
    told = live._Live(run, _small(), None, [], clock)
    told.begin()
    look_on(run)
    for step in range(4000):
        clock.now += 0.1
        told.hear({"job": "train", "step": step}, False)
    assert 5 <= len(saved) <= 10  # 1 % of 400 seconds, and the first two.
    assert json.loads((live_folder(run) / "progress.json").read_text())["step"] > 3900


def test_a_run_is_named_before_it_begins(
    tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # Runs that lie in "outputs" would be gone on with.
    options = TrainOptions(tiny_capture, tmp_path / "mine")
    assert run_folder(options) == tmp_path / "mine"
    assert run_folder(replace(options, out=None, resume="never")).parts[:2] == ("outputs", "tiny")
