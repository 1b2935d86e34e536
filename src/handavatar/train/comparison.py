"""The geometry table: PairOF against other decoders, trained alike and judged on the same poses.

The core of ``handavatar bench --table geometry``. Same poses, shapes, points and labels, same
number of steps, same seeds, same encoder at the start: only the decoder differs. What a training
reached is kept as ``NAME-SEED.json`` beside its weights; where that file is there, with the same
options, nothing is trained again, so that seeds can be added one by one, on several machines.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.capture.checks import load_json
from handavatar.errors import SEEDS, ArgumentError, require_ranges
from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.tables import TABLES, Cell, ResultTable
from handavatar.field.decoders import Decoder, OccupancyField, untrained_field
from handavatar.field.occupancy import HandCodes
from handavatar.field.partwise import PartwiseOccupancy
from handavatar.hand.open_hand import Level, load_open_hand
from handavatar.hand.parts import POINT_ROUNDS, Parts, finer_rig
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import PosedHand
from handavatar.jobs.files import make_folder, write_aside
from handavatar.jobs.progress import SILENT, Progress
from handavatar.train.attention import attention_figures, attention_picture, read_attention
from handavatar.train.kept import commit_notes, present_commit
from handavatar.train.labelled_poses import LabelledPose
from handavatar.train.prior import (
    PriorEvaluationOptions,
    PriorOptions,
    evaluation_poses,
    pose_scores,
    train_prior,
)
from handavatar.train.provenance import package_versions
from handavatar.train.runs import write_json

Measure = Callable[[OccupancyField, HandCodes, PosedHand], Mapping[str, float]]
"""Further columns by name, of one field on one posed hand: how good a mesh extracted from it is."""

Judges = tuple[Parts, list[LabelledPose]]
"""The parts of a guide, and the unseen poses of it that judge."""

ATTENTION_GESTURES = ("flat", "fist")


@dataclass(frozen=True)
class ComparisonOptions:
    """How decoders are compared.

    Attributes:
        priors: folder for the trained priors, their checkpoints and the picture of attention
            maps; a comparison that was begun there with the same options is continued.
        decoders: which ones; ``pair`` must be among them, the others are compared with it.
        guides: other numbers of subdivisions: COAP's small decoder is trained and judged once more
            on each, guided and labelled by that mesh alone: the paper's coarse one (0) and its
            fine one (2).
        seeds: each one trains every decoder once, all on the same data.
        steps: optimisation steps of each training.
        points: labelled points per step.
        poses: unseen poses of unseen shapes that judge, two or more.
        judged_points: labelled points of each of them, half in boxes, half near the surface.
        measured_poses: how many of the poses are also given to the measures.
        level: which open hand.
        rounds: midpoint subdivisions of the mesh that guides and labels.
        device: where the networks train.
    """

    priors: Path = Path("decoders")
    decoders: tuple[Decoder, ...] = get_args(Decoder)
    guides: tuple[int, ...] = (0, 2)
    seeds: tuple[int, ...] = (0,)
    steps: int = 10_000
    points: int = 1024
    poses: int = 50
    judged_points: int = 4096
    measured_poses: int = 10
    level: Level = "full"
    rounds: int = POINT_ROUNDS
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            guides=(0, 4),
            seeds=SEEDS,
            steps=(1, 10**8),
            points=(1, 10**6),
            poses=(2, 10**5),
            judged_points=(2, 10**6),
            measured_poses=(2, 10**5),
            rounds=(0, 4),
        )


GUIDED: Decoder = "coap"
"""The decoder that tells guides apart, as in the paper."""


@dataclass(frozen=True)
class Contender:
    """One row: a decoder and the mesh that guides it.

    Attributes:
        decoder: which one.
        rounds: midpoint subdivisions of the mesh that is encoded, labelled and measured.
        name: of the row and its files.
    """

    decoder: Decoder
    rounds: int
    name: str


@dataclass(frozen=True, eq=False)
class DecoderScores:
    """What one contender reached.

    Attributes:
        num_parameters: of encoder and decoder.
        columns: figures by name, of each training on each judged or measured pose.
        seconds: of training, on average over the seeds.
    """

    num_parameters: int
    columns: Mapping[str, Float[Tensor, "seeds _"]]
    seconds: float

    @staticmethod
    def of(trainings: Sequence[Mapping[str, Any]]) -> "DecoderScores":
        """Joins what the trainings of several seeds reached."""
        names = trainings[0]["columns"]
        return DecoderScores(
            trainings[0]["parameters"],
            {name: torch.tensor([_figures(row, name) for row in trainings]) for name in names},
            sum(row["seconds"] for row in trainings) / len(trainings),
        )


def compare_decoders(
    options: ComparisonOptions,
    measures: Sequence[Measure] = (),
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Trains every decoder with every seed and judges all on the same poses.

    Args:
        options: see :class:`ComparisonOptions`.
        measures: further columns, such as Laplacian, Chamfer and seam of extracted meshes.
        progress: told what is being trained, and how far it is.

    Returns:
        A value for JSON: ``options``, ``commits`` (of each training), ``note``, ``decoders`` (by
        name: ``parameters``, ``iou``, ``iou_boxes``, ``iou_surface`` in [0, 1],
        ``iou_points_per_100k``: per cent of IoU for 100,000 parameters, the measured columns,
        ``training_seconds``, ``minus_pair``: intervals of the paired differences by column,
        ``minus_pair_over_seeds``: the same over seeds, if there are several), ``guides`` (rows of
        the other guides by name, ``minus_coap`` in place of ``minus_pair``), ``control_hurts`` and
        ``attention`` if those decoders took part.

    Raises:
        ValueError: if there is nothing to compare with, or too little to judge by.

    Source: paper Sec. 4.2, table of geometry.
    """
    _check(options)
    make_folder(options.priors, TABLES)
    rows: dict[str, DecoderScores] = {}
    guides: dict[str, DecoderScores] = {}
    attention: dict[str, Any] = {}
    commits: dict[str, str] = {}

    @cache
    def judged_by(rounds: int) -> Judges:
        options_of = PriorEvaluationOptions(
            poses=options.poses,
            points=options.judged_points,
            level=options.level,
            rounds=rounds,
        )
        return evaluation_poses(options_of, untrained_field("pair").margin)

    names = [f"{one.name}-{seed}" for one in contenders(options) for seed in options.seeds]
    parts = progress.stages(dict.fromkeys(names, 1.0))
    for contender in contenders(options):
        trainings = [
            _training(
                options,
                contender,
                seed,
                judged_by,
                measures,
                parts[f"{contender.name}-{seed}"],
            )
            for seed in options.seeds
        ]
        for seed, training in zip(options.seeds, trainings, strict=True):
            commits[f"{contender.name}-{seed}"] = str(training.get("commit"))
        scores = DecoderScores.of(trainings)
        (rows if contender.rounds == options.rounds else guides)[contender.name] = scores
        attention = attention or trainings[0].get("attention", {})
    value: dict[str, Any] = {
        "options": {**asdict(options), "priors": options.priors.name},
        "commits": commits,
        "note": "Intervals of 95 % over poses, seeds averaged: they tell poses apart, not "
        "trainings; minus_pair_over_seeds tells trainings apart.",
        "decoders": {
            name: _summary(scores, "pair", None if name == "pair" else rows["pair"])
            for name, scores in rows.items()
        },
        "guides": {name: _summary(scores, GUIDED, rows[GUIDED]) for name, scores in guides.items()},
    }
    if "pair-shuffled" in rows:
        difference = value["decoders"]["pair-shuffled"]["minus_pair"]["iou"]
        value["control_hurts"] = difference["high"] < 0
    if attention:
        value["attention"] = attention
    return value


