"""``handavatar bench --table ablation``: what each part of the shading and the shape is worth."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from handavatar.capture.checks import CaptureError, load_json
from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.tables import Cell, ResultTable, step_counter
from handavatar.train.ablation import ROWS, ablate
from handavatar.train.runs import write_json


@dataclass(frozen=True)
class AblationTableOptions:
    """What is compared, and where the figures of every frame are kept.

    Attributes:
        captures: folders of made captures (``handavatar capture benchmark``), comma-separated.
        kept: folder; what a capture's rows reached is kept there as ``CAPTURE.json`` and is not
            measured again with the same steps and seeds; ``CAPTURE.png`` shows three test frames.
        seeds: of the shadings; geometry is fitted once per capture.
        steps: of each shading.
    """

    captures: tuple[Path, ...]
    kept: Path = Path("ablation")
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 310

    @property
    def total_steps(self) -> int:
        """Rows and seeds of all captures."""
        return len(ROWS) * len(self.seeds) * len(self.captures)


def ablation_table(
    options: AblationTableOptions, report: Callable[[int], None] | None = None
) -> ResultTable:
    """Measures what is not kept yet, and puts all captures into one table.

    Args:
        options: what to compare.
        report: told the number of rows and seeds done.

    Raises:
        CaptureError: if a capture is damaged or knows no truth.

    Source: paper Sec. 4.3, table of ablations; supplement, disentanglement.
    """
    finished = step_counter(report)
    for folder in options.captures:
        if not (folder / "truth" / "albedo").is_dir():
            raise CaptureError(
                f"{folder}: knows no albedo", "name captures of `handavatar capture benchmark`"
            )
    measured = []
    for folder in options.captures:
        path = options.kept / f"{folder.name}.json"
        found = load_json(path) if path.is_file() else {}
        if found.get("steps") == options.steps and found.get("seeds") == list(options.seeds):
            for _ in range(len(ROWS) * len(options.seeds)):
                finished()
        else:
            picture = options.kept / f"{folder.name}.png"
            found = ablate(folder, options.seeds, options.steps, finished, picture)
            found["seeds"] = list(options.seeds)
            found = json.loads(json.dumps(found))
            options.kept.mkdir(parents=True, exist_ok=True)
            write_json(path, found)
        measured.append(found)
    return table_of(measured, options)


def table_of(measured: Sequence[dict[str, Any]], options: AblationTableOptions) -> ResultTable:
    """One line per row; differences are paired by frame, means over seeds."""
    hidden = torch.cat([torch.tensor(found["hidden"]) for found in measured])
    is_hidden = hidden > hidden.median()
    parts = {
        "all": torch.ones_like(is_hidden),
        "occluded half": is_hidden,
        "open half": ~is_hidden,
    }
    rows: dict[str, dict[str, Cell]] = {}
    for name, row in ROWS.items():
        of_frame = {key: _per_frame(measured, name, key) for key in _frame_keys(measured[0])}
        line: dict[str, Cell] = {}
        for key, values in of_frame.items():
            line[key] = round(float(values.mean()), 2 if key.startswith("psnr") else 4)
        for key in ("albedo", "shading r", "view spread %"):
            line[key] = _mean_whole(measured, name, key)
        gain = torch.empty(0)
        if row.against:
            gain = of_frame["psnr"] - _per_frame(measured, row.against, "psnr")
        for which, chosen in parts.items():
            line[f"gain, {which}"] = _interval(gain[chosen]) if row.against else None
        line["against"] = row.against or None
        rows[name] = line
    notes = (
        f"Captures: {', '.join(found['capture'] for found in measured)}; {len(hidden)} test frames "
        f"of poses and cameras never seen, seeds {list(options.seeds)} of the shadings, "
        f"{options.steps} steps each; geometry is fitted once per capture and kind of shape.",
        "Gain: masked PSNR over the row that it is compared with, decibels, mean over frames of "
        "the mean over seeds [95 % over frames]; the occluded half are the frames in which the "
        "hand hides more of its own sky than in the median frame.",
        "Albedo in decibels after one scale per channel; shading r against true shading; view "
        "spread: how much the light of the same place changes with the camera alone.",
    )
    return ResultTable("Ablation", rows, notes)


def _frame_keys(found: dict[str, Any]) -> list[str]:
    first = next(iter(next(iter(found["rows"].values())).values()))
    return list(first["frames"])


def _per_frame(measured: Sequence[dict[str, Any]], name: str, key: str) -> torch.Tensor:
    parts = [
        torch.tensor([of_seed["frames"][key] for of_seed in found["rows"][name].values()]).mean(0)
        for found in measured
    ]
    return torch.cat(parts)


def _mean_whole(measured: Sequence[dict[str, Any]], name: str, key: str) -> float | None:
    values = [
        of_seed["whole"].get(key) for found in measured for of_seed in found["rows"][name].values()
    ]
    if any(value is None for value in values):
        return None
    return round(sum(values) / len(values), 3)


def _interval(samples: torch.Tensor) -> str | None:
    return mean_interval(samples).of_difference() if len(samples) > 1 else None
