import math

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.meshes import subdivide_midpoint
from handavatar.render.rasterize import rasterize
from handavatar.render.silhouette import WINDOW, silhouette_loss, soft_silhouette

TRUNCATION = 1 / (1 + math.exp(WINDOW**2))


def camera(size: int = 48, dtype: torch.dtype = torch.float32) -> Camera:
    """At the origin, looking along +z; a metre at one metre depth spans the image."""
    half = size / 2
    return Camera((float(size), float(size)), (half, half), size, size, torch.eye(4, dtype=dtype))


def tube(
    middle: tuple[float, float, float], angle: float, segments: int = 16
) -> tuple[Tensor, Tensor]:
    """An open tube across the view, 0.5 m long, radius 0.1 m, turned in the image by an angle."""
    around = torch.arange(segments) * (2 * math.pi / segments)
    ring = torch.stack([torch.zeros(segments), 0.1 * around.cos(), 0.1 * around.sin()], dim=-1)
    ends = torch.tensor([0.25, 0.0, 0.0])
    points = torch.cat([ring - ends, ring + ends])
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    here = torch.arange(segments)
    there = (here + 1) % segments
    low = torch.stack([here, there, there + segments], dim=-1)
    high = torch.stack([here, there + segments, here + segments], dim=-1)
    return points @ turn.T + torch.tensor(middle), torch.cat([low, high])


def crossing_fingers() -> tuple[Tensor, Tensor]:
    """Two tubes, one before the other: contours hidden and T-shaped meetings of outlines."""
    (first, faces), (second, more) = tube((0, 0.05, 1.2), 0.3), tube((0.05, 0, 0.9), 1.8)
    return torch.cat([first, second]), torch.cat([faces, more + len(first)])


def softras_slowly(vertices: Tensor, faces: Tensor, view: Camera, softness: float) -> Tensor:
    """The printed formula: all faces times all pixels."""
    corners = project(view, vertices)[0][faces].numpy()
    transparency = np.ones((view.height, view.width))
    for row in range(view.height):
        for column in range(view.width):
            point = np.array([column + 0.5, row + 0.5])
            for triangle in corners:
                squared, sides = math.inf, []
                for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
                    ratio = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
                    squared = min(squared, float(((a + ratio * (b - a) - point) ** 2).sum()))
                    sides.append((b - a)[0] * (point - a)[1] - (b - a)[1] * (point - a)[0])
                sign = 1 if min(sides) >= 0 or max(sides) <= 0 else -1
                transparency[row, column] *= 1 - 1 / (1 + math.exp(-sign * squared / softness**2))
    return torch.from_numpy(1 - transparency)


