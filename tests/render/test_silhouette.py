import math

import numpy as np
import pytest
import torch
from conftest import bent_pose, camera_above
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.meshes import subdivide_midpoint, vertex_normals
from handavatar.hand.open_hand import load_open_hand
from handavatar.render.rasterize import rasterize
from handavatar.render.silhouette import (
    WINDOW,
    _contours,
    outline_points,
    signed_distance,
    silhouette_loss,
    soft_mask,
    soft_silhouette,
)

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


@pytest.mark.parametrize("seed", [0, 3])
def test_points_are_covered_where_any_face_holds_them(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    corners = 40 * torch.rand(60, 1, 2, generator=generator, dtype=torch.float64) - 5
    corners = corners + 8 * torch.rand(60, 3, 2, generator=generator, dtype=torch.float64)
    corners[7, 1] = math.nan
    points = 30 * torch.rand(400, 2, generator=generator, dtype=torch.float64) - seed
    points[:200] = points[:200] / 6 + 10  # Many in a few pixels, none in most.
    a, b, c = (corners[None, :, index] - points[:, None] for index in range(3))
    crosses = [
        one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
        for one, other in ((a, b), (b, c), (c, a))
    ]
    sides = torch.stack(crosses).sign()
    expected = (sides.amin(0) >= 0) | (sides.amax(0) <= 0)
    expected = expected & ~corners.isnan().flatten(1).any(1)
    pixels, faces = corners.flatten(0, 1), torch.arange(180).reshape(60, 3)
    found = _contours(pixels, faces).cover(points, pixels)
    assert 20 < int(found.sum()) < 380
    assert torch.equal(found, expected.any(1))


def test_of_a_closed_mesh_few_edges_tell_what_is_covered() -> None:
    posed = load_open_hand().shaped().posed(bent_pose(2))
    vertices, faces, view = posed.vertices, posed.rig.faces, camera_above(64)
    pixels = project(view, vertices)[0].double()
    contours = _contours(pixels, faces)
    assert len(contours.ends) < len(faces) / 4
    mask = rasterize(vertices, faces, view).mask
    row, column = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    centers = torch.stack([column, row], dim=-1).double().flatten(0, 1) + 0.5
    assert torch.equal(contours.cover(centers, pixels).reshape(64, 64), mask)


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
    silhouette_loss(found, torch.ones(48, 48)).backward()
    assert float(found.detach().sum()) == 0
    assert vertices.grad is not None and bool((vertices.grad == 0).all())


def test_nearer_to_the_mask_is_a_lower_loss() -> None:
    vertices, faces = crossing_fingers()
    mask = rasterize(vertices, faces, camera(64)).mask.float()
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
    mask = soft_mask(
        rasterize(vertices + torch.cat([aim, torch.zeros(1)]), faces, view).mask.float(), 48
    )
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


def test_the_printed_formula_is_that_of_binary_masks() -> None:
    coverage = torch.rand(8, 8, generator=torch.Generator().manual_seed(0))
    mask = (torch.rand(8, 8, generator=torch.Generator().manual_seed(1)) > 0.5).float()
    product = (coverage * mask).sum()
    printed = 1 - product / ((coverage + mask).sum() - product)
    torch.testing.assert_close(silhouette_loss(coverage, mask), printed)


def test_a_soft_mask_is_what_its_own_outline_covers() -> None:
    vertices, faces = crossing_fingers()
    covered = rasterize(vertices, faces, camera(192)).mask.float()
    found = soft_mask(covered, 64)
    expected = soft_silhouette(vertices, faces, camera(64))
    # The mask knows its border to half a pixel of its own, a sixth of one here, and less in
    # corners; the coverage changes by at most 0.43 per pixel (sigmoid of a square).
    assert float((found - expected).abs().max()) < 0.2
    assert float((found - expected).abs().mean()) < 0.005


def test_the_loss_is_least_on_the_mask_and_not_beside_it() -> None:
    """Against a mask of zeros and ones a hand two thirds of a pixel too thick would be best."""
    posed = load_open_hand("778").shaped().posed(bent_pose(1))
    vertices, faces, view = posed.vertices, posed.rig.faces, camera_above(64)
    outwards = vertex_normals(vertices, faces) * (0.42 / view.focal[0])  # A pixel, metres.
    soft = soft_mask(rasterize(vertices, faces, view.resized(512, 512)).mask.float(), 64)
    hard = rasterize(vertices, faces, view).mask.float()
    offsets = torch.arange(-5, 11) * 0.1
    best = []
    for mask in (soft, hard):
        losses = [
            float(silhouette_loss(soft_silhouette(vertices + offset * outwards, faces, view), mask))
            for offset in offsets
        ]
        best.append(float(offsets[int(torch.tensor(losses).argmin())]))
    assert abs(best[0]) < 0.11
    assert best[1] > 0.45


def test_loss_is_one_minus_intersection_over_union() -> None:
    mask = torch.tensor([[1.0, 1], [0, 0]])
    assert float(silhouette_loss(mask, mask)) == 0
    assert float(silhouette_loss(1 - mask, mask)) == 1
    half = torch.full((2, 2), 0.5)
    assert float(silhouette_loss(half, mask)) == pytest.approx(1 - 1 / 3)
    assert float(silhouette_loss(torch.zeros(2, 2), torch.zeros(2, 2))) == 0
    chosen = torch.tensor([[True, False], [True, False]])
    assert float(silhouette_loss(half[chosen], mask[chosen])) == pytest.approx(1 - 0.5 / 1.5)


# --- points on the outline ------------------------------------------------------------------------


def test_outline_points_lie_on_the_border_of_the_covered_pixels() -> None:
    vertices, faces = crossing_fingers()
    view = camera(64)
    points = outline_points(vertices, faces, view)
    pixels = project(view, points.of(vertices))[0]
    distance = outline_slowly(vertices, faces, view).float()
    column, row = pixels.long().unbind(-1)
    is_inside = (column >= 0) & (column < 64) & (row >= 0) & (row < 64)
    # From the pixel's centre to the point is at most 0.71; the fine picture errs by a ninth.
    assert float(distance[row[is_inside], column[is_inside]].abs().max()) < 0.71 + 0.12
    assert float(points.lengths.max()) <= 1.0 + 1e-4


def test_the_lengths_of_a_tube_add_up_to_its_outline() -> None:
    vertices, faces = tube((0, 0, 1.0), 0.4, segments=32)
    points = outline_points(vertices, faces, camera(200))
    # Sides of 0.5 m seen at nearly one metre, ends of 0.2 m seen as flat ellipses.
    assert 2 * 100 + 2 * 38 < float(points.lengths.sum()) < 2 * 104 + 2 * 50


def test_signed_distance_of_a_disc() -> None:
    y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(50) + 0.5, indexing="ij")
    distance = torch.hypot(x - 24, y - 20) - 12
    found = signed_distance((distance < 0).float())
    assert torch.equal(found < 0, distance < 0)
    # Pixels know their border to half the diagonal.
    assert float((found - distance).abs().max()) < 0.75


