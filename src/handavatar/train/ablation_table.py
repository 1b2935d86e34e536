"""``handavatar bench --table ablation``: what each part of the shading and the shape is worth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import read_capture
from handavatar.errors import SEEDS, ArgumentError, require_ranges
from handavatar.evaluate.intervals import mean_interval
from handavatar.evaluate.tables import TABLES, Cell, ResultTable, step_counter
from handavatar.jobs.files import make_folder
from handavatar.jobs.progress import SILENT, Progress
from handavatar.train.ablation import ROWS, ablate
from handavatar.train.kept import (
    capture_fingerprint,
    origin,
    origin_notes,
    read_kept,
    require_known_origin,
    write_kept,
)


@dataclass(frozen=True)
class AblationTableOptions:
    """What is compared, and where the figures of every frame are kept.

    Attributes:
        captures: folders of captures, one after the other: made ones (``handavatar capture
            benchmark``), or any, whose split into albedo and light then is not judged.
        kept: folder; what a capture's rows reached is kept there as ``CAPTURE.json`` and is not
            measured again with the same steps and seeds; ``CAPTURE.png`` shows three test frames
            of the rows that were measured last. Figures of another capture are refused.
        rows: words that the names of the rows to measure contain, comma-separated, as ``(paper)``;
            by default all rows.
        seeds: of the shadings; geometry is fitted once per capture.
        steps: of each shading.
        any_commit: kept figures that another commit measured are shown too, and the table says
            which; else they are refused.
    """

    captures: tuple[Path, ...]
    kept: Path = Path("ablation")
    rows: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 310
    any_commit: bool = False

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, seeds=SEEDS, steps=(1, 10**8))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the rows.

        Raises:
            ValueError: for a word that no name contains.
        """
        for word in self.rows:
            if not any(word in name for name in ROWS):
                raise ArgumentError("rows", f"no row is called {word}; there are {'; '.join(ROWS)}")
        words = self.rows or ("",)
        return tuple(name for name in ROWS if any(word in name for word in words))

    @property
    def total_steps(self) -> int:
        """Rows and seeds of all captures."""
        return len(self.names) * len(self.seeds) * len(self.captures)


def ablation_table(options: AblationTableOptions, progress: Progress = SILENT) -> ResultTable:
    """Measures what is not kept yet, and puts all captures into one table.

    Args:
        options: what to compare.
        progress: told the number of rows and seeds done.

    Raises:
        CaptureError: if a capture is damaged, or what is kept is of another capture or commit.
        ValueError: if there is no row of a name.

    Source: paper Sec. 4.3, table of ablations; supplement, disentanglement.
    """
    finished = step_counter(progress, options.total_steps)
    measured = []
    for folder in options.captures:
        path = options.kept / f"{folder.name}.json"
        read_capture(folder)
        sha256 = capture_fingerprint(folder)
        kept = read_kept(path, sha256, options.any_commit)
        if (kept.get("steps"), kept.get("seeds")) != (options.steps, list(options.seeds)):
            kept = {"rows": {}}
        if not isinstance(kept.get("rows"), dict):
            raise CaptureError(f"{path}: holds no rows of figures", "move the file away")
        missing = [name for name in options.names if name not in kept["rows"]]
        for _ in range((len(options.names) - len(missing)) * len(options.seeds)):
            finished()
        if missing:
            if kept["rows"]:
                require_known_origin(path, kept)
            picture = options.kept / f"{folder.name}.png"
            found = ablate(folder, missing, options.seeds, options.steps, finished, picture)
            found["rows"] = {**kept["rows"], **found["rows"]}
            found["seeds"] = list(options.seeds)
            found |= origin(sha256, missing)
            found["commits"] = {**kept.get("commits", {}), **found["commits"]}
            make_folder(options.kept, TABLES)
            kept = write_kept(path, found)
        measured.append(kept)
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
    for name in options.names:
        row = ROWS[name]
        is_compared = row.against in options.names
        of_frame = {key: _per_frame(measured, name, key) for key in _frame_keys(measured[0])}
        line: dict[str, Cell] = {}
        for key, values in of_frame.items():
            line[key] = round(float(values.mean()), 2 if key.startswith("psnr") else 4)
        for key in ("albedo", "shading r", "view spread %"):
            line[key] = _mean_whole(measured, name, key)
        gain = torch.empty(0)
        if is_compared:
            gain = of_frame["psnr"] - _per_frame(measured, row.against, "psnr")
        for which, chosen in parts.items():
            line[f"gain, {which}"] = _interval(gain[chosen]) if is_compared else None
        line["against"] = row.against if is_compared else None
        rows[name] = line
    notes = (
        f"Captures: {', '.join(found['capture'] for found in measured)}; {len(hidden)} test frames "
        f"of poses and cameras never seen, seeds {list(options.seeds)} of the shadings, "
        f"{options.steps} steps each; geometry is fitted once per capture and kind of shape. "
        "Albedo and shading are judged where all captures know the truth.",
        "Gain: masked PSNR over the row that it is compared with, decibels, mean over frames of "
        "the mean over seeds [95 % over frames]; the occluded half are the frames in which the "
        "hand hides more of its own sky than in the median frame.",
        "Albedo in decibels after one scale per channel; shading r against true shading; view "
        "spread: how much the light of the same place changes with the camera alone.",
        *origin_notes({str(found["capture"]): found for found in measured}),
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
