"""One step of the prior's pre-training: what is minimised, at which rate, and where it goes on."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from handavatar.avatar import CheckpointError
from handavatar.field.decoders import OccupancyField
from handavatar.field.occupancy import (
    HandCodes,
    PairItems,
    PairOccupancy,
    contains,
    local_points,
)
from handavatar.hand.parts import Parts
from handavatar.hand.rig import PosedHand
from handavatar.jobs.files import is_empty, make_folder
from handavatar.jobs.finite import require_finite
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.signals import unbroken
from handavatar.jobs.stage_states import NOT_KEPT, StageState, WorkState, named_tensors
from handavatar.train.divergence import may_take_seed
from handavatar.train.labelled_poses import LabelledPose
from handavatar.train.muon import Muon
from handavatar.train.optimizer_state import (
    optimizer_options,
    optimizer_tensors,
    restore_optimizer,
)
from handavatar.train.runs import (
    RUN,
    Json,
    Run,
    is_unfinished_start,
    latest_checkpoint,
    load_checkpoint,
    save_checkpoint,
    write_json,
)
from handavatar.train.stage_times import StageTimes

LEAST_ERROR = 0.02
"""A point whose occupancy is this close to its label has hardly a gradient, and is left out."""
_WARM_UP = 0.02
"""Share of the steps in which the learning rate rises: the moments must settle first."""
_VECTOR_RATE = 0.6
"""Learning rate of biases and narrow matrices, as a part of that of the others."""
_NARROW = 8
"""Matrices with so few rows or columns are no better than vectors for Muon."""


class OccupancyLoss(nn.Module):
    """Cross entropy between a field and the labels of some hands.

    A module, because DistributedDataParallel joins the gradients of modules' forward passes.
    """

    def __init__(self, field: OccupancyField, parts: Parts, times: StageTimes) -> None:
        """Joins what a step needs.

        Args:
            field: to be trained.
            parts: of the stream's rig, on the field's device.
            times: takes note of encoding, searching (which pairs decide, which points err) and
                decoding.
        """
        super().__init__()
        self.field = field
        self.parts = parts
        self.times = times

    def forward(self, samples: Sequence[LabelledPose]) -> Float[Tensor, ""]:
        """Mean over all points of all hands.

        Source: paper Sec. 3.2, L_PairOF.
        Departs: cross entropy instead of the mean squared error, whose gradient vanishes where a
            saturated sigmoid errs; points without a noticeable error are left out.
        """
        losses = []
        device = self.parts.barycentric.device
        for sample in samples:
            with self.times.stage("encode"):
                codes = self.field.encode(self.parts, _moved(sample.posed, device))
            points, is_inside = sample.points.to(device), sample.is_inside.to(device)
            losses.append(self.of_codes(codes, points, is_inside))
            if len(sample.joint_pairs):
                first = len(points) - len(sample.joint_pairs)
                losses[-1] = losses[-1] + self._at_joints(
                    codes, points[first:], is_inside[first:], sample.joint_pairs.to(device)
                )
        return torch.stack(losses).mean()

    def of_codes(
        self, codes: HandCodes, points: Float[Tensor, "points 3"], is_inside: Bool[Tensor, "points"]
    ) -> Float[Tensor, ""]:
        """The same for one hand that is encoded already."""
        predicted, target = self._erring(codes, points, is_inside.to(points))
        total = nn.functional.binary_cross_entropy(predicted, target, reduction="sum")
        return total / len(points)

    def _at_joints(
        self,
        codes: HandCodes,
        points: Float[Tensor, "points 3"],
        is_inside: Bool[Tensor, "points"],
        pairs: Int[Tensor, "points"],
    ) -> Float[Tensor, ""]:
        """Cross entropy of either part of each point's pair, where its box holds the point.

        Departs: the paper asks only the part that decides. Where one part takes over from another,
            neither is asked beyond its own side, both fall off, and a groove of up to half a
            millimetre is left around the base of a bent thumb.
        """
        assert isinstance(self.field, PairOccupancy)
        with self.times.stage("decode"):
            is_known = pairs >= 0
            points, pairs, is_inside = points[is_known], pairs[is_known], is_inside[is_known]
            members = self.field.pairs[pairs]
            is_wanted = contains(codes.boxes, local_points(codes.boxes, points)).gather(1, members)
            order = torch.arange(len(points), device=points.device)
            logits = self.field.wanted_logits(codes, points, PairItems(order, pairs, is_wanted))
            target = is_inside[:, None].expand(-1, 2)[is_wanted].to(logits)
            total = nn.functional.binary_cross_entropy_with_logits(logits, target, reduction="sum")
            return total / (2 * len(is_known))

    def _erring(
        self, codes: HandCodes, points: Float[Tensor, "points 3"], target: Float[Tensor, "points"]
    ) -> tuple[Float[Tensor, "erring"], Float[Tensor, "erring"]]:
        """Prediction with gradient and target, of the points with an error."""
        with self.times.stage("search"), torch.no_grad():
            found = self.field(codes, points)
            is_erring = (found.whole - target).abs() > LEAST_ERROR
        erring, target = points[is_erring], target[is_erring]
        with self.times.stage("decode"):
            if isinstance(self.field, PairOccupancy):
                items = found.items.among(is_erring)
                return self.field.of_items(codes, erring, items), target
            return self.field.trainable_whole(codes, erring), target


def prior_optimizers(field: nn.Module) -> dict[str, torch.optim.Optimizer]:
    """Muon for the matrices, Adam for all else; no rate is set yet.

    Departs: the authors use Adam alone, with which the same time on a CPU gains half as much.
    """
    wide, narrow = wide_and_narrow(field.parameters())
    return {"muon": Muon(wide), "adam": torch.optim.Adam(narrow, fused=True)}


def wide_and_narrow(
    parameters: Iterable[nn.Parameter],
) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Matrices for Muon; and biases and narrow matrices, which are better off with Adam."""
    wide: list[nn.Parameter] = []
    narrow: list[nn.Parameter] = []
    for parameter in parameters:
        is_wide = parameter.ndim == 2 and min(parameter.shape) > _NARROW
        (wide if is_wide else narrow).append(parameter)
    return wide, narrow


