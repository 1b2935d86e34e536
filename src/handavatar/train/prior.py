"""Pre-training of the occupancy prior on sampled poses and shapes.

No data set: poses come from the sampler of plausible poses, shapes from the rig's shape space,
labels from the generalised winding number of the sealed mesh (an overlap of fingers is inside).
Nothing depends on the wrist's placement: the field works in the frames of the bones.
"""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_args

import torch
from jaxtyping import Bool, Float
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from handavatar.avatar import CheckpointError
from handavatar.evaluate.geometry import intersection_over_union
from handavatar.field.decoders import Decoder, OccupancyField, untrained_field
from handavatar.geometry.meshes import is_inside, sample_surface
from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import Level, load_open_hand
from handavatar.hand.parts import Parts, divide_into_parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import resolve_penetration, sample_poses
from handavatar.hand.rig import PosedHand, Rig

SHIPPED_PRIOR = Path(__file__).parent.parent / "assets" / "prior.safetensors"
"""Made with ``handavatar prior train --steps 9000 --out a.safetensors`` and then ``--start
a.safetensors --steps 5000 --lr 6e-4 --final-lr 3e-5 --warm-up 0 --seed 1 --refresh 2``; the first
run was made before the cut at the wrist was sampled."""
EVALUATION_SEED = 1_000_003
"""Evaluation poses come from seeds that training never draws."""


@dataclass(frozen=True)
class PriorOptions:
    """How the occupancy prior is pre-trained.

    Attributes:
        out: where the trained prior is written (safetensors).
        steps: optimisation steps.
        poses: poses per step.
        points: labelled points per pose and step.
        pool: labelled poses kept at hand.
        refresh: a fresh pose replaces the oldest one every so many steps.
        lr: learning rate at the start.
        final_lr: learning rate at the end; exponential in between.
        warm_up: share of the steps with cross entropy, before the paper's squared error alone.
        level: which open hand.
        rounds: midpoint subdivisions of the mesh that is encoded and labelled.
        seed: of everything.
        start: a prior to continue from.
        decoder: ``pair`` is PairOF, the avatar's. Only for comparison with it: ``pair-shuffled``
            pairs parts that do not touch, ``coap`` and ``coap-wide`` decode each part alone,
            ``transformer`` all parts together.
        device: where the networks run.
    """

    out: Path = Path("prior.safetensors")
    steps: int = 10_000
    poses: int = 1
    points: int = 1024
    pool: int = 192
    refresh: int = 3
    lr: float = 1e-3
    final_lr: float = 5e-5
    warm_up: float = 0.5
    level: Level = "full"
    rounds: int = 1
    seed: int = 0
    start: Path | None = None
    decoder: Decoder = "pair"
    device: str = "cpu"


@dataclass(frozen=True, eq=False)
class LabelledPose:
    """A posed hand with points whose inside or outside is known."""

    posed: PosedHand
    points: Float[Tensor, "points 3"]
    is_inside: Bool[Tensor, "points"]


def sample_points(
    parts: Parts, posed: PosedHand, count: int, margin: float, generator: torch.Generator
) -> Float[Tensor, "points 3"]:
    """Half the points uniform in the part boxes, half near the surface (sigma 1 and 4 mm).

    Without gradient and on the CPU. The surface is the sealed one: the cut at the wrist must be
    learned like the rest.

    Source: paper Sec. 3.2 (pre-training), after COAP: box and surface samples.
    """
    num_uniform = count // 2
    boxes = parts.boxes(posed, margin)
    bone = torch.arange(num_uniform) % NUM_BONES
    lower, upper = boxes.lower.cpu()[bone] - margin, boxes.upper.cpu()[bone] + margin
    local = lower + (upper - lower) * torch.rand(num_uniform, 3, generator=generator)
    uniform = apply_rigid(posed.world_from_bone.detach().cpu()[bone], local[:, None])[:, 0]
    num_near = count - num_uniform
    sealed = posed.sealed_vertices.detach().cpu()
    surface = sample_surface(sealed, posed.rig.sealed_faces.cpu(), num_near, generator)
    sigma = torch.where(torch.arange(num_near) % 2 == 0, 0.001, 0.004)[:, None]
    near = surface.positions(sealed)
    return torch.cat([uniform, near + sigma * torch.randn(num_near, 3, generator=generator)])


def labelled_pose(
    rig: Rig,
    parts: Parts,
    rotations: Float[Tensor, "bones 3"],
    count: int,
    margin: float,
    generator: torch.Generator,
) -> LabelledPose:
    """A hand of random shape in the given pose, with labelled points."""
    coefficients = torch.randn(rig.shape_directions.shape[-1], generator=generator)
    posed = rig.shaped(coefficients).posed(HandPose(rotations, torch.zeros(3)))
    points = sample_points(parts, posed, count, margin, generator)
    return LabelledPose(posed, points, is_inside(posed.sealed_vertices, rig.sealed_faces, points))