def test_pixels_covered_in_part_tell_where_the_outline_passes() -> None:
    y, x = torch.meshgrid(torch.arange(400) + 0.5, torch.arange(500) + 0.5, indexing="ij")
    fine = (torch.hypot(x / 10 - 24.3, y / 10 - 19.8) - 12).unflatten(0, (40, 10))
    covered = (fine.unflatten(2, (50, 10)) < 0).float().mean((1, 3))
    y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(50) + 0.5, indexing="ij")
    distance = torch.hypot(x - 24.3, y - 19.8) - 12
    error = (signed_distance(covered) - distance).abs()
    # Where the outline cuts a corner off a pixel, it is half the diagonal from the centre, and
    # the coverage says half a pixel; the pixels behind it repeat that, off the shortest way.
    assert float(error.mean()) < 0.1 and float(error.max()) < 0.9
    # The mask alone knows less.
    hard = (signed_distance((covered >= 0.5).float()) - distance).abs()
    assert float(error.mean()) < 0.5 * float(hard.mean())


def test_signed_distance_without_a_border() -> None:
    nothing = torch.zeros(5, 7)
    assert torch.equal(signed_distance(nothing), torch.full((5, 7), 12.0))
    assert torch.equal(signed_distance(1 - nothing), torch.full((5, 7), -12.0))
