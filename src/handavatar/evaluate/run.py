"""Judges a trained avatar on the held-out frames of its capture."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from handavatar.avatar import HandAvatar, Rendering, chosen_device, rendering_seconds
from handavatar.capture.checks import decoded, load_json, open_picture
from handavatar.capture.frame_sequence import spread_numbers
from handavatar.capture.frames import (
    FITTED_SIDE,
    Capture,
    CaptureError,
    Frame,
    FrameRecord,
    block_means,
    read_capture,
)
from handavatar.capture.registration import poses_of as registered_poses
from handavatar.capture.registration import register_frames
from handavatar.edit import Edit
from handavatar.errors import require_ranges
from handavatar.evaluate.baselines import judged_frame, textured_mesh_psnr, training_color
from handavatar.evaluate.figures import protocol_figures
from handavatar.evaluate.metrics import (
    JudgedFrame,
    albedo_psnr,
    masked_psnr,
    mean_color_masked_psnr,
    paper_scores,
    shading_correlation,
)
from handavatar.evaluate.perceptual import LpipsVgg, perceptual_loss
from handavatar.evaluate.registered import fitted_hand, registered_pose
from handavatar.evaluate.report import (
    Curve,
    ReportRow,
    contact_sheet,
    error_picture,
    greyed,
    picture,
    write_report,
)
from handavatar.evaluate.unseen import unseen_figures, unseen_pictures
from handavatar.fit.register import RegisterOptions
from handavatar.hand.pose import HandPose
from handavatar.jobs.files import (
    FolderKind,
    fill_folder,
    read_plain,
    refuse_folder_in_use,
    write_atomically,
)
from handavatar.jobs.logs import finite_figures, is_step, json_lines
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.video_writer import VideoWriter


def _is_older_evaluation(folder: Path) -> bool:
    """Whether a version that left no marker has judged an avatar there."""
    return all((folder / name).is_file() for name in ("metrics.json", "report.html"))


EVALUATION = FolderKind(
    "evaluation", ("*.png", "metrics.json", "report.html", "own_motion.mp4"), _is_older_evaluation
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
        full_size: judge pictures as large as the capture stores them; otherwise large ones are
            binned towards 256 pixels along a side, so that figures compare, and sooner.
        device: where the fields run.
    """

    run: Path
    capture: Path | None = None
    split: str = "test"
    out: Path | None = None
    max_frames: int | None = None
    full_size: bool = False
    device: str = "auto"

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, max_frames=(1, 10**6))


@dataclass(frozen=True, eq=False)
class _Protocol:
    """Everything of the judged frames when their poses are found in one way."""

    poses: list[HandPose]
    renderings: list[Rendering]
    judged: list[JudgedFrame]


def evaluate_run(options: EvaluateOptions, progress: Progress = SILENT) -> dict[str, Any]:
    """Renders the split and measures it; writes pictures, a report, a sheet and a film.

    Captures whose poses are known are judged in these (protocol ``known``). Of those made from
    videos every frame is judged twice: with its pose fitted to the mask and never to the colours
    (``mask``: how well the avatar is driven), and with this pose drawn to the texture, the avatar
    frozen (``registered``: how well it can look). The figures outside of ``protocols`` are those
    of ``known`` or ``mask``.

    Args:
        options: what to judge.
        progress: told how far it is.

    Returns:
        The object that ``handavatar evaluate --json`` prints.

    Raises:
        CheckpointError: if the run holds no finished avatar.
        CaptureError: if the capture is damaged, the split is empty, or the avatar has no light of
            one of the clips.
        FolderInUse: if ``out`` holds something that is no evaluation.

    Source: paper Sec. 4.1 (metrics).
    """
    avatar, capture, out = _opened(options)
    avatar.moved_to(chosen_device(options.device))
    split = capture.split(options.split)
    indices = [split[place] for place in spread_numbers(len(split), options.max_frames)]
    if not indices:
        raise CaptureError(
            f"{capture.folder}: no frame of split {options.split!r}",
            "name another split with `split`",
        )
    clips = {capture.records[index].clip for index in indices}
    if max(clips) >= avatar.num_lights:
        raise CaptureError(
            f"{capture.folder}: frames of clip {max(clips)} are to be judged; the avatar knows "
            f"lights {', '.join(map(str, range(avatar.num_lights)))}",
            "judge an avatar that was trained on these clips",
        )
    inputs = (options.run, capture.folder)
    refuse_folder_in_use(out, EVALUATION, True, inputs)
    count, is_tracked = len(indices), capture.is_tracked
    frames = [capture.frame(index) for index in indices]
    if not options.full_size:
        frames = [frame.binned(FITTED_SIDE) for frame in frames]
    cameras = [frame.camera for frame in frames]
    pictures = sum(rendering_seconds(camera.width, camera.height) for camera in cameras)
    stages = progress.stages(
        {
            "poses": 2.0 * count if is_tracked else 0.0,
            "rendering": pictures,
            "registered poses": 1.0 * count if is_tracked else 0.0,
            "rendering again": pictures if is_tracked else 0.0,
            "measuring": 1.0 * count,
            "report": 0.5 * count,
        }
    )
    protocols = _protocols(avatar, frames, is_tracked, stages)
    stages["measuring"](0.0)
    metrics = _measured(options, capture, avatar, frames, protocols)
    stages["report"](0.0)
    with fill_folder(out, EVALUATION, True, inputs) as folder:
        _write(folder, metrics, avatar, capture, frames, protocols, options)
    return metrics


