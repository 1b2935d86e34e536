"""The geometry table: PairOF against other decoders, trained alike and judged on the same poses.

The core of ``handavatar bench --table geometry``. Same poses, shapes, points and labels, same
number of steps, same seeds, same encoder at the start: only the decoder differs.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.tables import Cell, ResultTable
from handavatar.field.decoders import Decoder, OccupancyField, untrained_field
from handavatar.field.occupancy import HandCodes
from handavatar.field.partwise import PartwiseOccupancy
from handavatar.hand.open_hand import Level, load_open_hand
from handavatar.hand.parts import POINT_ROUNDS, Parts, finer_rig
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import PosedHand
from handavatar.train.attention import attention_figures, attention_picture, read_attention
from handavatar.train.labelled_poses import LabelledPose
from handavatar.train.prior import (
    PriorEvaluationOptions,
    PriorOptions,
    evaluation_poses,
    pose_scores,
    train_prior,
)

Measure = Callable[[OccupancyField, HandCodes, PosedHand], Mapping[str, float]]
"""Further columns by name, of one field on one posed hand: how good a mesh extracted from it is."""

ATTENTION_GESTURES = ("flat", "fist")


@dataclass(frozen=True)
class ComparisonOptions:
    """How decoders are compared.

    Attributes:
        priors: folder for the trained priors, their checkpoints and the picture of attention
            maps; a comparison that was begun there with the same options is continued.
        decoders: which ones; ``pair`` must be among them, the others are compared with it.
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
    seeds: tuple[int, ...] = (0,)
    steps: int = 10_000
    points: int = 1024
    poses: int = 50
    judged_points: int = 4096
    measured_poses: int = 10
    level: Level = "full"
    rounds: int = POINT_ROUNDS
    device: str = "cpu"


@dataclass(frozen=True, eq=False)
class DecoderScores:
    """What one decoder reached.

    Attributes:
        num_parameters: of encoder and decoder.
        columns: figures by name, of each training on each judged or measured pose.
        seconds: of training, on average over the seeds.
    """

    num_parameters: int
    columns: Mapping[str, Float[Tensor, "seeds _"]]
    seconds: float


def compare_decoders(
    options: ComparisonOptions,
    measures: Sequence[Measure] = (),
    report: Callable[[str, int, dict[str, float]], None] | None = None,
) -> dict[str, Any]:
    """Trains every decoder with every seed and judges all on the same poses.

    Args:
        options: see :class:`ComparisonOptions`.
        measures: further columns, such as Laplacian, Chamfer and seam of extracted meshes.
        report: called now and then with what is being trained, the step and current figures.

    Returns:
        A value for JSON: ``options``, ``note``, ``decoders`` (by name: ``parameters``, ``iou``,
        ``iou_boxes``, ``iou_surface`` in [0, 1], ``iou_points_per_100k``: per cent of IoU for
        100,000 parameters, the measured columns, ``training_seconds``, ``minus_pair``: intervals
        of the paired differences by column, ``minus_pair_over_seeds``: the same over seeds, if
        there are several), ``control_hurts`` and ``attention`` if those decoders took part.

    Raises:
        ValueError: if there is nothing to compare with, or too little to judge by.

    Source: paper Sec. 4.2, table of geometry.
    """
    _check(options)
    options.priors.mkdir(parents=True, exist_ok=True)
    margin = untrained_field("pair").margin
    parts, samples = evaluation_poses(
        PriorEvaluationOptions(
            poses=options.poses,
            points=options.judged_points,
            level=options.level,
            rounds=options.rounds,
        ),
        margin,
    )
    results: dict[Decoder, DecoderScores] = {}
    attention: dict[str, Any] = {}
    for decoder in options.decoders:
        trained = [_train(options, decoder, seed, report) for seed in options.seeds]
        fields = [field for field, _ in trained]
        rows = [_columns(field, parts, samples, options, measures) for field in fields]
        results[decoder] = DecoderScores(
            num_parameters=sum(parameter.numel() for parameter in fields[0].parameters()),
            columns={name: torch.stack([row[name] for row in rows]) for name in rows[0]},
            seconds=sum(seconds for _, seconds in trained) / len(trained),
        )
        if decoder == "transformer" and isinstance(fields[0], PartwiseOccupancy):
            attention = _attention(fields[0], options)
    value: dict[str, Any] = {
        "options": {**asdict(options), "priors": options.priors.name},
        "note": "Intervals of 95 % over poses, seeds averaged: they tell poses apart, not "
        "trainings; minus_pair_over_seeds tells trainings apart.",
        "decoders": {
            name: _summary(scores, results["pair"] if name != "pair" else None)
            for name, scores in results.items()
        },
    }
    if "pair-shuffled" in results:
        difference = value["decoders"]["pair-shuffled"]["minus_pair"]["iou"]
        value["control_hurts"] = difference["high"] < 0
    if attention:
        value["attention"] = attention
    return value


