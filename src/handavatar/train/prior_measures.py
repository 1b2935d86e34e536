"""The table of geometry: an occupancy prior's surface on unseen hands, one row per pose."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import degrees
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.errors import HandAvatarError
from handavatar.evaluate.geometry import (
    Skin,
    Truth,
    chamfer,
    contact_errors,
    roughness,
    seams,
)
from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.metrics import mask_iou
from handavatar.field.decoders import OccupancyField
from handavatar.geometry.extraction import Field, num_components
from handavatar.hand.parts import PartBoxes, Parts, divide_into_parts, finer_rig
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations, resolve_penetration, sample_poses
from handavatar.hand.rig import PosedHand, Rig
from handavatar.hand.surface import extract_hand
from handavatar.train.labelled_poses import sample_points
from handavatar.train.prior import EVALUATION_SEED, open_prior


@dataclass(frozen=True)
class GeometryRow:
    """All measures of one field in one pose. Lengths in 1e-4 m, as in the paper's tables.

    Attributes:
        iou: share in [0, 1], mean of points in the part boxes and near the surface.
        lap: roughness of the extracted mesh.
        cham: mean of both directions of the vertex-to-face distance.
        cham_to_truth: the paper's direction.
        cham_from_truth: the other one.
        seam: excess of the normals' error at part borders over that elsewhere, degrees.
        seam_angle: the error at the borders, degrees.
        seam_worst: its 95th percentile, degrees.
        seam_step: step across the borders.
        contact_error: share of wrong points near self-contacts, in [0, 1]; none without contact.
        contact_flesh: of those that are inside.
        contact_gap: of those that are outside.
        pieces: separate pieces of the surface; a hand is one, and so is each hollow that a fist
            encloses.
        voxel: of the extraction.
        evaluations: points at which the field was asked.
        saved: how many times as many the dense grid has; less than 1 where the grid is so coarse
            that it is asked everywhere and vertices are corrected.
        seconds: of the extraction.
    """

    iou: float
    lap: float
    cham: float
    cham_to_truth: float
    cham_from_truth: float
    seam: float
    seam_angle: float
    seam_worst: float
    seam_step: float
    contact_error: float | None
    contact_flesh: float | None
    contact_gap: float | None
    pieces: int
    voxel: float
    evaluations: int
    saved: float
    seconds: float


def unseen_hands(rig: Rig, base: Rig, count: int, seed: int = EVALUATION_SEED) -> list[PosedHand]:
    """Hands of random shape in random poses whose self-penetration is resolved.

    Args:
        rig: the hands' rig.
        base: the same before subdivision, which samples and resolves the poses.
        count: how many.
        seed: training never draws from ``EVALUATION_SEED`` or above.
    """
    generator = torch.Generator().manual_seed(seed)
    rotations = resolve_penetration(base, sample_poses(base, count, generator))
    return _posed(rig, rotations, generator)


def unseen_fists(rig: Rig, base: Rig, count: int, seed: int = EVALUATION_SEED) -> list[PosedHand]:
    """Fists of random shape, each joint some degrees off, self-penetration resolved."""
    generator = torch.Generator().manual_seed(seed)
    fist = gesture_rotations(base, "fist").expand(count, -1, -1)
    noise = 0.05 * torch.randn(count, 15, 3, generator=generator)
    rotations = torch.cat([fist[:, :1], fist[:, 1:] + noise], dim=1)
    return _posed(rig, resolve_penetration(base, rotations), generator)


def _posed(
    rig: Rig, rotations: Float[Tensor, "hands bones 3"], generator: torch.Generator
) -> list[PosedHand]:
    coefficients = torch.randn(len(rotations), rig.shape_directions.shape[-1], generator=generator)
    return [
        rig.shaped(shape).posed(HandPose(pose, torch.zeros(3)))
        for shape, pose in zip(coefficients, rotations, strict=True)
    ]


def measure_prior(
    prior: OccupancyField,
    hands: Sequence[PosedHand],
    resolution: int = 128,
    truths: Sequence[PosedHand] | None = None,
    num_points: int = 4096,
    parts: Parts | None = None,
) -> list[GeometryRow]:
    """One row per hand; deterministic, so that rows of several priors are paired.

    Args:
        prior: the field, on the CPU.
        hands: what guides the field; all of one rig.
        resolution: cells along the longest side of the extraction's box.
        truths: the hands that the field is held against, by default those that guide it; give
            the fine ones to judge fields that are guided by a coarse mesh.
        num_points: judged for IoU, and as many near contacts.
        parts: of the guiding rig, where ``divide_into_parts`` would draw other points.

    Raises:
        ValueError: if a field has no surface in some pose, or answers NaN.

    Source: paper Sec. 4.2, Tab. 1.
    """
    parts = parts or divide_into_parts(hands[0].rig)
    truths = hands if truths is None else truths
    skin = Skin.of(truths[0].rig)
    truth_parts = parts if truths is hands else divide_into_parts(truths[0].rig)
    rows = []
    for number, (hand, truth) in enumerate(zip(hands, truths, strict=True)):
        with torch.no_grad():
            codes = prior.encode(parts, hand)

            def occupancy_of(points: Tensor, codes: Any = codes) -> Tensor:
                return prior(codes, points).whole

            generator = torch.Generator().manual_seed(EVALUATION_SEED + number)
            points = sample_points(truth_parts, truth, num_points, prior.margin, generator)
            rows.append(
                measure_field(
                    occupancy_of, codes.boxes, Truth(truth, skin), points, resolution, generator
                )
            )
    return rows


def measure_field(
    occupancy_of: Field,
    boxes: PartBoxes,
    truth: Truth,
    points: Float[Tensor, "points 3"],
    resolution: int,
    generator: torch.Generator,
) -> GeometryRow:
    """The row of any occupancy function: a prior's, an avatar's, or the truth's own.

    Args:
        occupancy_of: in [0, 1] at world points.
        boxes: of the hand, for the wrist's cut.
        truth: the hand that the field is held against.
        points: for IoU, the first half in the part boxes, the other near the surface.
        resolution: of the extraction.
        generator: draws the points near contacts.

    Raises:
        ValueError: if the field has no surface, or answers NaN.
    """
    start = time.perf_counter()
    surface = extract_hand(occupancy_of, boxes, truth.hand, resolution)
    seconds = time.perf_counter() - start
    if len(surface.faces) == 0:
        raise HandAvatarError(
            "the field has no surface: its occupancy is on one side of 0.5 at all "
            f"{surface.num_evaluations} samples; is the prior trained, and for this rig?"
        )
    predicted, inside = occupancy_of(points) > 0.5, truth.contains(points)
    half = len(points) // 2
    ious = [
        mask_iou(predicted[window], inside[window])
        for window in (slice(0, half), slice(half, None))
    ]
    distance = chamfer(surface.vertices, surface.faces, truth)
    seam = seams(surface.vertices, surface.faces, truth)
    contact = contact_errors(occupancy_of, truth, generator, len(points))
    return GeometryRow(
        iou=sum(ious) / 2,
        lap=1e4 * roughness(surface.vertices, surface.faces),
        cham=1e4 * distance.mean,
        cham_to_truth=1e4 * distance.to_truth,
        cham_from_truth=1e4 * distance.from_truth,
        seam=degrees(seam.excess),
        seam_angle=degrees(seam.angle),
        seam_worst=degrees(seam.worst_angle),
        seam_step=1e4 * seam.step,
        contact_error=contact.whole if contact else None,
        contact_flesh=contact.flesh if contact else None,
        contact_gap=contact.gap if contact else None,
        pieces=num_components(surface),
        voxel=1e4 * surface.voxel,
        evaluations=surface.num_evaluations,
        saved=surface.num_dense / surface.num_evaluations,
        seconds=seconds,
    )


def measure_prior_file(
    prior: Path, base: Rig, rounds: int, count: int, resolution: int
) -> dict[str, dict[str, dict[str, float | int | None]]]:
    """Every column on unseen poses (``unseen``) and on fists (``fists``), summarised.

    Args:
        prior: file of the weights.
        base: the hand before subdivision.
        rounds: midpoint subdivisions of the mesh that guides.
        count: of the unseen poses, and of the fists.
        resolution: cells along the longest side of the extraction's box.
    """
    field = open_prior(prior)
    rig, parts = finer_rig(base, rounds)
    return {
        name: summarised(measure_prior(field, hands(rig, base, count), resolution, parts=parts))
        for name, hands in (("unseen", unseen_hands), ("fists", unseen_fists))
    }


def summarised(rows: Sequence[GeometryRow]) -> dict[str, dict[str, float | int | None]]:
    """Mean, 95 percent half width (none for a single pose) and count of every column.

    Poses without contact are left out of the contact columns, which are missing if no pose has
    any.
    """
    summary: dict[str, dict[str, float | int | None]] = {}
    table = [asdict(row) for row in rows]
    for name in table[0]:
        values = [float(row[name]) for row in table if row[name] is not None]
        if values:
            half = None
            if len(values) > 1:
                interval = mean_interval(torch.tensor(values))
                half = interval.high - interval.mean
            mean = sum(values) / len(values)
            summary[name] = {"mean": mean, "half_width": half, "count": len(values)}
    return summary
