"""Meshes: laws on simple solids, slow loops and trimesh as references."""

import math

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from handavatar.geometry.meshes import (
    boundary_loop,
    distance_between_sets,
    distance_to_mesh,
    face_cross_products,
    face_normals,
    is_inside,
    sample_surface,
    sample_surface_evenly,
    subdivide_midpoint,
    uniform_laplacian,
    uniform_laplacian_matrix,
    unique_edges,
    vertex_normals,
    winding_number,
)


def _sphere(rounds: int = 2) -> tuple[Tensor, Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=rounds)
    return torch.tensor(mesh.vertices), torch.tensor(mesh.faces)


def _area(vertices: Tensor, faces: Tensor) -> float:
    return float(face_cross_products(vertices, faces).norm(dim=-1).sum() / 2)


def test_normals_of_a_sphere_point_outwards() -> None:
    vertices, faces = _sphere(3)
    normals = vertex_normals(vertices, faces)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(vertices)).double())
    # Faces of a sphere cut 16 times per quarter turn deviate by less than 0.02 rad.
    assert float((normals * vertices).sum(-1).min()) > math.cos(0.02)
    middles = vertices[faces].mean(1)
    outward = (face_normals(vertices, faces) * middles).sum(-1)
    assert float(outward.min()) > 0


def test_a_face_without_area_has_no_normal_and_no_nan() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], requires_grad=True)
    normals = face_normals(vertices, torch.tensor([[0, 1, 2]]))
    normals.sum().backward()
    assert normals.tolist() == [[0, 0, 0]] and bool(torch.isfinite(vertices.grad).all())  # type: ignore[arg-type]


def test_subdivision_agrees_with_a_dictionary_of_edges() -> None:
    vertices, faces = _sphere(1)
    found = subdivide_midpoint(faces, len(vertices))
    positions = found.carried(vertices)

    slow = [tuple(v) for v in vertices.tolist()]
    middle: dict[tuple[int, int], int] = {}
    triangles = set()
    for face in faces.tolist():
        ends = [tuple(sorted((face[k], face[(k + 1) % 3]))) for k in range(3)]
        for edge in ends:
            if edge not in middle:
                middle[edge] = len(slow)
                slow.append(tuple(((vertices[edge[0]] + vertices[edge[1]]) / 2).tolist()))
        ab, bc, ca = (middle[edge] for edge in ends)
        a, b, c = face
        triangles |= {(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)}

    def corners(points: list, triangle: tuple[int, int, int]) -> tuple:
        cycle = [tuple(np.round(points[i], 9)) for i in triangle]
        first = cycle.index(min(cycle))
        return tuple(cycle[first:] + cycle[:first])

    expected = {corners(slow, triangle) for triangle in triangles}
    ours = {corners(positions.tolist(), tuple(face)) for face in found.faces.tolist()}
    assert ours == expected


def test_subdivision_keeps_area_volume_and_old_vertices() -> None:
    vertices, faces = _sphere(1)
    found = subdivide_midpoint(faces, len(vertices))
    finer = found.carried(vertices)
    assert len(found.faces) == 4 * len(faces)
    assert len(finer) == len(vertices) + len(unique_edges(faces))
    assert torch.equal(finer[: len(vertices)], vertices)
    assert _area(finer, found.faces) == pytest.approx(_area(vertices, faces))
    volumes = [
        trimesh.Trimesh(v.numpy(), f.numpy(), process=False).volume
        for v, f in ((vertices, faces), (finer, found.faces))
    ]
    assert volumes[1] == pytest.approx(volumes[0])


def test_the_rim_of_a_bowl_closes_it() -> None:
    vertices, faces = _sphere(2)
    bowl = faces[(vertices[faces][..., 2] < 0.3).all(-1)]
    loop = boundary_loop(bowl)
    fan = torch.stack([loop.roll(-1), loop, torch.full_like(loop, len(vertices))], dim=-1)
    centre = vertices[loop].mean(0, keepdim=True)
    closed = trimesh.Trimesh(
        torch.cat([vertices, centre]).numpy(), torch.cat([bowl, fan]).numpy(), process=False
    )
    assert closed.is_watertight and closed.is_winding_consistent and closed.volume > 0


def test_a_mesh_without_one_boundary_is_refused() -> None:
    vertices, faces = _sphere(2)
    with pytest.raises(ValueError, match="no boundary"):
        boundary_loop(faces)
    belt = faces[(vertices[faces][..., 2].abs() < 0.5).all(-1)]
    with pytest.raises(ValueError, match="more than one boundary"):
        boundary_loop(belt)


def _winding_slowly(vertices: Tensor, faces: Tensor, point: Tensor) -> float:
    """Sum of the solid angles of all faces (Van Oosterom and Strackee)."""
    total = 0.0
    for face in faces.tolist():
        a, b, c = (vertices[i] - point for i in face)
        la, lb, lc = a.norm(), b.norm(), c.norm()
        top = torch.dot(a, torch.linalg.cross(b, c))
        bottom = la * lb * lc + torch.dot(a, b) * lc + torch.dot(b, c) * la + torch.dot(c, a) * lb
        total += 2 * math.atan2(float(top), float(bottom))
    return total / (4 * math.pi)


