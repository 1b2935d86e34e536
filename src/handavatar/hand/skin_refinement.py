"""Refined skinning weights of a subdivided rig: smooth when bent, true to the coarse surface.

Midpoint subdivision averages weights, which creases the posed skin at joints. Here the weights of
all vertices are fitted to random poses under three terms (smooth, on the coarse surface, few
bones), then cut to four bones per vertex and fitted once more with those bones.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from handavatar.errors import SEEDS, raise_if_refused, require_ranges
from handavatar.geometry.closest import closest_on_mesh
from handavatar.geometry.meshes import uniform_laplacian_matrix, unique_edges
from handavatar.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    rotations_between,
)
from handavatar.hand.detail import subdivided
from handavatar.hand.pose import FINGER_BONES, bone_transforms
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import Rig, RigError
from handavatar.hand.sparse_skin import MAX_BONES
from handavatar.jobs.files import write_atomically
from handavatar.jobs.finite import require_finite

SHARPNESS = 100.0
"""The paper's eta: a weight of 0.01 counts as 63 % of a bone."""
_BEGIN_ANEW = "begin anew with another `seed` or a lower `lr`, and without `resume=True`"
# Decay of the running means of the gradient and of its square.
_MOMENTUM, _SCALE = 0.9, 0.99


@dataclass(frozen=True)
class RefinementOptions:
    """How skinning weights are refined.

    Departs: the paper's balance (l0 0.01, lap 1, surf 10) belongs to lengths in decimetres and to
        a squared distance that takes most triangles for their edges. A Laplacian in metres is a
        tenth of one in decimetres, so 0.01 becomes 0.001; 10 squared decimetres pull as 200 d
        metres per metre do, 0.02 at the d of 0.1 mm that vertices inside a face have and 0.2 at
        the 1 mm to its edges. Hence the paper's order of rows comes out at a surface weight of
        0.1. The default is 1: with a true distance smoothness and truth to the surface both
        improve over averaged weights. The l0 weight is 0.005 since weights here may come back
        from zero, which the authors' clamping forbids.

    Attributes:
        steps: with all bones free.
        refit_steps: with the four strongest bones of each vertex only, without the l0 term.
        poses: per step, all of one random shape.
        surface_points: vertices per step whose distance to the coarse surface is taken.
        smoothness: weight of the Laplacian term.
        surface: weight of the distance to the coarse surface.
        sparsity: weight of the l0 term, metres.
        lr: largest change of a weight per step, at the start.
        final_lr: at the end; exponential in between.
        is_local: only bones that move a vertex's surroundings already may move it. Else a thumb
            may hang by a percent on the little finger, which the paper's terms reward.
        seed: of everything.
    """

    steps: int = 300
    refit_steps: int = 100
    poses: int = 8
    surface_points: int = 3000
    smoothness: float = 1.0
    surface: float = 1.0
    sparsity: float = 5e-3
    lr: float = 3e-3
    final_lr: float = 1e-5
    is_local: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(
            self,
            steps=(0, 10**7),
            refit_steps=(0, 10**7),
            poses=(1, 1000),
            surface_points=(1, 10**6),
            smoothness=(0, 1e6),
            surface=(0, 1e6),
            sparsity=(0, 1e6),
            lr=(1e-12, 1),
            final_lr=(1e-12, 1),
            seed=SEEDS,
        )


@dataclass(frozen=True, eq=False)
class RefinementState:
    """Where a refinement stands; everything that a later step depends on.

    Attributes:
        step: steps done, both stages counted.
        weights: the present ones.
        support: which entries may differ from zero.
        mean_gradient: running mean.
        mean_square: running mean of the largest squared entry of each vertex's gradient.
        free: the weights at the end of the first stage; during it, the present ones.
    """

    step: int
    weights: Float[Tensor, "vertices bones"]
    support: Bool[Tensor, "vertices bones"]
    mean_gradient: Float[Tensor, "vertices bones"]
    mean_square: Float[Tensor, "vertices 1"]
    free: Float[Tensor, "vertices bones"]

    def save(self, path: Path, problem: "SkinRefinement") -> None:
        """Writes the state aside and renames it into place.

        Raises:
            NotFinite: if a value is NaN or infinite; the state before stays.
        """
        require_finite(vars(self), f"{path}: not saved", _BEGIN_ANEW)
        # A tensor that is two of the fields at once is stored twice.
        tensors = {name: value.clone() for name, value in vars(self).items() if name != "step"}
        facts = {"step": str(self.step), "problem": problem.fingerprint}
        write_atomically({path: save(tensors, facts)})

    @staticmethod
    def load(path: Path, problem: "SkinRefinement") -> "RefinementState":
        """Reads a state back.

        Raises:
            RigError: if the file is damaged or belongs to another rig or other options.
        """
        try:
            with safe_open(path, framework="pt") as file:
                header = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            require_finite(tensors, "state")
            state = RefinementState(step=int(header["step"]), **tensors)
        except Exception as error:
            raise_if_refused(error)
            raise RigError(
                f"{path}: cannot be continued ({error}); delete it and begin anew"
            ) from error
        if header.get("problem") != problem.fingerprint:
            raise RigError(
                f"{path}: begun as {header.get('problem')}\nnow it is {problem.fingerprint}\n"
                "continue with the options it was begun with, or delete it"
            )
        return state