def set_rate(optimizers: Mapping[str, torch.optim.Optimizer], rate: float) -> None:
    """The learning rate of the next step, Muon's; Adam's follows."""
    for name, optimizer in optimizers.items():
        for group in optimizer.param_groups:
            group["lr"] = rate if name == "muon" else _VECTOR_RATE * rate


def learning_rate(step: int, steps: int, highest: float, lowest: float) -> float:
    """Of a step, counted from 1: a short rise, then half a cosine down to the lowest."""
    rise = min(1.0, step / max(_WARM_UP * steps, 1))
    fall = 0.5 * (1 + math.cos(math.pi * step / max(steps, 1)))
    return rise * (lowest + (highest - lowest) * fall)


def descend(
    title: str,
    decoder: nn.Module,
    steps: int,
    rates: tuple[float, float],
    loss_of_step: Callable[[], Float[Tensor, ""]],
    generator: torch.Generator,
    progress: Progress = SILENT,
    kept: StageState = NOT_KEPT,
) -> None:
    """Trains a decoder alone, with the prior's optimisers.

    Args:
        title: of the stage, for errors.
        decoder: whose gradients ``loss_of_step`` gives.
        steps: how many.
        rates: highest and last learning rate; see :func:`learning_rate`.
        loss_of_step: the loss of the next step, on samples of its own.
        generator: that draws these samples.
        progress: told the steps done.
        kept: where it goes on, if it was interrupted.

    Raises:
        NotFinite: if a loss is NaN or infinite.
        Interrupted: if the command was told to stop.
    """
    optimizers = prior_optimizers(decoder)
    average, done = math.nan, 0

    def state() -> WorkState:
        tensors = {f"decoder.{name}": value for name, value in decoder.state_dict().items()}
        for name, part in optimizers.items():
            tensors |= {f"{name}.{key}": value for key, value in optimizer_tensors(part).items()}
        facts: Json = {name: optimizer_options(part) for name, part in optimizers.items()}
        facts |= {"step": done, "average": average if done else 0.0}
        return WorkState({**tensors, "generator": generator.get_state()}, facts)

    if (begun := kept.read()) is not None:
        decoder.load_state_dict(named_tensors(begun.tensors, "decoder."))
        for name, part in optimizers.items():
            restore_optimizer(part, named_tensors(begun.tensors, f"{name}."), begun.facts[name])
        generator.set_state(begun.tensors["generator"])
        done = int(begun.facts["step"])
        average = float(begun.facts["average"]) if done else math.nan
    progress.skip(done, max(steps, 1))
    with kept.kept(state) as now_and_then:
        for step in range(done + 1, steps + 1):
            with unbroken():
                set_rate(optimizers, learning_rate(step, steps, *rates))
                for optimizer in optimizers.values():
                    optimizer.zero_grad(set_to_none=True)
                loss = loss_of_step()
                loss.backward()
                for optimizer in optimizers.values():
                    optimizer.step()
                value = float(loss.detach())
                require_finite({"loss": value}, f"{title}, step {step}")
                average = value if math.isnan(average) else 0.95 * average + 0.05 * value
                done = step
            now_and_then()
            progress(step, steps, loss=average)
    decoder.zero_grad(set_to_none=True)