def _protocols(
    avatar: HandAvatar,
    frames: list[Frame],
    is_tracked: bool,
    stages: dict[str, Progress],
) -> dict[str, _Protocol]:
    """By name; the first one is that of the figures outside of ``protocols``."""
    if not is_tracked:
        poses = [frame.pose for frame in frames]
        return {"known": _rendered(avatar, frames, poses, stages["rendering"])}
    held_out = held_out_poses(avatar, frames, stages["poses"])
    fitted = _rendered(avatar, frames, held_out, stages["rendering"])
    poses = []
    for frame, pose, rendering in zip(frames, fitted.poses, fitted.renderings, strict=True):
        poses.append(registered_pose(avatar, frame, pose, rendering))
        stages["registered poses"](len(poses), len(frames))
    registered = _rendered(avatar, frames, poses, stages["rendering again"])
    return {"mask": fitted, "registered": registered}


_AT_ONCE = 4
"""Pictures that are rendered side by side before progress is told."""


def _rendered(
    avatar: HandAvatar,
    frames: list[Frame],
    poses: list[HandPose],
    progress: Progress,
) -> _Protocol:
    renderings: list[Rendering] = []
    for start in range(0, len(frames), _AT_ONCE):
        progress(start, len(frames))
        part = slice(start, start + _AT_ONCE)
        cameras = [frame.camera for frame in frames[part]]
        lights = [Edit(light=frame.clip) for frame in frames[part]]
        renderings += map(_on_cpu, avatar.render_batch(poses[part], cameras, lights))
    judged = [
        judged_frame(frame, rendering.color, rendering.alpha)
        for frame, rendering in zip(frames, renderings, strict=True)
    ]
    return _Protocol(poses, renderings, judged)


def held_out_poses(
    avatar: HandAvatar, frames: list[Frame], progress: Progress = SILENT
) -> list[HandPose]:
    """Poses by landmarks and masks alone, never by colours.

    Training corrects the poses of its own frames; held-out frames get the same chance, with the
    avatar's shape as it is.

    Args:
        avatar: whose hand.
        frames: with their poses as tracked.
        progress: told how far it is.
    """
    hands = [fitted_hand(avatar, frame.pose) for frame in frames]
    options = RegisterOptions(
        pose_error=float(avatar.info.get("pose_error", RegisterOptions.pose_error)),
        learns_pose_error=False,
        texture_sigmas=(),
    )
    found = register_frames(hands, frames, options, learns_shape=False, progress=progress)
    return [pose.to(avatar.device) for pose in registered_poses(found)]


def _opened(options: EvaluateOptions) -> tuple[HandAvatar, Capture, Path]:
    run = options.run
    if run.is_dir():
        avatar = HandAvatar.load(run)
        folder = options.capture
        if folder is None:
            folder = _capture_of(run)
        out = options.out or run / "evaluation"
    else:
        folder = options.capture
        if folder is None:
            raise CaptureError(f"{run}: a file alone names no capture", "name one with `capture`")
        avatar = HandAvatar.load(run)
        out = options.out or run.parent / f"{run.stem}-evaluation"
    return avatar, read_capture(folder), out


