"""Closest points: random and degenerate triangles against the slow definition, libigl, trimesh."""

import igl
import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from handavatar.geometry.closest import closest_on_mesh, closest_on_triangles

KINDS = ("random", "on a line", "almost on a line", "double corner", "a point", "tiny", "huge")


def _triangles(kind: str, count: int, generator: torch.Generator) -> Tensor:
    corners = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    share = 3 * torch.rand(count, 1, generator=generator, dtype=torch.float64) - 1
    a, b, _ = corners.unbind(1)
    if kind in ("on a line", "almost on a line"):
        corners[:, 2] = a + share * (b - a)
        if kind == "almost on a line":
            corners[:, 2] += 1e-9 * torch.randn(count, 3, generator=generator).double()
    if kind == "double corner":
        corners[:, 2] = b
    if kind == "a point":
        corners[:] = corners[:, :1].clone()
    return corners * {"tiny": 1e-4, "huge": 1e3}.get(kind, 1.0)


def _distance_slowly(point: np.ndarray, corners: np.ndarray) -> float:
    """To the three edges, and to the plane if the foot of the perpendicular lies inside."""
    found = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = end - start
        square = along @ along
        share = np.clip((point - start) @ along / square, 0, 1) if square > 0 else 0.0
        found.append(np.linalg.norm(start + share * along - point))
    a, b, c = corners
    normal = np.cross(b - a, c - a)
    height = np.linalg.norm(normal)
    if height > 1e-12 * max(1.0, np.abs(corners).max() ** 2):
        normal /= height
        foot = point - (point - a) @ normal * normal
        sides = [np.cross(q - p, foot - p) @ normal for p, q in ((a, b), (b, c), (c, a))]
        if min(sides) >= 0:
            found.append(abs((point - a) @ normal))
    return float(min(found))


@pytest.mark.parametrize("kind", KINDS)
def test_distances_to_triangles_agree_with_the_definition(kind: str) -> None:
    generator = torch.Generator().manual_seed(KINDS.index(kind))
    corners = _triangles(kind, 100, generator)
    scale = float(corners.abs().max())
    points = scale * torch.randn(100, 3, generator=generator, dtype=torch.float64)
    found = closest_on_triangles(points, corners)
    expected = [
        _distance_slowly(p, c) for p, c in zip(points.numpy(), corners.numpy(), strict=True)
    ]
    distance = (found - points).norm(dim=-1)
    # Cancellation in the areas of slivers may cost half the digits, never more.
    torch.testing.assert_close(
        distance, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-8 * scale
    )


def test_corners_and_points_on_the_triangle_are_their_own_closest_points() -> None:
    corners = _triangles("random", 50, torch.Generator().manual_seed(0))
    weights = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).double()
    inside = ((weights / weights.sum(-1, keepdim=True))[..., None] * corners).sum(1)
    torch.testing.assert_close(closest_on_triangles(inside, corners), inside)
    torch.testing.assert_close(closest_on_triangles(corners[:, 1], corners), corners[:, 1])


def test_the_distance_has_the_right_gradient() -> None:
    generator = torch.Generator().manual_seed(2)
    corners = _triangles("random", 8, generator).requires_grad_()
    points = (3 * torch.randn(8, 3, generator=generator, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p, c: (closest_on_triangles(p, c) - p).norm(dim=-1), (points, corners)
    )


def test_the_gradient_of_a_triangle_without_area_is_finite() -> None:
    corners = torch.zeros(2, 3, 3, dtype=torch.float64)
    corners[1, 1:, 0] = 1.0
    corners.requires_grad_()
    closest_on_triangles(torch.ones(2, 3, dtype=torch.float64), corners).sum().backward()
    assert corners.grad is not None and bool(torch.isfinite(corners.grad).all())


def test_meshes_agree_with_libigl_and_trimesh() -> None:
    solid = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = torch.tensor(solid.vertices), torch.tensor(solid.faces)
    vertices = vertices * torch.tensor([1.0, 0.4, 0.2])
    generator = torch.Generator().manual_seed(3)
    points = 2 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    points[:100] *= 0.1
    found = closest_on_mesh(vertices, faces, points)
    squared = igl.point_mesh_squared_distance(points.numpy(), vertices.numpy(), faces.numpy())[0]
    torch.testing.assert_close(found.distances, torch.from_numpy(squared).sqrt())
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    _, theirs, _ = trimesh.proximity.closest_point_naive(mesh, points[:60].numpy())
    torch.testing.assert_close(found.distances[:60], torch.from_numpy(theirs))
    on_face = closest_on_triangles(points, vertices[faces[found.faces]])
    torch.testing.assert_close(on_face, found.positions)


def test_meshes_with_faces_of_all_kinds_agree_with_every_face_in_turn() -> None:
    """One face is as large as everything: the search must not miss it by its far middle."""
    generator = torch.Generator().manual_seed(4)
    corners = torch.cat([0.1 * _triangles(kind, 9, generator) for kind in KINDS[:6]])
    corners = corners + torch.randn(len(corners), 1, 3, generator=generator).double()
    corners = torch.cat([corners, _triangles("random", 1, generator) * 5])
    points = 2 * torch.randn(25, 3, generator=generator, dtype=torch.float64)
    faces = torch.arange(3 * len(corners)).reshape(-1, 3)
    found = closest_on_mesh(corners.reshape(-1, 3), faces, points)
    slow = [min(_distance_slowly(p, c) for c in corners.numpy()) for p in points.numpy()]
    torch.testing.assert_close(
        found.distances, torch.tensor(slow, dtype=torch.float64), rtol=0, atol=1e-8
    )


def test_bad_meshes_and_points_are_refused() -> None:
    triangle, face = torch.eye(3), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match="without faces"):
        closest_on_mesh(triangle, face[:0], triangle)
    with pytest.raises(ValueError, match="1 of 3 vertices hold NaN"):
        closest_on_mesh(triangle * torch.tensor([[1.0], [torch.nan], [1.0]]), face, triangle)
    with pytest.raises(ValueError, match="3 of 3 points hold NaN"):
        closest_on_mesh(triangle, face, triangle / 0)
    assert len(closest_on_mesh(triangle, face, triangle[:0]).distances) == 0
