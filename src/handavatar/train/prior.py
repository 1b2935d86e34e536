"""Pre-training of the occupancy prior on sampled poses and shapes.

No data set: poses come from the sampler of plausible poses, shapes from the rig's shape space,
labels from the generalised winding number of the sealed mesh (an overlap of fingers is inside).
Nothing depends on the wrist's placement: the field works in the frames of the bones.

Several processes: ``torchrun --nproc-per-node 2 -m handavatar prior train --poses 2 ...``. Torchrun
takes any abbreviation of its own options for itself: no option here may begin one of them.
"""

import json
import math
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from handavatar.avatar import CheckpointError
from handavatar.errors import SEEDS, ArgumentError, argument, raise_if_refused, require_ranges
from handavatar.evaluate.metrics import mask_iou
from handavatar.field.decoders import Decoder, OccupancyField, untrained_field
from handavatar.hand.open_hand import Level
from handavatar.hand.parts import POINT_ROUNDS, Parts, finer_rig
from handavatar.hand.pose_sampling import resolve_penetration, sample_poses
from handavatar.hand.rig import Rig
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import is_empty, refuse_file_in_use, write_atomically
from handavatar.jobs.finite import NotFinite, find_not_finite, require_finite
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import (
    Interrupted,
    heard_signals,
    is_stopping,
    stop_point,
    unbroken,
)
from handavatar.processes import Processes, joined_processes
from handavatar.train.divergence import divergence_noted, take_seed
from handavatar.train.labelled_poses import LabelledPose, PoseStream, labelled_pose
from handavatar.train.optimizer_state import optimizer_tensors
from handavatar.train.pretraining import (
    OccupancyLoss,
    begin_prior_run,
    learning_rate,
    load_progress,
    prior_optimizers,
    save_progress,
    set_rate,
)
from handavatar.train.runs import Run, append_log, locked, truncate_log
from handavatar.train.stage_times import StageTimes

SHIPPED_PRIOR = Path(__file__).parent.parent / "assets" / "prior.safetensors"
"""Made in stages, each from the result of the last:

1. at commit 214103c ``handavatar prior train --steps 9000 --out a.safetensors``, then ``--start
   a.safetensors --steps 5000 --lr 6e-4 --final-lr 3e-5 --warm-up 0 --seed 1 --refresh 2`` (a pool
   of poses and squared error, words that only that commit understands);
2. at commit eb43742 ``--start-from A --steps 1000 --lr 4e-4 --final-lr 4e-6 --seed 21`` (Adam);
3. at commit 7f644f9 ``--start-from B --steps 1200 --lr 5e-4 --final-lr 5e-6 --seed 22`` (Muon);
4. at commit df72211 ``--start-from C --steps 10000 --lr 6e-4 --final-lr 3e-6 --seed 23``, then
   ``--start-from D --steps 13000 --lr 6e-4 --final-lr 2e-6 --seed 24``: half an hour of one core
   each, from an IoU of 0.928 to 0.955 and 0.965;
5. at commit 223c02d, with both parts of a pair asked at joints, which closed a groove there, four
   times ``--start-from LAST``: ``--steps 6000 --lr 6e-4 --final-lr 2e-6 --seed 40 --joint-points
   384``, ``--steps 6500 --lr 6e-4 --final-lr 1e-6 --seed 41 --joint-points 256``, ``--steps 3500
   --lr 3e-4 --final-lr 1e-6 --seed 42 --joint-points 64``, ``--steps 2500 --lr 6e-5 --final-lr 1e-7
   --seed 43 --joint-points 64``: an hour of one core.
"""
EVALUATION_SEED = 1_000_003
"""Evaluation poses come from seeds that training never draws."""


