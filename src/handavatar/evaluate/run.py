"""Judges a trained avatar on the held-out frames of its capture."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from handavatar.alignment import aligned_pose
from handavatar.avatar import HandAvatar, Rendering, chosen_device
from handavatar.capture.frames import Capture, CaptureError, Frame, read_capture
from handavatar.evaluate.metrics import (
    JudgedFrame,
    albedo_psnr,
    masked_psnr,
    masked_scores,
    mean_color,
    mean_color_masked_psnr,
    mean_mask_iou,
    paper_scores,
    shading_correlation,
)
from handavatar.evaluate.perceptual import LpipsVgg, perceptual_loss
from handavatar.evaluate.report import Curve, ReportRow, error_picture, picture, write_report
from handavatar.hand.pose import HandPose
from handavatar.jobs.files import FolderKind, claim_folder


def _is_older_evaluation(folder: Path) -> bool:
    """Whether a version that left no marker has judged an avatar there."""
    return all((folder / name).is_file() for name in ("metrics.json", "report.html"))


EVALUATION = FolderKind(
    "evaluation", ("*.png", "metrics.json", "report.html"), _is_older_evaluation
)
"""The folder that :func:`evaluate_run` writes into."""


@dataclass(frozen=True)
class EvaluateOptions:
    """What to judge.

    Attributes:
        run: run folder, or an avatar file (then name the capture).
        capture: by default the one the run was trained on.
        split: frames to judge.
        out: folder for pictures, ``metrics.json`` and ``report.html``; by default
            ``evaluation`` in the run.
        max_frames: judge at most so many frames, evenly spread over the split.
        device: where the fields run.
    """

    run: Path
    capture: Path | None = None
    split: str = "test"
    out: Path | None = None
    max_frames: int | None = None
    device: str = "auto"


def evaluate_run(options: EvaluateOptions) -> dict[str, Any]:
    """Renders the split and measures it; writes pictures and a report.

    Poses of captures made from videos are first fitted to the frame's mask (never to its
    colours), since the training never saw these frames.

    Returns:
        The object that ``handavatar evaluate --json`` prints.

    Raises:
        CheckpointError: if the run holds no finished avatar.
        CaptureError: if the capture is damaged or the split is empty.
        FolderInUse: if ``out`` holds something that is no evaluation.

    Source: paper Sec. 4.1 (metrics).
    """
    avatar, capture, out = _opened(options)
    avatar.moved_to(chosen_device(options.device))
    indices = _spread(capture.split(options.split), options.max_frames)
    if not indices:
        raise CaptureError(
            f"{capture.folder}: no frame of split {options.split!r}",
            "name another split with --split",
        )
    claim_folder(out, EVALUATION)
    is_tracked = capture.is_tracked
    frames = [capture.frame(index) for index in indices]
    renderings, judged = [], []
    for frame in frames:
        pose = frame.pose
        if is_tracked:
            pose = held_out_pose(avatar, frame)
        rendering = _on_cpu(avatar.render(pose, frame.camera))
        renderings.append(rendering)
        judged.append(
            JudgedFrame(
                rendering.color.clamp(0, 1),
                rendering.alpha > 0.5,
                frame.image.float() / 255,
                frame.alpha,
            )
        )
    metrics = _measured(options, capture, frames, renderings, judged)
    if is_tracked:
        metrics["notes"].append("poses of the judged frames were fitted to their masks")
    _write(out, metrics, capture, frames, renderings, judged, options)
    return metrics


def held_out_pose(avatar: HandAvatar, frame: Frame) -> HandPose:
    """Training corrects the poses of its own frames; held-out frames get the same chance."""
    device = avatar.device
    return aligned_pose(
        avatar.coarse_personal, frame.pose.to(device), frame.camera.to(device), frame.alpha
    )


def _opened(options: EvaluateOptions) -> tuple[HandAvatar, Capture, Path]:
    run = options.run
    if run.is_dir():
        avatar = HandAvatar.load(run)
        folder = options.capture
        if folder is None:
            facts = json.loads((run / "run.json").read_text())
            folder = Path(facts["capture"]["path"])
        out = options.out or run / "evaluation"
    else:
        folder = options.capture
        if folder is None:
            raise CaptureError(f"{run}: a file alone names no capture", "name one with --capture")
        avatar = HandAvatar.load(run)
        out = options.out or run.parent / f"{run.stem}-evaluation"
    return avatar, read_capture(folder), out


def _spread(indices: tuple[int, ...], count: int | None) -> list[int]:
    if count is None or count >= len(indices):
        return list(indices)
    places = torch.linspace(0, len(indices) - 1, count).round().long().tolist()
    return [indices[place] for place in places]


def _on_cpu(rendering: Rendering) -> Rendering:
    return Rendering(**{name: value.cpu() for name, value in vars(rendering).items()})


def _measured(
    options: EvaluateOptions,
    capture: Capture,
    frames: list[Frame],
    renderings: list[Rendering],
    judged: list[JudgedFrame],
) -> dict[str, Any]:
    notes = []
    paper, masked = paper_scores(judged), masked_scores(judged)
    distance = perceptual_loss("auto")
    pairs = [frame.on_black() for frame in judged]
    perceptual = [float(distance(rendered[None], truth[None])) for rendered, truth in pairs]
    value = sum(perceptual) / len(perceptual)
    is_lpips = isinstance(distance, LpipsVgg)
    if not is_lpips:
        notes.append(f"paper.lpips: null, its weights are not here; {distance.name}: {value:.4f}")
    truth = _against_truth(capture, frames, renderings)
    if truth is None:
        notes.append("truth: null, the capture knows neither albedo nor shading of these frames")
    training = [capture.frame(index) for index in capture.split("train")]
    color = mean_color(
        [frame.image.float() / 255 for frame in training], [frame.mask for frame in training]
    )
    baseline = mean_color_masked_psnr(
        color,
        [frame.image.float() / 255 for frame in frames],
        [frame.alpha for frame in frames],
    )
    return {
        "split": options.split,
        "frames": len(frames),
        "hand_share": paper.hand_share,
        "paper": {
            "psnr": paper.psnr,
            "ssim": paper.ssim,
            "lpips": value if is_lpips else None,
        },
        "masked": {
            "psnr": masked.psnr,
            "ssim": masked.ssim,
            "flip": masked.flip,
            "worst5_psnr": masked.worst5_psnr,
        },
        "mask_iou": mean_mask_iou(judged),
        "baseline": {"mean_color_masked_psnr": baseline},
        "truth": truth,
        "perceptual": distance.name,
        "notes": notes,
    }


def _against_truth(
    capture: Capture, frames: list[Frame], renderings: list[Rendering]
) -> dict[str, float] | None:
    """Albedo and shading where the capture knows them."""
    albedos, lights, true_albedos, shadings, masks = [], [], [], [], []
    for frame, rendering in zip(frames, renderings, strict=True):
        files = [capture.folder / "truth" / kind / f"{frame.name}.png" for kind in _TRUTH]
        if not all(file.is_file() for file in files):
            return None
        albedo, shading = (float_image(file) for file in files)
        mask = frame.mask & (rendering.alpha > 0.5)
        albedos.append(rendering.albedo / rendering.alpha.clamp_min(1e-6)[..., None])
        lights.append(rendering.illumination / rendering.alpha.clamp_min(1e-6))
        true_albedos.append(albedo)
        shadings.append(shading if shading.ndim == 2 else shading.mean(-1))
        masks.append(mask)
    return {
        "albedo_psnr": albedo_psnr(albedos, true_albedos, masks),
        "shading_correlation": shading_correlation(lights, shadings, masks),
    }


_TRUTH = ("albedo", "shading")


def float_image(file: Path) -> Tensor:
    """A picture's values in [0, 1], as stored."""
    with Image.open(file) as image:
        return torch.from_numpy(np.asarray(image).astype(np.float32) / 255)


