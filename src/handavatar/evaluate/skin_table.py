"""The paper's table of the high-resolution rig: smoothness, truth to the coarse mesh, sparsity.

Measured on unseen plausible poses of the mean hand. Lengths are unsquared and in metres inside,
in 1e-4 m in the table.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from handavatar.errors import SEEDS, require_ranges
from handavatar.evaluate.tables import Cell, ResultTable
from handavatar.geometry.meshes import distance_to_mesh, uniform_laplacian, unique_edges
from handavatar.hand.detail import refined
from handavatar.hand.open_hand import Level, load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import resolve_penetration, sample_poses
from handavatar.hand.rig import Rig
from handavatar.hand.skin_refinement import (
    RefinementOptions,
    RefinementState,
    SkinRefinement,
    refine_skin,
    strongest_bones,
)
from handavatar.jobs.progress import SILENT, Progress

EVALUATION_SEED = 1_000_033
"""Evaluation poses come from a seed that no refinement draws."""
PAPER_SURFACE = 0.1
"""Surface weight of the rows that are the paper's: see ``RefinementOptions``."""
PAPER_SPARSITY = 7e-3
"""Their l0 weight: with every bone free it takes a little more to stay below averaged weights."""


@dataclass(frozen=True)
class SkinTableOptions:
    """The table of skinning weights (paper appendix A).

    Attributes:
        level: which open hand; ``778`` is the paper's counterpart.
        rounds: midpoint subdivisions.
        steps: of each refinement.
        refit_steps: with four bones per vertex.
        poses: unseen poses.
        seeds: every refinement is made once with each.
    """

    level: Level = "778"
    rounds: int = 2
    steps: int = 200
    refit_steps: int = 50
    poses: int = 100
    seeds: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            rounds=(0, 4),
            steps=(0, 10**7),
            refit_steps=(0, 10**7),
            poses=(1, 10**5),
            seeds=SEEDS,
        )

    @property
    def total_steps(self) -> int:
        """Of three refinements per seed, one of which goes on with four bones."""
        return len(self.seeds) * (3 * self.steps + self.refit_steps)


@dataclass(frozen=True, eq=False)
class SkinMeasures:
    """What one set of weights does, pose by pose.

    Attributes:
        laplacian: mean distance of a vertex from the middle of its neighbours, metres.
        edge: mean length of a vertex's edges, metres: the Laplacian as the paper prints it.
        distance: mean distance of a vertex from the coarse posed surface, metres.
        non_zero: share of the weights that are not exactly zero.
        most_bones: of any vertex.
    """

    laplacian: Float[Tensor, "poses"]
    edge: Float[Tensor, "poses"]
    distance: Float[Tensor, "poses"]
    non_zero: float
    most_bones: int

    def summary(self) -> dict[str, float]:
        """Means over the poses in the table's units."""
        return {
            "lap": 1e4 * float(self.laplacian.mean()),
            "lap_as_printed": 1e4 * float(self.edge.mean()),
            "cham": 1e4 * float(self.distance.mean()),
            "non_zero_percent": 100 * self.non_zero,
            "most_bones": float(self.most_bones),
        }


def evaluation_poses(base: Rig, count: int) -> Float[Tensor, "count bones 3"]:
    """Unseen plausible poses whose self-penetration is resolved; axis-angle, radians."""
    generator = torch.Generator().manual_seed(EVALUATION_SEED)
    return resolve_penetration(base, sample_poses(base, count, generator))


@torch.no_grad()
def measure_skin(
    base: Rig,
    fine: Rig,
    skin_weights: Float[Tensor, "vertices bones"],
    rotations: Float[Tensor, "poses bones 3"],
) -> SkinMeasures:
    """Measures weights of a fine rig against the posed base rig, mean shape.

    Source: paper appendix A, effects of MANO-HD (Lap., Cham., l0 norm).
    Departs: ``Cham`` is the unsquared distance from vertices to true triangles.
    """
    rig = replace(fine, skin_weights=skin_weights)
    edges = unique_edges(rig.faces)
    valence = torch.bincount(edges.reshape(-1), minlength=rig.num_vertices).clamp_min(1)
    laplacian, lengths, distance = [], [], []
    for pose in rotations:
        placed = HandPose(pose, pose.new_zeros(3))
        vertices = rig.shaped().posed(placed).vertices
        coarse = base.shaped().posed(placed).vertices
        laplacian.append(uniform_laplacian(vertices, edges).norm(dim=-1).mean())
        edge = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=-1)
        share = (1 / valence[edges[:, 0]] + 1 / valence[edges[:, 1]]) / rig.num_vertices
        lengths.append((edge * share).sum())
        distance.append(distance_to_mesh(coarse, base.faces, vertices).mean())
    is_used = skin_weights != 0
    return SkinMeasures(
        torch.stack(laplacian),
        torch.stack(lengths),
        torch.stack(distance),
        float(is_used.double().mean()),
        int(is_used.sum(-1).max()),
    )