@dataclass(frozen=True)
class PriorOptions:
    """How the occupancy prior is pre-trained.

    Attributes:
        out: where the trained prior is written (safetensors).
        steps: optimisation steps.
        poses: poses per step, all of them new; processes share them.
        points: labelled points per pose.
        joint_points: further points per pose where two parts meet, at which both must be right
            and not only the one that decides; PairOF alone. For the last steps, against grooves
            where parts meet.
        lr: the highest learning rate, soon after the start.
        final_lr: learning rate at the end; half a cosine in between.
        rig: the hand: ``open-hand``, an imported one (``mano-right``) or its file.
        level: ``778`` thins the open hand to MANO's size; other rigs have ``full`` alone.
        rounds: midpoint subdivisions of the mesh that is labelled and whose points are encoded.
        seed: of everything.
        start_from: a prior to continue from.
        decoder: ``pair`` is PairOF, the avatar's. Only for comparison with it: ``pair-shuffled``
            pairs parts that do not touch, ``coap`` and ``coap-wide`` decode each part alone,
            ``transformer`` all parts together.
        folder: for the log and checkpoints; what was begun there is continued.
        checkpoint_every: steps between two writings.
        device: where the networks run.
        overwrite: replace a file at ``out``; what was begun in ``folder`` does so anyway.
    """

    out: Path = Path("prior.safetensors")
    steps: int = 10_000
    poses: int = 1
    points: int = 1024
    joint_points: int = 0
    lr: float = 1e-3
    final_lr: float = 5e-5
    rig: str = "open-hand"
    level: Level = "full"
    rounds: int = POINT_ROUNDS
    seed: int = 0
    start_from: Path | None = None
    decoder: Decoder = "pair"
    folder: Path | None = None
    checkpoint_every: int = 1000
    device: str = "cpu"
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            steps=(1, 10**8),
            poses=(1, 1000),
            points=(1, 10**6),
            joint_points=(0, 10**6),
            lr=(1e-12, 1),
            final_lr=(1e-12, 1),
            rounds=(0, 4),
            seed=SEEDS,
            checkpoint_every=(1, 10**8),
        )


def train_prior(options: PriorOptions, progress: Progress = SILENT) -> OccupancyField:
    """Pre-trains the occupancy field and writes it.

    Started by ``torchrun``, the processes share the poses of every step and keep equal weights;
    the first one writes. The result is that of one process but for rounding.

    Args:
        options: see :class:`PriorOptions`.
        progress: told the steps done and the current figures: ``loss``, and ``samples`` a second
            (labelled points, of all processes together). The log of ``folder`` has besides the
            share of each stage of the first process's time, as ``share_...``.

    Raises:
        CheckpointError: if ``folder`` holds something else than a run with these options.
        FolderInUse: if there is a file at ``out`` already.
        NotFinite: if a loss, a weight or an optimiser's state is no longer finite; it names what,
            in which step, and how to go on.
        Interrupted: after SIGINT or SIGTERM; a checkpoint was saved if there is a ``folder``.
        RigError: if there is no such rig, or not at this level.
        ValueError: if the processes cannot share the poses of a step evenly, or for points at
            joints with another decoder.
    """
    if options.joint_points and options.decoder != "pair":
        raise ArgumentError(
            "joint_points",
            f"{options.joint_points} for the decoder {options.decoder!r}",
            "0: only 'pair' answers for two parts at once",
        )
    is_begun = options.folder is not None and not is_empty(options.folder)
    refuse_file_in_use(options.out, options.overwrite or is_begun)
    base = load_rig(options.rig, options.level)
    with joined_processes(options.device) as processes, heard_signals():
        if options.poses % processes.count:
            raise ArgumentError(
                "poses",
                f"{options.poses} a step for {processes.count} processes",
                "as many for each: a multiple",
            )
        with ExitStack() as held:
            run = None
            if options.folder is not None and processes.is_first:
                run = begin_prior_run(options.folder, _what_to_learn(options, base))
                held.enter_context(locked(run))
                begun, words = run.options["seed"], argument("folder", options.folder)
                held.enter_context(divergence_noted(run, begun, options.seed, words))
            return _trained(options, base, processes, run, progress)