@dataclass(frozen=True, eq=False)
class RefinedWeights:
    """Weights of the fine rig at three points of the road.

    Attributes:
        free: any number of bones per vertex.
        projected: the four strongest of those, scaled to sum to 1.
        fitted: the same bones, fitted again.
    """

    free: Float[Tensor, "vertices bones"]
    projected: Float[Tensor, "vertices bones"]
    fitted: Float[Tensor, "vertices bones"]


# --------------------------------------------------------------------------------- the terms


def sparsity_loss(skin_weights: Float[Tensor, "vertices bones"]) -> Float[Tensor, ""]:
    """Smooth stand-in for the share of weights that are not zero, in [0, 1].

    Source: paper appendix A, L_l0.
    Departs: the mean over all entries, as in the authors' code, not the printed sum.
    """
    return (1 - torch.exp(-SHARPNESS * skin_weights)).mean()


def smoothness_loss(
    laplacian: Float[Tensor, "vertices vertices"],
    posed_vertices: Float[Tensor, "vertices poses 3"],
) -> Float[Tensor, ""]:
    """Mean distance in metres of a vertex from the middle of its neighbours.

    Args:
        laplacian: from :func:`uniform_laplacian_matrix`.
        posed_vertices: metres.

    Source: paper appendix A, L_lap.
    Departs: the norm of the mean difference, as in the authors' code; the printed mean of norms
        is a mean edge length, which a flat and even mesh does not lessen.
    """
    difference: Tensor = torch.sparse.mm(laplacian, posed_vertices.flatten(1))
    return difference.unflatten(1, (-1, 3)).norm(dim=-1).mean()


def surface_loss(
    posed_vertices: Float[Tensor, "vertices poses 3"],
    coarse_vertices: Float[Tensor, "coarse_vertices poses 3"],
    coarse_faces: Int[Tensor, "faces 3"],
) -> Float[Tensor, ""]:
    """Mean distance in metres from vertices to the nearest point of the coarse posed surface.

    The nearest point is held fixed for the gradient, which is exact: a closest point moves at
    right angles to the distance.

    Source: paper appendix A, L_surf.
    Departs: unsquared distance to true triangles, from the fine vertices only. The authors' code
        squares, adds the other direction, and its library measures small triangles by their edges.
    """
    nearest = torch.stack(
        [
            closest_on_mesh(coarse, coarse_faces, fine).positions
            for coarse, fine in zip(
                coarse_vertices.unbind(1), posed_vertices.detach().unbind(1), strict=True
            )
        ],
        dim=1,
    )
    return (posed_vertices - nearest).norm(dim=-1).mean()


# ----------------------------------------------------------------------------------- weights


def on_simplex(
    values: Float[Tensor, "vertices bones"], support: Bool[Tensor, "vertices bones"]
) -> Float[Tensor, "vertices bones"]:
    """The nearest weights: not negative, rows sum to 1, exactly zero outside the support.

    Departs: the authors clamp and divide by the sum, after which a weight below zero has no
        gradient and never comes back.
    """
    allowed = values.masked_fill(~support, -torch.inf)
    ordered = allowed.sort(dim=-1, descending=True).values
    excess = ordered.cumsum(-1) - 1
    rank = torch.arange(1, values.shape[-1] + 1, device=values.device)
    count = (ordered * rank > excess).sum(-1, keepdim=True)
    return (allowed - excess.gather(-1, count - 1) / count).clamp_min(0)


def strongest_bones(
    skin_weights: Float[Tensor, "vertices bones"], count: int = MAX_BONES
) -> Float[Tensor, "vertices bones"]:
    """Keeps the largest weights of each vertex and scales them to sum to 1."""
    kept = skin_weights.topk(count, dim=-1)
    cut = torch.zeros_like(skin_weights).scatter(-1, kept.indices, kept.values)
    return cut / cut.sum(-1, keepdim=True)


