"""The table of training's speed: plain gradients against the way that training takes.

One patch of rays through all fields and back, and one step of the occupancy's pre-training. The
plain way keeps every pair at every sample for the backward pass; it costs the same for every ray,
so it is measured on some rays of the patch and scaled to all.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from handavatar.avatar import EXACT, HandAvatar, HandState, RayValues, RenderSettings
from handavatar.errors import require_range, require_ranges
from handavatar.evaluate.speed_table import hand_camera
from handavatar.evaluate.tables import Cell, ResultTable, step_counter
from handavatar.field.occupancy import BOX_MARGIN, PairOccupancy, hand_codes
from handavatar.geometry.cameras import Rays, pixel_centers, rays_through_pixels
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import POINT_ROUNDS, Parts, finer_rig
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.jobs.progress import SILENT, Progress
from handavatar.plain import plain_rays
from handavatar.train.labelled_poses import LabelledPose, PoseStream
from handavatar.train.loop import learned_rays
from handavatar.train.pretraining import OccupancyLoss, prior_optimizers, set_rate
from handavatar.train.prior import load_prior
from handavatar.train.stage_times import StageTimes

_PICTURE = 256
_RATE = 1e-5
"""Of the timed steps: the prior stays as good as it is."""


@dataclass(frozen=True)
class TrainingTableOptions:
    """What is timed.

    Attributes:
        avatar: a trained one.
        patch: pixels along a side of the patch, out of the middle of the hand.
        samples: along each ray.
        plain_rays: rays of the patch that the plain way evaluates.
        steps: of the occupancy's pre-training, in each way, from the prior that ships.
        points: labelled points of each such step.
    """

    avatar: Path
    patch: int = 32
    samples: int = 64
    plain_rays: int = 32
    steps: int = 8
    points: int = 1024

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            patch=(1, _PICTURE),
            samples=(1, 4096),
            plain_rays=(1, 10**6),
            steps=(1, 10**6),
            points=(1, 10**6),
        )

    @property
    def total_steps(self) -> int:
        """The patch three times, and the steps both ways."""
        return 3 + 2 * self.steps


@dataclass(frozen=True, eq=False)
class PatchCost:
    """One patch forward and backward.

    Attributes:
        seconds: both.
        saved: bytes kept for the backward pass, parameters and what was there before left out.
        gradients: of every parameter that has one, by name.
    """

    seconds: float
    saved: int
    gradients: dict[str, Tensor]


def training_table(options: TrainingTableOptions, progress: Progress = SILENT) -> ResultTable:
    """Measures a patch and a step of pre-training, each in the plain way and in ours.

    Args:
        options: what to measure.
        progress: told the number of pieces of work done.

    Raises:
        CheckpointError: if the avatar cannot be read.
        ArgumentError: if the patch does not fit, or has fewer rays than the plain way shall take.
    """
    require_range("plain_rays", options.plain_rays, 1, options.patch**2)
    finished = step_counter(progress, options.total_steps)
    rows = _patch_rows(options, finished)
    plain, ours = _step_seconds(options, finished)
    rows["pre-training step, plain"] = {"s": round(plain, 3), "ratio": 1.0, **_NOTHING}
    rows["pre-training step"] = {"s": round(ours, 3), "ratio": round(plain / ours, 1), **_NOTHING}
    notes = (
        f"A patch of {options.patch}x{options.patch} pixels in the middle of a hand, "
        f"{options.samples} samples a ray, {torch.get_num_threads()} threads; plain: "
        f"{options.plain_rays} of its rays, scaled to all. Without the state of the pose, which "
        "all rays share.",
        "MB: kept for the backward pass. Gradient error: of those rays, the largest difference of "
        "an entry over the largest entry, worst of all parameters.",
        f"Pre-training: {options.points} points of a new hand with their labels, the prior that "
        f"ships, mean of {options.steps} steps in turn, optimiser included.",
    )
    return ResultTable("Speed of training", rows, notes)


_NOTHING: dict[str, Cell] = {"MB": None, "MB ratio": None, "gradient error": None}


# --- a patch --------------------------------------------------------------------------------------


def _patch_rows(
    options: TrainingTableOptions, finished: Callable[[], None]
) -> dict[str, dict[str, Cell]]:
    avatar = HandAvatar.load(options.avatar)
    pose = HandPose(gesture_rotations(avatar.base_rig, "relaxed"), torch.zeros(3))
    with torch.no_grad():
        posed = avatar.prepare(pose).posed
    camera = hand_camera(posed.vertices, (0.0, -1.0, 0.0), _PICTURE)
    start = (_PICTURE - options.patch) // 2
    window = slice(start, start + options.patch)
    rays = rays_through_pixels(camera, pixel_centers(camera)[window, window].flatten(0, 1))
    order = torch.randperm(len(rays.origins), generator=torch.Generator().manual_seed(0))
    chosen = order[: options.plain_rays]
    few = Rays(rays.origins[chosen], rays.directions[chosen])
    scale = len(rays.origins) / len(chosen)

    def plainly(state: HandState, some: Rays) -> RayValues:
        return plain_rays(avatar, state, some, options.samples)

    reference = _patch_cost(avatar, pose, few, plainly)
    finished()
    seconds, saved = scale * reference.seconds, scale * reference.saved
    rows: dict[str, dict[str, Cell]] = {
        "patch, plain": {
            "s": round(seconds, 3),
            "ratio": 1.0,
            "MB": round(saved / 1e6, 1),
            "MB ratio": 1.0,
            "gradient error": None,
        }
    }
    settings = {
        "patch, all that weighs 1e-7": replace(EXACT, num_samples=options.samples),
        "patch, as trained": learned_rays(options.samples),
    }
    for name, chosen_settings in settings.items():

        def fast(state: HandState, some: Rays, how: RenderSettings = chosen_settings) -> RayValues:
            return avatar.render_rays(state, some, how)

        error = gradient_error(reference.gradients, _patch_cost(avatar, pose, few, fast).gradients)
        cost = _patch_cost(avatar, pose, rays, fast)
        rows[name] = {
            "s": round(cost.seconds, 3),
            "ratio": round(seconds / cost.seconds, 1),
            "MB": round(cost.saved / 1e6, 1),
            "MB ratio": round(saved / cost.saved, 1),
            "gradient error": float(f"{error:.1e}"),
        }
        finished()
    return rows


def _patch_cost(
    avatar: HandAvatar,
    pose: HandPose,
    rays: Rays,
    evaluated: Callable[[HandState, Rays], RayValues],
) -> PatchCost:
    """Mean absolute distance from grey, as the loss of colours, and back to all parameters."""
    state = avatar.prepare(pose)
    avatar.zero_grad(set_to_none=True)
    known = {parameter.untyped_storage().data_ptr() for parameter in avatar.parameters()}
    known |= {value.untyped_storage().data_ptr() for value in (state.anchors, state.anchor_normals)}
    saved: dict[int, int] = {}

    def kept(value: Tensor) -> Tensor:
        storage = value.untyped_storage()
        if storage.data_ptr() not in known:
            saved[storage.data_ptr()] = storage.nbytes()
        return value

    begin = time.perf_counter()
    with torch.autograd.graph.saved_tensors_hooks(kept, lambda value: value):
        values = evaluated(state, rays)
        loss = (values.color - 0.3).abs().mean() + (values.alpha - 0.5).square().mean()
    loss.backward()
    seconds = time.perf_counter() - begin
    gradients = {
        name: parameter.grad.clone()
        for name, parameter in avatar.named_parameters()
        if parameter.grad is not None
    }
    return PatchCost(seconds, sum(saved.values()), gradients)


def gradient_error(expected: dict[str, Tensor], found: dict[str, Tensor]) -> float:
    """Largest difference of an entry over its tensor's largest entry, the worst of all tensors.

    Tensors whose entries are all below a millionth of the largest of all are left out: a sum that
    cancels, such as that over the hand of offsets which the wrist takes back, is rounding alone.
    """
    largest = {name: float(theirs.abs().max()) for name, theirs in expected.items()}
    least = 1e-6 * max(largest.values())
    return max(
        float((found[name] - expected[name]).abs().max()) / size
        for name, size in largest.items()
        if size > least
    )


# --- a step of pre-training -----------------------------------------------------------------------


def _plain_loss(field: PairOccupancy, parts: Parts, sample: LabelledPose) -> Tensor:
    """Cross entropy with every pair at every point, and nothing shared in the encoder."""
    codes = hand_codes(field.encoder, parts, sample.posed, field.margin)
    predicted, _ = field.plain(codes, sample.points)
    return nn.functional.binary_cross_entropy(predicted, sample.is_inside.to(predicted))


def _step_seconds(
    options: TrainingTableOptions, finished: Callable[[], None]
) -> tuple[float, float]:
    """Mean seconds of a step, plain and ours; the two take turns."""
    base = load_open_hand("full")
    rig, parts = finer_rig(base, POINT_ROUNDS)
    stream = PoseStream(base, rig, parts, BOX_MARGIN, options.points, seed=0)
    steps = {"plain": _step(stream, is_plain=True), "ours": _step(stream, is_plain=False)}
    spent = dict.fromkeys(steps, 0.0)
    for number in range(options.steps):
        for name, step in steps.items():
            begin = time.perf_counter()
            step(number)
            spent[name] += time.perf_counter() - begin
            finished()
    return spent["plain"] / options.steps, spent["ours"] / options.steps


def _step(stream: PoseStream, is_plain: bool) -> Callable[[int], None]:
    """A step, by its number, of a field of its own."""
    field = PairOccupancy()
    load_prior(field)
    learned = OccupancyLoss(field, stream.parts, StageTimes())
    optimizers = prior_optimizers(field)
    set_rate(optimizers, _RATE)

    def step(number: int) -> None:
        sample = stream.drawn(number, StageTimes())
        for optimizer in optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        loss = _plain_loss(field, stream.parts, sample) if is_plain else learned([sample])
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()

    return step