def contenders(options: ComparisonOptions) -> list[Contender]:
    """What is trained with every seed: the decoders, and the decoder of the guides with each."""
    own = [Contender(name, options.rounds, name) for name in options.decoders]
    if GUIDED not in options.decoders:
        return own
    return own + [
        Contender(GUIDED, rounds, f"{GUIDED}-guide-{rounds}")
        for rounds in options.guides
        if rounds != options.rounds
    ]


def comparison_table(value: Mapping[str, Any]) -> ResultTable:
    """The result of :func:`compare_decoders` as a table; IoU in per cent."""
    notes = [str(value["note"])]
    if "control_hurts" in value:
        hurts = "hurt" if value["control_hurts"] else "do not hurt: the table says nothing"
        notes.append(f"Control: shuffled pairs {hurts}.")
    rows = {name: _cells(row) for name, row in value["decoders"].items()}
    rows |= {name: _cells(row) for name, row in value["guides"].items()}
    for name, row in value["guides"].items():
        differences = [
            f"{column} {_interval(interval)}"
            for column, interval in row[f"minus_{GUIDED}"].items()
            if math.isfinite(interval["mean"])
        ]
        notes.append(f"{name} minus {GUIDED}: {', '.join(differences)}; IoU in [0, 1].")
    notes += commit_notes("Trainings", value["commits"])
    return ResultTable("Geometry: decoders of the occupancy field", rows, tuple(notes))