def nearby_bones(rig: Rig, rings: int = 4) -> Bool[Tensor, "vertices bones"]:
    """Bones that move a vertex, or one at most ``rings`` edges away, by more than a percent."""
    edges = unique_edges(rig.faces)
    near = rig.skin_weights > 0.01
    for _ in range(rings):
        grown = near.clone()
        for here, there in (edges.unbind(-1), edges.flip(-1).unbind(-1)):
            reached = torch.zeros_like(near, dtype=torch.int32)
            reached = reached.index_add(0, here, near[there].int())
            grown |= reached > 0
        near = grown
    return near


# ------------------------------------------------------------------------------------- poses


def recombined_poses(
    rig: Rig, count: int, generator: torch.Generator
) -> Float[Tensor, "count bones 3"]:
    """Poses between two hands whose fingers were drawn independently of each other.

    Axis-angle rotations; the wrist stays at zero, since no term depends on it.

    Source: paper appendix A, "randomly compose and interpolate finger-level rotations".
    Departs: fingers come from our sampler of plausible poses, not from MANO's registrations.
    """

    def composed() -> Float[Tensor, "count bones 3 3"]:
        draws = sample_poses(rig, len(FINGER_BONES) * count, generator)
        draws = draws.unflatten(0, (len(FINGER_BONES), count))
        rotations = torch.zeros_like(draws[0])
        for draw, bones in zip(draws, FINGER_BONES.values(), strict=True):
            rotations[:, list(bones)] = draw[:, list(bones)]
        return matrix_from_axis_angle(rotations)

    start, end = composed(), composed()
    share = torch.rand(count, 1, 1, generator=generator)
    return axis_angle_from_matrix(rotations_between(start, end, share))


def posed_by(
    skin_weights: Float[Tensor, "vertices bones"],
    rest_vertices: Float[Tensor, "vertices 3"],
    rotations: Float[Tensor, "poses bones 3"],
    rest_joints: Float[Tensor, "bones 3"],
) -> Float[Tensor, "vertices poses 3"]:
    """Linear blend skinning of one shape in many poses, as a single matrix product.

    Equal to :func:`handavatar.hand.pose.linear_blend_skinning`, but several times as fast.
    """
    world_from_bone = bone_transforms(rotations, rest_joints)
    turn = world_from_bone[..., :3, :3]
    shift = world_from_bone[..., :3, 3] - (turn @ rest_joints[..., None])[..., 0]
    motion = torch.cat([turn, shift[..., None]], dim=-1)
    columns = motion.permute(1, 3, 0, 2).flatten(0, 1).flatten(1)
    ones = torch.ones_like(rest_vertices[:, :1])
    spread = skin_weights[:, :, None] * torch.cat([rest_vertices, ones], dim=-1)[:, None]
    return (spread.flatten(1) @ columns).unflatten(1, (len(rotations), 3))


# ------------------------------------------------------------------------------------ fitting


