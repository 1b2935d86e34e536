"""``handavatar tracker train|evaluate``: makes pictures, teaches the tracker, judges it.

Several processes: ``torchrun --nproc-per-node 2 -m handavatar tracker train --out ...``.
"""

import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from handavatar.capture.checks import CaptureError
from handavatar.errors import SEEDS, ArgumentError, raise_if_refused, require_ranges
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import refuse_file_in_use, write_atomically
from handavatar.jobs.finite import NotFinite, find_not_finite, require_finite
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import Interrupted, heard_signals, is_stopping, unbroken
from handavatar.processes import ALONE, Processes, joined_processes
from handavatar.synthetic.crops import MadeCrops, make_crops
from handavatar.tracker.measures import TrackerFigures, measure_tracker
from handavatar.tracker.model import (
    TrackerError,
    TrainedTracker,
    read_tracker,
    save_tracker,
    shipped_tracker,
)
from handavatar.tracker.network import HandNetwork
from handavatar.tracker.points import TrackedPoints
from handavatar.tracker.training import (
    CROP_FIELDS,
    CropBatch,
    TrackerOptions,
    TrackerTraining,
    vary_crops,
)

RIG = "open-hand"
NUM_SKIN_POINTS = 64
IN_A_FILE = 1000
"""Pictures of a file."""
_SAVED_EVERY = 120
"""Seconds between two writings of all that a training needs to go on."""
_JUDGED_FROM = 1_000_000
"""Seeds from here on are never taught with."""
_IN_USE = TrackerOptions(turn=0.2, any_turn=0.0, sides=(1.3, 1.6), shift=0.05, mirrored=0.0)
"""How hands lie in crops that are cut about where they were seen before."""


@dataclass(frozen=True)
class TrackerTrainOptions:
    """How a tracker is taught."""

    out: Path
    """file of the tracker, such as tracker.safetensors"""
    pictures: Path = Path("tracker-pictures")
    """folder of made pictures, 54 MB a thousand; those that are missing are made"""
    count: int = 100_000
    """made pictures"""
    steps: int = 7000
    """of training, 64 pictures each"""
    seed: int = 0
    """first seed of the pictures"""
    device: str = "cpu"
    """where the network is taught"""
    processes: int = 0
    """that make pictures; 0: one a core"""
    start_from: Path | None = None
    """tracker whose weights are taught further; drawn anew if None"""
    rate: float = 2e-3
    """learning rate at its highest"""
    resume: bool = False
    """go on where a training of this file ended, or was ended"""
    overwrite: bool = False
    """replace a file at OUT, and what a training of it has left"""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            count=(1, 10**8),
            steps=(1, 10**8),
            seed=SEEDS,
            processes=(0, 1024),
            rate=(1e-12, 1),
        )


@dataclass(frozen=True)
class TrackerEvaluateOptions:
    """How a tracker is judged."""

    tracker: Path | None = None
    """file; the one that ships if None"""
    count: int = 2000
    """made pictures that none was taught with"""

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, count=(1, 10**7))


def train_made_tracker(options: TrackerTrainOptions, progress: Progress = SILENT) -> TrainedTracker:
    """Makes what pictures are missing, teaches a network, writes it.

    Started by ``torchrun``, the processes share files and the pictures of every step, and keep
    equal weights; the first one writes. Each normalises by its own part of a step's pictures.

    Args:
        options: how it is taught.
        progress: told how far it is.

    Raises:
        Interrupted: the command was told to stop; ``resume`` goes on with the state that it left.
        CaptureError: nothing to go on with, or a damaged file.
        FolderInUse: there is a file at ``out`` already.
        NotFinite: the loss, a weight or the optimiser's state is no longer finite; it names what,
            in which step, and how to go on.
        TrackerError: the file to start from is no tracker, or one of other points.
        ArgumentError: fewer files of a thousand pictures than processes.
    """
    with joined_processes(options.device) as processes, heard_signals():
        return _taught(options, processes, progress)


def _taught(
    options: TrackerTrainOptions, processes: Processes, progress: Progress
) -> TrainedTracker:
    state_file = options.out.with_suffix(".state")
    for path in (options.out, state_file):
        refuse_file_in_use(path, options.overwrite or options.resume)
    if options.resume and not state_file.is_file():
        raise CaptureError(
            f"{state_file}: there is nothing to go on with", "train without `resume=True`"
        )
    rig = load_rig(RIG)
    points = TrackedPoints.of(rig, NUM_SKIN_POINTS)
    stages = progress.stages({"pictures": 0.02 * options.count, "training": 1.0 * options.steps})
    files = make_pictures(options, stages["pictures"], processes)
    processes.wait()  # The others' files may be needed when it goes on with fewer processes.
    torch.manual_seed(options.seed)
    network = HandNetwork(len(points))
    if options.start_from is not None:
        first = read_tracker(options.start_from)
        if not first.points.are(points):
            raise TrackerError(
                f"{options.start_from}: tells other points of the hand; train it anew"
            )
        network = first.network
    taught = TrackerOptions(rate=options.rate)
    network = network.to(processes.device)
    training = TrackerTraining(network, taught, options.steps, options.seed, processes)
    if options.resume:
        try:
            state = load_file(state_file)
            require_finite(state, "state")
            training.restore(state)
        except (OSError, SafetensorError, KeyError, RuntimeError, NotFinite) as error:
            raise_if_refused(error)
            raise CaptureError(
                f"{state_file} cannot be gone on with ({error})", "train without `resume=True`"
            ) from error
    own = files[processes.rank :: processes.count]
    lessons = draw_lessons(read_pictures(own), training)
    saved, written = time.monotonic(), training.step
    stages["training"].skip(training.step, options.steps)
    for batch in lessons:
        # The processes stop together: at the end of a step.
        with unbroken():
            loss = training.teach(batch)
            is_stopped = processes.any(is_stopping())
            is_due = time.monotonic() - saved > _SAVED_EVERY or training.step == options.steps
            is_saved = processes.is_first and (is_due or is_stopped)
            state = training.state() if is_saved else {}
            found = find_not_finite({"loss": loss, **state})
            # All processes end, or those that found nothing would wait for the others for ever.
            if processes.any(found is not None):
                found = found or "the loss of another process is not finite"
                raise NotFinite(f"step {training.step}: {found}", _way_from(options, written))
            if is_saved:
                write_atomically({state_file: save(state)})
                saved, written = time.monotonic(), training.step
        stages["training"](training.step, options.steps, loss=loss)
        if is_stopped:  # Another process was told to stop, and this one not.
            raise Interrupted(f"{state_file}: stopped at step {training.step}; `resume=True`")
    tracker = TrainedTracker(training.taught().cpu(), points)
    record = {
        "pictures": IN_A_FILE * len(files),
        "steps": training.step,
        "seed": options.seed,
        "options": asdict(taught),
    }
    if processes.is_first:
        save_tracker(options.out, tracker, record)
    return tracker


