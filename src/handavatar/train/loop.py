"""The training loop: capture in, avatar out. There is only this one."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from handavatar import __version__
from handavatar.avatar import SCHEMA, CheckpointError, HandAvatar, RenderSettings, chosen_device
from handavatar.capture.frame_sequence import (
    FrameSequence,
    change_frames,
    choose_frames,
    spread_numbers,
)
from handavatar.capture.frames import FITTED_SIDE, Capture, CaptureError, Frame, read_capture
from handavatar.capture.soundness import require_sound
from handavatar.capture.view import view_of
from handavatar.edit import Edit
from handavatar.errors import SEEDS, argument, require_ranges
from handavatar.evaluate.metrics import mean_color
from handavatar.evaluate.perceptual import PerceptualChoice, PerceptualLoss, perceptual_loss
from handavatar.field.shading import CueSet, OrientedCues, PaperCues, TracedCues
from handavatar.fit.register import RegisterOptions
from handavatar.geometry.cameras import pixel_centers, rays_through_pixels
from handavatar.geometry.meshes import SurfacePoints, is_inside
from handavatar.geometry.rotations import mean_rotation
from handavatar.hand.rigs import find_rig
from handavatar.jobs.finite import NotFinite, find_not_finite, require_finite
from handavatar.jobs.memory import tidy
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import Interrupted, heard_signals, stop_point, unbroken
from handavatar.jobs.stage_states import (
    NOT_KEPT,
    StageState,
    StageStates,
    WorkState,
    named_tensors,
    state_files,
)
from handavatar.train.appearance import (
    SeenSamples,
    appearance_loss,
    find_seen_samples,
    samples_of_frames,
    with_hidden_poses,
)
from handavatar.train.border import border_pixels, fit_border
from handavatar.train.corrections import PoseCorrections
from handavatar.train.detail import learn_detail
from handavatar.train.divergence import (
    divergence_noted,
    finite_stage,
    may_take_seed,
    read_seeds,
    take_seed,
)
from handavatar.train.labelled_poses import sample_points
from handavatar.train.live import shown_live
from handavatar.train.losses import border_loss, color_loss, occupancy_loss
from handavatar.train.muon import Muon
from handavatar.train.optimizer_state import (
    optimizer_options,
    optimizer_tensors,
    restore_optimizer,
)
from handavatar.train.outlines import (
    EdgeSet,
    corrected_pose,
    fit_outlines,
    shape_losses,
    small_mask,
)
from handavatar.train.personal_occupancy import fit_occupancy
from handavatar.train.pretraining import wide_and_narrow
from handavatar.train.prior import SHIPPED_PRIOR, load_prior
from handavatar.train.registration import register_training
from handavatar.train.runs import (
    UNFINISHED_STAGES,
    Checkpoint,
    Run,
    append_log,
    create_run,
    default_run_folder,
    interrupted_run_folder,
    latest_checkpoint,
    load_checkpoint,
    locked,
    open_run,
    save_checkpoint,
    truncate_log,
)
from handavatar.train.seen_anchors import count_seen_anchors
from handavatar.train.sky import place_directions, relit


@dataclass(frozen=True)
class Method:
    """The budget of a training; the method itself is always the whole one.

    Attributes:
        steps: optimisation steps.
        cues: what the illumination depends on: the paper's inputs, these and the normal, or light
            that is traced to the posed mesh.
        corrects_poses: those of tracked captures are learned; the paper takes them as they are.
        outline_rounds: before the first step, the poses of tracked captures and the shape are
            drawn in turn to the outlines of all frames, so many times (``train.outlines``).
        outline_visits: how often the shape sees every frame in one round.
        personal_steps: after the outlines, before the first step, the pair decoder learns the
            personal hand for so many steps (``train.personal_occupancy``).
        sharpness: of the occupancy, from then on; see :class:`PairOccupancy`.
        border_steps: then the decoder learns the borders of the masks (``train.border``).
        warm_steps: the first steps fit albedo and illumination alone, on samples that are found
            once (``train.appearance``); later steps recall these.
        warm_pixels: pixels per such step and per recall, from all frames.
        warm_stride: such steps know every so-manieth pixel in both directions.
        frames: frames per step.
        patches: patches per frame.
        patch_size: pixels along a side.
        patch_strides: a patch takes every pixel, or every second, ...; drawn for each patch. Wide
            patches show more of the hand for the same work.
        border_pixels: per frame; beside the mask's border the alpha is compared with the mask.
        perceptual_weight: of the perceptual loss beside the colour loss.
        num_samples: samples per ray while training.
        silhouette_size: the mask is compared at this many pixels along a side.
        lr: learning rate of albedo and illumination at the start.
        lr_matrices: of the matrices of albedo and illumination, with Muon in place of Adam; None
            leaves them to Adam.
        lr_shape: learning rate of the shape offsets at the start.
        lr_codes: learning rate of the albedo codes at the start.
        lr_decoder: learning rate of the pair decoder at the start.
        lr_pose: learning rate of the pose corrections at the start: radians; metres get a tenth.
        decay: all learning rates fall by this factor until the end, exponentially.
        occupancy_points: labelled points per frame for L_PairOF.
        occupancy_every: L_PairOF is taken at every so many steps.
        picture_size: pixels along a side towards which pictures are binned for all but the detail;
            None takes them as they are.
        rounds: midpoint subdivisions of the rig's mesh.
        num_anchors: anchors on the surface.
        detail_size: texels along a side of the texture that is learned last (``train.detail``); 0
            is none.
        detail_steps: that it is learned for, after it was unwrapped.
    """

    steps: int
    frames: int
    patches: int
    patch_size: int
    num_samples: int
    silhouette_size: int
    cues: CueSet = field(default_factory=PaperCues)
    corrects_poses: bool = True
    outline_rounds: int = 6
    outline_visits: int = 3
    personal_steps: int = 0
    sharpness: float = 1.0
    border_steps: int = 0
    warm_steps: int = 0
    warm_pixels: int = 2560
    warm_stride: int = 6
    patch_strides: tuple[int, ...] = (1,)
    border_pixels: int = 256
    perceptual_weight: float = 1.0
    lr: float = 5e-4
    lr_matrices: float | None = None
    lr_shape: float = 5e-4
    lr_codes: float = 5e-4
    lr_decoder: float = 5e-5
    lr_pose: float = 1e-3
    decay: float = 0.1
    occupancy_points: int = 1024
    occupancy_every: int = 1
    picture_size: int | None = FITTED_SIDE
    rounds: int = 2
    num_anchors: int = 4096
    detail_size: int = 0
    detail_steps: int = 0


_DETAILED_FRAMES = 256
"""So many frames, evenly spread, give the detail their large pictures: about 7 MB each."""
_MOST_DETAIL_FRAMES = 500
"""So many, evenly spread, have a say in the detail at all."""
_SEEN_FRAMES = 500
"""Of more frames, fewer pixels of each are looked at again and again."""
_DETAIL_STRIDE = 4
"""Where no pixels were found before, every so-manieth tells the detail of the light."""

_QUICK = Method(
    steps=320,
    cues=OrientedCues(),
    personal_steps=600,
    sharpness=3.0,
    border_steps=450,
    warm_steps=310,
    warm_stride=4,
    frames=1,
    patches=1,
    patch_size=32,
    num_samples=64,
    silhouette_size=192,
    patch_strides=(1, 2, 4),
    perceptual_weight=0.1,
    lr=2e-3,
    lr_matrices=1.2e-2,
    lr_shape=1e-2,
    lr_codes=1e-2,
    lr_decoder=2e-3,
    lr_pose=5e-3,
    decay=0.02,
    occupancy_every=4,
    detail_size=1024,
    detail_steps=200,
)
METHODS: dict[str, Method] = {
    "quick": _QUICK,
    "best": replace(_QUICK, cues=TracedCues()),
    # Its rates for the geometry are those of the last steps of all; these are the paper's.
    "joint": replace(
        _QUICK,
        warm_steps=0,
        lr_shape=5e-4,
        lr_decoder=5e-5,
        lr_pose=1e-3,
        detail_size=0,
        detail_steps=0,
    ),
    "paper": Method(
        steps=50_000,
        frames=8,
        patches=2,
        patch_size=32,
        num_samples=64,
        silhouette_size=256,
        picture_size=None,
        corrects_poses=False,
        outline_rounds=0,
    ),
}


@dataclass(frozen=True)
class TrainOptions:
    """What to train and where to.

    Attributes:
        capture: folder of the capture.
        out: run folder; by default ``outputs/{capture}/{method}/{time}``.
        method: the budget: ``quick`` for two CPU cores and minutes, ``best`` as long with light
            that is traced instead of guessed, ``paper`` for the paper's; ``joint`` is ``quick``
            with geometry and appearance learned together from the first step on, for comparison.
        steps: overrides the method's number of steps.
        resume: ``auto`` continues the run at ``out``, or by default the last one of this capture
            and method that was begun and is not finished, if there is one; ``never`` starts anew.
        prior: occupancy prior to start from.
        perceptual: ``auto`` takes LPIPS where its weights are present, else the features of a
            network that the extra ``perceptual`` installs, else the substitute; the run records
            which.
        checkpoint_every: steps between checkpoints.
        seed: of everything.
        device: ``auto`` takes a GPU if there is one.
    """

    capture: Path
    out: Path | None = None
    method: Literal["quick", "best", "joint", "paper"] = "quick"
    steps: int | None = None
    resume: Literal["auto", "never"] = "auto"
    prior: Path = SHIPPED_PRIOR
    perceptual: PerceptualChoice = "auto"
    checkpoint_every: int = 100
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, steps=(1, 10**8), checkpoint_every=(1, 10**8), seed=SEEDS)


@dataclass(frozen=True, eq=False)
class Training:
    """Everything that changes while training.

    Attributes:
        avatar: what is trained.
        corrections: of the tracked poses; None where poses are known exactly.
        optimizers: over both, by name.
    """

    avatar: HandAvatar
    corrections: PoseCorrections | None
    optimizers: dict[str, torch.optim.Optimizer]


def train(options: TrainOptions, progress: Progress = SILENT) -> Path:
    """Trains an avatar and returns the run folder.

    Args:
        options: what to train and where to.
        progress: told how far the whole training is.

    Raises:
        CaptureError: if the capture is damaged, has no training or test frames, or its hand,
            masks and pictures do not agree (:mod:`handavatar.capture.soundness`).
        RigError: if the rig that the capture's poses belong to is not here.
        CheckpointError: if the run to resume is damaged.
        NotFinite: if a weight, an optimiser's state or a loss is no longer finite; it names what,
            and in which step. The last checkpoint stays; the run may go on from it with another
            seed.
        Interrupted: after SIGINT or SIGTERM; what was done is kept, and the same call goes on from
            there.

    Source: paper Sec. 4.1 (end-to-end training).
    """
    with heard_signals():
        return _train(options, progress)


def _train(options: TrainOptions, progress: Progress) -> Path:
    device = chosen_device(options.device)
    method = METHODS[options.method]
    steps = method.steps if options.steps is None else options.steps
    capture = read_capture(options.capture)
    is_corrected = capture.is_tracked and method.corrects_poses
    seconds = stage_seconds(method, steps, len(capture.split("train")), is_corrected)
    stages = progress.stages(seconds)
    require_sound(capture, stages["checks"])
    frames = training_frames(capture, method, stages["frames"])
    perceptual = perceptual_loss(options.perceptual).to(device)
    stop_point()
    training = begin_training(capture, frames, method, options)
    stop_point()
    views = [view_of(own) for own in frames_of_clips(capture, frames)]
    training.avatar.info["view"] = views[0]
    if len(views) > 1:
        training.avatar.info["views"] = views
    run = _open_or_create(options, capture, perceptual.name, steps)
    live = shown_live(run, training.avatar, training.corrections, frames, progress)
    begun = run.facts["seed"]
    words = f"{argument('out', run.folder)} `resume='auto'`"
    noted = divergence_noted(run, begun, options.seed, words)
    where = "before the first step"
    with locked(run), live as progress, _repeatable(device), noted:
        stages = progress.stages(seconds)
        checkpoint = latest_checkpoint(run)
        take_seed(run, begun, options.seed, checkpoint.step if checkpoint else 0)
        work = _fingerprint(capture, method, options)
        done = 0
        try:
            outlines = _fit_or_restore_outlines(
                run, checkpoint, training, frames, method, options, stages, work
            )
            # Before the checkpoint is loaded: the samples are those of the geometry as it is now.
            seen = None
            if method.warm_steps:
                seen = _seen_samples(
                    *(training, frames, method, checkpoint, options.seed, stages["samples"]),
                    StageStates(run.folder / _SAMPLES_STATE, work, ("samples", "light", "done")),
                )
            lights = _light_directions(training).clone()
            start = done = _restore(run, checkpoint, training)
            # The checkpoint before the first step does not know them yet.
            _light_directions(training).copy_(lights)
            edges = EdgeSet.of(training.avatar.rig)
            num_warm = min(method.warm_steps, steps)
            warm, joint = stages["train"].split(num_warm, steps, _JOINT_STEP / _WARM_STEP)
            warm.skip(min(start, num_warm), max(num_warm, 1))
            if start > num_warm:
                joint.skip(start - num_warm, steps - num_warm)
            where = f"at step {start}"
            try:
                for step in range(start + 1, steps + 1):
                    _set_learning_rates(training, method.decay ** ((step - 1) / steps))
                    if seen is not None and step <= method.warm_steps:
                        figures = warm_step(training, seen, method, step, options.seed)
                        told, counted = warm, (step, num_warm)
                    else:
                        figures = train_step(
                            training, frames, seen, edges, perceptual, method, step, options.seed
                        )
                        told, counted = joint, (step - num_warm, steps - num_warm)
                    with unbroken():
                        _require_finite_step(training, figures, step)
                        append_log(run, step, figures)
                        done, where = step, f"at step {step}"
                        if step == steps or step % options.checkpoint_every == 0:
                            _save(run, training, outlines, step)
                    told(*counted, psnr=figures["psnr"], loss=figures["loss"])
            except Interrupted:
                with unbroken():
                    if done > start and done % options.checkpoint_every and done < steps:
                        _save(run, training, outlines, done)
                raise
            where = "while the detail is learned"
            with finite_stage("detail", lambda: model_tensors(training)):
                _learn_detail(
                    *(training, capture, frames, seen, perceptual, method, options.seed),
                    stages["detail"],
                    StageStates(
                        run.folder / _DETAIL_STATE, f"{work} {steps} {perceptual.name}", ("detail",)
                    ),
                )
            stages["saving"](0.0)
            count_seen_anchors(training.avatar, corrected_frames(training, frames))
            training.avatar.save(run.avatar)
        except KeyboardInterrupt as stop:
            raise Interrupted(
                f"{run.folder}: stopped {where}; the same command goes on from there"
            ) from stop
        for name in UNFINISHED_STAGES:
            for path in state_files(run.folder / name):
                path.unlink(missing_ok=True)
        stages["saving"](1.0)
    return run.folder


_GEOMETRY_STATE, _SAMPLES_STATE, _DETAIL_STATE = UNFINISHED_STAGES
_WARM_STEP, _JOINT_STEP = 0.25, 2.2
"""Usual seconds of a step of the appearance alone, and of a frame of the other steps."""


def _samples_seconds(method: Method, count: int) -> dict[str, float]:
    """The parts of the stage that finds samples in so many frames, and their usual seconds."""
    if method.cues.num_directions > 0:
        return {"samples": 2.7 * count, "light": 1.8 * count}
    return {"samples": 0.5 * count, "light": 0.0}


def stage_seconds(method: Method, steps: int, count: int, is_corrected: bool) -> dict[str, float]:
    """The stages of a training, and how long each usually takes on two cores.

    Args:
        method: of the training.
        steps: of it.
        count: of the training frames.
        is_corrected: whether their poses are learned, too.
    """
    warm = min(method.warm_steps, steps)
    return {
        "checks": 0.03 * count,
        "frames": 0.02 * count + 2.0,
        "registration": 2.0 * count if is_corrected else 0.0,
        "outlines": 0.03 * method.outline_rounds * method.outline_visits * count,
        "occupancy": 0.2 * count + 0.13 * method.personal_steps if method.personal_steps else 0.0,
        "border": 0.11 * count + 0.55 * method.border_steps if method.border_steps else 0.0,
        "samples": sum(_samples_seconds(method, count).values()) if method.warm_steps else 0.0,
        "train": _WARM_STEP * warm + _JOINT_STEP * method.frames * (steps - warm),
        "detail": 0.5 * count + 0.06 * method.detail_steps if method.detail_size else 0.0,
        "saving": 2.0,
    }


def _fingerprint(capture: Capture, method: Method, options: TrainOptions) -> str:
    """Of all that the state of a stage before the first step depends on."""
    budget = asdict(method) | {"cues": method.cues.name}
    own = {"seed": options.seed, "prior": sha256(options.prior.read_bytes()).hexdigest()}
    own |= {"capture": capture.sha256, "version": __version__, "schema": SCHEMA}
    record = {"budget": budget} | own
    return sha256(json.dumps(record, default=str).encode()).hexdigest()


def _require_finite_step(training: Training, figures: dict[str, float], step: int) -> None:
    """Refuses a step that leads nowhere: before it is logged, shown or saved."""
    found = [find_not_finite({"loss": figures}), find_not_finite(model_tensors(training))]
    if any(found):
        raise NotFinite(f"step {step}: {'; '.join(text for text in found if text)}")


def training_frames(
    capture: Capture, method: Method, progress: Progress = SILENT
) -> Sequence[Frame]:
    """The frames of split ``train``, as large as the method takes them, read when needed.

    Args:
        capture: that holds them.
        method: of the training.
        progress: told how many have been read.

    Raises:
        CaptureError: if a frame is damaged, or a number of it is not finite.
    """
    indices = capture.split("train")

    def read(number: int) -> Frame:
        frame = capture.frame(indices[number])
        return frame if method.picture_size is None else frame.binned(method.picture_size)

    frames = FrameSequence(read, len(indices))
    for number, frame in enumerate(tidy(frames)):
        progress(number, len(frames))
        frame.require_finite()
    return frames


def frames_of_clips(capture: Capture, frames: Sequence[Frame]) -> list[Sequence[Frame]]:
    """The training frames of each clip.

    Args:
        capture: of the frames.
        frames: of training.

    Raises:
        CaptureError: if a clip has none: its light could not be learned.
    """
    clips = [frame.clip for frame in frames]
    found = []
    for clip in range(capture.num_clips):
        numbers = [number for number, own in enumerate(clips) if own == clip]
        if not numbers:
            raise CaptureError(
                f"{capture.folder}: clip {clip} has no frame of split 'train', from which its "
                "light could be learned",
                "mark some of its frames as split: train, and number the clips from 0 without gaps",
            )
        found.append(choose_frames(frames, numbers))
    return found


def _learn_detail(
    training: Training,
    capture: Capture,
    frames: Sequence[Frame],
    seen: SeenSamples | None,
    perceptual: PerceptualLoss,
    method: Method,
    seed: int,
    progress: Progress,
    states: StageStates,
) -> None:
    """The texture, from the last checkpoint on."""
    if not method.detail_size:
        return
    avatar = training.avatar
    parts = progress.stages(
        {"samples": 0.0 if seen is not None else 0.4 * len(frames), "detail": 1.0 * len(frames)}
    )
    if seen is None:
        settings = RenderSettings(num_samples=method.num_samples)
        small = corrected_frames(training, frames)
        stride = _DETAIL_STRIDE * _thinning(len(frames))
        seen = find_seen_samples(avatar, small, settings, stride, parts["samples"])
    numbers = spread_numbers(len(frames), _MOST_DETAIL_FRAMES)
    corrected = corrected_frames(training, _detailed_frames(capture, frames, numbers))
    if len(frames) > len(numbers):
        seen, corrected = samples_of_frames(seen, numbers), choose_frames(corrected, numbers)
    learned = learn_detail(
        avatar,
        corrected,
        seen,
        method.detail_size,
        method.detail_steps,
        perceptual,
        method.perceptual_weight,
        seed,
        parts["detail"],
        states.begin("detail", lambda: WorkState({})),
    )
    avatar.info["detail"] = {
        "size": method.detail_size,
        "steps": method.detail_steps,
        "perceptual": perceptual.name,
        "seen_share": round(learned.seen_share, 4),
    }


def _thinning(num_frames: int) -> int:
    """By how much pixels lie further apart, so that those of very many frames are not more."""
    return math.ceil(math.sqrt(max(1.0, num_frames / _SEEN_FRAMES)))


def _detailed_frames(
    capture: Capture, frames: Sequence[Frame], numbers: Sequence[int]
) -> Sequence[Frame]:
    """The training frames as the capture stores them; of very many, some stay binned.

    Args:
        capture: of the frames.
        frames: as large as training takes them.
        numbers: of those that have a say in the detail.
    """
    indices = capture.split("train")
    whole = {numbers[place] for place in spread_numbers(len(numbers), _DETAILED_FRAMES)}

    def detailed(number: int, frame: Frame) -> Frame:
        is_large = number in whole and capture.records[indices[number]].camera != frame.camera
        return capture.frame(indices[number]) if is_large else frame

    return change_frames(frames, detailed)


@contextmanager
def _repeatable(device: torch.device) -> Iterator[None]:
    """The same bits every time on a CPU, with several threads too.

    Torch's threads add the gradients of indexed values in any order, unless told otherwise.
    """
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(before or device.type == "cpu")
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)


def begin_training(
    capture: Capture, frames: Sequence[Frame], method: Method, options: TrainOptions
) -> Training:
    """An untrained avatar of the capture's person with the prior's geometry, and its optimisers.

    Departs: the authors use Adam alone; where the method says so, Muon takes the matrices of albedo
        and illumination, and a quarter of the steps does.
    """
    rig = find_rig(capture.rig_sha256, capture.rig_name)
    torch.manual_seed(options.seed)
    info = {
        "side": capture.side,
        "subject": capture.subject,
        "method": options.method,
        "color_space": capture.color_space,
        "licence": capture.licence,
    }
    avatar = HandAvatar(
        rig,
        capture.shape_coefficients,
        method.rounds,
        method.num_anchors,
        cues=method.cues,
        info=info,
        num_lights=capture.num_clips,
    )
    load_prior(avatar.occupancy, options.prior)
    some = choose_frames(frames, spread_numbers(len(frames), _SEEN_FRAMES))
    avatar.start_from_color(mean_color((frame.colors, frame.mask) for frame in some))
    wrists = torch.stack([frame.pose.rotations[0] for frame in frames])
    avatar.illumination.wrist_reference.copy_(mean_rotation(wrists))
    avatar.occupancy.encoder.requires_grad_(False)
    is_corrected = capture.is_tracked and method.corrects_poses
    corrections = PoseCorrections(len(frames)) if is_corrected else None
    device = chosen_device(options.device)
    avatar.moved_to(device)
    networks = [*avatar.albedo.mlp.parameters(), *avatar.illumination.parameters()]
    wide, others = wide_and_narrow(networks) if method.lr_matrices is not None else ([], networks)
    groups: list[dict[str, Any]] = [
        {"params": others, "lr": method.lr},
        {"params": list(avatar.shape.parameters()), "lr": method.lr_shape},
        {"params": [avatar.albedo.codes], "lr": method.lr_codes},
        {"params": list(avatar.occupancy.decoder.parameters()), "lr": method.lr_decoder},
    ]
    if corrections is not None:
        corrections.to(device)
        groups += [
            {"params": list(corrections.rotations), "lr": method.lr_pose},
            {"params": list(corrections.translations), "lr": 0.1 * method.lr_pose},
        ]
    optimizers: dict[str, torch.optim.Optimizer] = {"adam": torch.optim.Adam(groups)}
    if method.lr_matrices is not None:
        optimizers["muon"] = Muon(wide, method.lr_matrices)
    for optimizer in optimizers.values():
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
    training = Training(avatar, corrections, optimizers)
    require_finite(
        model_tensors(training),
        "before the first step",
        "check the capture with `handavatar capture check`, and give another prior if you gave one",
    )
    return training


def _fit_or_restore_outlines(
    run: Run,
    checkpoint: Checkpoint | None,
    training: Training,
    frames: Sequence[Frame],
    method: Method,
    options: TrainOptions,
    stages: dict[str, Progress],
    fingerprint: str,
) -> dict[str, Tensor]:
    """Sets shape, poses and decoder as the outlines alone would have them, and returns these."""
    modules = _outline_modules(training)
    states = StageStates(run.folder / _GEOMETRY_STATE, fingerprint, _GEOMETRY_STAGES)
    if checkpoint is None:
        fit_geometry(training, frames, method, options.seed, stages, states)
        tensors = {
            f"{prefix}{name}": value.clone()
            for prefix, module in modules.items()
            for name, value in module.state_dict().items()
        }
        tensors["coefficients"] = training.avatar.coefficients.clone()
        with unbroken():
            _save(run, training, tensors, 0)
            states.remove()
        return tensors
    states.remove()
    for name in _GEOMETRY_STAGES:
        stages[name].skip()
    training.avatar.occupancy.sharpness = method.sharpness
    contents = load_checkpoint(checkpoint)
    stored = contents.tensors
    training.avatar.info |= contents.state.get("learned", {})  # Older checkpoints have none.
    tensors = stored["outlines"]
    if "parts" in stored:  # Older checkpoints have none; they are drawn alike.
        _set_part_points(training, stored["parts"])
    training.avatar.coefficients.copy_(tensors["coefficients"])
    for prefix, module in modules.items():
        module.load_state_dict(named_tensors(tensors, prefix))
    return tensors


def _set_part_points(training: Training, parts: Mapping[str, Tensor]) -> None:
    points = SurfacePoints(parts["corners"].clone(), parts["barycentric"].clone())
    divided = training.avatar.parts.with_points(points)
    training.avatar.parts = divided.to(training.avatar.device)


_GEOMETRY_STAGES = ("registration", "outlines", "occupancy", "border")


def fit_geometry(
    training: Training,
    frames: Sequence[Frame],
    method: Method,
    seed: int,
    stages: Mapping[str, Progress] | None = None,
    states: StageStates | None = None,
) -> None:
    """What comes before the first step: poses, shape and decoder, from what the frames show.

    Args:
        training: that has not begun.
        frames: of training.
        method: its budget.
        seed: of all that is drawn.
        stages: told how far its stages are.
        states: where they go on, if they were interrupted.

    Raises:
        NotFinite: if one of its stages leaves NaN or infinity.
        Interrupted: if the command was told to stop.
    """
    avatar = training.avatar
    if states is not None and states.whole is not None:
        _restore_whole(training, states.whole)

    @contextmanager
    def stage(name: str) -> Iterator[tuple[Progress, StageState]]:
        progress = SILENT if stages is None else stages[name]
        state = NOT_KEPT if states is None else states.begin(name, lambda: _whole(training))
        progress(0.0)
        with finite_stage(name, lambda: model_tensors(training)):
            yield progress, state

    def is_done(name: str) -> bool:
        if states is None or not states.is_done(name):
            return False
        if stages is not None:
            stages[name].skip()
        return True

    if training.corrections is not None and not is_done("registration"):
        with stage("registration") as (progress, state):
            found = register_training(
                avatar,
                training.corrections,
                frames,
                replace(RegisterOptions(), seed=seed),
                progress,
                state,
            )
        avatar.info["pose_error"] = round(found.pose_error, 3)
    if not is_done("outlines"):
        with stage("outlines") as (progress, state):
            fit_outlines(
                avatar,
                None,
                corrected_frames(training, frames),
                method.outline_rounds,
                method.outline_visits,
                method.silhouette_size,
                seed,
                progress,
                state,
            )
    corrected = corrected_frames(training, frames)
    if method.personal_steps and not is_done("occupancy"):
        poses = [frame.pose for frame in corrected]
        with stage("occupancy") as (progress, state):
            fit_occupancy(avatar, poses, method.personal_steps, seed, progress, state)
    avatar.occupancy.sharpness = method.sharpness
    if method.border_steps:
        settings = learned_rays(method.num_samples)
        with stage("border") as (progress, state):
            fit_border(avatar, corrected, method.border_steps, settings, seed, progress, state)


def _whole(training: Training) -> WorkState:
    points = training.avatar.parts.points
    tensors = model_tensors(training) | {"coefficients": training.avatar.coefficients}
    tensors |= {"parts.corners": points.faces, "parts.barycentric": points.barycentric}
    return WorkState(tensors, _learned_facts(training))


def _learned_facts(training: Training) -> dict[str, Any]:
    """What the avatar says of itself that was learned before the first step."""
    return {name: v for name, v in training.avatar.info.items() if name == "pose_error"}


def _restore_whole(training: Training, whole: WorkState) -> None:
    _load_model(training, whole.tensors)
    training.avatar.coefficients.copy_(whole.tensors["coefficients"])
    _set_part_points(training, named_tensors(whole.tensors, "parts."))
    training.avatar.info |= whole.facts


def _load_model(training: Training, model: Mapping[str, Tensor]) -> None:
    training.avatar.load_state_dict(named_tensors(model, "avatar."))
    if training.corrections is not None:
        training.corrections.load_state_dict(named_tensors(model, "corrections."))


def _outline_modules(training: Training) -> dict[str, torch.nn.Module]:
    modules: dict[str, torch.nn.Module] = {
        "shape.": training.avatar.shape,
        "decoder.": training.avatar.occupancy.decoder,
    }
    if training.corrections is not None:
        modules["corrections."] = training.corrections
    return modules


def _light_directions(training: Training) -> Tensor:
    """Of the light that is traced; empty where none is."""
    illumination = training.avatar.illumination
    return illumination.directions if illumination.chosen.num_directions else torch.zeros(0)


def _seen_samples(
    training: Training,
    frames: Sequence[Frame],
    method: Method,
    checkpoint: Checkpoint | None,
    seed: int,
    progress: Progress,
    states: StageStates,
) -> SeenSamples:
    """Found once; the directions of light are those of the checkpoint, if it has them already."""
    has_light = method.cues.num_directions > 0
    parts = progress.stages(_samples_seconds(method, len(frames)))
    avatar, corrected = training.avatar, corrected_frames(training, frames)
    settings = RenderSettings(num_samples=method.num_samples)
    directions = _light_directions(training)
    if states.whole is not None and states.is_done("samples"):
        tensors = dict(states.whole.tensors)
        placed = tensors.pop("directions", directions)
        seen = SeenSamples.of(tensors).moved_to(avatar.device)
        parts["samples"].skip()
    else:
        state = states.begin("samples", lambda: WorkState({}))
        stride = method.warm_stride * _thinning(len(frames))
        seen = find_seen_samples(avatar, corrected, settings, stride, parts["samples"], state)
    if states.is_done("light"):
        directions.copy_(placed)
        parts["light"].skip()
        return seen
    found = seen
    if has_light:
        state = states.begin("light", lambda: WorkState(found.tensors()))
        if checkpoint is None or checkpoint.step == 0:
            seen = place_directions(avatar, corrected, seen, seed, parts["light"], state)
        else:
            stored = load_checkpoint(checkpoint).tensors["model"]
            directions.copy_(stored["avatar.illumination.directions"])
            seen = relit(avatar, corrected, seen, parts["light"], state)
    states.begin("done", lambda: WorkState(seen.tensors() | {"directions": directions}))
    return seen


@torch.no_grad()
def corrected_frames(training: Training, frames: Sequence[Frame]) -> Sequence[Frame]:
    """The frames with their poses as training sees them."""
    device = training.avatar.device
    # The poses of now, whenever a frame is needed.
    poses = [
        corrected_pose(training.corrections, frame, number, device)
        for number, frame in enumerate(frames)
    ]
    return change_frames(frames, lambda number, frame: replace(frame, pose=poses[number]))


def _recalled(
    avatar: HandAvatar, seen: SeenSamples, method: Method, generator: torch.Generator
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Colour loss and squared error of pixels drawn from all frames."""
    pixels = torch.randint(len(seen.colors), (method.warm_pixels,), generator=generator)
    pixels = pixels.to(seen.colors.device)
    shown = with_hidden_poses(seen, avatar.illumination.chosen.pose_dropout, generator)
    return appearance_loss(avatar, shown, pixels)


