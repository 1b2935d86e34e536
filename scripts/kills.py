"""SIGKILL at random moments of what writes; then old or new lies there whole, and never neither.

python scripts/kills.py [--count 200] [--seed 0] [--only PATTERN]

Every command replaces what an earlier one, with other options, has written. It is killed at a
moment between its start and its usual end; then

- what lies at its place is the old or the new, file by file;
- what lies beside, which is nobody's but the user's, is as it was;
- the same command, given again, ends with the new, and leaves nothing else beside.

Training does not replace: it is killed, looked at and gone on with, and ends with the bits of one
that was not killed. Prints one JSON object a command, and ends with 1 if anything was wrong.
"""

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from conftest import TINY, make_hand_film, write_tiny_capture
from stop_anywhere import contents

from handavatar.cli import main
from handavatar.train.loop import METHODS, TrainOptions, train


@dataclass(frozen=True)
class Job:
    """A command that replaces what lies at a place.

    Attributes:
        name: of the command.
        place: file or folder that it writes.
        old: words that wrote what lies there.
        new: words that replace it.
        beside: further files that it writes.
    """

    name: str
    place: Path
    old: list[str]
    new: list[str]
    beside: tuple[Path, ...] = ()


@dataclass
class Score:
    """What was found after so many kills."""

    kills: int = 0
    old: int = 0
    new: int = 0
    ended_before: int = 0
    wrong: list[str] = field(default_factory=list)


def run(words: list[str]) -> None:
    """Runs a command in a process of its own, silently; it must end well."""
    process = start(words)
    _, status = os.waitpid(process, 0)
    if status:
        raise RuntimeError(f"{' '.join(words)} ended with {status}")


def start(words: list[str]) -> int:
    """Begins a command in a forked process, which knows all modules already."""
    process = os.fork()
    if process == 0:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os._exit(main(words))
    return process


def remove(path: Path) -> None:
    """Removes a file or a folder, if it is there."""
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def copy(source: Path, target: Path) -> None:
    """Copies a file or a folder."""
    (shutil.copytree if source.is_dir() else shutil.copy2)(source, target)


def jobs(room: Path, capture: Path, avatar: Path, film: Path) -> list[Job]:
    """All commands that replace."""
    video = ["capture", "video", str(film), "--out", str(room / "video"), "--overwrite"]
    # Every stage, in few steps.
    video += ["--tracker", "own", "--fit.landmark-steps", "8", "--fit.outline-steps", "4"]
    video += ["--fit.retry-steps", "1"]
    video += ["--register.tilts", "--register.restarts", "0", "--register.texture-rounds", "1"]
    video += ["--register.texture-sigmas", "3", "--register.no-is-wide"]
    synth = ["capture", "synth", "--size", "32", "--test-frames", "1", "--samples", "2"]
    synth += [
        "--subdivisions",
        "0",
        "--variant",
        "scalar_rgb",
        "--overwrite",
        "--out",
        str(room / "synth"),
    ]
    degrade = ["capture", "degrade", str(capture), "--out", str(room / "degraded"), "--overwrite"]
    render = ["render", str(avatar), "--size", "32", "--overwrite", "--out", str(room / "film")]
    render += ["--device", "cpu"]
    judge = ["evaluate", str(avatar), "--capture", str(capture), "--device", "cpu"]
    judge += ["--out", str(room / "judged")]
    edit = ["edit", str(avatar), "--out", str(room / "e.safetensors"), "--overwrite"]
    motion = ["motion", "from", str(capture), "--out", str(room / "m.json"), "--overwrite"]
    found = [
        Job("video", room / "video", [*video, "--subject", "old"], [*video, "--subject", "new"]),
        Job(
            "synth",
            room / "synth",
            [*synth, "--train-frames", "2"],
            [*synth, "--train-frames", "3"],
        ),
        Job("degrade", room / "degraded", [*degrade, "--seed", "1"], [*degrade, "--seed", "2"]),
        Job("render", room / "film", [*render, "--frames", "2"], [*render, "--frames", "3"]),
        Job("evaluate", room / "judged", [*judge, "--max-frames", "1"], judge),
        Job(
            "edit",
            room / "e.safetensors",
            [*edit, "--light-gain", "0.5"],
            [*edit, "--light-gain", "0.7"],
        ),
        Job("motion", room / "m.json", [*motion, "--fps", "5"], [*motion, "--fps", "6"]),
    ]
    for kind in ("glb", "ply", "obj"):
        words = ["export", str(avatar), kind, "--texture-size", "64", "--overwrite"]
        words += ["--out", str(room / f"hand.{kind}")]
        place, further = room / f"hand.{kind}", ()
        if kind == "obj":
            further = (room / "hand.png", room / "hand.mtl")
        found.append(Job(kind, place, [*words, "--unlit"], words, further))
    return found


