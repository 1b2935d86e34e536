"""Two processes on one machine learn what one learns; a killed training ends as an unbroken one."""

import json
import os
import signal
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from two_processes import ended, two_begun

import handavatar.train.prior as prior
from handavatar.avatar import CheckpointError
from handavatar.jobs.signals import Interrupted
from handavatar.processes import Processes
from handavatar.synthetic.lessons import TrackerTrainOptions
from handavatar.train.labelled_poses import LabelledPose, PoseStream
from handavatar.train.pretraining import begin_prior_run
from handavatar.train.prior import PriorOptions, train_prior
from handavatar.train.stage_times import StageTimes

WORDS = ["prior", "train", "--points", "64", "--level", "778", "--rounds", "0", "--poses", "2"]
STOPPED_PROGRAM = [
    "-c",
    """
import os, signal, sys
from handavatar import cli
from handavatar.train.labelled_poses import PoseStream

drawn = PoseStream.drawn

def interrupted(stream, number, times):
    if number == 1:  # Amid step 1, and only in the second process.
        os.kill(os.getpid(), signal.SIGTERM)
    return drawn(stream, number, times)

PoseStream.drawn = interrupted
sys.exit(cli.main(sys.argv[1:]))
""",
]


def _options(out: Path, steps: int) -> PriorOptions:
    return PriorOptions(out, steps=steps, points=64, poses=2, level="778", rounds=0)


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What two processes left, undisturbed: the weights ``two`` and the folder ``run``."""
    folder = tmp_path_factory.mktemp("two")
    words = [*WORDS, "--out", str(folder / "two"), "--folder", str(folder / "run")]
    codes, text = ended(two_begun([*words, "--steps", "3"]))
    assert codes == [0, 0], text
    return folder


def _log(folder: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_two_processes_learn_what_one_learns(tmp_path: Path, two_processes: Path) -> None:
    train_prior(_options(tmp_path / "one", 3))
    one, two = load_file(tmp_path / "one"), load_file(two_processes / "two")
    # The same hands, the mean of two gradients summed in another order: float rounding (6e-8 of
    # a gradient), which Adam can blow up to a step of the learning rate, 1e-3, where a gradient
    # is nothing but rounding. Hence nearly all weights agree to 1e-6, none differs by three steps.
    difference = torch.cat([(two[name] - one[name]).abs().flatten() for name in one])
    assert float((difference < 1e-6).float().mean()) > 0.999
    assert float(difference.max()) < 3e-3
    log = _log(two_processes / "run")
    assert [line["step"] for line in log] == [3]
    assert log[0]["samples_per_second"] > 0
    shares = [value for name, value in log[0].items() if name.startswith("share_")]
    assert sum(shares) == pytest.approx(1)


@pytest.mark.slow
def test_two_processes_stop_together_and_continue_bit_for_bit(
    tmp_path: Path, two_processes: Path
) -> None:
    words = [*WORDS, "--out", str(tmp_path / "two"), "--folder", str(tmp_path / "run")]
    codes, text = ended(two_begun([*words, "--steps", "3"], STOPPED_PROGRAM))
    assert codes == [130, 130], text
    assert text.count("stopped at step 1; ") == text.count("the same command goes on") == 2
    # Two steps more: what the second process keeps of the optimisers shows in the first one's
    # weights only by the gradient of a later step.
    codes, text = ended(two_begun([*words, "--steps", "3"]))
    assert codes == [0, 0], text
    assert [line["step"] for line in _log(tmp_path / "run")] == [1, 3]
    # Equal bits: a sum of two gradients has only one order. That of three may be rounded otherwise.
    resumed, whole = load_file(tmp_path / "two"), load_file(two_processes / "two")
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)


def test_processes_that_cannot_share_evenly_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prior, "joined_processes", lambda _: nullcontext(Processes(0, 3, "cpu")))
    with pytest.raises(ValueError, match="found 2 a step for 3 processes"):
        train_prior(_options(tmp_path / "a", 1))


def test_a_stopped_training_continues_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = replace(_options(tmp_path / "b", 5), folder=tmp_path / "run", checkpoint_every=2)
    whole = train_prior(replace(options, out=tmp_path / "a", folder=None)).state_dict()
    drawn = PoseStream.drawn

    def interrupted(stream: PoseStream, number: int, times: StageTimes) -> LabelledPose:
        if number == 2 * 2:  # Amid step 3.
            os.kill(os.getpid(), signal.SIGTERM)
        return drawn(stream, number, times)

    with monkeypatch.context() as patched:
        patched.setattr(PoseStream, "drawn", interrupted)
        with pytest.raises(Interrupted, match=r"stopped at step 3; .*the same command goes on"):
            train_prior(options)
    # As if it had been killed later, after a checkpoint that the disk lost.
    (tmp_path / "run" / "log.jsonl").open("a").write(json.dumps({"step": 4}) + "\n")
    resumed = train_prior(options).state_dict()
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)
    assert [line["step"] for line in _log(tmp_path / "run")] == [3, 5]
    saved = load_file(tmp_path / "b")
    assert all(torch.equal(saved[name], whole[name]) for name in whole)


def test_a_run_is_continued_with_its_own_options_alone(tmp_path: Path) -> None:
    begin_prior_run(tmp_path / "run", {"lr": 1, "seed": 0})
    begin_prior_run(tmp_path / "run", {"lr": 1, "seed": 0})
    with pytest.raises(CheckpointError, match="other options: lr, seed"):
        begin_prior_run(tmp_path / "run", {"lr": 2, "seed": 1})
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(CheckpointError, match="no pre-training run"):
        begin_prior_run(tmp_path / "full", {})


def test_torchrun_leaves_our_options_alone() -> None:
    """It reads the words behind the program's name too, and knows its own by their beginnings."""
    from torch.distributed.run import get_args_parser

    for kind, options in (("prior", PriorOptions), ("tracker", TrackerTrainOptions)):
        for field in fields(options):
            word = "--" + field.name.replace("_", "-")
            parsed = get_args_parser().parse_args(["-m", "handavatar", kind, "train", word, "1"])
            assert parsed.training_script_args == [kind, "train", word, "1"]
