"""The high-resolution rig carries everything the coarse one has."""

import torch

from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import NUM_BONES, HandPose


def test_zero_rounds_change_nothing() -> None:
    rig = load_open_hand("778")
    assert subdivided(rig, 0) is rig


def test_each_round_follows_eulers_count() -> None:
    """V' = V + E, F' = 4 F, for any mesh; an open surface has V - E + F = 1."""
    for level in ("full", "778"):
        rig = load_open_hand(level)
        fine = subdivided(rig, 1)
        edges = rig.num_vertices + len(rig.faces) - 1
        assert fine.num_vertices == rig.num_vertices + edges
        assert len(fine.faces) == len(fine.uv_faces) == 4 * len(rig.faces)


def test_joints_weights_and_coarse_vertices_stay() -> None:
    rig = load_open_hand("778")
    fine = subdivided(rig)
    coefficients = torch.randn(10, generator=torch.Generator().manual_seed(0))
    coarse_hand, fine_hand = rig.shaped(coefficients), fine.shaped(coefficients)
    torch.testing.assert_close(fine_hand.rest_joints, coarse_hand.rest_joints, atol=1e-7, rtol=0)
    old = slice(0, rig.num_vertices)
    torch.testing.assert_close(fine_hand.rest_vertices[old], coarse_hand.rest_vertices)
    torch.testing.assert_close(fine.skin_weights.sum(-1), torch.ones(fine.num_vertices))
    rotations = 0.5 * torch.randn(NUM_BONES, 3, generator=torch.Generator().manual_seed(1))
    pose = HandPose(rotations, torch.tensor([0.0, 0.1, 0.5]))
    # Old vertices keep their weights, so they are posed as before.
    torch.testing.assert_close(
        fine_hand.posed(pose).vertices[old], coarse_hand.posed(pose).vertices, atol=1e-6, rtol=0
    )


def test_midpoints_carry_the_mean_of_their_ends() -> None:
    """Slowly: every new vertex of one round is the middle of an edge, in every quantity."""
    rig = load_open_hand("778")
    fine = subdivided(rig, 1)
    edges = {tuple(sorted((f[k], f[(k + 1) % 3]))) for f in rig.faces.tolist() for k in range(3)}
    for new, (a, b) in enumerate(sorted(edges), start=rig.num_vertices):
        for name in ("template_vertices", "skin_weights", "shape_directions"):
            values = getattr(rig, name)
            middle = (values[a] + values[b]) / 2
            assert torch.equal(getattr(fine, name)[new], middle), name


def test_sets_grow_with_the_mesh() -> None:
    rig = load_open_hand("full")
    fine = subdivided(rig, 1)
    for name, members in rig.vertex_sets.items():
        grown = fine.vertex_sets[name]
        assert set(members.tolist()) <= set(grown.tolist())
        assert int(grown.max()) < fine.num_vertices
