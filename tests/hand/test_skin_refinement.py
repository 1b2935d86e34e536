"""Refined skinning weights: terms against slow references, laws of the weights, continuing."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from handavatar.geometry.meshes import (
    distance_to_mesh,
    uniform_laplacian,
    uniform_laplacian_matrix,
    unique_edges,
)
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.pose_sampling import limit_excess
from handavatar.hand.rig import RigError
from handavatar.hand.skin_refinement import (
    RefinementOptions,
    RefinementState,
    SkinRefinement,
    nearby_bones,
    on_simplex,
    posed_by,
    recombined_poses,
    refine_skin,
    smoothness_loss,
    sparsity_loss,
    strongest_bones,
    surface_loss,
)
from handavatar.jobs.finite import NotFinite

TINY = RefinementOptions(steps=6, refit_steps=4, poses=2, surface_points=300)


@pytest.fixture(scope="module")
def problem() -> SkinRefinement:
    return SkinRefinement.of(load_open_hand("778"), 1, TINY)


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# --------------------------------------------------------------------------------- the terms


def test_sparsity_agrees_with_the_printed_sum() -> None:
    weights = torch.tensor([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])
    slow = sum(1 - 2.718281828 ** (-100 * w) for w in weights.flatten().tolist())
    assert float(sparsity_loss(weights)) == pytest.approx(slow / 6, abs=1e-6)


def test_sparsity_counts_the_bones_of_clear_weights() -> None:
    """Lies between zero and the share of non-zero weights, and reaches it for large ones."""
    weights = torch.tensor([[0.5, 0.5, 0, 0], [1, 0, 0, 0], [0.3, 0.3, 0.4, 0]])
    assert float(sparsity_loss(weights)) == pytest.approx(6 / 12, abs=1e-6)
    assert float(sparsity_loss(torch.tensor([[0.999, 0.001]]))) < 0.6


def test_smoothness_agrees_with_the_mean_norm_of_every_laplacian(problem: SkinRefinement) -> None:
    edges = unique_edges(problem.fine.faces)
    vertices = torch.rand(problem.fine.num_vertices, 2, 3, generator=_generator())
    slow = [float(uniform_laplacian(vertices[:, k], edges).norm(dim=-1).mean()) for k in range(2)]
    assert float(smoothness_loss(problem.laplacian, vertices)) == pytest.approx(sum(slow) / 2)


def test_vertices_on_the_coarse_surface_are_at_no_distance() -> None:
    rig = load_open_hand("778")
    corners = rig.template_vertices[rig.faces]
    middles = corners.mean(1)[:, None]
    truth = rig.template_vertices[:, None]
    # float32 places of 0.1 m are rounded to about 1e-8 m.
    assert float(surface_loss(middles, truth, rig.faces)) < 3e-8


@pytest.mark.slow
def test_surface_distance_is_unsquared_and_its_gradient_is_exact() -> None:
    rig = load_open_hand("778")
    truth = rig.template_vertices[:, None].double()
    points = (truth[:40] + 0.004 * torch.randn(40, 1, 3, generator=_generator())).requires_grad_()
    loss = surface_loss(points, truth, rig.faces)
    slow = distance_to_mesh(truth[:, 0], rig.faces, points[:, 0]).mean()
    assert float(loss.detach()) == pytest.approx(float(slow), rel=1e-9)
    function: Callable[[Tensor], Tensor] = lambda p: surface_loss(p, truth, rig.faces)  # noqa: E731
    assert torch.autograd.gradcheck(function, (points,), eps=1e-7, atol=1e-5)


def test_the_terms_are_differentiable_in_the_weights() -> None:
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    matrix = uniform_laplacian_matrix(unique_edges(faces), 4).double()
    rest = torch.rand(4, 3, generator=_generator()).double()
    rotations = 0.4 * torch.randn(2, NUM_BONES, 3, generator=_generator(1)).double()
    joints = 0.1 * torch.rand(NUM_BONES, 3, generator=_generator(2)).double()
    weights = torch.rand(4, NUM_BONES, generator=_generator(3)).double().requires_grad_()

    def terms(w: Tensor) -> Tensor:
        return smoothness_loss(matrix, posed_by(w, rest, rotations, joints)) + sparsity_loss(w)

    assert torch.autograd.gradcheck(terms, (weights,))


# ----------------------------------------------------------------------------------- weights


def _slow_simplex(values: list[float]) -> list[float]:
    """Bisection of the level that is taken off."""
    low, high = min(values) - 1, max(values)
    for _ in range(80):
        middle = (low + high) / 2
        if sum(max(v - middle, 0) for v in values) > 1:
            low = middle
        else:
            high = middle
    return [max(v - high, 0) for v in values]


def test_the_simplex_agrees_with_bisection() -> None:
    values = torch.randn(50, 6, generator=_generator()).double()
    found = on_simplex(values, torch.ones(50, 6, dtype=torch.bool))
    slow = torch.tensor([_slow_simplex(row) for row in values.tolist()]).double()
    torch.testing.assert_close(found, slow, atol=1e-6, rtol=0)


def test_weights_stay_what_they_are_and_keep_to_their_support() -> None:
    weights = torch.rand(30, 16, generator=_generator()).softmax(-1)
    everything = torch.ones_like(weights, dtype=torch.bool)
    torch.testing.assert_close(on_simplex(weights, everything), weights, atol=1e-6, rtol=0)
    support = torch.rand(30, 16, generator=_generator(1)) < 0.3
    support[:, 0] = True
    found = on_simplex(torch.randn(30, 16, generator=_generator(2)), support)
    torch.testing.assert_close(found.sum(-1), torch.ones(30))
    assert bool((found >= 0).all()) and not bool(found[~support].any())


def test_the_strongest_bones_are_kept_in_proportion() -> None:
    weights = torch.tensor([[0.1, 0.4, 0.2, 0.3, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0]])
    kept = strongest_bones(weights, 2)
    expected = torch.tensor([[0, 4 / 7, 0, 3 / 7, 0], [0, 1.0, 0, 0, 0]])
    torch.testing.assert_close(kept, expected)
    assert torch.equal(strongest_bones(kept, 2) > 0, kept > 0)


def test_nearby_bones_agree_with_walking_along_the_edges() -> None:
    rig = load_open_hand("778")
    found = nearby_bones(rig, 2)
    neighbours: list[set[int]] = [{vertex} for vertex in range(rig.num_vertices)]
    for face in rig.faces.tolist():
        for vertex in face:
            neighbours[vertex] |= set(face)
    for vertex in range(0, rig.num_vertices, 13):
        around = set().union(*(neighbours[near] for near in neighbours[vertex]))
        slow = (rig.skin_weights[sorted(around)] > 0.01).any(0)
        assert torch.equal(found[vertex], slow)


def test_no_bone_from_afar_takes_part(problem: SkinRefinement) -> None:
    weights = refine_skin(problem).free
    assert not bool((weights > 0)[~nearby_bones(problem.fine)].any())
    dense = replace(problem, options=replace(TINY, is_local=False))
    assert bool((refine_skin(dense).free > 0)[~nearby_bones(problem.fine)].any())


# ------------------------------------------------------------------------------------- poses


def test_the_fast_skinning_equals_the_plain_one(problem: SkinRefinement) -> None:
    rotations = recombined_poses(problem.base, 3, _generator())
    rest = problem.fine.shaped(torch.randn(10, generator=_generator(1)))
    weights = problem.fine.skin_weights
    fast = posed_by(weights, rest.rest_vertices, rotations, rest.rest_joints)
    plain = rest.posed(HandPose(rotations, torch.zeros(3, 3))).vertices
    torch.testing.assert_close(fast.transpose(0, 1), plain, atol=1e-6, rtol=0)


def test_poses_are_new_combinations_inside_the_joints_reach() -> None:
    rig = load_open_hand("778")
    rotations = recombined_poses(rig, 64, _generator())
    assert not bool(rotations[:, 0].any())
    # Between two poses inside the limits; turning about a changing axis may leave them a little.
    assert float(limit_excess(rig, rotations).max()) < 0.15
    angles = rotations.norm(dim=-1)
    middle_of = {finger: angles[:, bone] for finger, bone in (("index", 2), ("little", 8))}
    together = torch.corrcoef(torch.stack(list(middle_of.values())))[0, 1]
    # Plain samples bend their fingers together (0.8); these were drawn apart.
    assert abs(float(together)) < 0.4
    assert torch.equal(rotations, recombined_poses(rig, 64, _generator()))
    assert torch.isfinite(matrix_from_axis_angle(rotations)).all()


# ------------------------------------------------------------------------------------ fitting


def test_refined_weights_are_weights_and_at_most_four(problem: SkinRefinement) -> None:
    skins = refine_skin(problem)
    for weights in (skins.free, skins.projected, skins.fitted):
        torch.testing.assert_close(weights.sum(-1), torch.ones(len(weights)))
        assert bool((weights >= 0).all())
    assert int((skins.projected > 0).sum(-1).max()) <= 4
    assert not bool((skins.fitted > 0)[skins.projected == 0].any())
    rig = replace(problem.fine, skin_weights=skins.fitted)
    flat = rig.shaped().posed(HandPose.flat()).vertices
    torch.testing.assert_close(flat, rig.template_vertices, atol=1e-6, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("term", ["smoothness", "surface"])
def test_each_term_alone_falls_on_unseen_poses(problem: SkinRefinement, term: str) -> None:
    alone = {"smoothness": 0.0, "surface": 0.0, "sparsity": 0.0, term: 1.0}
    few = replace(TINY, steps=40, refit_steps=0, poses=4, surface_points=1000, lr=3e-4)
    options = replace(few, **alone)
    weights = refine_skin(replace(problem, options=options)).free
    rotations = recombined_poses(problem.base, 6, _generator(77))
    rest = problem.fine.shaped()
    coarse = rest.rest_vertices[: problem.base.num_vertices]
    truth = posed_by(problem.base.skin_weights, coarse, rotations, rest.rest_joints)

    def measured(w: Tensor) -> float:
        posed = posed_by(w, rest.rest_vertices, rotations, rest.rest_joints)
        if term == "surface":
            return float(surface_loss(posed, truth, problem.base.faces))
        return float(smoothness_loss(problem.laplacian, posed))

    assert measured(weights) < measured(problem.fine.skin_weights)


def test_a_continued_refinement_is_the_same(problem: SkinRefinement, tmp_path: Path) -> None:
    """Stopped within the second stage, whose support depends on the first."""
    file = tmp_path / "skin.part"

    def keep(state: RefinementState, figures: dict[str, float]) -> None:
        if state.step == TINY.steps + 2:
            state.save(file, problem)

    whole = refine_skin(problem, after_step=keep)
    continued = refine_skin(problem, RefinementState.load(file, problem))
    assert torch.equal(whole.fitted, continued.fitted) and torch.equal(whole.free, continued.free)
    other = replace(problem, options=replace(TINY, seed=1))
    assert not torch.equal(refine_skin(other).fitted, whole.fitted)
    with pytest.raises(RigError, match="continue with the options"):
        RefinementState.load(file, other)
    spoilt = problem.begin()
    spoilt.mean_gradient[5, 2] = float("nan")
    with pytest.raises(NotFinite, match=r"not saved: mean_gradient holds NaN at \[5, 2\]"):
        spoilt.save(file, problem)
    assert RefinementState.load(file, problem).step == TINY.steps + 2
    with pytest.raises(NotFinite, match=r"step 1: weights holds NaN at \[5, 2\]"):
        refine_skin(problem, spoilt)
    file.write_bytes(b"short")
    with pytest.raises(RigError, match="delete it"):
        RefinementState.load(file, problem)