def _capture_of(run: Path) -> Path:
    """The folder that a run says it was trained on."""
    capture = load_json(run / "run.json").get("capture")
    folder = capture.get("path") if isinstance(capture, dict) else None
    if not isinstance(folder, str):
        raise CaptureError(
            f"{run}: its run.json does not say of which capture it is", "name one with `capture`"
        )
    return Path(folder)


def _on_cpu(rendering: Rendering) -> Rendering:
    return Rendering(**{name: value.cpu() for name, value in vars(rendering).items()})


def _measured(
    options: EvaluateOptions,
    capture: Capture,
    avatar: HandAvatar,
    frames: list[Frame],
    protocols: dict[str, _Protocol],
) -> dict[str, Any]:
    notes: list[str] = []
    name, main = next(iter(protocols.items()))
    distance = perceptual_loss("auto")
    pairs = [frame.on_black() for frame in main.judged]
    perceptual = [float(distance(rendered[None], truth[None])) for rendered, truth in pairs]
    value = sum(perceptual) / len(perceptual)
    is_lpips = isinstance(distance, LpipsVgg)
    if not is_lpips:
        notes.append(f"paper.lpips: null, its weights are not here; {distance.name}: {value:.4f}")
    truth = _against_truth(capture, frames, main.renderings)
    if truth is None:
        notes.append("truth: null, the capture knows neither albedo nor shading of these frames")
    color = training_color(capture)
    colors = [] if color is None else [(color * frame.gain).clamp(0, 1) for frame in frames]
    stored = _record_of(capture, frames[0]).camera.width
    if frames[0].camera.width != stored:
        notes.append(
            f"judged at {frames[0].camera.width} pixels along a side, of {stored} that the capture "
            "stores; `full_size` judges these"
        )
    times = torch.tensor([frame.time for frame in frames], dtype=torch.float64)
    figures = {
        key: protocol_figures(protocol.judged, times, colors) for key, protocol in protocols.items()
    }
    paper = paper_scores(main.judged)
    notes += _POSE_NOTES[name]
    return {
        "split": options.split,
        "frames": len(frames),
        "dropped": dropped_frames(capture.folder, options.split),
        "hand_share": paper.hand_share,
        "paper": {
            "psnr": paper.psnr,
            "ssim": paper.ssim,
            "lpips": value if is_lpips else None,
        },
        "protocol": name,
        **{key: figures[name][key] for key in _OUTSIDE},
        "inside": {
            "psnr": figures[name]["masked"]["psnr"],
            "unknown_share": sum(float((~frame.known).float().mean()) for frame in frames)
            / len(frames),
        },
        "baseline": _baseline(avatar, capture, frames, main, color, colors, notes),
        "protocols": figures,
        "truth": truth,
        "skin_never_seen": unseen_figures(avatar),
        "perceptual": distance.name,
        "notes": notes,
    }


_OUTSIDE = ("masked", "core", "border", "detail", "mask_iou", "intervals")
_POSE_NOTES = {
    "known": ["poses are those of the capture, which knows them"],
    "mask": [
        "poses of the judged frames were fitted to their masks (protocol mask), and from there to "
        "their texture with the avatar frozen (protocol registered); the latter says how well the "
        "avatar can look, not how well it is driven",
        "mask_iou of poses that were fitted to masks is no evidence of right poses",
    ],
}


def _baseline(
    avatar: HandAvatar,
    capture: Capture,
    frames: list[Frame],
    main: _Protocol,
    color: Float[Tensor, "3"] | None,
    colors: Sequence[Float[Tensor, "3"]],
    notes: list[str],
) -> dict[str, float | None]:
    """What the avatar has to beat, by the masked protocol."""
    if color is None:
        notes.append("baseline: null, the capture has no training frames to learn a colour from")
        return dict.fromkeys(_BASELINES)
    own = [
        frame.painted(flat, rendering.alpha)
        for frame, flat, rendering in zip(main.judged, colors, main.renderings, strict=True)
    ]

    def poses_of(training: list[Frame]) -> list[HandPose]:
        if capture.is_tracked:
            return held_out_poses(avatar, training)
        return [frame.pose for frame in training]

    figures = (
        mean_color_masked_psnr(colors, main.judged),
        sum(map(masked_psnr, own)) / len(own),
        textured_mesh_psnr(avatar, capture, color, frames, main.poses, poses_of),
    )
    return dict(zip(_BASELINES, figures, strict=True))