def outline_slowly(vertices: Tensor, faces: Tensor, view: Camera, times: int = 9) -> Tensor:
    """Signed distance in pixels to the outline, from a picture ``times`` as fine."""
    fine = view.resized(view.width * times, view.height * times)
    covered = rasterize(vertices, faces, fine).mask.numpy()
    signed = distance_transform_edt(covered) - distance_transform_edt(~covered)
    middle = slice(times // 2, None, times)
    return torch.from_numpy((signed - 0.5 * np.sign(signed)) / times)[middle, middle]


@pytest.mark.parametrize("softness", [0.7, 1.0])
def test_single_triangles_equal_the_printed_formula(softness: float) -> None:
    vertices = torch.tensor([[-0.35, -0.3, 1], [0.3, -0.25, 1.1], [0.02, 0.4, 0.9]])
    faces = torch.tensor([[0, 1, 2]])
    expected = softras_slowly(vertices, faces, camera(24), softness)
    found = soft_silhouette(vertices, faces, camera(24), softness)
    # float32 squares of distances of some 10 pixels: 1e-5
    assert float((found - expected).abs().max()) <= TRUNCATION + 1e-5


def test_the_outline_is_that_of_the_whole_mesh() -> None:
    vertices, faces = crossing_fingers()
    signed = outline_slowly(vertices, faces, camera(64))
    expected = torch.sigmoid(signed * signed.abs())
    found = soft_silhouette(vertices, faces, camera(64))
    outside, near = signed < 0, signed.abs() < WINDOW
    # the reference rounds distances to 1/18 pixel, and the slope of the coverage is below 0.45
    assert float((found - expected)[outside].abs().max()) < 0.45 / 18 + TRUNCATION
    # inside, the few pixels behind the meeting of two outlines may be off by half a pixel
    assert float((found - expected)[~outside].abs().max()) < 0.45 / 2
    assert float(((found - expected)[near].abs() > 0.03).float().mean()) < 0.03


def test_half_coverage_is_the_hard_mask_and_far_pixels_are_sure() -> None:
    vertices, faces = crossing_fingers()
    found = soft_silhouette(vertices, faces, camera(64))
    mask = rasterize(vertices, faces, camera(64)).mask
    assert bool((found[mask] >= 0.5).all()) and bool((found[~mask] <= 0.5).all())
    far = outline_slowly(vertices, faces, camera(64)).abs() > WINDOW + 0.6
    assert torch.equal(found[far], mask[far].float())
    assert float(found.min()) >= 0 and float(found.max()) <= 1


def test_a_finer_mesh_has_the_same_silhouette() -> None:
    """The reason for departing from the printed formula."""
    vertices, faces = tube((0, 0, 1), 0.4)
    coarse = soft_silhouette(vertices, faces, camera())
    for _ in range(2):
        finer = subdivide_midpoint(faces, len(vertices))
        vertices, faces = finer.carried(vertices), finer.faces
    fine = soft_silhouette(vertices, faces, camera())
    assert torch.allclose(coarse, fine, atol=1e-4)


def test_area_is_unbiased() -> None:
    """Borders cancel, whatever the phase of the pixel grid; each right angle adds a constant.

    Around a convex corner, the integral of ``sigmoid(-distance ** 2)`` over the quarter disc
    outside, pi / 4 ln 2, and over the square inside that both borders share, ln 2.
    """
    half = 10.25 / 48
    square = torch.tensor([[-half, -half, 1], [half, -half, 1], [half, half, 1], [-half, half, 1]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    phases = torch.arange(4) / (4 * 48)
    found = [
        float(soft_silhouette(square + torch.tensor([x, y, 0.0]), faces, camera()).sum())
        for x in phases.tolist()
        for y in phases.tolist()
    ]
    expected = 20.5**2 + 4 * math.log(2) * (1 + math.pi / 4)
    # 82 pixels of border: 0.2 is a shift by 1/400 pixel
    assert sum(found) / len(found) == pytest.approx(expected, abs=0.2)


def test_outlines_beyond_the_image_count() -> None:
    """A window of the picture shows what the picture shows there."""
    vertices, faces = crossing_fingers()
    whole = soft_silhouette(vertices, faces, camera(64))
    part = soft_silhouette(vertices, faces, camera(64).cropped(20.0, 24.0, 17.0, 13.0))
    assert torch.allclose(part, whole[24:37, 20:37], atol=1e-5)


def test_gradient() -> None:
    vertices, faces = tube((0.01, 0.02, 1.0), 0.4, segments=4)
    view = camera(14, dtype=torch.float64)
    free = vertices.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: soft_silhouette(v, faces, view), [free])


def test_gradient_is_finite_where_the_mesh_is_out_of_sight() -> None:
    vertices = torch.tensor([[5.0, 5, 1], [6, 5, 1], [5, 6, 1]], requires_grad=True)
    found = soft_silhouette(vertices, torch.tensor([[0, 1, 2]]), camera())
    silhouette_loss(found, torch.ones(48, 48, dtype=torch.bool)).backward()
    assert float(found.detach().sum()) == 0
    assert vertices.grad is not None and bool((vertices.grad == 0).all())


def test_nearer_to_the_mask_is_a_lower_loss() -> None:
    vertices, faces = crossing_fingers()
    mask = rasterize(vertices, faces, camera(64)).mask
    losses = []
    for pixels in (0, 1, 2, 4, 8, 12):
        moved = vertices + torch.tensor([pixels / 64, 0.0, 0.0])
        losses.append(float(silhouette_loss(soft_silhouette(moved, faces, camera(64)), mask)))
    assert losses == sorted(losses)


def test_descent_finds_a_mask_several_pixels_away() -> None:
    """The mask's border is farther than the window: border pixels alone give the direction."""
    vertices, faces = crossing_fingers()
    view = camera(48)
    aim = torch.tensor([6 / 48, -5 / 48])
    mask = rasterize(vertices + torch.cat([aim, torch.zeros(1)]), faces, view).mask
    shift = torch.zeros(2, requires_grad=True)
    descent = torch.optim.Adam([shift], lr=0.02)
    for _ in range(40):
        descent.zero_grad()
        moved = vertices + torch.cat([shift, torch.zeros(1)])
        silhouette_loss(soft_silhouette(moved, faces, view), mask).backward()
        descent.step()
        descent.param_groups[0]["lr"] *= 0.92
    # a third of a pixel at 1 m
    assert float((shift.detach() - aim).abs().max()) < 0.33 / 48


def test_loss_is_one_minus_intersection_over_union() -> None:
    mask = torch.tensor([[True, True], [False, False]])
    assert float(silhouette_loss(mask.float(), mask)) == 0
    assert float(silhouette_loss((~mask).float(), mask)) == 1
    half = torch.full((2, 2), 0.5)
    assert float(silhouette_loss(half, mask)) == pytest.approx(1 - 1 / 3)
    assert float(silhouette_loss(torch.zeros(2, 2), torch.zeros(2, 2, dtype=torch.bool))) == 0
    chosen = torch.tensor([[True, False], [True, False]])
    assert float(silhouette_loss(half[chosen], mask[chosen])) == pytest.approx(1 - 0.5 / 1.5)
