"""``handavatar bench --table geometry``: every decoder, by IoU and by its extracted meshes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from handavatar.errors import require_ranges
from handavatar.evaluate.geometry import Skin, Truth
from handavatar.evaluate.tables import ResultTable
from handavatar.field.decoders import OccupancyField
from handavatar.field.occupancy import HandCodes
from handavatar.hand.parts import Parts, divide_into_parts
from handavatar.hand.rig import PosedHand
from handavatar.jobs.progress import SILENT, Progress
from handavatar.train.comparison import (
    ComparisonOptions,
    compare_decoders,
    comparison_table,
    contenders,
)
from handavatar.train.labelled_poses import sample_points
from handavatar.train.prior import EVALUATION_SEED
from handavatar.train.prior_measures import measure_field

_MESH_COLUMNS = ("lap", "cham_to_truth", "cham_from_truth", "cham", "seam", "seam_step")


@dataclass(frozen=True)
class GeometryTableOptions(ComparisonOptions):
    """What is compared, and how finely meshes are extracted.

    Attributes:
        resolution: cells along the longest side of the extraction's box.
    """

    resolution: int = 128

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        super().__post_init__()
        require_ranges(self, resolution=(2, 1024))

    @property
    def total_steps(self) -> int:
        """Of all trainings together."""
        return self.steps * len(self.seeds) * len(contenders(self))


class MeshMeasure:
    """The columns of :mod:`handavatar.train.prior_measures` that every pose has.

    A field without a surface has none of them: NaN.
    """

    def __init__(self, resolution: int) -> None:
        """At a resolution of the extraction."""
        self._resolution = resolution
        self._of_rig: dict[str, tuple[Skin, Parts]] = {}

    def __call__(
        self, field: OccupancyField, codes: HandCodes, posed: PosedHand
    ) -> Mapping[str, float]:
        """Figures of one field in one pose; lengths in 1e-4 m, angles in degrees."""
        rig = posed.rig
        if rig.sha256 not in self._of_rig:
            self._of_rig[rig.sha256] = Skin.of(rig), divide_into_parts(rig)
        skin, parts = self._of_rig[rig.sha256]
        generator = torch.Generator().manual_seed(EVALUATION_SEED)
        points = sample_points(parts, posed, 64, field.margin, generator)
        try:
            row = measure_field(
                lambda places: field(codes, places).whole,
                codes.boxes,
                Truth(posed, skin),
                points,
                self._resolution,
                generator,
            )
        except ValueError:
            return dict.fromkeys(_MESH_COLUMNS, math.nan)
        return {name: float(getattr(row, name)) for name in _MESH_COLUMNS}


def geometry_table(options: GeometryTableOptions, progress: Progress = SILENT) -> ResultTable:
    """Trains and judges; see :func:`handavatar.train.comparison.compare_decoders`.

    Args:
        options: what to compare.
        progress: told how far it is.

    Source: paper Sec. 4.2, table of geometry.
    """
    measure = MeshMeasure(options.resolution)
    table = comparison_table(compare_decoders(options, (measure,), progress))
    what = (
        f"{options.steps} steps of {options.points} points, seeds {list(options.seeds)}; IoU in "
        f"per cent on {options.poses} unseen poses, meshes of {options.measured_poses} of them at "
        f"resolution {options.resolution}; lengths in 1e-4 m, angles in degrees."
    )
    return replace(table, notes=(what, *table.notes))