def skin_table(options: SkinTableOptions, progress: Progress = SILENT) -> ResultTable:
    """Refines the weights with every seed and measures all rows on the same poses.

    Args:
        options: see :class:`SkinTableOptions`.
        progress: told the steps done.

    Returns:
        Lengths in 1e-4 m with half the width of their 95 % confidence interval over poses (values
        first averaged over seeds); the columns ``... vs averaged`` are paired per pose.
    """
    base = load_open_hand(options.level)
    poses = evaluation_poses(base, options.poses)
    ours = RefinementOptions(steps=options.steps, refit_steps=options.refit_steps)
    papers = replace(
        ours, surface=PAPER_SURFACE, sparsity=PAPER_SPARSITY, is_local=False, refit_steps=0
    )
    variants = {"paper": papers, "dense": replace(papers, sparsity=0.0), "ours": ours}
    done = 0

    def count(state: RefinementState, figures: dict[str, float]) -> None:
        nonlocal done
        done += 1
        progress(done, options.total_steps, **figures)

    problem = SkinRefinement.of(base, options.rounds, ours)
    fine = problem.fine

    def measured(weights: Tensor) -> SkinMeasures:
        return measure_skin(base, fine, weights, poses)

    rows: dict[str, list[SkinMeasures]] = {
        "coarse": [measure_skin(base, base, base.skin_weights, poses)],
        "HD, averaged weights": [measured(fine.skin_weights)],
        "HD, averaged, four bones": [measured(strongest_bones(fine.skin_weights))],
        "HD, refined without l0": [],
        "HD, refined": [],
        "HD, refined, ours": [],
        "ours, cut to four bones": [],
        "ours, fitted again": [],
    }
    for seed in options.seeds:
        for name, variant in variants.items():
            seeded = replace(problem, options=replace(variant, seed=seed))
            skins = refine_skin(seeded, after_step=count)
            if name == "dense":
                rows["HD, refined without l0"].append(measured(skins.free))
            elif name == "paper":
                rows["HD, refined"].append(measured(skins.free))
            else:
                rows["HD, refined, ours"].append(measured(skins.free))
                rows["ours, cut to four bones"].append(measured(skins.projected))
                rows["ours, fitted again"].append(measured(skins.fitted))
    shipped = refined(base, options.rounds).skin_weights
    if not torch.equal(shipped, fine.skin_weights):
        rows["the file that ships"] = [measured(shipped)]
    reference = rows["HD, averaged weights"][0]
    return ResultTable(
        title=f"Skinning weights, open hand {options.level}, {options.rounds} rounds",
        rows={name: _row(measures, reference) for name, measures in rows.items()},
        notes=(
            f"{fine.num_vertices} vertices, {len(fine.faces)} faces; {options.poses} unseen poses "
            f"of the mean hand, seeds {', '.join(map(str, options.seeds))}, {options.steps} steps "
            f"and {options.refit_steps} more with four bones.",
            "Lap, Lap as printed and Cham in 1e-4 m, unsquared, ± half the 95 % confidence "
            "interval over poses; differences from averaged weights are paired per pose.",
            f"Rows without 'ours': every bone free, weights lap 1, surface {PAPER_SURFACE:g}, "
            f"l0 {PAPER_SPARSITY:g} or none. Ours: bones nearby, weights lap 1, surface "
            f"{ours.surface:g}, l0 {ours.sparsity:g}. Cut and fitted rows start from ours.",
        ),
    )


def _row(measures: list[SkinMeasures], reference: SkinMeasures) -> dict[str, Cell]:
    """One row: means over seeds, intervals over poses, paired differences."""
    laplacian = torch.stack([m.laplacian for m in measures]).mean(0) * 1e4
    edge = torch.stack([m.edge for m in measures]).mean(0) * 1e4
    distance = torch.stack([m.distance for m in measures]).mean(0) * 1e4
    is_coarse = measures[0].distance.max() < 1e-7
    is_reference = measures[0] is reference
    versus: dict[str, Cell] = {"Lap vs averaged": None, "Cham vs averaged": None}
    if not is_coarse and not is_reference:
        versus = {
            "Lap vs averaged": with_interval(laplacian - 1e4 * reference.laplacian, True),
            "Cham vs averaged": with_interval(distance - 1e4 * reference.distance, True),
        }
    spread = torch.tensor([float(m.laplacian.mean()) for m in measures]) * 1e4
    return {
        "Lap": with_interval(laplacian),
        "Lap as printed": round(float(edge.mean()), 2),
        "Cham": None if is_coarse else with_interval(distance),
        "non-zero %": round(100 * sum(m.non_zero for m in measures) / len(measures), 2),
        "most bones": max(m.most_bones for m in measures),
        **versus,
        "Lap spread over seeds": (round(float(spread.std()), 4) if len(measures) > 1 else None),
    }


def with_interval(values: Float[Tensor, "poses"], is_signed: bool = False) -> str:
    """Mean and half the 95 % confidence interval of Student's t, as text."""
    mean = float(values.mean())
    text = f"{mean:+.3f}" if is_signed else f"{mean:.3f}"
    if len(values) < 2:
        return text
    spread = float(values.double().std()) / math.sqrt(len(values))
    return f"{text} ± {float(stats.t.ppf(0.975, len(values) - 1)) * spread:.3f}"
