import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from handavatar.geometry.cameras import Camera, project, rays_through_pixels
from handavatar.render.rasterize import (
    NEAR_PLANE,
    Fragments,
    covered_pixels,
    interpolate,
    pixels_in_boxes,
    rasterize,
)


def camera(width: int = 24, height: int = 20, dtype: torch.dtype = torch.float32) -> Camera:
    """At the origin, looking along +z; one metre at one metre depth spans 20 pixels."""
    return Camera((20.0, 20.0), (width / 2, height / 2), width, height, torch.eye(4, dtype=dtype))


def rasterize_slowly(vertices: Tensor, faces: Tensor, view: Camera) -> Fragments:
    """Every pixel against every face, one at a time, by the intersection of its ray."""
    face_index = torch.full((view.height, view.width), -1)
    depth = torch.full((view.height, view.width), math.inf, dtype=torch.float64)
    barycentric = torch.zeros(view.height, view.width, 3, dtype=torch.float64)
    rotation, translation = view.camera_from_world[:3, :3], view.camera_from_world[:3, 3]
    corners = (vertices @ rotation.T + translation).double()[faces].numpy()
    for row in range(view.height):
        for column in range(view.width):
            ray = np.array(
                [
                    (column + 0.5 - view.center[0]) / view.focal[0],
                    (row + 0.5 - view.center[1]) / view.focal[1],
                    1.0,
                ]
            )
            for face, triangle in enumerate(corners):
                if abs(np.linalg.det(triangle)) < 1e-15 or (triangle[:, 2] <= NEAR_PLANE).any():
                    continue
                # depth * ray = weights @ triangle, with weights that sum to 1
                weights = np.linalg.solve(triangle.T, ray)
                distance = 1 / weights.sum() if weights.sum() > 0 else math.inf
                if (weights >= 0).all() and distance < depth[row, column]:
                    face_index[row, column] = face
                    depth[row, column] = distance
                    barycentric[row, column] = torch.from_numpy(weights * distance)
    return Fragments(face_index, depth, barycentric)


def random_mesh(seed: int, num_faces: int, size: float) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    middles = torch.rand(num_faces, 1, 3, generator=generator) * torch.tensor([1.4, 1.2, 1.5])
    middles = middles - torch.tensor([0.7, 0.6, -0.4])
    corners = middles + size * (torch.rand(num_faces, 3, 3, generator=generator) - 0.5)
    return corners.reshape(-1, 3), torch.arange(3 * num_faces).reshape(-1, 3)


@pytest.mark.parametrize(("num_faces", "size"), [(1, 1.0), (8, 0.8), (30, 0.1), (25, 1.5)])
def test_equals_every_ray_against_every_face(num_faces: int, size: float) -> None:
    vertices, faces = random_mesh(num_faces, num_faces, size)
    fast, slow = rasterize(vertices, faces, camera()), rasterize_slowly(vertices, faces, camera())
    assert torch.equal(fast.face_index, slow.face_index)
    # float32 projection of positions of order 1: some 1e-6, enlarged at grazing faces
    seen = fast.mask
    assert torch.allclose(fast.depth[seen].double(), slow.depth[seen], rtol=1e-3)
    assert torch.allclose(fast.barycentric[seen].double(), slow.barycentric[seen], atol=1e-3)
    assert bool((fast.depth[~seen] == math.inf).all())
    assert bool((fast.barycentric[~seen] == 0).all())