def killed(job: Job, count: int, draw: random.Random) -> Score:
    """Kills a command so many times."""
    places = (job.place, *job.beside)
    neighbours = {path: path.read_bytes() for path in job.place.parent.glob("mine*")}
    for path in places:
        remove(path)
    run(job.old)
    old = [contents(path) for path in places]
    kept = job.place.parent.parent / "kept"
    for path in places:
        copy(path, kept / path.name)
    begin = time.monotonic()
    run(job.new)
    length = time.monotonic() - begin
    new = [contents(path) for path in places]
    score = Score()
    if old == new:
        score.wrong.append("old and new are the same: nothing was tested")
    for number in range(count):
        for path in places:
            remove(path)
            copy(kept / path.name, path)
        process = start(job.new)
        time.sleep(draw.uniform(0, length))
        os.kill(process, signal.SIGKILL)
        _, status = os.waitpid(process, 0)
        score.kills += os.WIFSIGNALED(status)
        score.ended_before += not os.WIFSIGNALED(status)
        for path, was, becomes in zip(places, old, new, strict=True):
            found = contents(path) if path.exists() else None
            score.old += found == was
            score.new += found == becomes
            if found not in (was, becomes):
                score.wrong.append(f"kill {number}: {path.name} is neither old nor new")
        if any(path.read_bytes() != content for path, content in neighbours.items()):
            score.wrong.append(f"kill {number}: a neighbour was touched")
        if number % 5 == 4 or number == count - 1:
            run(job.new)
            if [contents(path) for path in places] != new:
                score.wrong.append(f"kill {number}: the same command again ends otherwise")
    left = {path.name for path in job.place.parent.iterdir()} - {path.name for path in neighbours}
    left = {name for name in left if not name.startswith(".tmp-")}
    if unknown := left - {path.name for path in places}:
        score.wrong.append(f"left beside: {sorted(unknown)}")
    for path in places:
        remove(path)
    return score


def killed_training(room: Path, capture: Path, count: int, draw: random.Random) -> Score:
    """Kills a training, and goes on with it, until it ends; again and again."""

    def begin(folder: Path) -> int:
        process = os.fork()
        if process == 0:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            train(
                TrainOptions(
                    capture,
                    folder,
                    steps=8,
                    checkpoint_every=2,
                    device="cpu",
                    perceptual="substitute",
                )
            )
            os._exit(0)
        return process

    whole = room / "whole"
    started = time.monotonic()
    os.waitpid(begin(whole), 0)
    length = time.monotonic() - started
    expected = (whole / "avatar.safetensors").read_bytes()
    score, number = Score(), 0
    while score.kills < count:
        number += 1
        folder = room / f"run-{number}"
        for _ in range(4):
            process = begin(folder)
            time.sleep(draw.uniform(0, 0.9 * length))
            os.kill(process, signal.SIGKILL)
            _, status = os.waitpid(process, 0)
            score.kills += os.WIFSIGNALED(status)
            score.ended_before += not os.WIFSIGNALED(status)
            file = folder / "avatar.safetensors"
            if file.exists() and file.read_bytes() != expected:
                score.wrong.append(f"{folder.name}: half an avatar")
        _, status = os.waitpid(begin(folder), 0)
        if status or (folder / "avatar.safetensors").read_bytes() != expected:
            score.wrong.append(f"{folder.name}: gone on with, it ends otherwise ({status})")
        else:
            score.new += 1
        shutil.rmtree(folder)
    shutil.rmtree(whole)
    return score


def kill_all(count: int, seed: int, only: str = "") -> bool:
    """Kills every command in whose name a pattern is found equally often; whether all was right."""
    draw = random.Random(seed)
    METHODS["quick"] = TINY
    is_right = True
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder)
        for name in ("room", "kept", "training", "film"):
            (top / name).mkdir()
        capture = write_tiny_capture(top / "capture")
        with contextlib.redirect_stderr(open(os.devnull, "w")):
            trained = train(
                TrainOptions(capture, top / "run", steps=4, device="cpu", perceptual="substitute")
            )
        for name in ("mine.tmp", "mine.unfinished", "mine"):
            (top / "room" / name).write_text(name)
        film = make_hand_film(top / "film", 0.9)
        todo = jobs(top / "room", capture, trained / "avatar.safetensors", film)
        todo = [job for job in todo if re.search(only, job.name)]
        is_trained = bool(re.search(only, "train"))
        each = -(-count // (len(todo) + is_trained))
        for job in todo:
            score = killed(job, each, draw)
            is_right &= not score.wrong
            print(json.dumps({"command": job.name} | vars(score)), flush=True)
        if is_trained:
            score = killed_training(top / "training", capture, each, draw)
            is_right &= not score.wrong
            print(json.dumps({"command": "train"} | vars(score)), flush=True)
    return is_right


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="kills, of all commands together")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", default="", help="commands in whose name this pattern is found")
    options = parser.parse_args()
    sys.exit(0 if kill_all(options.count, options.seed, options.only) else 1)