def _way_from(options: TrackerTrainOptions, written: int) -> str:
    """What to do after a step that was not finite; the step of the state that was written."""
    again = "give the same command again with"
    rate = f"`rate={options.rate / 2:g}`"
    if not written:
        return f"{again} {rate}"
    state_file = options.out.with_suffix(".state")
    return f"{state_file} holds step {written}, which is good\n{again} `resume=True` {rate}"


def evaluate_made_tracker(options: TrackerEvaluateOptions) -> TrackerFigures:
    """Judges a tracker on pictures of subjects, poses and scenes of their own.

    Raises:
        TrackerError: the file is no tracker.
    """
    tracker = read_tracker(options.tracker) if options.tracker else shipped_tracker()
    rig = load_rig(tracker.points.rig_name)
    made = [
        make_crops(rig, tracker.points, min(500, options.count - start), _JUDGED_FROM + start)
        for start in range(0, options.count, 500)
    ]
    batch = CropBatch.joined([_tensors(part) for part in made])
    images, classes, points, _ = vary_crops(batch, _IN_USE, torch.Generator().manual_seed(0))
    pixels = (255 * images).round().to(torch.uint8).permute(0, 2, 3, 1)
    seen = CropBatch(pixels, classes.to(torch.uint8), points, batch.is_hand)
    return measure_tracker(tracker, seen)


def draw_lessons(pictures: CropBatch, training: TrackerTraining) -> Iterator[CropBatch]:
    """Batches up to the last step, every picture once before any comes again.

    Args:
        pictures: of this process.
        training: in which each process has an equal part of a step's pictures.
    """
    batch, total = training.options.batch // training.processes.count, len(pictures.images)
    order = torch.zeros(0, dtype=torch.long)
    while training.step < training.steps:
        if len(order) < batch:
            order = torch.cat([order, torch.randperm(total, generator=training.generator)])
        chosen, order = order[:batch], order[batch:]
        yield pictures.chosen(chosen)


def make_pictures(
    options: TrackerTrainOptions, progress: Progress = SILENT, processes: Processes = ALONE
) -> list[Path]:
    """Files of made pictures, of which those that are missing are made.

    Args:
        options: how many, and where.
        progress: told how many are there.
        processes: that share the work, each on cores of its own.

    Raises:
        ArgumentError: if there are fewer files than processes.
    """
    options.pictures.mkdir(parents=True, exist_ok=True)
    seeds = range(options.seed, options.seed + -(-options.count // IN_A_FILE))
    files = [options.pictures / f"made-{seed:06d}.safetensors" for seed in seeds]
    if len(files) < processes.count:
        raise ArgumentError(
            "count",
            f"{options.count} pictures for {processes.count} processes",
            f"at least {IN_A_FILE} for each",
        )
    own = list(zip(files, seeds, strict=True))[processes.rank :: processes.count]
    missing = [(file, seed) for file, seed in own if not file.is_file()]
    progress.skip(len(files) - len(missing), len(files))
    if not missing:
        return files
    workers = options.processes or os.cpu_count() or 1
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(_make_file, *zip(*missing, strict=True)), start=1):
            progress(len(files) - len(missing) + done, len(files))
    return files


def _make_file(file: Path, seed: int) -> None:
    torch.set_num_threads(1)
    rig = load_rig(RIG)
    made = make_crops(rig, TrackedPoints.of(rig, NUM_SKIN_POINTS), IN_A_FILE, seed)
    tensors = _tensors(made)
    # Maps have a quarter of the resolution; turned pictures are looked up in between.
    tensors["classes"] = tensors["classes"][:, ::2, ::2].contiguous()
    write_atomically({file: save(tensors)})


def _tensors(made: MadeCrops) -> dict[str, Tensor]:
    return {
        name: torch.from_numpy(np.ascontiguousarray(getattr(made, name))) for name in CROP_FIELDS
    }


def read_pictures(files: list[Path]) -> CropBatch:
    """All pictures of some files, in memory.

    Raises:
        CaptureError: a file is damaged.
    """
    parts = []
    for file in files:
        try:
            parts.append(load_file(file))
        except (OSError, SafetensorError) as error:
            raise_if_refused(error)
            raise CaptureError(f"{file} cannot be read ({error})", "delete it") from error
    return CropBatch.joined(parts)
