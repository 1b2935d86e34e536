"""All figures of one protocol: what `evaluate` says of an avatar whose poses were found one way."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from handavatar.evaluate.detail import frame_detail
from handavatar.evaluate.intervals import block_interval, time_blocks
from handavatar.evaluate.metrics import (
    JudgedFrame,
    core_psnr,
    masked_psnr,
    masked_scores,
    mean_mask_iou,
    region_psnr,
    zone_scores,
)


def protocol_figures(
    frames: Sequence[JudgedFrame], times: Float[Tensor, "frames"], colors: Sequence[Tensor]
) -> dict[str, Any]:
    """The masked protocol, core and border apart, detail, and how sure the means are.

    Args:
        frames: to be judged.
        times: of the frames, seconds; intervals are over blocks of them.
        colors: mean colour of the training frames as each of the frames is exposed; empty where
            there is none, and then nothing is compared with it.

    Returns:
        As JSON takes it; None for what no frame allows.
    """
    masked, zones = masked_scores(frames), zone_scores(frames)
    details = [frame_detail(frame) for frame in frames]
    ratios, correlations = (
        [value for value in values if value is not None] for values in zip(*details, strict=True)
    )
    return {
        "masked": asdict(masked),
        "core": {"psnr": zones.core_psnr, "share": zones.core_share},
        "border": {"psnr": zones.border_psnr, "error_share": zones.border_error_share},
        "detail": {"ratio": _mean(ratios), "correlation": _mean(correlations)},
        "mask_iou": mean_mask_iou(frames),
        "flip": masked.flip,
        "intervals": _intervals(frames, times, colors, [ratio for ratio, _ in details]),
    }


def _intervals(
    frames: Sequence[JudgedFrame],
    times: Float[Tensor, "frames"],
    colors: Sequence[Tensor],
    ratios: Sequence[float | None],
) -> dict[str, Any]:
    blocks = time_blocks(times)
    masked = _samples([masked_psnr(frame) for frame in frames])
    core = _samples([core_psnr(frame) for frame in frames])
    samples = {"masked_psnr": masked, "core_psnr": core, "detail_ratio": _samples(ratios)}
    if colors:
        pairs = list(zip(frames, colors, strict=True))
        flat = [frame.painted(color, frame.truth_coverage) for frame, color in pairs]
        samples["masked_psnr_minus_mean_color"] = masked - _samples(
            [masked_psnr(frame) for frame in flat]
        )
        samples["core_psnr_minus_mean_color"] = core - _samples(
            [
                region_psnr(painted, zone) if bool(zone.any()) else None
                for painted, zone in zip(flat, (frame.core() for frame in frames), strict=True)
            ]
        )
    found = {name: block_interval(values, blocks) for name, values in samples.items()}
    intervals = {name: asdict(value) if value else None for name, value in found.items()}
    return {"blocks": len(blocks.unique()), **intervals}


def _samples(values: Sequence[float | None]) -> Float[Tensor, "frames"]:
    return torch.tensor(
        [math.nan if value is None else value for value in values], dtype=torch.float64
    )


def _mean(values: Sequence[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None
