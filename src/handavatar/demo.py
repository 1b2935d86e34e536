"""The whole road in one command: of the capture that ships, offline, or of a user's own video."""

import json
import sys
import time
from dataclasses import dataclass, replace
from hashlib import file_digest
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from handavatar.animate import PICTURES, RenderOptions, pass_pictures, render_motion
from handavatar.avatar import HandAvatar, rendering_seconds
from handavatar.capture.checks import load_json
from handavatar.capture.default import default_capture
from handavatar.capture.frames import CAPTURE, Capture, read_capture
from handavatar.capture.video import VideoOptions, capture_video
from handavatar.capture.video_report import summary_lines
from handavatar.edit import Edit, bones_named
from handavatar.errors import SEEDS, ArgumentError, argument, require_ranges
from handavatar.evaluate.run import EvaluateOptions, evaluate_run
from handavatar.jobs.files import (
    FolderInUse,
    FolderKind,
    claim_folder,
    read_marker,
    refuse_folder_in_use,
    write_aside,
    write_atomically,
)
from handavatar.jobs.progress import SILENT, Progress
from handavatar.train.loop import TrainOptions, train
from handavatar.train.runs import RUN


def _is_older_demo(folder: Path) -> bool:
    """Whether a version that left no marker has begun a demonstration there."""
    # Versions that mark runs mark the demonstration, too: else it is a folder with a run in it.
    return read_marker(folder / "run") is None and RUN.is_older(folder / "run")


DEMONSTRATION = FolderKind("demonstration", is_older=_is_older_demo)
"""The folder that :func:`run_demo` writes into."""
_SOURCE = "source.json"
"""In it, once its capture is made: of which video, and how."""


@dataclass(frozen=True)
class DemoOptions:
    """The demonstration.

    Attributes:
        out: folder for everything; a demonstration that was interrupted there is continued.
        video: recording of one bare hand, as for `capture video`: all is done with that hand, in
            its light. By default with the capture that ships.
        fps: pictures taken per second of the video.
        start: seconds of the video from which pictures are taken.
        end: seconds until which they are; the end of the video by default.
        hand: which of two hands that are seen together is taken.
        steps: training steps; by default those of method ``quick``.
        frames: frames of the video of unseen poses.
        size: pixels along a side of the video.
        device: where the fields run.
        seed: of the training.
    """

    out: Path = Path("demo")
    video: Path | None = None
    fps: float = 10.0
    start: float = 0.0
    end: float | None = None
    hand: Literal["only", "left", "right", "larger"] = "only"
    steps: int | None = None
    frames: int = 24
    size: int = 128
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, steps=(1, 10**8), frames=(1, 10_000), size=(2, 4096), seed=SEEDS)
        self.of_video(self.video or Path()).sampling()  # Refuses what selects nothing.
        if self.video is None:
            for name in ("fps", "start", "end", "hand"):
                if getattr(self, name) != getattr(DemoOptions, name):
                    words = f"{getattr(self, name)} without a video"
                    raise ArgumentError(name, words, f"{argument('video')} beside it")

    def of_video(self, video: Path) -> VideoOptions:
        """How the capture is made of the user's video."""
        return VideoOptions(
            video,
            self.out / "capture",
            fps=self.fps,
            start=self.start,
            end=self.end,
            hand=self.hand,
        )


def run_demo(options: DemoOptions, progress: Progress = SILENT) -> Path:
    """Trains on the shipped capture or on a video, judges held-out poses, renders, edits.

    Args:
        options: where to, how much.
        progress: told how far the whole demonstration is.

    Leaves ``avatar.safetensors``, ``metrics.json``, ``report.html``, ``overview.png``,
    ``novel_poses.mp4``, ``edits.png`` and the run itself in ``options.out``; of a video also
    ``capture`` and ``own_motion.mp4``, the avatar beside the video's held-out frames.

    Returns:
        The folder.

    Raises:
        FolderInUse: if ``out`` holds something that is no demonstration.
        ArgumentError: if it holds a demonstration of something else.
        CaptureError: if no hand can be learned from the video; it says why.
    """
    out = options.out
    run = out / "run"
    claim_folder(out, DEMONSTRATION)
    begin = time.monotonic()
    is_own = options.video is not None
    source = _source(options)
    stages = progress.stages(
        {
            "the hand in the video": 400.0 if is_own else 0.0,
            "training": 700.0 if is_own else 400.0,
            "judging": 400.0 if is_own else 180.0,
            "a video": rendering_seconds(options.size, options.size) * options.frames,
            "edits": 8.0,
        }
    )
    numbers = count(1)

    def say_step(text: str) -> None:
        _say(f"{next(numbers)}/{5 if is_own else 4} {text}", begin)

    if options.video is None:
        capture = default_capture()
    else:
        say_step(f"looking for the hand in {options.video.name}")
        capture = _captured(
            options.of_video(options.video), source, stages["the hand in the video"]
        )
        for line in summary_lines(load_json(capture.folder / "fit.json")["summary"]):
            _say(line, begin)
    say_step(f"training on {'your video' if is_own else 'the shipped capture'}")
    train(
        TrainOptions(
            capture=capture.folder,
            out=run,
            steps=options.steps,
            device=options.device,
            seed=options.seed,
        ),
        stages["training"],
    )
    _copy(run / "avatar.safetensors", out / "avatar.safetensors")
    say_step("judging held-out poses")
    metrics = evaluate_run(EvaluateOptions(run=run, device=options.device), stages["judging"])
    _copy(run / "evaluation" / "metrics.json", out / "metrics.json")
    _copy(run / "evaluation" / "report.html", out / "report.html")
    if is_own:
        _copy(run / "evaluation" / "own_motion.mp4", out / "own_motion.mp4")
    with write_aside(out / "overview.png") as aside:
        Image.fromarray(overview(run / "evaluation")).save(aside)
    say_step("a video of poses it never saw")
    renders = _folder_of_pictures(run / "renders")
    render_motion(
        RenderOptions(
            run=run,
            out=renders,
            size=options.size,
            frames=options.frames,
            overwrite=True,
            device=options.device,
        ),
        stages["a video"],
    )
    _copy(renders / "rgb.mp4", out / "novel_poses.mp4")
    stages["edits"](0.0)
    say_step("edits")
    with write_aside(out / "edits.png") as aside:
        edits = edited_pictures(HandAvatar.load(out / "avatar.safetensors"), capture)
        Image.fromarray(edits).save(aside)
    _say(
        f"done: {metrics['paper']['psnr']:.1f} dB (paper's protocol), "
        f"mask IoU {metrics['mask_iou']:.3f}; open {out / 'report.html'}",
        begin,
    )
    return out


