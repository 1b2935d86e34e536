"""``handavatar capture``: make captures and check them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from handavatar.cli.failures import BAD_DATA

if TYPE_CHECKING:
    from handavatar.capture.video import VideoOptions


def video(words: list[str]) -> int:
    """A video of one bare hand (or several) -> capture: track, mask, fit pose and shape."""
    from handavatar.capture.video import VideoOptions
    from handavatar.cli.arguments import parse

    options = parse(VideoOptions, words, "capture video", positional=("file", "more"))
    for asked in options.of_each_hand():
        _capture_hand(asked)
    return 0


def _capture_hand(options: "VideoOptions") -> None:
    from handavatar.capture.video import capture_video
    from handavatar.capture.video_report import summary_lines
    from handavatar.train.progress import Progress

    with Progress("capture video", 100) as progress:
        capture_video(
            options, progress=lambda share, stage: progress.update(round(100 * share), stage)
        )
    skipped = json.loads((options.out / "skipped.json").read_text(encoding="utf-8"))
    for name, reason in skipped["frames"].items():
        print(f"skipped {name}: {reason}")
    fit = json.loads((options.out / "fit.json").read_text(encoding="utf-8"))
    for line in summary_lines(fit["summary"]):
        print(line)
    print(f"look at: {options.out / 'overview.png'}")
    print(f"capture: {options.out}\nnext: handavatar train {options.out}")


def synth(words: list[str]) -> int:
    """A made capture with known albedo, light, shape and pose."""
    from handavatar.capture.synthetic import SynthOptions, make_capture
    from handavatar.cli.arguments import OUT, OVERWRITE, parse_with
    from handavatar.train.progress import Progress

    options, extras = parse_with(SynthOptions, (OUT, OVERWRITE), words, "capture synth")
    with Progress("capture synth", options.train_frames + options.test_frames) as progress:
        make_capture(
            extras["out"], options, extras["overwrite"], lambda done, total: progress.update(done)
        )
    print(f"capture: {extras['out']}\nnext: handavatar train {extras['out']}")
    return 0


def degrade(words: list[str]) -> int:
    """A worse copy of a capture: tracking noise, mask erosion, blur, JPEG."""
    from handavatar.capture.degraded import DegradeOptions, degrade_capture
    from handavatar.cli.arguments import OUT, OVERWRITE, parse_with

    options, extras = parse_with(
        DegradeOptions, (OUT, OVERWRITE), words, "capture degrade", ("source",)
    )
    degrade_capture(extras["out"], options, extras["overwrite"])
    print(f"capture: {extras['out']}\nnext: handavatar train {extras['out']}")
    return 0


def benchmark(words: list[str]) -> int:
    """The named made captures with known truth: subjects, lightings, transport, worse ones."""
    from handavatar.capture.benchmark import BenchmarkOptions, make_benchmark
    from handavatar.cli.arguments import OUT, parse_with
    from handavatar.train.progress import Progress

    options, extras = parse_with(BenchmarkOptions, (OUT,), words, "capture benchmark")
    with Progress("capture benchmark", len(options.names())) as progress:
        folders = make_benchmark(extras["out"], options, progress.update)
    for folder in folders:
        print(f"capture: {folder}")
    return 0


@dataclass(frozen=True)
class _CheckOptions:
    """Reads a capture completely and names every problem with file, frame and remedy.

    Attributes:
        capture: folder of the capture.
    """

    capture: Path


def check(words: list[str]) -> int:
    """Validate a capture: every problem with file, frame and remedy."""
    from handavatar.capture.frames import find_problems
    from handavatar.cli.arguments import JSON, parse_with, print_json

    options, extras = parse_with(_CheckOptions, (JSON,), words, "capture check", ("capture",))
    problems = find_problems(options.capture)
    if extras["json"]:
        print_json({"sound": not problems, "problems": [vars(problem) for problem in problems]})
    else:
        for problem in problems:
            print(problem)
        print(f"{options.capture}: {f'{len(problems)} problems' if problems else 'sound'}")
    return BAD_DATA if problems else 0