# --- the run folder -------------------------------------------------------------------------------


def begin_prior_run(folder: Path, options: Json) -> Run:
    """The folder's run: a new one, or the one that was begun there with the same options.

    One that has diverged goes on with another seed as well.

    Raises:
        CheckpointError: if the folder holds something else, or a run with other options.
    """
    run, path = Run(folder), folder / "options.json"
    if path.is_file():
        begun = run.options
        different = sorted(
            name for name in {**begun, **options} if begun.get(name) != options.get(name)
        )
        old, new = begun.get("seed"), options.get("seed")
        if isinstance(old, int) and isinstance(new, int):
            others = [name for name in different if name != "seed"]
            different = others if may_take_seed(run, old, new) else sorted({*others, "seed"})
        if different:
            raise CheckpointError(
                f"{folder}: the run there was begun with other options: {', '.join(different)}",
                "",
                "give the same ones to continue it, or name another folder with `folder`",
            )
        return run
    if not is_empty(folder) and not is_unfinished_start(folder):
        raise CheckpointError(
            f"{folder}: holds something that is no pre-training run, expected a new folder",
            "",
            "name another with `folder`",
        )
    make_folder(folder, RUN)
    run.checkpoints.mkdir(exist_ok=True)
    write_json(path, options)
    return run


def save_progress(
    run: Run,
    step: int,
    field: OccupancyField,
    optimizers: Mapping[str, torch.optim.Optimizer],
    average: float,
) -> None:
    """Writes everything that :func:`load_progress` needs to go on bit for bit."""
    tensors = {"model": field.state_dict()}
    tensors |= {name: optimizer_tensors(optimizer) for name, optimizer in optimizers.items()}
    state: Json = {name: optimizer_options(optimizer) for name, optimizer in optimizers.items()}
    save_checkpoint(run, step, tensors, {**state, "average": average})


def load_progress(
    run: Run, field: OccupancyField, optimizers: Mapping[str, torch.optim.Optimizer]
) -> tuple[int, float]:
    """Sets field and optimisers to the newest whole checkpoint.

    Returns:
        The steps done (0 if there is no checkpoint), and the running average of the loss.
    """
    checkpoint = latest_checkpoint(run)
    if checkpoint is None:
        return 0, math.nan
    contents = load_checkpoint(checkpoint)
    field.load_state_dict(contents.tensors["model"])
    for name, optimizer in optimizers.items():
        restore_optimizer(optimizer, contents.tensors[name], contents.state[name])
    return checkpoint.step, float(contents.state["average"])


def _moved(posed: PosedHand, device: torch.device) -> PosedHand:
    if device.type == "cpu":
        return posed
    return PosedHand(
        posed.rig, posed.pose, posed.vertices.to(device), posed.world_from_bone.to(device)
    )
