"""Stops the whole road at random moments, goes on with the same command, and compares the results.

    OMP_NUM_THREADS=1 .venv/bin/python scripts/stop_anywhere.py --count 50 --folder stopped
    OMP_NUM_THREADS=1 .venv/bin/python scripts/stop_anywhere.py --gaps train CAPTURE --out RUN

The road: a small made capture, a training with a small budget, pictures, figures, a surface. It is
gone once without a stop. Then, again and again, one of its commands gets SIGTERM at a moment drawn
evenly from the whole road, ends, is given again, and must leave the same bits. Told are how many
did, the longest time from the signal to the end, and the longest silence on standard error. Each
command is a fork, so that imports are done once.

With ``--gaps`` one command is run as it is, and its longest times between two stop points are told.
"""

import argparse
import json
import os
import random
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

from handavatar import animate, cli
from handavatar.capture import pathtracer
from handavatar.evaluate import run as evaluating
from handavatar.export import run as exporting
from handavatar.field.shading import TracedCues
from handavatar.jobs import signals
from handavatar.jobs.progress import duration
from handavatar.train.loop import METHODS

IMPORTED = (animate, pathtracer, evaluating, exporting)
"""Once, before all forks."""

SMALL = {
    "cues": TracedCues(14),
    "outline_rounds": 2,
    "outline_visits": 1,
    "personal_steps": 12,
    "border_steps": 8,
    "warm_steps": 12,
    "warm_stride": 2,
    "warm_pixels": 128,
    "patch_size": 16,
    "border_pixels": 32,
    "num_samples": 12,
    "silhouette_size": 48,
    "occupancy_points": 128,
    "rounds": 0,
    "num_anchors": 128,
    "detail_size": 64,
    "detail_steps": 12,
}
"""Of the method ``best``: every stage of it, each for a second or a few."""
STEPS = 16


def road(folder: Path) -> dict[str, tuple[list[str], Path]]:
    """The commands by name, and what each leaves."""
    capture, run = folder / "capture", folder / "run"
    sizes = ["--size", "40", "--train-frames", "3", "--test-frames", "1", "--samples", "2"]
    budget = ["--steps", str(STEPS), "--perceptual", "substitute"]
    pictures = ["--size", "24", "--frames", "4", "--num-samples", "24"]
    return {
        "capture synth": (
            ["capture", "synth", "--out", str(capture), *sizes, "--texture", "128"],
            capture,
        ),
        "train": (
            ["train", str(capture), "--method", "best", "--out", str(run), *budget],
            run / "avatar.safetensors",
        ),
        "render": (
            ["render", str(run), "--out", str(folder / "pictures"), *pictures],
            folder / "pictures",
        ),
        "evaluate": (["evaluate", str(run)], run / "evaluation" / "metrics.json"),
        "export": (
            ["export", str(run), "ply", "--out", str(folder / "hand.ply")],
            folder / "hand.ply",
        ),
    }


@dataclass
class Ended:
    """How a command ended.

    Attributes:
        code: of the exit.
        seconds: it took.
        stopping: seconds from the signal to the end.
        silence: longest, on standard error.
        told: on standard error.
    """

    code: int
    seconds: float
    stopping: float = 0.0
    silence: float = 0.0
    told: list[str] = field(default_factory=list)