def warm_step(
    training: Training, seen: SeenSamples, method: Method, step: int, seed: int
) -> dict[str, float]:
    """One optimiser step of the appearance alone, on ``seen``."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    _clear_gradients(training)
    color, squared = _recalled(training.avatar, seen, method, generator)
    color.backward()
    for optimizer in training.optimizers.values():
        optimizer.step()
    psnr = -10 * math.log10(max(float(squared), 1e-10))
    return {"color": float(color.detach()), "loss": float(color.detach()), "psnr": psnr}


def train_step(
    training: Training,
    frames: Sequence[Frame],
    seen: SeenSamples | None,
    edges: EdgeSet,
    perceptual: PerceptualLoss,
    method: Method,
    step: int,
    seed: int,
) -> dict[str, float]:
    """One optimiser step over the step's own frames, patches and random numbers.

    A step with few frames would pull the illumination towards just these; where ``seen`` is
    given, pixels of all frames keep it in place (the loss "recall").

    All randomness comes from ``(seed, step)``, so that a resumed training repeats nothing and
    skips nothing.

    Returns:
        The losses' values and the PSNR over the patches.
    """
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    _clear_gradients(training)
    sums: dict[str, float] = {}
    for place in range(method.frames):
        stop_point()
        number = _frame_number(len(frames), (step - 1) * method.frames + place, seed)
        losses = frame_losses(
            training, frames[number], number, edges, perceptual, method, step, generator
        )
        squared = losses.pop("squared_error")
        total = torch.stack(list(losses.values())).sum() / method.frames
        total.backward()
        for name, value in {**losses, "loss": total * method.frames, "squared": squared}.items():
            sums[name] = sums.get(name, 0.0) + float(value.detach()) / method.frames
    if seen is not None:
        recall, _ = _recalled(training.avatar, seen, method, generator)
        recall.backward()
        sums["recall"] = float(recall.detach())
    for optimizer in training.optimizers.values():
        optimizer.step()
    sums["psnr"] = -10 * math.log10(max(sums.pop("squared"), 1e-10))
    return sums


def learned_rays(num_samples: int) -> RenderSettings:
    """Of rays that are learned from: little is left out of their gradient."""
    return RenderSettings(num_samples=num_samples, smallest_weight=1e-6, stop=1e-5)


def frame_losses(
    training: Training,
    frame: Frame,
    number: int,
    edges: EdgeSet,
    perceptual: PerceptualLoss,
    method: Method,
    step: int,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """All losses of one frame; ``squared_error`` beside them for the record."""
    avatar = training.avatar
    device = avatar.device
    pose = corrected_pose(training.corrections, frame, number, device)
    state = avatar.prepare(pose)
    camera = frame.camera.to(device)
    mask, is_counted = small_mask(frame, method.silhouette_size)
    if is_counted is not None:
        is_counted = is_counted.to(device)
    losses = shape_losses(state.posed, state.offsets, camera, mask.to(device), edges, is_counted)
    if training.corrections is not None:
        losses["pose"] = 0.01 * training.corrections.penalty(number)

    if step % method.occupancy_every == 0:
        margin = avatar.occupancy.margin
        points = sample_points(
            avatar.parts, state.posed, method.occupancy_points, margin, generator
        ).to(device)
        labels = is_inside(state.posed.sealed_vertices, avatar.rig.sealed_faces, points)
        items = avatar.occupancy(state.codes, points).items
        predicted = avatar.occupancy.of_items(state.codes, points, items)
        losses["occupancy"] = occupancy_loss(predicted, labels)

    settings = learned_rays(method.num_samples)
    patches = [
        patch_pixels(frame.mask, method.patch_size, method.patch_strides, generator)
        for _ in range(method.patches)
    ]
    border = border_pixels(frame.alpha, method.border_pixels, generator, frame.known)
    x, y = torch.cat([*patches, border]).unbind(-1)
    near = avatar.near_mesh(state, camera, settings.mask_margin)[y, x].nonzero()[:, 0]
    rays = rays_through_pixels(camera, pixel_centers(camera)[y, x][near])
    seen = avatar.render_rays(state, rays, settings, generator, Edit(light=frame.clip))
    black = torch.zeros(len(x), device=device)
    alpha = black.index_copy(0, near, seen.alpha)
    color = black[:, None].repeat(1, 3).index_copy(0, near, seen.color)
    coverage = frame.alpha[y, x].to(device)
    if len(border):
        losses["border"] = border_loss(alpha[-len(border) :], coverage[-len(border) :])

    in_patches = slice(len(x) - len(border))
    x, y, coverage = x[in_patches], y[in_patches], coverage[in_patches]
    color, alpha = color[in_patches], alpha[in_patches]
    background = torch.rand(3, generator=generator).to(device)
    truth = frame.colors[y, x].to(device)
    truth = background + coverage[:, None] * (truth - background)
    color = color + (1 - alpha[:, None]) * background
    # Of what is not known both show the same: it has no loss, and its neighbours keep their weight.
    is_known = frame.known[y, x].to(device)[:, None]
    truth, color = (
        torch.where(is_known, truth, background),
        torch.where(is_known, color, background),
    )
    losses["color"] = color_loss(color, truth)
    size = (method.patches, method.patch_size, method.patch_size)
    distance = perceptual(color.unflatten(0, size), truth.unflatten(0, size)).mean()
    losses["perceptual"] = method.perceptual_weight * distance
    squared = (color.detach() - truth).square().mean(-1).sum()
    losses["squared_error"] = squared / is_known.sum().clamp_min(1)
    return losses


def patch_pixels(
    mask: Bool[Tensor, "height width"],
    size: int,
    strides: tuple[int, ...],
    generator: torch.Generator,
) -> Int[Tensor, "pixels 2"]:
    """Pixels (x, y) of a square patch that lies on the hand, row by row.

    The centre is a pixel of the mask four times out of five, else one of the square around it.

    Args:
        mask: true on the hand.
        size: pixels along a side.
        strides: steps between the pixels; one is drawn among those that fit the picture.
        generator: draws stride and place.

    Raises:
        CaptureError: if the picture is smaller than the patch.
    """
    height, width = mask.shape
    fitting = [stride for stride in strides if (size - 1) * stride < min(height, width)]
    if not fitting:
        raise CaptureError(
            f"pictures of {width} x {height} pixels are smaller than a {size} x {size} patch",
            "make the capture with larger pictures",
        )
    stride = fitting[int(torch.randint(len(fitting), (), generator=generator))]
    extent = (size - 1) * stride + 1
    on_hand = mask.nonzero()
    if len(on_hand) == 0:
        center = torch.tensor([height // 2, width // 2])
    elif float(torch.rand((), generator=generator)) < 0.8:
        center = on_hand[int(torch.randint(len(on_hand), (), generator=generator))]
    else:
        lower, upper = on_hand.amin(0), on_hand.amax(0) + 1
        center = lower + (torch.rand(2, generator=generator) * (upper - lower)).long()
    steps = torch.arange(size) * stride
    top = min(max(int(center[0]) - extent // 2, 0), height - extent)
    left = min(max(int(center[1]) - extent // 2, 0), width - extent)
    y, x = torch.meshgrid(top + steps, left + steps, indexing="ij")
    return torch.stack([x, y], dim=-1).flatten(0, 1)


def _frame_number(num_frames: int, visit: int, seed: int) -> int:
    """Frames in a new random order every epoch."""
    epoch, place = divmod(visit, num_frames)
    generator = torch.Generator().manual_seed(seed * 7919 + epoch)
    return int(torch.randperm(num_frames, generator=generator)[place])


def _set_learning_rates(training: Training, factor: float) -> None:
    for optimizer in training.optimizers.values():
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * factor


def _clear_gradients(training: Training) -> None:
    for optimizer in training.optimizers.values():
        optimizer.zero_grad(set_to_none=True)


def run_folder(options: TrainOptions) -> Path:
    """Where a training with these options goes on, or begins: ``out``, if that is given.

    Raises:
        CaptureError: if the capture cannot be read.
    """
    if options.out is not None:
        return options.out
    return _default_folder(options, read_capture(options.capture))


def _default_folder(options: TrainOptions, capture: Capture) -> Path:
    if options.resume == "auto":
        begun = interrupted_run_folder(capture.sha256, options.method)
        if begun is not None:
            return begun
    return default_run_folder(options.capture, options.method)


def _open_or_create(options: TrainOptions, capture: Capture, perceptual: str, steps: int) -> Run:
    folder = options.out or _default_folder(options, capture)
    if options.resume == "auto" and (folder / "run.json").exists():
        run = open_run(folder)
        _require_same_training(run, options, capture)
        return run
    record = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in asdict(options).items()
    }
    budget = asdict(METHODS[options.method])
    record |= {"steps": steps, "avatar_schema": SCHEMA}
    record |= {"budget": budget | {"cues": METHODS[options.method].cues.name}}
    return create_run(
        folder,
        record,
        seed=options.seed,
        capture=options.capture,
        capture_sha256=capture.sha256,
        perceptual=perceptual,
    )


def _require_same_training(run: Run, options: TrainOptions, capture: Capture) -> None:
    """A run goes on with what it was begun with, or not at all."""
    if run.options.get("avatar_schema") != SCHEMA:
        raise CheckpointError(
            f"{run.folder}: was begun by a version whose weights mean something else",
            "",
            "name another folder with `out`, or begin anew with `resume='never'`",
        )
    facts = run.facts
    seed = read_seeds(run, facts["seed"])[-1].seed
    if may_take_seed(run, facts["seed"], options.seed):
        seed = options.seed
    then = (facts["capture"]["sha256"], seed, run.options["method"])
    now = (capture.sha256, options.seed, options.method)
    for what, old, new in zip(("capture", "seed", "method"), then, now, strict=True):
        if old != new:
            raise CheckpointError(
                f"{run.folder}: was begun with {what} {str(old)[:12]}, now it is {str(new)[:12]}",
                "",
                "name another folder with `out`, or begin anew with `resume='never'`",
            )


def model_tensors(training: Training) -> dict[str, Tensor]:
    """Weights, buffers and pose corrections by name, as checkpoints have them."""
    model = {f"avatar.{name}": value for name, value in training.avatar.state_dict().items()}
    if training.corrections is not None:
        state = training.corrections.state_dict()
        model |= {f"corrections.{name}": value for name, value in state.items()}
    return model


def _save(run: Run, training: Training, outlines: dict[str, Tensor], step: int) -> None:
    points = training.avatar.parts.points
    parts = {"corners": points.faces, "barycentric": points.barycentric}
    tensors = {"model": model_tensors(training), "outlines": outlines, "parts": parts}
    tensors |= {name: optimizer_tensors(part) for name, part in training.optimizers.items()}
    state: dict[str, Any] = {
        name: optimizer_options(part) for name, part in training.optimizers.items()
    }
    state["learned"] = _learned_facts(training)
    save_checkpoint(run, step, tensors, state)


def _restore(run: Run, checkpoint: Checkpoint | None, training: Training) -> int:
    """Loads the checkpoint, if any; returns its step."""
    if checkpoint is None:
        truncate_log(run, 0)
        return 0
    contents = load_checkpoint(checkpoint)
    model = contents.tensors["model"]
    _load_model(training, model)
    for name, optimizer in training.optimizers.items():
        restore_optimizer(optimizer, contents.tensors[name], contents.state[name])
    truncate_log(run, checkpoint.step)
    return checkpoint.step