_BASELINES = ("mean_color_masked_psnr", "mean_color_own_mask_psnr", "textured_mesh_masked_psnr")


def dropped_frames(folder: Path, split: str) -> dict[str, int | None]:
    """How many frames the capture left out, since they could not be fitted or trusted.

    Args:
        folder: of the capture; its ``fit.json`` and ``skipped.json`` are read if they are there.
        split: whose frames were judged.

    Returns:
        ``split``: of this split, where the capture fixed its splits before it dropped anything;
        ``capture``: of all. None for what the capture does not say.
    """
    of_split: int | None = None
    for name in ("fit.json", "skipped.json"):
        splits = _object(folder / name).get("splits")
        found = splits.get(split) if isinstance(splits, dict) else None
        if isinstance(found, dict):
            found = next((found[key] for key in _DROPPED if key in found), None)
        if isinstance(found, int) and of_split is None:
            of_split = found
    is_there = (folder / "skipped.json").is_file()
    reasons = {key for key in _object(folder / "skipped.json") if key != "splits"}
    return {"split": of_split, "capture": len(reasons) if is_there else None}


_DROPPED = ("dropped", "skipped", "left_out")


def _object(path: Path) -> dict[str, Any]:
    """A JSON file's object; an empty one if there is none."""
    try:
        return load_json(path)
    except (OSError, CaptureError):
        return {}


def _against_truth(
    capture: Capture, frames: list[Frame], renderings: list[Rendering]
) -> dict[str, float] | None:
    """Albedo and shading where the capture knows them."""
    albedos, lights, true_albedos, shadings, masks = [], [], [], [], []
    for frame, rendering in zip(frames, renderings, strict=True):
        files = [capture.folder / "truth" / kind / f"{frame.name}.png" for kind in _TRUTH]
        if not all(file.is_file() for file in files):
            return None
        albedo, shading = (true_picture(capture, frame, kind) for kind in _TRUTH)
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


def true_picture(capture: Capture, frame: Frame, kind: str) -> Tensor:
    """What a made capture knows of a frame's pixels, binned as the frame is.

    Args:
        capture: whose ``truth`` it is; its files are black outside of the stored mask.
        frame: of it.
        kind: a folder of ``truth``, such as ``albedo``.
    """
    image = float_image(capture.folder / "truth" / kind / f"{frame.name}.png")
    factor = len(image) // len(frame.mask)
    if factor == 1:
        return image
    mask = float_image(capture.folder / _record_of(capture, frame).mask_path) > 0.5
    image = image if image.ndim > 2 else image[..., None]
    values = torch.cat([image * mask[..., None], mask[..., None].float()], dim=-1)
    means = block_means(values, factor)
    found = means[..., :-1] / means[..., -1:].clamp_min(1e-6)
    return found if found.shape[-1] > 1 else found[..., 0]


def _record_of(capture: Capture, frame: Frame) -> FrameRecord:
    return next(record for record in capture.records if record.name == frame.name)


_TRUTH = ("albedo", "shading")