def pictures_of(rendering: Rendering) -> dict[str, np.ndarray]:
    """The channels of a rendering as pictures."""
    light = rendering.illumination[..., None].expand(-1, -1, 3)
    normal = (rendering.normal + rendering.alpha[..., None]) / 2
    return {
        "rendered": picture(rendering.color),
        "albedo": picture(rendering.albedo),
        "illumination": picture(light),
        "normal": picture(normal),
    }


def _write(
    out: Path,
    metrics: dict[str, Any],
    capture: Capture,
    frames: list[Frame],
    renderings: list[Rendering],
    judged: list[JudgedFrame],
    options: EvaluateOptions,
) -> None:
    rows = []
    for frame, rendering, pair in zip(frames, renderings, judged, strict=True):
        rendered, truth = pair.on_black()
        pictures = {"truth": picture(truth), **pictures_of(rendering)}
        pictures["error"] = error_picture(rendered, truth)
        rows.append(ReportRow(f"{frame.name}  {masked_psnr(pair):.1f} dB masked", pictures))
        strip = np.concatenate(list(pictures.values()), axis=1)
        Image.fromarray(strip).save(out / f"{frame.name}.png")
    (out / "metrics.json").write_text(json.dumps(metrics, indent=2))
    figures = {name: value for name, value in metrics.items() if name != "notes"}
    write_report(
        out / "report.html",
        title=f"Avatar of {capture.subject or capture.folder.name}",
        subtitle=f"{metrics['frames']} held-out frames of {capture.folder.name}",
        metrics={name: value for name, value in figures.items() if value is not None},
        rows=rows,
        curves=_curves(options.run),
        notes=metrics["notes"],
    )


def _curves(run: Path) -> list[Curve]:
    log = run / "log.jsonl"
    if not log.is_file():
        return []
    records = [json.loads(line) for line in log.read_text().splitlines() if line.endswith("}")]
    return [
        Curve(
            f"{name}, mean of 20 steps",
            _averaged([(record["step"], record[name]) for record in records if name in record]),
        )
        for name in ("psnr", "silhouette", "color")
    ]


def _averaged(points: list[tuple[int, float]]) -> list[tuple[int, float]]:
    return [
        (points[end - 1][0], sum(value for _, value in points[max(0, end - 20) : end]) / 20)
        for end in range(20, len(points) + 1, 20)
    ]
