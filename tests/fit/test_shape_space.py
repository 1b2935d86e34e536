"""A person's own shape: smooth waves on the skin, linear in a few numbers."""

import pytest
import torch

from handavatar.fit.shape import ShapeSpace, fixed_shape
from handavatar.geometry.meshes import unique_edges, vertex_normals
from handavatar.hand.rig import Rig

WAVES = 12


@pytest.fixture(scope="module")
def space(rig: Rig) -> ShapeSpace:
    return ShapeSpace.around(rig, 0.5, WAVES)


def test_waves_lie_along_the_normals_with_mean_square_one(rig: Rig, space: ShapeSpace) -> None:
    swellings = space.directions[..., 10:]
    normals = vertex_normals(rig.template_vertices, rig.faces)
    waves = (swellings * normals[..., None]).sum(1)
    torch.testing.assert_close(swellings, normals[..., None] * waves[:, None], rtol=0, atol=1e-5)
    # Orthogonal, as eigenvectors are.
    products = waves.T @ waves / rig.num_vertices
    torch.testing.assert_close(products, torch.eye(WAVES), rtol=0, atol=1e-3)
    # The first is constant, and each further one is as smooth as the one before, or less.
    torch.testing.assert_close(waves[:, 0], torch.ones(778), rtol=0, atol=1e-3)
    first, second = unique_edges(rig.faces).T
    roughness = (waves[first] - waves[second]).square().sum(0) / rig.num_vertices
    assert bool((roughness.diff() > -1e-4).all())


def test_expected_sizes_fall_from_long_to_short_waves(space: ShapeSpace) -> None:
    assert space.sigmas[:10].tolist() == [0.5] * 10
    sizes = space.sigmas[10:]
    assert float(sizes[0]) == pytest.approx(1.5e-3, rel=1e-3)
    assert float(sizes[-1]) == pytest.approx(0.75e-3, rel=1e-3)
    assert bool((sizes.diff() <= 1e-9).all())


def test_the_same_bits_at_every_call(rig: Rig, space: ShapeSpace) -> None:
    again = ShapeSpace.around(rig, 0.5, WAVES)
    assert torch.equal(space.directions, again.directions)
    assert torch.equal(space.joint_directions, again.joint_directions)
    assert torch.equal(space.sigmas, again.sigmas)


def test_shapes_are_linear_and_coefficients_the_rigs(rig: Rig, space: ShapeSpace) -> None:
    generator = torch.Generator().manual_seed(0)
    first, second = space.sigmas * torch.randn(2, 10 + WAVES, generator=generator)
    hand = rig.shaped()
    both = space.shaped(space.shaped(hand, first), second)
    at_once = space.shaped(hand, first + second)
    torch.testing.assert_close(both.rest_vertices, at_once.rest_vertices, rtol=0, atol=1e-6)
    torch.testing.assert_close(both.rest_joints, at_once.rest_joints, rtol=0, atol=1e-6)
    values = torch.cat([torch.linspace(-1, 1, 10), torch.zeros(WAVES)])
    found, expected = space.shaped(hand, values), rig.shaped(values[:10])
    torch.testing.assert_close(found.rest_vertices, expected.rest_vertices, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.rest_joints, expected.rest_joints, rtol=0, atol=1e-6)
    # A swelling leaves the joints where they are.
    assert not space.joint_directions[..., 10:].any()


def test_a_fixed_shape_has_no_freedom(rig: Rig) -> None:
    space, hand = fixed_shape(rig), rig.shaped(torch.linspace(-1, 1, 10))
    kept = space.shaped(hand, torch.zeros(0))
    assert torch.equal(kept.rest_vertices, hand.rest_vertices)
    assert torch.equal(kept.rest_joints, hand.rest_joints)