_OWN_FIGURES = (
    *("parameters", "iou", "iou_boxes", "iou_surface", "iou_points_per_100k", "training_seconds"),
    *("minus_pair", "minus_pair_over_seeds", f"minus_{GUIDED}", f"minus_{GUIDED}_over_seeds"),
)


def _cells(row: Mapping[str, Any]) -> dict[str, Cell]:
    poses = row.get("minus_pair", {}).get("iou")
    seeds = row.get("minus_pair_over_seeds", {}).get("iou")
    cells: dict[str, Cell] = {
        "parameters": row["parameters"],
        "IoU": round(100 * row["iou"], 2),
        "in boxes": round(100 * row["iou_boxes"], 2),
        "near surface": round(100 * row["iou_surface"], 2),
        "IoU - pair [95 % over poses]": None if poses is None else _interval(poses, 100.0),
        "IoU - pair [95 % over seeds]": None if seeds is None else _interval(seeds, 100.0),
        "IoU per 100K": round(row["iou_points_per_100k"], 1),
    }
    measured = {name: figure for name, figure in row.items() if name not in _OWN_FIGURES}
    return cells | {
        name: round(figure, 3) if math.isfinite(figure) else None
        for name, figure in measured.items()
    }


def _interval(interval: Mapping[str, float], scale: float = 1.0) -> str:
    mean, low, high = (scale * interval[key] for key in ("mean", "low", "high"))
    digits = 2 if scale > 1 else 3
    return f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"


def _check(options: ComparisonOptions) -> None:
    if "pair" not in options.decoders or len(set(options.decoders)) < 2:
        raise ArgumentError(
            "decoders",
            str(options.decoders),
            f"'pair' and at least one other of {get_args(Decoder)}",
        )
    if any(rounds < 0 for rounds in options.guides) or len(set(options.guides)) < len(
        options.guides
    ):
        raise ArgumentError(
            "guides", str(options.guides), "different numbers of subdivisions, 0 or more"
        )
    if not options.seeds or len(set(options.seeds)) < len(options.seeds):
        raise ArgumentError("seeds", str(options.seeds), "different ones")
    if options.poses < 2 or not 2 <= options.measured_poses <= options.poses:
        raise ArgumentError(
            "measured_poses",
            f"{options.measured_poses} of {options.poses} poses",
            "two or more of both and no more measured than judged",
        )


def _training(
    options: ComparisonOptions,
    contender: Contender,
    seed: int,
    judged_by: Callable[[int], Judges],
    measures: Sequence[Measure],
    progress: Progress,
) -> dict[str, Any]:
    """What one training reached: read where it is kept, else trained, judged and kept.

    Returns:
        A value for JSON: ``options`` on which the figures depend, ``versions``, ``commit``,
        ``parameters``, ``seconds``, ``columns`` by name, and ``attention`` of the Transformer.
    """
    name = f"{contender.name}-{seed}"
    elsewhere = ("priors", "decoders", "guides", "seeds", "device", "rounds")
    depends_on = {key: value for key, value in asdict(options).items() if key not in elsewhere}
    depends_on |= {"decoder": contender.decoder, "rounds": contender.rounds, "seed": seed}
    kept = options.priors / f"{name}.json"
    if kept.is_file():
        training = load_json(kept)
        if training.get("options") == depends_on:
            return training
    start = time.perf_counter()
    field = train_prior(
        PriorOptions(
            out=options.priors / f"{name}.safetensors",
            steps=options.steps,
            points=options.points,
            level=options.level,
            rounds=contender.rounds,
            seed=seed,
            decoder=contender.decoder,
            folder=options.priors / name,
            device=options.device,
        ),
        progress,
    ).to("cpu")
    seconds = time.perf_counter() - start
    columns = _columns(field, *judged_by(contender.rounds), options, measures)
    training = {
        "options": depends_on,
        "versions": package_versions(),
        "commit": present_commit(),
        "parameters": sum(parameter.numel() for parameter in field.parameters()),
        "seconds": seconds,
        "columns": {
            name: [figure if math.isfinite(figure) else None for figure in values.tolist()]
            for name, values in columns.items()
        },
    }
    if contender.decoder == "transformer" and isinstance(field, PartwiseOccupancy):
        training["attention"] = _attention(field, options)
    write_json(kept, training)
    return training