def _trained(
    options: PriorOptions,
    base: Rig,
    processes: Processes,
    run: Run | None,
    progress: Progress,
) -> OccupancyField:
    """The loop; ``run`` is the first process's alone."""
    stop_point()  # From here on, processes stop together.
    torch.manual_seed(options.seed)
    field = untrained_field(options.decoder)
    if options.start_from is not None:
        load_prior(field, options.start_from, options.decoder)
    field.to(processes.device)
    optimizers = prior_optimizers(field)
    done, average = 0, math.nan
    if options.folder is not None:
        # The first process may put a broken checkpoint aside; the others must not be quicker.
        if processes.is_first:
            done, average = load_progress(Run(options.folder), field, optimizers)
        processes.wait()
        if not processes.is_first:
            done, average = load_progress(Run(options.folder), field, optimizers)
    rig, parts = finer_rig(base, options.rounds)
    stream = PoseStream(
        base, rig, parts, field.margin, options.points, options.seed, options.joint_points
    )
    times = StageTimes()
    loss_of: nn.Module = OccupancyLoss(field, parts.to(processes.device), times)
    if processes.count > 1:
        loss_of = DistributedDataParallel(loss_of, broadcast_buffers=False)
    if run is not None:
        take_seed(run, run.options["seed"], options.seed, done)
        if run.log.exists():
            truncate_log(run, done)
    written = 0
    note = ""
    progress.skip(done, options.steps)
    for step in range(done + 1, options.steps + 1):
        # The processes stop together: at the end of a step.
        with unbroken():
            first = (step - 1) * options.poses + processes.rank
            own = range(first, step * options.poses, processes.count)
            samples = [stream.drawn(number, times) for number in own]
            set_rate(optimizers, learning_rate(step, options.steps, options.lr, options.final_lr))
            field.zero_grad()
            loss = loss_of(samples)
            with times.stage("backward"):
                loss.backward()
            with times.stage("optimizer"):
                torch.nn.utils.clip_grad_norm_(field.parameters(), 1.0)
                for optimizer in optimizers.values():
                    optimizer.step()
            value = float(loss.detach())
            with times.stage("wait"):
                is_stopped = processes.any(is_stopping())
            is_last = step == options.steps or is_stopped
            is_saved = step % options.checkpoint_every == 0 or is_last
            values: dict[str, object] = {"loss": value, **field.state_dict()}
            if is_saved:
                values |= {name: optimizer_tensors(part) for name, part in optimizers.items()}
            found = find_not_finite(values)
            # All processes end, or those that found nothing would wait for the others for ever.
            with times.stage("wait"):
                if processes.any(found is not None):
                    found = found or "the loss of another process is not finite"
                    raise NotFinite(f"step {step}: {found}", _way_from(options, written))
            average = value if math.isnan(average) else 0.99 * average + 0.01 * value
            if processes.is_first and (step % 100 == 0 or is_last):
                points = (step - done) * options.poses * options.points
                figures = {"loss": average, "samples_per_second": points / times.seconds}
                figures |= {f"share_{name}": share for name, share in times.shares().items()}
                shares = sorted(
                    ((v, k[6:]) for k, v in figures.items() if k[:6] == "share_"), reverse=True
                )
                speed = f"{figures['samples_per_second']:,.0f} labelled points/s"
                note = "; ".join([speed, *(f"{name} {share:.0%}" for share, name in shares)])
                if run is not None:
                    append_log(run, step, figures)
            if processes.is_first and is_saved:
                save_prior(field, options, base, step)
                written = step
                if run is not None:
                    save_progress(run, step, field, optimizers, average)
            if is_stopped and step < options.steps:
                way = (
                    f"{options.folder}: the same command goes on from there"
                    if options.folder
                    else f"so far: {options.out}"
                )
                raise Interrupted(f"stopped at step {step}; {way}")
        progress(step, options.steps, note, loss=average)
    return field


def _way_from(options: PriorOptions, written: int) -> str:
    """What to do where there is no folder to go on in; the step of the file that was written."""
    again = "give the same command again with"
    if not written:
        return f"{again} `seed={options.seed + 1}`"
    return (
        f"{options.out} holds the weights of step {written}, which are good\n"
        f"{again} {argument('start_from', options.out)} `overwrite=True` "
        f"`seed={options.seed + 1}`"
    )


def _what_to_learn(options: PriorOptions, rig: Rig) -> dict[str, Any]:
    """The options on which the weights depend, as JSON; the rig as it is known anywhere."""
    elsewhere = ("out", "folder", "checkpoint_every", "device")
    record = {name: value for name, value in asdict(options).items() if name not in elsewhere}
    start = None if options.start_from is None else options.start_from.name
    known = f"{rig.name} ({rig.sha256[:12]})"
    return {**record, "rig": known, "start_from": start}


def save_prior(field: OccupancyField, options: PriorOptions, rig: Rig, step: int) -> None:
    """Writes the weights aside and renames them into place.

    Of the rig, whose arrays may be licensed, the file holds only name and fingerprint.

    Raises:
        NotFinite: if a weight is NaN or infinite; nothing is written then.
    """
    require_finite(field.state_dict(), f"{options.out}: not saved")
    record = {**_what_to_learn(options, rig), "out": options.out.name}
    metadata = {
        "schema": "1",
        "rig": rig.name,
        "rig_sha256": rig.sha256,
        "decoder": options.decoder,
        "margin": str(field.margin),
        "step": str(step),
        "options": json.dumps(record),
    }
    state = {name: value.detach().cpu().contiguous() for name, value in field.state_dict().items()}
    write_atomically({options.out: save(state, metadata)})


def load_prior(
    field: OccupancyField, path: Path = SHIPPED_PRIOR, decoder: Decoder = "pair"
) -> None:
    """Loads pre-trained weights into a field.

    Args:
        field: with the given decoder.
        path: a file that :func:`train_prior` wrote.
        decoder: which one the weights must be of; shapes alone do not tell.

    Raises:
        CheckpointError: if the file is missing, damaged or of another decoder, or holds NaN or
            infinity; it names the tensor.
    """
    found = _decoder_of(path)
    if found != decoder:
        raise CheckpointError(
            f"{path} holds a prior with the decoder {found!r}, expected {decoder!r}: train one "
            f"with handavatar prior train {argument('decoder', decoder)}"
        )
    try:
        tensors = load_file(path)
        field.load_state_dict(tensors)
    except Exception as error:
        raise_if_refused(error)
        raise CheckpointError(f"{path} is not a usable occupancy prior: {error}") from error
    if bad := find_not_finite(tensors):
        raise CheckpointError(
            f"{path} is not a usable occupancy prior: {bad}",
            "",
            "copy the file again, or leave it out: the prior that ships is good",
        )


