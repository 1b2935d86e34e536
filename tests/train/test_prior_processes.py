"""Two processes on one machine learn what one learns; a killed training ends as an unbroken one."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from handavatar.avatar import CheckpointError
from handavatar.train.prior import PriorOptions, train_prior

WORDS = ["prior", "train", "--points", "64", "--level", "778", "--rounds", "0", "--poses", "2"]


def _options(out: Path, steps: int) -> PriorOptions:
    return PriorOptions(out, steps=steps, points=64, poses=2, level="778", rounds=0)


def _begun(words: list[str], **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "handavatar", *words],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
    )


def _two_begun(words: list[str]) -> list[subprocess.Popen[str]]:
    """What torchrun sets, without its agent, which takes seconds to start."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    return [
        _begun(
            words,
            RANK=str(rank),
            LOCAL_RANK=str(rank),
            WORLD_SIZE="2",
            MASTER_ADDR="127.0.0.1",
            MASTER_PORT=port,
        )
        for rank in range(2)
    ]


def _ended(processes: list[subprocess.Popen[str]]) -> tuple[list[int], str]:
    try:
        texts = [process.communicate(timeout=60)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], "\n".join(texts)


def test_two_processes_learn_what_one_learns_stop_together_and_continue(tmp_path: Path) -> None:
    one = load_file(tmp_path / "one") if train_prior(_options(tmp_path / "one", 3)) else {}
    words = [*WORDS, "--out", str(tmp_path / "two"), "--run", str(tmp_path / "run")]
    codes, text = _ended(_two_begun([*words, "--steps", "3"]))
    assert codes == [0, 0], text
    two = load_file(tmp_path / "two")
    # The same hands, the mean of two gradients summed in another order: float rounding (6e-8 of
    # a gradient), which Adam can blow up to a step of the learning rate, 1e-3, where a gradient
    # is nothing but rounding. Hence nearly all weights agree to 1e-6, none differs by three steps.
    difference = torch.cat([(two[name] - one[name]).abs().flatten() for name in one])
    assert float((difference < 1e-6).float().mean()) > 0.999
    assert float(difference.max()) < 3e-3
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in log] == [3]
    assert log[0]["samples_per_second"] > 0
    shares = [value for name, value in log[0].items() if name.startswith("share_")]
    assert sum(shares) == pytest.approx(1)


def test_processes_that_cannot_share_evenly_are_refused(tmp_path: Path) -> None:
    codes, text = _ended(_two_begun([*WORDS[:-1], "3", "--out", str(tmp_path / "a")]))
    assert all(codes) and "expected as many for each" in text


def test_a_stopped_training_continues_bit_for_bit(tmp_path: Path) -> None:
    steps = 40
    words = [*WORDS, "--steps", str(steps), "--out", str(tmp_path / "b"), "--run"]
    words.append(str(tmp_path / "run"))
    process = _begun([*words, "--checkpoint-every", "1"])
    checkpoints = tmp_path / "run" / "checkpoints"
    deadline = time.monotonic() + 60
    while not list(checkpoints.glob("step-*")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    (code,), text = _ended([process])
    assert code != 0 and "continue with --run" in text, text
    done = max(int(path.name[5:]) for path in checkpoints.glob("step-*"))
    assert 0 < done < steps
    whole = train_prior(_options(tmp_path / "a", steps)).state_dict()
    options = replace(_options(tmp_path / "b", steps), run=tmp_path / "run")
    resumed = train_prior(options).state_dict()
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)
    with pytest.raises(CheckpointError, match="other options: lr, seed"):
        train_prior(replace(options, seed=1, lr=1e-2))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(CheckpointError, match="no pre-training run"):
        train_prior(replace(options, run=tmp_path / "full"))