def test_winding_numbers_agree_with_solid_angles() -> None:
    vertices, faces = _sphere(1)
    points = 3 * torch.rand(20, 3, generator=torch.Generator().manual_seed(0)).double() - 1.5
    expected = [_winding_slowly(vertices, faces, point) for point in points]
    found = winding_number(vertices, faces, points)
    assert float((found - torch.tensor(expected)).abs().max()) < 0.01  # its stated error


def test_the_overlap_of_two_solids_is_inside() -> None:
    vertices, faces = _sphere(2)
    both = torch.cat([vertices, vertices + torch.tensor([1.0, 0, 0])])
    joined = torch.cat([faces, faces + len(vertices)])
    points = torch.tensor([[0.5, 0, 0], [-0.5, 0, 0], [1.5, 0, 0], [0.5, 1.2, 0]]).double()
    assert is_inside(both, joined, points).tolist() == [True, True, True, False]


def test_distances_agree_with_trimesh() -> None:
    vertices, faces = _sphere(2)
    points = 3 * torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).double() - 1.5
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    _, expected, _ = trimesh.proximity.closest_point_naive(mesh, points.numpy())
    torch.testing.assert_close(distance_to_mesh(vertices, faces, points), torch.tensor(expected))
    others = vertices[:9]
    brute = torch.cdist(points, others).min(-1).values
    torch.testing.assert_close(distance_between_sets(points, others), brute)


def test_surface_samples_are_uniform_in_area() -> None:
    """Two squares, one four times as large: it gets four fifths of the points."""
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = torch.cat([square, 2 * square + torch.tensor([5.0, 0, 0])])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    points = sample_surface(vertices, faces, 4000, torch.Generator().manual_seed(0))
    positions = points.positions(vertices)
    torch.testing.assert_close(points.barycentric.sum(-1), torch.ones(4000))
    share = float((positions[:, 0] > 3).float().mean())
    assert abs(share - 0.8) < 4 * math.sqrt(0.8 * 0.2 / 4000)  # four standard deviations
    left = positions[positions[:, 0] < 3, :2]
    assert float((left.mean(0) - 0.5).abs().max()) < 4 * math.sqrt(1 / 12 / len(left))


def test_even_samples_keep_apart_and_move_with_the_mesh() -> None:
    vertices, faces = _sphere(2)
    generator = torch.Generator().manual_seed(0)
    even = sample_surface_evenly(vertices, faces, 200, generator)
    loose = sample_surface(vertices, faces, 200, generator)

    def closest_pair(positions: Tensor) -> float:
        distance = torch.cdist(positions, positions) + 9 * torch.eye(len(positions))
        return float(distance.min())

    # Perfect packing of 200 points on the unit sphere leaves 0.27 between neighbours; choosing
    # greedily among eight times as many keeps more than half of that.
    assert closest_pair(even.positions(vertices)) > 0.14
    assert closest_pair(loose.positions(vertices)) < 0.05
    shift = torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(even.positions(vertices + shift), even.positions(vertices) + shift)


def test_no_area_no_samples() -> None:
    with pytest.raises(ValueError, match="without area"):
        sample_surface(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]), 5, torch.Generator())


def test_the_laplacian_agrees_with_a_loop_over_vertices() -> None:
    vertices, faces = _sphere(1)
    edges = unique_edges(faces)
    expected = torch.zeros_like(vertices)
    for index in range(len(vertices)):
        neighbours = [int(b if a == index else a) for a, b in edges.tolist() if index in (a, b)]
        expected[index] = vertices[neighbours].mean(0) - vertices[index]
    torch.testing.assert_close(uniform_laplacian(vertices, edges), expected)


def test_the_laplacian_of_a_flat_even_grid_vanishes_inside() -> None:
    y, x = torch.meshgrid(torch.arange(5.0), torch.arange(5.0), indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3)
    index = torch.arange(25).reshape(5, 5)
    right = torch.stack([index[:, :-1], index[:, 1:]], dim=-1).reshape(-1, 2)
    down = torch.stack([index[:-1], index[1:]], dim=-1).reshape(-1, 2)
    laplacian = uniform_laplacian(vertices, torch.cat([right, down])).reshape(5, 5, 3)
    assert float(laplacian[1:-1, 1:-1].abs().max()) < 1e-6
    assert float(laplacian[0, 0].norm()) > 0.1


def test_the_laplacian_as_a_matrix_is_the_laplacian() -> None:
    vertices, faces = _sphere(2)
    edges = unique_edges(faces)
    matrix = uniform_laplacian_matrix(edges, len(vertices))
    product = torch.sparse.mm(matrix, vertices.float())
    torch.testing.assert_close(
        product, uniform_laplacian(vertices.float(), edges), atol=1e-6, rtol=0
    )