def comparison_table(value: Mapping[str, Any]) -> ResultTable:
    """The result of :func:`compare_decoders` as a table; IoU in per cent."""
    notes = [str(value["note"])]
    if "control_hurts" in value:
        hurts = "hurt" if value["control_hurts"] else "do not hurt: the table says nothing"
        notes.append(f"Control: shuffled pairs {hurts}.")
    rows = {name: _cells(row) for name, row in value["decoders"].items()}
    return ResultTable("Geometry: decoders of the occupancy field", rows, tuple(notes))


_OWN_FIGURES = (
    *("parameters", "iou", "iou_boxes", "iou_surface", "iou_points_per_100k"),
    *("training_seconds", "minus_pair", "minus_pair_over_seeds"),
)


def _cells(row: Mapping[str, Any]) -> dict[str, Cell]:
    difference = row.get("minus_pair", {}).get("iou")
    compared = None
    if difference is not None:
        mean, low, high = (100 * difference[key] for key in ("mean", "low", "high"))
        compared = f"{mean:+.2f} [{low:+.2f}, {high:+.2f}]"
    cells: dict[str, Cell] = {
        "parameters": row["parameters"],
        "IoU": round(100 * row["iou"], 2),
        "in boxes": round(100 * row["iou_boxes"], 2),
        "near surface": round(100 * row["iou_surface"], 2),
        "IoU - pair [95 %]": compared,
        "IoU per 100K": round(row["iou_points_per_100k"], 1),
    }
    measured = {name: figure for name, figure in row.items() if name not in _OWN_FIGURES}
    return cells | {
        name: round(figure, 3) if math.isfinite(figure) else None
        for name, figure in measured.items()
    }


def _check(options: ComparisonOptions) -> None:
    if "pair" not in options.decoders or len(set(options.decoders)) < 2:
        raise ValueError(
            f"comparison: found the decoders {options.decoders}, expected 'pair' and at least one "
            f"other of {get_args(Decoder)}"
        )
    if not options.seeds or len(set(options.seeds)) < len(options.seeds):
        raise ValueError(f"comparison: found the seeds {options.seeds}, expected different ones")
    if options.poses < 2 or not 2 <= options.measured_poses <= options.poses:
        raise ValueError(
            f"comparison: found {options.poses} poses of which {options.measured_poses} are "
            "measured, expected two or more of both and no more measured than judged"
        )


def _train(
    options: ComparisonOptions,
    decoder: Decoder,
    seed: int,
    report: Callable[[str, int, dict[str, float]], None] | None,
) -> tuple[OccupancyField, float]:
    """The trained field on the CPU, and the seconds it took."""
    name = f"{decoder}-{seed}"
    start = time.perf_counter()
    field = train_prior(
        PriorOptions(
            out=options.priors / f"{name}.safetensors",
            steps=options.steps,
            points=options.points,
            level=options.level,
            rounds=options.rounds,
            seed=seed,
            decoder=decoder,
            folder=options.priors / name,
            device=options.device,
        ),
        None if report is None else lambda step, figures: report(name, step, figures),
    )
    return field.to("cpu"), time.perf_counter() - start


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


def _summary(scores: DecoderScores, pair: DecoderScores | None) -> dict[str, Any]:
    """The means of one decoder and, except for PairOF itself, its distance from PairOF."""
    means = {name: float(values.double().mean()) for name, values in scores.columns.items()}
    summary: dict[str, Any] = {
        "parameters": scores.num_parameters,
        **means,
        "iou_points_per_100k": 100 * means["iou"] / (scores.num_parameters / 100_000),
        "training_seconds": scores.seconds,
    }
    if pair is None:
        return summary
    differences = {name: values - pair.columns[name] for name, values in scores.columns.items()}
    summary["minus_pair"] = {
        name: asdict(mean_interval(values.mean(0))) for name, values in differences.items()
    }
    if len(next(iter(differences.values()))) > 1:
        summary["minus_pair_over_seeds"] = {
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
    attention_picture(readings).save(options.priors / "attention.png")
    return {"picture": "attention.png", **figures}


def _mean_preference(by_part: Mapping[str, Mapping[str, float]]) -> float:
    return sum(figures["preference"] for figures in by_part.values()) / max(len(by_part), 1)