@dataclass(frozen=True, eq=False)
class SkinRefinement:
    """The problem: which rig, which options. ``begin``, then ``advanced`` step by step.

    Attributes:
        base: the coarse rig, whose posed surface is the truth.
        fine: its subdivision, with averaged weights.
        laplacian: sparse, of the fine mesh.
        options: see :class:`RefinementOptions`.
    """

    base: Rig
    fine: Rig
    laplacian: Float[Tensor, "vertices vertices"]
    options: RefinementOptions

    @staticmethod
    def of(base: Rig, rounds: int, options: RefinementOptions) -> "SkinRefinement":
        """Subdivides the rig."""
        fine = subdivided(base, rounds)
        matrix = uniform_laplacian_matrix(unique_edges(fine.faces), fine.num_vertices)
        return SkinRefinement(base, fine, matrix, options)

    @property
    def fingerprint(self) -> str:
        """Rig, size and options as text: what a state may be continued with."""
        facts = {"rig": self.base.sha256, "vertices": self.fine.num_vertices}
        return json.dumps(facts | asdict(self.options))

    @property
    def total_steps(self) -> int:
        """Of both stages."""
        return self.options.steps + self.options.refit_steps

    def begin(self) -> RefinementState:
        """The averaged weights, cut to the bones that may take part."""
        weights = self.fine.skin_weights
        support = torch.ones_like(weights, dtype=torch.bool)
        if self.options.is_local:
            support = nearby_bones(self.fine)
            weights = on_simplex(weights, support)
        return RefinementState(
            step=0,
            weights=weights,
            support=support,
            mean_gradient=torch.zeros_like(weights),
            mean_square=torch.zeros_like(weights[:, :1]),
            free=weights,
        )

    def advanced(self, state: RefinementState) -> tuple[RefinementState, dict[str, float]]:
        """One step further, and the terms before it (lengths in 1e-4 m).

        A projected gradient step. The gradient is taken along the simplex, smoothed, and scaled
        per vertex: scaled per entry, as Adam would, the noise of bones that hardly matter would
        weigh as much as those that do.
        """
        if state.step == self.options.steps:
            state = self._with_few_bones(state)
        is_refit = state.step >= self.options.steps
        weights = state.weights.clone().requires_grad_()
        smooth, surface = self._lengths(weights, state.step)
        sparse = sparsity_loss(weights)
        total = self.options.smoothness * smooth + self.options.surface * surface
        if not is_refit:
            total = total + self.options.sparsity * sparse
        (gradient,) = torch.autograd.grad(total, weights)
        figures = {
            "lap": 1e4 * float(smooth.detach()),
            "cham": 1e4 * float(surface.detach()),
            "l0": float(sparse.detach()),
        }
        return self._moved(state, gradient, is_refit), figures

    def _with_few_bones(self, state: RefinementState) -> RefinementState:
        """Ends the first stage: cuts to four bones per vertex and forgets the momentum."""
        projected = strongest_bones(state.weights)
        return replace(
            self.begin(),
            step=state.step,
            weights=projected,
            support=projected > 0,
            free=state.weights,
        )

    def _lengths(self, weights: Tensor, step: int) -> tuple[Tensor, Tensor]:
        """Laplacian and surface terms on the poses of a step; these depend on seed and step."""
        options = self.options
        generator = torch.Generator().manual_seed(options.seed * 1_000_003 + step)
        rotations = recombined_poses(self.base, options.poses, generator)
        shape = torch.randn(self.base.shape_directions.shape[-1], generator=generator)
        rest = self.fine.shaped(shape)
        vertices = posed_by(weights, rest.rest_vertices, rotations, rest.rest_joints)
        coarse = rest.rest_vertices[: self.base.num_vertices]
        with torch.no_grad():
            truth = posed_by(self.base.skin_weights, coarse, rotations, rest.rest_joints)
        chosen = torch.randperm(len(vertices), generator=generator)[: options.surface_points]
        return (
            smoothness_loss(self.laplacian, vertices),
            surface_loss(vertices[chosen], truth, self.base.faces),
        )

    def _moved(self, state: RefinementState, gradient: Tensor, is_refit: bool) -> RefinementState:
        options = self.options
        active = state.weights > 0
        level = (gradient * active).sum(-1, keepdim=True) / active.sum(-1, keepdim=True)
        gradient = gradient - level
        # A weight at zero that should fall, or that may not rise, stays.
        is_held = ~active & ((gradient > 0) | ~state.support)
        gradient = gradient.masked_fill(is_held, 0)
        square = gradient.square().amax(-1, keepdim=True)
        mean_gradient = _MOMENTUM * state.mean_gradient + (1 - _MOMENTUM) * gradient
        mean_square = _SCALE * state.mean_square + (1 - _SCALE) * square
        first = options.steps if is_refit else 0
        done = state.step + 1 - first
        share = done / (options.refit_steps if is_refit else options.steps)
        rate = options.lr * (options.final_lr / options.lr) ** share
        direction = mean_gradient / (1 - _MOMENTUM**done)
        scale = (mean_square / (1 - _SCALE**done)).sqrt() + 1e-12
        moved = state.weights - rate * direction / scale
        values = {"weights": moved, "mean_gradient": mean_gradient, "mean_square": mean_square}
        require_finite(values, f"step {state.step + 1}", _BEGIN_ANEW)
        moved = on_simplex(moved, state.support)
        return replace(
            state,
            step=state.step + 1,
            weights=moved,
            mean_gradient=mean_gradient,
            mean_square=mean_square,
            free=state.free if is_refit else moved,
        )

    def result(self, state: RefinementState) -> RefinedWeights:
        """What a finished state holds."""
        projected = strongest_bones(state.free)
        fitted = state.weights if state.step > self.options.steps else projected
        return RefinedWeights(state.free, projected, fitted)


def refine_skin(
    problem: SkinRefinement,
    state: RefinementState | None = None,
    after_step: Callable[[RefinementState, dict[str, float]], None] | None = None,
) -> RefinedWeights:
    """Refines the weights of a subdivided rig.

    Args:
        problem: rig and options.
        state: where to continue; the beginning by default.
        after_step: is given every state and its figures.

    Raises:
        NotFinite: if a weight or what moves it is no longer finite.

    Source: paper appendix A, L_HD.
    Departs: ends with at most four bones per vertex; the paper leaves their number open.
    """
    state = problem.begin() if state is None else state
    while state.step < problem.total_steps:
        state, figures = problem.advanced(state)
        if after_step is not None:
            after_step(state, figures)
    return problem.result(state)