@pytest.mark.parametrize(("num_faces", "size"), [(0, 1.0), (8, 0.8), (200, 0.1), (25, 1.5)])
def test_covered_pixels_are_those_of_the_rasterised_mesh(num_faces: int, size: float) -> None:
    for seed in range(5):
        vertices, faces = random_mesh(seed, num_faces, size)
        vertices[: num_faces // 4] = math.nan
        vertices[num_faces // 4 : num_faces // 2, 2] = -1.0
        expected = rasterize(vertices, faces, camera()).mask
        assert torch.equal(covered_pixels(vertices, faces, camera()), expected)


def test_interpolated_positions_lie_on_the_pixels_rays() -> None:
    """Only perspective-correct weights do this."""
    vertices, faces = random_mesh(3, 20, 0.8)
    turned = torch.tensor([[0.0, 0, 1, 0.1], [0, 1, 0, 0], [-1, 0, 0, 0.9], [0, 0, 0, 1]])
    view = Camera((20.0, 25.0), (9.0, 11.0), 24, 20, turned)
    fragments = rasterize(vertices, faces, view)
    assert bool(fragments.mask.any())
    points = interpolate(fragments, faces, vertices)[fragments.mask]
    row, column = fragments.mask.nonzero().unbind(-1)
    pixels = torch.stack([column, row], -1) + 0.5
    found, depth = project(view, points)
    assert torch.allclose(found, pixels, atol=1e-3)
    assert torch.allclose(depth, fragments.depth[fragments.mask], rtol=1e-4)
    rays = rays_through_pixels(view, pixels)
    reach = (points - rays.origins).norm(dim=-1, keepdim=True)
    assert torch.allclose(rays.origins + reach * rays.directions, points, atol=1e-4)


def test_a_pixel_is_covered_where_its_centre_is() -> None:
    """A square from 2.6 to 5.4 pixels holds the centres 3.5 and 4.5, not 2.5 or 5.5."""
    low, high = (2.6 - 12) / 20, (5.4 - 12) / 20
    square = torch.tensor([[low, low, 1.0], [high, low, 1], [high, high, 1], [low, high, 1]])
    square = square + torch.tensor([0.0, 2 / 20, 0])  # the image is 4 pixels less high than wide
    mask = rasterize(square, torch.tensor([[0, 1, 2], [0, 2, 3]]), camera()).mask
    expected = torch.zeros(20, 24, dtype=torch.bool)
    expected[3:5, 3:5] = True
    assert torch.equal(mask, expected)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_neighbouring_faces_leave_no_gap(seed: int) -> None:
    """A fan around a point on a pixel centre, spanning the whole image, covers all of it."""
    generator = torch.Generator().manual_seed(seed)
    angles = torch.arange(7) * (2 * math.pi / 7) + torch.rand(7, generator=generator) * 0.5
    rim = torch.stack([20 * angles.cos(), 20 * angles.sin(), torch.ones(7)], dim=-1)
    centre = torch.tensor([[0.5 / 20, 0.5 / 20, 1.0]])
    following = torch.arange(1, 8) % 7
    faces = torch.stack([torch.full((7,), 7), torch.arange(7), following], dim=-1)
    assert bool(rasterize(torch.cat([rim, centre]), faces, camera()).mask.all())


def test_the_nearer_face_wins_in_any_order_and_winding() -> None:
    near = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [0, 1.5, 1]])
    vertices = torch.cat([near * 2, near])  # the same picture, at 1 m and at 2 m
    faces = torch.tensor([[0, 1, 2], [3, 5, 4]])
    first = rasterize(vertices, faces, camera())
    second = rasterize(vertices, faces.flip(0), camera())
    assert bool(first.mask.any())
    assert bool((first.face_index[first.mask] == 1).all())
    assert bool((second.face_index[second.mask] == 0).all())
    assert torch.allclose(first.depth[first.mask], torch.ones(()))


def test_faces_that_reach_the_camera_plane_or_have_no_area_are_skipped() -> None:
    vertices = torch.tensor(
        [[-1.0, -1, 1], [1, -1, 1], [0, 1, -1], [0, 0.5, NEAR_PLANE], [0.2, -1, 1]]
    )
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 0, 1]])
    assert not bool(rasterize(vertices, faces, camera()).mask.any())


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 2])
def test_faces_that_are_not_finite_are_skipped(value: float, axis: int) -> None:
    vertices = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [0, 1, 1], [0, 0, 1]])
    whole = rasterize(vertices, torch.tensor([[0, 1, 2]]), camera())
    vertices[3, axis] = value
    spoilt = rasterize(vertices, torch.tensor([[0, 1, 2], [0, 1, 3]]), camera())
    assert torch.equal(spoilt.face_index, whole.face_index)


def test_no_faces_and_faces_outside_the_image() -> None:
    none = rasterize(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long), camera())
    assert not bool(none.mask.any())
    outside = torch.tensor([[5.0, 5, 1], [6, 5, 1], [5, 6, 1]])
    assert not bool(rasterize(outside, torch.tensor([[0, 1, 2]]), camera()).mask.any())


def test_a_mesh_of_many_batches_equals_one_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = random_mesh(5, 80, 0.6)
    whole = rasterize(vertices, faces, camera())
    monkeypatch.setattr("handavatar.render.rasterize._PAIRS_AT_ONCE", 100)
    parts = rasterize(vertices, faces, camera())
    assert torch.equal(whole.face_index, parts.face_index)
    assert torch.equal(whole.depth, parts.depth)


def test_pixels_in_boxes_finds_each_centre_once() -> None:
    lower = torch.tensor([[-3.0, 1.2], [2.5, 2.5], [4.6, 0.0], [50.0, 0.0]])
    upper = torch.tensor([[1.6, 2.7], [3.5, 2.5], [5.4, 9.0], [60.0, 9.0]])
    pairs = [
        pair
        for batch in pixels_in_boxes(lower, upper, 6, 4)
        for pair in zip(*(column.tolist() for column in batch), strict=True)
    ]
    expected = [
        (box, x, y)
        for box in range(4)
        for y in range(4)
        for x in range(6)
        if lower[box, 0] <= x + 0.5 <= upper[box, 0] and lower[box, 1] <= y + 0.5 <= upper[box, 1]
    ]
    assert sorted(pairs) == sorted(expected)


def test_interpolation_is_differentiable_in_the_values() -> None:
    vertices, faces = random_mesh(2, 2, 0.8)
    fragments = rasterize(vertices.double(), faces, camera(6, 5, dtype=torch.float64))
    values = torch.rand(len(vertices), 1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: interpolate(fragments, faces, v), [values])


@pytest.mark.gpu
def test_equals_the_cpu_on_a_gpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    vertices, faces = random_mesh(5, 80, 0.6)
    cpu = rasterize(vertices, faces, camera())
    gpu = rasterize(vertices.cuda(), faces.cuda(), camera().to("cuda"))
    # the projections may round differently, which can move single pixels at borders
    assert (cpu.face_index != gpu.face_index.cpu()).float().mean() < 0.01