def train_prior(
    options: PriorOptions, report: Callable[[int, dict[str, float]], None] | None = None
) -> OccupancyField:
    """Pre-trains the occupancy field and writes it.

    Args:
        options: see :class:`PriorOptions`.
        report: called now and then with the step and the current figures.

    Source: paper Sec. 3.2, L_PairOF: mean squared error of the occupancy.
    Departs: cross entropy for the first ``warm_up`` of the steps, since the squared error of a
        saturated sigmoid has hardly a gradient.
    """
    base = load_open_hand(options.level)
    rig = subdivided(base, options.rounds)
    parts = divide_into_parts(rig)
    torch.manual_seed(options.seed)
    field = untrained_field(options.decoder)
    if options.start is not None:
        load_prior(field, options.start, options.decoder)
    field.to(options.device)
    parts_there = parts.to(options.device)
    generator = torch.Generator().manual_seed(options.seed)
    optimizer = torch.optim.Adam(field.parameters(), lr=options.lr)
    decay = (options.final_lr / options.lr) ** (1 / max(options.steps, 1))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)

    def fresh() -> LabelledPose:
        rotations = sample_poses(base, 1, generator)[0]
        return labelled_pose(rig, parts, rotations, 4096, field.margin, generator)

    pool = [fresh() for _ in range(min(options.pool, 16))]
    average = math.nan
    for step in range(1, options.steps + 1):
        if step % options.refresh == 0:
            pool = [*pool[1 - options.pool :], fresh()] if options.pool > 1 else [fresh()]
        loss = torch.zeros((), device=options.device)
        for index in torch.randint(len(pool), (options.poses,), generator=generator).tolist():
            sample = pool[index]
            chosen = torch.randint(len(sample.points), (options.points,), generator=generator)
            points = sample.points[chosen].to(options.device)
            target = sample.is_inside[chosen].to(points)
            codes = field.encode(parts_there, _moved(sample.posed, options.device))
            predicted = field.trainable_whole(codes, points)
            if step <= options.warm_up * options.steps:
                term = torch.nn.functional.binary_cross_entropy(predicted, target)
            else:
                term = (predicted - target).square().mean()
            loss = loss + term / options.poses
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(field.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        value = float(loss.detach())
        average = value if math.isnan(average) else 0.99 * average + 0.01 * value
        if report is not None and (step % 100 == 0 or step == options.steps):
            report(step, {"loss": average})
        if step % 2000 == 0 or step == options.steps:
            save_prior(field, options, step)
    return field


def _moved(posed: PosedHand, device: str) -> PosedHand:
    if device == "cpu":
        return posed
    return PosedHand(
        posed.rig, posed.pose, posed.vertices.to(device), posed.world_from_bone.to(device)
    )


def save_prior(field: OccupancyField, options: PriorOptions, step: int) -> None:
    """Writes the weights aside and renames them into place."""
    rig = load_open_hand(options.level)
    record = {**asdict(options), "out": options.out.name, "start": str(options.start)}
    metadata = {
        "schema": "1",
        "rig": rig.name,
        "rig_sha256": rig.sha256,
        "decoder": options.decoder,
        "margin": str(field.margin),
        "step": str(step),
        "options": json.dumps(record),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    aside = options.out.with_suffix(".tmp")
    state = {name: value.detach().cpu().contiguous() for name, value in field.state_dict().items()}
    save_file(state, aside, metadata)
    aside.replace(options.out)


def load_prior(
    field: OccupancyField, path: Path = SHIPPED_PRIOR, decoder: Decoder = "pair"
) -> None:
    """Loads pre-trained weights into a field.

    Args:
        field: with the given decoder.
        path: a file that :func:`train_prior` wrote.
        decoder: which one the weights must be of; shapes alone do not tell.

    Raises:
        CheckpointError: if the file is missing, damaged or of another decoder.
    """
    found = _decoder_of(path)
    if found != decoder:
        raise CheckpointError(
            f"{path} holds a prior with the decoder {found!r}, expected {decoder!r}: train one "
            f"with `handavatar prior train --decoder {decoder}`"
        )
    try:
        field.load_state_dict(load_file(path))
    except Exception as error:
        raise CheckpointError(f"{path} is not a usable occupancy prior: {error}") from error


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
            f"no occupancy prior at {path}: train one with `handavatar prior train --out {path}`"
        )
    try:
        with safe_open(path, framework="pt") as file:
            found = (file.metadata() or {}).get("decoder", "pair")
    except Exception as error:
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
        level: which open hand.
        rounds: midpoint subdivisions.
    """

    prior: Path = SHIPPED_PRIOR
    poses: int = 50
    points: int = 4096
    level: Level = "full"
    rounds: int = 1


def evaluate_prior(options: PriorEvaluationOptions) -> dict[str, float]:
    """Intersection over union on unseen poses whose self-penetration is resolved.

    Returns:
        ``iou`` (mean over poses of the mean of the next two), ``iou_boxes``, ``iou_surface``.
    """
    field = open_prior(options.prior)
    parts, samples = evaluation_poses(options, field.margin)
    scores = pose_scores(field, parts, samples)
    boxes, surface = scores.mean(0).tolist()
    return {"iou": (boxes + surface) / 2, "iou_boxes": boxes, "iou_surface": surface}


def evaluation_poses(
    options: PriorEvaluationOptions, margin: float
) -> tuple[Parts, list[LabelledPose]]:
    """Unseen poses of unseen shapes with labelled points, the same at every call.

    Args:
        options: how many; ``prior`` plays no part.
        margin: of the part boxes, metres.
    """
    base = load_open_hand(options.level)
    rig = subdivided(base, options.rounds)
    parts = divide_into_parts(rig)
    generator = torch.Generator().manual_seed(EVALUATION_SEED)
    rotations = resolve_penetration(base, sample_poses(base, options.poses, generator))
    return parts, [
        labelled_pose(rig, parts, pose, options.points, margin, generator) for pose in rotations
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
                intersection_over_union(predicted[window], sample.is_inside[window])
                for window in (slice(0, half), slice(half, None))
            ]
        )
    return torch.tensor(scores)