def float_image(file: Path) -> Tensor:
    """A picture's values in [0, 1], as stored."""
    return torch.from_numpy(decoded(open_picture(file), str(file)).astype(np.float32) / 255)


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
    avatar: HandAvatar,
    capture: Capture,
    frames: list[Frame],
    protocols: dict[str, _Protocol],
    options: EvaluateOptions,
) -> None:
    name, main = next(iter(protocols.items()))
    ratios, rows = [], []
    for place, frame in enumerate(frames):
        pictures = _strip(frame, main, place)
        strip = np.concatenate(list(pictures.values()), axis=1)
        Image.fromarray(strip).save(out / f"{frame.name}.png")
        said = [f"{key} {masked_psnr(of.judged[place]):.1f}" for key, of in protocols.items()]
        for key, of in protocols.items():
            if of is not main:
                pictures[key] = _strip(frame, of, place)["rendered"]
        ratios.append(masked_psnr(main.judged[place]))
        rows.append(ReportRow(f"{frame.name}  {', '.join(said)} dB masked", pictures))
    order = sorted(range(len(rows)), key=lambda place: -ratios[place])
    rows = [rows[place] for place in order]
    Image.fromarray(contact_sheet(rows, _SHEET)).save(out / "sheet.png")
    if capture.is_tracked:
        _film(out / "own_motion.mp4", capture, frames, main)
    write_atomically({out / "metrics.json": json.dumps(metrics, indent=2).encode()})
    figures = {key: value for key, value in metrics.items() if key not in ("notes", "protocols")}
    figures |= {f"protocol_{key}": value for key, value in metrics["protocols"].items()}
    for key in (*_OUTSIDE, "protocol"):
        del figures[key]
    write_report(
        out / "report.html",
        title=f"Avatar of {capture.subject or capture.folder.name}",
        subtitle=f"{metrics['frames']} held-out frames of {capture.folder.name}, best to worst by "
        f"protocol {name}; grey: nothing is known there",
        metrics={key: value for key, value in figures.items() if value is not None},
        rows=rows,
        unseen=_unseen_rows(avatar, metrics["skin_never_seen"]),
        curves=_curves(options.run),
        notes=metrics["notes"],
    )


def _unseen_rows(avatar: HandAvatar, figures: dict[str, Any] | None) -> list[ReportRow]:
    if figures is None:
        return []
    said = f"{100 * figures['share']:.0f} % of the skin, in violet: how it looks there is a guess"
    if figures["regions"]:
        said += f"; most of: {', '.join(figures['regions'])}"
    return [ReportRow(said, unseen_pictures(avatar, _UNSEEN_SIZE))]


_UNSEEN_SIZE = 192
_SHEET = {
    "truth": "truth",
    "rendered": "avatar",
    "albedo": "albedo",
    "illumination": "light",
    "error": "error",
}
"""Columns of the sheet, with their headings."""


def _strip(frame: Frame, protocol: _Protocol, place: int) -> dict[str, np.ndarray]:
    """The pictures of a frame; what is compared is grey where nothing is known."""
    rendered, truth = protocol.judged[place].on_black()
    pictures = {"truth": picture(truth), **pictures_of(protocol.renderings[place])}
    pictures["rendered"] = picture(rendered)
    pictures["error"] = error_picture(rendered, truth)
    compared = ("truth", "rendered", "error")
    return pictures | {key: greyed(pictures[key], frame.known) for key in compared}


def _film(path: Path, capture: Capture, frames: list[Frame], protocol: _Protocol) -> None:
    """The photographs beside the avatar in the hand's own motion, blocks of time one by one."""
    order = sorted(range(len(frames)), key=lambda place: frames[place].time)
    times = torch.tensor([frames[place].time for place in order], dtype=torch.float64)
    steps = times.diff()
    steps = steps[steps > 0]
    fps = 1 / float(steps.median()) if len(steps) else 1.0
    side = frames[0].camera.width
    fps = min(max(fps, 1.0), 60.0)
    with VideoWriter(path, fps, frames[0].camera.height, 2 * side) as writer:
        for place in order:
            frame = frames[place]
            shown = [frame.image.numpy(), picture(protocol.judged[place].rendered)]
            shown = [greyed(pixels, frame.known) for pixels in shown]
            if capture.side == "left":
                shown = [pixels[:, ::-1] for pixels in shown]
            writer.add(np.concatenate(shown, axis=1))


def _curves(run: Path) -> list[Curve]:
    log = run / "log.jsonl"
    if not log.is_file():
        return []
    records = [
        (record["step"], finite_figures(record))
        for _, record in json_lines(read_plain(log))
        if is_step(record.get("step"))
    ]
    return [
        Curve(
            f"{name}, mean of 20 steps",
            _averaged([(step, figures[name]) for step, figures in records if name in figures]),
        )
        for name in ("psnr", "silhouette", "color")
    ]


def _averaged(points: list[tuple[int, float]]) -> list[tuple[int, float]]:
    return [
        (points[end - 1][0], sum(value for _, value in points[max(0, end - 20) : end]) / 20)
        for end in range(20, len(points) + 1, 20)
    ]