def _figures(training: Mapping[str, Any], column: str) -> list[float]:
    """JSON has no NaN: what could not be measured is null there."""
    return [math.nan if figure is None else figure for figure in training["columns"][column]]


def _columns(
    field: OccupancyField,
    parts: Parts,
    samples: list[LabelledPose],
    options: ComparisonOptions,
    measures: Sequence[Measure],
) -> dict[str, Float[Tensor, "_"]]:
    """Figures of one field by name, on every judged pose or every measured one."""
    boxes, surface = pose_scores(field, parts, samples).unbind(-1)
    columns = {"iou": (boxes + surface) / 2, "iou_boxes": boxes, "iou_surface": surface}
    for measure in measures:
        found = []
        for sample in samples[: options.measured_poses]:
            with torch.no_grad():
                found.append(measure(field, field.encode(parts, sample.posed), sample.posed))
        columns |= {name: torch.tensor([row[name] for row in found]) for name in found[0]}
    return columns


def _summary(scores: DecoderScores, other: str, others: DecoderScores | None) -> dict[str, Any]:
    """The means of one row and, unless it is that very row, its distance from another."""
    means = {name: float(values.double().mean()) for name, values in scores.columns.items()}
    summary: dict[str, Any] = {
        "parameters": scores.num_parameters,
        **means,
        "iou_points_per_100k": 100 * means["iou"] / (scores.num_parameters / 100_000),
        "training_seconds": scores.seconds,
    }
    if others is None:
        return summary
    differences = {name: values - others.columns[name] for name, values in scores.columns.items()}
    summary[f"minus_{other}"] = {
        name: asdict(mean_interval(values.mean(0))) for name, values in differences.items()
    }
    if len(next(iter(differences.values()))) > 1:
        summary[f"minus_{other}_over_seeds"] = {
            name: asdict(mean_interval(values.mean(1))) for name, values in differences.items()
        }
    return summary


def _attention(field: PartwiseOccupancy, options: ComparisonOptions) -> dict[str, Any]:
    """Writes the picture; figures of the trained decoder, and of an untrained one as control."""
    base = load_open_hand(options.level)
    rig, parts = finer_rig(base, options.rounds)
    torch.manual_seed(options.seeds[0])
    untrained = untrained_field("transformer")
    assert isinstance(untrained, PartwiseOccupancy)
    readings, figures = {}, {}
    for gesture in ATTENTION_GESTURES:
        pose = HandPose(gesture_rotations(base, gesture), torch.zeros(3))
        posed = rig.shaped().posed(pose)
        with torch.no_grad():
            readings[gesture] = read_attention(field, field.encode(parts, posed), posed.vertices)
            control = read_attention(untrained, untrained.encode(parts, posed), posed.vertices)
        by_part = attention_figures(readings[gesture])
        figures[gesture] = {
            "preference": _mean_preference(by_part),
            "preference_untrained": _mean_preference(attention_figures(control)),
            "parts": by_part,
        }
    with write_aside(options.priors / "attention.png") as aside:
        attention_picture(readings).save(aside)
    return {"picture": "attention.png", **figures}


def _mean_preference(by_part: Mapping[str, Mapping[str, float]]) -> float:
    return sum(figures["preference"] for figures in by_part.values()) / max(len(by_part), 1)