def open_prior(path: Path = SHIPPED_PRIOR) -> OccupancyField:
    """The pre-trained field of a file, with the decoder that the file names.

    Raises:
        CheckpointError: if the file is missing, damaged or of an unknown decoder.
    """
    decoder = _decoder_of(path)
    field = untrained_field(decoder)
    load_prior(field, path, decoder)
    return field


def _decoder_of(path: Path) -> Decoder:
    """Which decoder a file's weights are of; the first files did not say and hold PairOF."""
    if not path.is_file():
        raise CheckpointError(
            f"no occupancy prior at {path}: train one with handavatar prior train "
            f"{argument('out', path)}"
        )
    try:
        with safe_open(path, framework="pt") as file:
            found = (file.metadata() or {}).get("decoder", "pair")
    except Exception as error:
        raise_if_refused(error)
        raise CheckpointError(f"{path} is not a usable occupancy prior: {error}") from error
    for decoder in get_args(Decoder):
        if decoder == found:
            return decoder
    raise CheckpointError(
        f"{path} is not a usable occupancy prior: found the decoder {found!r}, expected one of "
        f"{get_args(Decoder)}; it may come from a newer version"
    )


@dataclass(frozen=True)
class PriorEvaluationOptions:
    """How an occupancy prior is judged.

    Attributes:
        prior: the weights; by default those that ship.
        poses: unseen poses of unseen shapes.
        points: labelled points per pose, half in the part boxes, half near the surface.
        rig: the hand: ``open-hand``, an imported one (``mano-right``) or its file.
        level: ``778`` thins the open hand to MANO's size; other rigs have ``full`` alone.
        rounds: midpoint subdivisions.
    """

    prior: Path = SHIPPED_PRIOR
    poses: int = 50
    points: int = 4096
    rig: str = "open-hand"
    level: Level = "full"
    rounds: int = POINT_ROUNDS

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, poses=(1, 10**5), points=(2, 10**6), rounds=(0, 4))


def evaluate_prior(options: PriorEvaluationOptions) -> dict[str, float]:
    """Intersection over union on unseen poses whose self-penetration is resolved.

    Returns:
        ``iou`` (mean over poses of the mean of the next two), ``iou_boxes``, ``iou_surface``; and
        ``iou_people``, the same as ``iou`` on hands that no shape coefficients give.
    """
    field = open_prior(options.prior)
    parts, samples = evaluation_poses(options, field.margin)
    scores = pose_scores(field, parts, samples)
    boxes, surface = scores.mean(0).tolist()
    parts, people = evaluation_poses(options, field.margin, are_people=True)
    return {
        "iou": (boxes + surface) / 2,
        "iou_boxes": boxes,
        "iou_surface": surface,
        "iou_people": float(pose_scores(field, parts, people).mean()),
    }


def evaluation_poses(
    options: PriorEvaluationOptions, margin: float, are_people: bool = False
) -> tuple[Parts, list[LabelledPose]]:
    """Unseen poses of unseen shapes with labelled points, the same at every call.

    Args:
        options: how many; ``prior`` plays no part.
        margin: of the part boxes, metres.
        are_people: whether the hands are off the rig's shapes.
    """
    base = load_rig(options.rig, options.level)
    rig, parts = finer_rig(base, options.rounds)
    generator = torch.Generator().manual_seed(EVALUATION_SEED + are_people)
    rotations = resolve_penetration(base, sample_poses(base, options.poses, generator))
    return parts, [
        labelled_pose(rig, parts, pose, options.points, margin, generator, are_people)
        for pose in rotations
    ]


def pose_scores(
    field: OccupancyField, parts: Parts, samples: list[LabelledPose]
) -> Float[Tensor, "poses 2"]:
    """Intersection over union of each pose: in the part boxes, and near the surface."""
    scores = []
    for sample in samples:
        with torch.no_grad():
            predicted = field(field.encode(parts, sample.posed), sample.points).whole > 0.5
        half = len(sample.points) // 2
        scores.append(
            [
                mask_iou(predicted[window], sample.is_inside[window])
                for window in (slice(0, half), slice(half, None))
            ]
        )
    return torch.tensor(scores)
