"""``handavatar capture``: make captures and check them."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handavatar.cli.failures import BAD_DATA, say, shown
from handavatar.errors import ArgumentError
from handavatar.jobs.progress import Progress, shown_progress

if TYPE_CHECKING:
    from handavatar.capture.video import VideoOptions


def video(words: list[str], progress: Progress) -> int:
    """A video of one bare hand (or several) -> capture: track, mask, fit pose and shape."""
    from handavatar.capture.video import VideoOptions
    from handavatar.cli.arguments import parse
    from handavatar.cli.inputs import CAMERAS, MASKS, VIDEO

    reads = {"file": VIDEO, "more": VIDEO, "masks": MASKS, "camera": CAMERAS}
    options = parse(VideoOptions, words, "capture video", ("file", "more"), reads)
    _capture_hands(options, progress)
    return 0


_WEBCAM = """From your hand before a webcam to a capture.

A page, opened in a browser of the machine with the camera, shows the hand live: which skin has been
seen well, what to show next, and what is wrong. It records; when you press stop, the recording is
kept beside OUT, and the command goes on as `handavatar capture video` does.
"""


def webcam(words: list[str], progress: Progress) -> int:
    """A hand before the webcam -> capture; a page says what to show; --drive: an avatar follows."""
    from handavatar.capture.video import VideoOptions
    from handavatar.cli.arguments import Extra, parse_with
    from handavatar.cli.inputs import AVATAR, CAMERAS, MASKS, VIDEO

    extras = (
        Extra(
            "out",
            Path | None,
            "folder of the capture; the recording is kept beside it, with an ending. Not needed "
            "with --drive: then nothing is recorded",
            None,
        ),
        Extra(
            "drive",
            Path | None,
            "run folder or file of an avatar, which follows the hand beside the camera's picture",
            None,
        ),
        Extra(
            "port", int, "of the page; if it is taken, the next free one", 7007, least=0, most=65535
        ),
        Extra("host", str, "where the page listens, as for view", "127.0.0.1"),
        Extra("token", str, "who does not know it does not see the page, as for view", ""),
    )
    options, values = parse_with(
        VideoOptions,
        extras,
        words,
        "capture webcam",
        given={"file": Path(), "out": Path()},
        about=_WEBCAM,
        reads={"drive": AVATAR, "more": VIDEO, "masks": MASKS, "camera": CAMERAS},
    )
    progress.end()  # While the page is open there is nothing to tell.
    recording = _record(options, values)
    if recording is None:
        return 0
    say(f"recorded: {recording}")
    try:
        with shown_progress("capture webcam", progress.is_silent) as shown:
            _capture_hands(replace(options, file=recording), shown)
    except BaseException:
        say(f"the recording is kept; handavatar capture video {recording} goes on")
        raise
    return 0


def _record(options: "VideoOptions", values: dict[str, Any]) -> Path | None:
    """The recording of a page; None if none was wanted. What is wrong is said before it opens."""
    from handavatar.capture.video import refuse_capture_in_use
    from handavatar.view.webcam import WebcamOptions, record_webcam

    out, drive = values["out"], values["drive"]
    if out is None and drive is None:
        raise ArgumentError("out", "say where the capture is to be, or `drive` an avatar")
    sampling = options.sampling()
    longest = sampling.wanted(sampling.max_frames)
    if sampling.end is not None:
        longest = min(longest, sampling.end)
    if out is not None:
        for asked in options.of_each_hand():
            refuse_capture_in_use(asked)
    place = values["port"], values["host"], values["token"]
    asked_page = WebcamOptions(out, drive, options.side, options.fit.focal_share, longest, *place)
    return record_webcam(asked_page)


def _capture_hands(options: "VideoOptions", progress: Progress) -> None:
    from handavatar.capture.video import capture_video

    hands = options.of_each_hand()
    with progress:
        for asked, part in zip(hands, progress.equal_parts(len(hands)), strict=True):
            capture_video(asked, progress=part)
    for asked in hands:
        _say_captured(asked)


def _say_captured(options: "VideoOptions") -> None:
    from handavatar.capture.video_report import summary_lines

    skipped = json.loads((options.out / "skipped.json").read_text(encoding="utf-8"))
    for name, reason in skipped["frames"].items():
        print(shown(f"skipped {name}: {reason}"))
    fit = json.loads((options.out / "fit.json").read_text(encoding="utf-8"))
    for line in summary_lines(fit["summary"]):
        print(shown(line))
    say(f"look at: {options.out / 'overview.png'}")
    say(f"capture: {options.out}\nnext: handavatar train {options.out}")


def synth(words: list[str], progress: Progress) -> int:
    """A made capture with known albedo, light, shape and pose."""
    from handavatar.capture.synthetic import SynthOptions, make_capture
    from handavatar.cli.arguments import OUT, OVERWRITE, parse_with

    options, extras = parse_with(SynthOptions, (OUT, OVERWRITE), words, "capture synth")
    with progress:
        make_capture(extras["out"], options, extras["overwrite"], progress)
    say(f"capture: {extras['out']}\nnext: handavatar train {extras['out']}")
    return 0


def degrade(words: list[str], progress: Progress) -> int:
    """A worse copy of a capture: tracking noise, mask erosion, blur, JPEG."""
    from handavatar.capture.degraded import DegradeOptions, degrade_capture
    from handavatar.cli.arguments import OUT, OVERWRITE, parse_with
    from handavatar.cli.inputs import CAPTURE

    options, extras = parse_with(
        DegradeOptions,
        (OUT, OVERWRITE),
        words,
        "capture degrade",
        ("source",),
        reads={"source": CAPTURE},
    )
    with progress:
        degrade_capture(extras["out"], options, extras["overwrite"], progress)
    say(f"capture: {extras['out']}\nnext: handavatar train {extras['out']}")
    return 0


def benchmark(words: list[str], progress: Progress) -> int:
    """The named made captures with known truth: subjects, lightings, transport, worse ones."""
    from handavatar.capture.benchmark import BenchmarkOptions, make_benchmark
    from handavatar.cli.arguments import OUT, parse_with

    options, extras = parse_with(BenchmarkOptions, (OUT,), words, "capture benchmark")
    with progress:
        folders = make_benchmark(extras["out"], options, progress)
    for folder in folders:
        say(f"capture: {folder}")
    return 0


@dataclass(frozen=True)
class _CheckOptions:
    """Reads a capture completely and names every problem with file, frame and remedy.

    Attributes:
        capture: folder of the capture.
    """

    capture: Path


def check(words: list[str], progress: Progress) -> int:
    """Validate a capture: every problem with file, frame and remedy."""
    from handavatar.capture.soundness import find_problems
    from handavatar.cli.arguments import JSON, parse_with, print_json
    from handavatar.cli.inputs import CHECKED

    options, extras = parse_with(
        _CheckOptions, (JSON,), words, "capture check", ("capture",), reads={"capture": CHECKED}
    )
    with progress:
        problems = find_problems(options.capture, progress)
    if extras["json"]:
        print_json({"sound": not problems, "problems": [vars(problem) for problem in problems]})
    else:
        for problem in problems:
            print(shown(str(problem)))
        say(f"{options.capture}: {f'{len(problems)} problems' if problems else 'sound'}")
    return BAD_DATA if problems else 0
