"""The detail texture: where a point lies on the chart, and what the texture says there."""

import pytest
import torch
from conftest import any_pose

from handavatar.field.anchors import nearest_anchors, place_anchors
from handavatar.field.texture import (
    DetailTexture,
    detailed,
    incident_faces,
    texture_at,
    vertices_around,
)
from handavatar.geometry.meshes import sample_surface
from handavatar.hand.rig import Rig


@pytest.fixture(scope="module")
def texture(rig: Rig) -> DetailTexture:
    return DetailTexture(rig, place_anchors(rig, 256), 32)


def test_points_on_the_skin_find_their_own_place(rig: Rig, texture: DetailTexture) -> None:
    """Exactly, if a corner of the face is the vertex nearest to the point, or the second nearest.

    As far as the vertices around the nearest anchor go: in this pose fingers touch, and a point
    whose nearest anchor is that of another finger takes the place there, as the albedo takes its
    codes. A face much longer than the net around it (the wrist's are, up to 24 mm) may have no
    such corner. Other points' places are no farther off than the nearest vertex around the anchor.
    """
    posed = any_pose(rig, turn=0.4, shift=0.1)
    generator = torch.Generator().manual_seed(0)
    samples = sample_surface(posed.vertices, rig.faces, 2000, generator)
    points = samples.positions(posed.vertices)
    near = nearest_anchors(place_anchors(rig, 256).positions(posed.vertices), points)
    around = texture.around[near.indices[:, 0]]
    two_nearest = torch.cdist(points, posed.vertices).topk(2, largest=False).indices
    is_around = (two_nearest[..., None] == around[:, None]).any(-1).all(-1)
    is_corner = (two_nearest[..., None] == samples.faces[:, None]).flatten(1).any(-1)
    is_exact = is_around & is_corner
    faces, weights = texture.nearest(posed.vertices, points, near)
    found = (posed.vertices[rig.faces[faces]] * weights[..., None]).sum(1)
    distances = (found - points).norm(dim=-1)
    assert float(is_exact.float().mean()) > 0.9
    assert float(distances[is_exact].max()) < 1e-6
    bound = (posed.vertices[around] - points[:, None]).norm(dim=-1).amin(1)
    assert bool((distances <= bound + 1e-6).all())
    places = texture.places(posed.vertices, points, near)
    expected = (rig.uv_coordinates[rig.uv_faces[faces]] * weights[..., None]).sum(1)
    torch.testing.assert_close(places, expected)


def test_points_beside_the_skin_find_the_nearest_place(rig: Rig, texture: DetailTexture) -> None:
    """Nearly as near as a search of all faces, on a fine net of samples, has it."""
    posed = any_pose(rig)
    generator = torch.Generator().manual_seed(1)
    points = sample_surface(posed.vertices, rig.faces, 300, generator).positions(posed.vertices)
    points = points + 1e-3 * torch.randn(300, 3, generator=generator)
    near = nearest_anchors(place_anchors(rig, 256).positions(posed.vertices), points)
    faces, weights = texture.nearest(posed.vertices, points, near)
    found = (posed.vertices[rig.faces[faces]] * weights[..., None]).sum(1)
    fine = sample_surface(posed.vertices, rig.faces, 60_000, generator)
    smallest = torch.cdist(points, fine.positions(posed.vertices)).amin(1)
    excess = (found - points).norm(dim=-1) - smallest
    assert float(excess.quantile(0.95)) < 2e-4


def test_a_texture_is_linear_between_its_texels_and_constant_beyond_them() -> None:
    texels = torch.rand(5, 5, 3, generator=torch.Generator().manual_seed(0))
    rows, columns = torch.tensor([0, 3, 4]), torch.tensor([4, 1, 0])
    centres = torch.stack([columns + 0.5, rows + 0.5], dim=-1) / 5
    torch.testing.assert_close(texture_at(texels, centres), texels[rows, columns])
    middle = torch.tensor([[2.0, 3.0]]) / 5
    torch.testing.assert_close(texture_at(texels, middle)[0], texels[2:4, 1:3].mean((0, 1)))
    beyond = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    torch.testing.assert_close(
        texture_at(texels, beyond), torch.stack([texels[0, 0], texels[4, 4]])
    )


def test_a_lookup_teaches_the_four_texels_around_it(texture: DetailTexture) -> None:
    places = torch.tensor([[10.25 / 32 + 0.5 / 32, 7.0 / 32 + 0.5 / 32]])
    texture(places).sum().backward()
    gradient = texture.texels.grad
    assert gradient is not None
    found = gradient[7, 10:12, 0]
    torch.testing.assert_close(found, torch.tensor([0.75, 0.25]), atol=1e-4, rtol=0)
    assert float(gradient.sum()) == pytest.approx(3, abs=1e-4)
    texture.texels.grad = None


def test_the_albedo_is_multiplied_and_stays_at_most_one() -> None:
    albedo = torch.tensor([[0.2, 0.5, 0.9]])
    assert torch.equal(detailed(albedo, torch.zeros(1, 3)), albedo)
    found = detailed(albedo, torch.log(torch.tensor([[0.5, 1.5, 2.0]])))
    torch.testing.assert_close(found, torch.tensor([[0.1, 0.75, 1.0]]))


def test_every_vertex_has_its_faces_and_every_anchor_vertices_around_it(rig: Rig) -> None:
    faces = incident_faces(rig)
    for vertex in (0, 100, rig.num_vertices - 1):
        expected = (rig.faces == vertex).any(-1).nonzero()[:, 0]
        assert set(faces[vertex].tolist()) == set(expected.tolist())
    anchors = place_anchors(rig, 256)
    around = vertices_around(rig, anchors)
    assert around.shape == (256, 16)
    distance = (anchors.positions(rig.template_vertices)[:, None] - rig.template_vertices).norm(
        dim=-1
    )
    assert torch.equal(around[:, 0], distance.argmin(1))
