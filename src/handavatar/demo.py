"""The embedded default: the whole road on the capture that ships, offline, on two cores."""

import json
import sys
import time
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from handavatar.animate import PICTURES, RenderOptions, pass_pictures, render_motion
from handavatar.avatar import HandAvatar, rendering_seconds
from handavatar.capture.default import default_capture
from handavatar.edit import Edit, bones_named
from handavatar.errors import SEEDS, require_ranges
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


@dataclass(frozen=True)
class DemoOptions:
    """The demonstration.

    Attributes:
        out: folder for everything; a demonstration that was interrupted there is continued.
        steps: training steps; by default those of method ``quick``.
        frames: frames of the video of unseen poses.
        size: pixels along a side of the video.
        device: where the fields run.
        seed: of the training.
    """

    out: Path = Path("demo")
    steps: int | None = None
    frames: int = 24
    size: int = 128
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, steps=(1, 10**8), frames=(1, 10_000), size=(2, 4096), seed=SEEDS)


def run_demo(options: DemoOptions, progress: Progress = SILENT) -> Path:
    """Trains on the shipped capture, judges held-out poses, renders new ones, edits one.

    Args:
        options: where to, how much.
        progress: told how far the whole demonstration is.

    Leaves ``avatar.safetensors``, ``metrics.json``, ``report.html``, ``overview.png``,
    ``novel_poses.mp4``, ``edits.png`` and the run itself in ``options.out``.

    Returns:
        The folder.

    Raises:
        FolderInUse: if ``out`` holds something that is no demonstration.
    """
    out = options.out
    run = out / "run"
    claim_folder(out, DEMONSTRATION)
    begin = time.monotonic()
    video = rendering_seconds(options.size, options.size) * options.frames
    stages = progress.stages({"training": 400.0, "judging": 180.0, "a video": video, "edits": 8.0})
    _say("1/4 training on the shipped capture", begin)
    train(
        TrainOptions(
            capture=default_capture().folder,
            out=run,
            steps=options.steps,
            device=options.device,
            seed=options.seed,
        ),
        stages["training"],
    )
    _copy(run / "avatar.safetensors", out / "avatar.safetensors")
    _say("2/4 judging held-out poses", begin)
    metrics = evaluate_run(EvaluateOptions(run=run, device=options.device), stages["judging"])
    _copy(run / "evaluation" / "metrics.json", out / "metrics.json")
    _copy(run / "evaluation" / "report.html", out / "report.html")
    with write_aside(out / "overview.png") as aside:
        Image.fromarray(overview(run / "evaluation")).save(aside)
    _say("3/4 a video of poses it never saw", begin)
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
    _say("4/4 edits", begin)
    with write_aside(out / "edits.png") as aside:
        edits = edited_pictures(HandAvatar.load(out / "avatar.safetensors"))
        Image.fromarray(edits).save(aside)
    _say(
        f"done: {metrics['paper']['psnr']:.1f} dB (paper's protocol), "
        f"mask IoU {metrics['mask_iou']:.3f}; open {out / 'report.html'}",
        begin,
    )
    return out


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


def edited_pictures(avatar: HandAvatar) -> np.ndarray:
    """One held-out frame side by side: as it is, brighter, recoloured, without finger shadows.

    Source: paper supplement (texture editing).
    """
    capture = default_capture()
    frame = capture.frame(capture.split("test")[0])
    edits = (
        Edit(),
        Edit(light_gain=1.5),
        Edit(light_gain=0.8),
        Edit(albedo_shift=(-0.05, 0.05, 0.2)),
        Edit(lifted_bones=bones_named(("thumb", "index", "middle"))),
    )
    camera = frame.camera.resized(128, 128)
    pictures = [pass_pictures(avatar.render(frame.pose, camera, edit))["rgb"] for edit in edits]
    return np.concatenate(pictures, axis=1)


def _say(text: str, begin: float) -> None:
    if sys.stderr.isatty():
        print(f"[{time.monotonic() - begin:5.0f} s] {text}", file=sys.stderr)
    else:
        line = {"demo": text, "seconds": round(time.monotonic() - begin, 1)}
        print(json.dumps(line), file=sys.stderr, flush=True)