def run_command(words: list[str], stop_after: float | None = None) -> Ended:
    """Runs a command in a process of its own, and tells it to stop after so many seconds."""
    begin = last = time.monotonic()
    reading, writing = os.pipe()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.dup2(writing, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout, sys.stderr = (os.fdopen(n, "w", buffering=1) for n in (1, 2))
        os._exit(run_small(words))
    os.close(writing)
    ended = Ended(0, 0.0)

    def read() -> None:
        nonlocal last
        with open(reading, encoding="utf-8") as lines:
            for line in lines:
                ended.silence = max(ended.silence, time.monotonic() - last)
                last = time.monotonic()
                ended.told.append(line.rstrip())

    reader = threading.Thread(target=read)
    reader.start()
    status = 0
    if stop_after is not None:
        while time.monotonic() < begin + stop_after and not has_ended(child):
            time.sleep(0.005)
        told = time.monotonic()
        os.kill(child, signal.SIGTERM)  # One that has ended is still there until it is waited for.
        _, status = os.waitpid(child, 0)
        ended.stopping = time.monotonic() - told
    else:
        _, status = os.waitpid(child, 0)
    reader.join()
    ended.code = os.waitstatus_to_exitcode(status)
    ended.seconds = time.monotonic() - begin
    ended.silence = max(ended.silence, time.monotonic() - last)
    return ended


def has_ended(child: int) -> bool:
    """Whether a process has, which stays there."""
    return os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def contents(place: Path) -> dict[str, str]:
    """Fingerprints of the files of a place, but for what says when and where they were made."""
    files = [place] if place.is_file() else [path for path in place.rglob("*") if path.is_file()]
    return {
        str(path.relative_to(place)): sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.name != ".handavatar"
    }


def leftovers(folder: Path) -> list[str]:
    """Files half written: none are at their place."""
    return [str(path) for path in folder.rglob(".tmp-*")]


def measure(count: int, folder: Path, seed: int) -> int:
    """The table; how many did not become the same."""
    draw = random.Random(seed)
    whole = folder / "whole"
    steps = road(whole)
    lasts: dict[str, float] = {}
    for name, (words, place) in steps.items():
        ended = run_command(words)
        if ended.code or not contents(place):
            raise SystemExit(f"{name}: exit code {ended.code}\n" + "\n".join(ended.told[-5:]))
        lasts[name] = ended.seconds
        print(f"{name}: {ended.seconds:.1f} s without a stop, silence {ended.silence:.1f} s")
    expected = {name: contents(place) for name, (_, place) in steps.items()}
    ends: list[Ended] = []
    different, before, was_stopped = [], {name: 0 for name in steps}, 0
    for number in range(count):
        moment = draw.uniform(0.0, sum(lasts.values()))
        for name in steps:
            if moment < lasts[name]:
                break
            moment -= lasts[name]
        before[name] += 1
        folder_of = folder / f"stopped-{number:03d}"
        folder_of.mkdir(parents=True)
        if name != "capture synth":
            shutil.copytree(whole / "capture", folder_of / "capture")
        if name not in ("capture synth", "train"):
            shutil.copytree(whole / "run", folder_of / "run", ignore=_without_evaluation)
            facts = json.loads((folder_of / "run" / "run.json").read_text())
            facts["capture"]["path"] = str(folder_of / "capture")
            (folder_of / "run" / "run.json").write_text(json.dumps(facts))
        words, place = road(folder_of)[name]
        first = run_command(words, moment)
        again = run_command(words)
        is_same = again.code == 0 and contents(place) == expected[name]
        is_clean = first.code in (0, signals.INTERRUPTED, -signal.SIGTERM)
        was_stopped += first.code != 0
        if not is_same or not is_clean or leftovers(folder_of):
            different.append(f"{folder_of.name}: {name} after {moment:.2f} s, code {first.code}")
        ends += [first, again]
        print(
            f"{number + 1}/{count} {name} after {moment:.2f} s: exit code {first.code} in "
            f"{first.stopping:.2f} s, again {again.seconds:.1f} s: "
            + ("the same" if is_same else f"DIFFERENT ({again.told[-3:]})"),
            flush=True,
        )
        if is_same:
            shutil.rmtree(folder_of)
    stopping = [end.stopping for end in ends]
    print(f"told to stop: {count}, by command {before}; {was_stopped} before they had ended")
    print(f"the same afterwards: {count - len(different)} of {count}")
    print(f"from signal to exit: at most {max(stopping):.2f} s")
    print(f"silence: at most {max(end.silence for end in ends):.1f} s")
    print("\n".join(different))
    return len(different)


def _without_evaluation(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name == "evaluation"]


def run_small(words: list[str]) -> int:
    """A command, whose trainings have the small budget."""
    with signals.heard_signals(ends_at_once=True):
        METHODS["best"] = replace(METHODS["best"], **SMALL)  # type: ignore[arg-type]
        return cli.main(words)


@contextmanager
def watched_stop_points(least: float = 0.5) -> Iterator[list[tuple[float, str]]]:
    """The times between two stop points, from ``least`` seconds on, and the lines that they end at.

    Of the main thread: with one thread, that is all there is.
    """
    found: list[tuple[float, str]] = []

    class Watched(signals._Listening):
        last = time.monotonic(), time.thread_time()

        def __getattribute__(self, name: str) -> object:
            is_main = threading.current_thread() is threading.main_thread()
            if name == "received" and is_main and not super().__getattribute__("num_unbroken"):
                now, busy = time.monotonic(), time.thread_time()
                if busy - Watched.last[1] >= least:
                    places = traceback.extract_stack()[-6:-1]
                    where = " < ".join(f"{p.name}:{p.lineno}" for p in reversed(places))
                    found.append(
                        (
                            busy - Watched.last[1],
                            f"{now - Watched.last[0]:.2f} by the clock, until {where}",
                        )
                    )
                Watched.last = now, busy
            return super().__getattribute__(name)

    before = signals._Listening
    signals._Listening = Watched  # type: ignore[misc]
    try:
        yield found
    finally:
        signals._Listening = before  # type: ignore[misc]


def tell_gaps(words: list[str]) -> int:
    """Runs a command and tells where its stop points are farthest apart."""
    begin = time.monotonic()
    with watched_stop_points() as found:
        code = cli.main(words)
    print(f"{' '.join(words)}: exit code {code}, {duration(time.monotonic() - begin)}")
    for seconds, where in sorted(found, reverse=True)[:15]:
        print(f"{seconds:.2f} s of a core, {where}")
    return code


def main() -> int:
    if sys.argv[1:2] == ["--gaps"]:
        return tell_gaps(sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--folder", type=Path, required=True, help="new")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    return 1 if measure(options.count, options.folder.absolute(), options.seed) else 0


if __name__ == "__main__":
    sys.exit(main())