def _source(options: DemoOptions) -> dict[str, Any]:
    """What a demonstration is of; nothing is said of the capture that ships.

    Raises:
        ArgumentError: if ``out`` holds a demonstration of something else.
    """
    now: dict[str, Any] = {}
    if options.video is not None:
        digest = None  # Of a folder or a pattern the name alone is compared.
        if options.video.is_file():
            with options.video.open("rb") as content:
                digest = file_digest(content, "sha256").hexdigest()
        now = {
            "video": options.video.name,
            "sha256": digest,
            "fps": options.fps,
            "start": options.start,
            "end": options.end,
            "hand": options.hand,
        }
    path = options.out / _SOURCE
    if path.is_file():
        before = load_json(path)
    elif (options.out / "run").exists():
        before = {}
    else:
        return now
    if before != now:
        found, wanted = (str(one.get("video", "the capture that ships")) for one in (before, now))
        if found == wanted:
            differ = [key for key in now if before.get(key) != now[key]]
            found = f"{found} with other {', '.join(differ)}"
        raise ArgumentError(
            "out",
            f"{options.out}, a demonstration of {found}",
            f"one of {wanted}",
            f"name another folder with {argument('out', options.out.with_name('other'))}",
        )
    return now


def _captured(options: VideoOptions, source: dict[str, Any], progress: Progress) -> Capture:
    """The capture of a video; that which an earlier, interrupted command has made."""
    note = options.out.parent / _SOURCE
    if note.is_file():
        progress(1.0)
        return read_capture(options.out)
    # One without a note is of a command that was killed just before it would have left one.
    marker = read_marker(options.out)
    is_ours = marker is not None and marker["kind"] == CAPTURE.name
    capture = capture_video(replace(options, overwrite=is_ours), progress=progress)
    write_atomically({note: json.dumps(source, indent=1).encode()})
    return capture


def _copy(source: Path, target: Path) -> None:
    write_atomically({target: source.read_bytes()})


def _folder_of_pictures(renders: Path) -> Path:
    """``novel_poses``, or the first name with a number that holds nothing of anybody else's."""
    for number in count(1):
        folder = renders / ("novel_poses" if number == 1 else f"novel_poses-{number}")
        try:
            refuse_folder_in_use(folder, PICTURES, overwrite=True)
        except FolderInUse:
            continue
        return folder
    raise AssertionError("there is always a number that is free")


def overview(evaluation: Path, count: int = 4) -> np.ndarray:
    """Some judged frames, one below the other: truth, rendering, albedo, illumination, normal."""
    strips = sorted(evaluation.glob("[0-9]*.png"))
    chosen = [strips[place] for place in np.linspace(0, len(strips) - 1, count).astype(int)]
    pictures = [np.asarray(Image.open(strip)) for strip in chosen]
    return np.concatenate([strip[:, : strip.shape[1] * 5 // 6] for strip in pictures], axis=0)


def edited_pictures(avatar: HandAvatar, capture: Capture) -> np.ndarray:
    """One held-out frame side by side: as it is, brighter, recoloured, without finger shadows.

    Args:
        avatar: of the capture.
        capture: whose first held-out frame is taken.

    Source: paper supplement (texture editing).
    """
    frame = capture.frame(capture.split("test")[0])
    edits = (
        Edit(),
        Edit(light_gain=1.5),
        Edit(light_gain=0.8),
        Edit(albedo_shift=(-0.05, 0.05, 0.2)),
        Edit(lifted_bones=bones_named(("thumb", "index", "middle"))),
    )
    camera = frame.camera.resized(128, 128)
    renderings = avatar.render_batch([frame.pose] * len(edits), [camera] * len(edits), edits)
    pictures = [pass_pictures(rendering, capture.side)["rgb"] for rendering in renderings]
    return np.concatenate(pictures, axis=1)


def _say(text: str, begin: float) -> None:
    if sys.stderr.isatty():
        print(f"[{time.monotonic() - begin:5.0f} s] {text}", file=sys.stderr)
    else:
        line = {"demo": text, "seconds": round(time.monotonic() - begin, 1)}
        print(json.dumps(line), file=sys.stderr, flush=True)
