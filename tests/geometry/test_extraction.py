"""Extraction: known solids, the dense evaluation, scikit-image and trimesh as references."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes
from torch import Tensor

from handavatar.geometry.extraction import (
    ExtractedSurface,
    extract_surface,
    largest_component,
    logits_of,
    num_components,
)
from handavatar.geometry.meshes import face_cross_products

Values = Callable[[Tensor], Tensor]
LOWER, UPPER = torch.full((3,), -0.1), torch.full((3,), 0.1)


def _sphere(
    radius: float = 0.06, centre: tuple[float, float, float] = (0.003, -0.002, 0.001)
) -> Values:
    return lambda points: radius - (points - torch.tensor(centre)).norm(dim=-1)


def _torus(points: Tensor) -> Tensor:
    ring = points[:, :2].norm(dim=-1) - 0.06
    return 0.013 - torch.stack([ring, points[:, 2]], dim=-1).norm(dim=-1)


def _solid(surface: ExtractedSurface) -> trimesh.Trimesh:
    """Checked as it is: nothing merged, nothing repaired."""
    return trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)


def _same(first: ExtractedSurface, second: ExtractedSurface) -> bool:
    """The same triangles, whatever their order."""

    def triangles(surface: ExtractedSurface) -> np.ndarray:
        corners = surface.vertices.double().numpy().round(9)[surface.faces.numpy()]
        start = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
        rolled = corners[np.arange(len(corners))[:, None], (start[:, None] + np.arange(3)) % 3]
        flat = rolled.reshape(-1, 9)
        return flat[np.lexsort(flat.T[::-1])]

    a, b = triangles(first), triangles(second)
    return a.shape == b.shape and bool(np.abs(a - b).max() < 1e-8)


def test_a_sphere_is_found_to_a_fraction_of_a_voxel() -> None:
    surface = extract_surface(_sphere(), LOWER, UPPER, 64)
    offset = surface.vertices - torch.tensor([0.003, -0.002, 0.001])
    error = (offset.norm(dim=-1) - 0.06).abs()
    assert surface.voxel == pytest.approx(0.2 / 64)
    # Linear interpolation of a distance along an edge of h errs by h^2 / 8 times the curvature.
    bound = surface.voxel**2 / (8 * (0.06 - surface.voxel))
    assert float(error.max()) < bound + 1e-7 < 0.008 * surface.voxel
    solid = _solid(surface)
    # No shift: samples less two for intervals would move the middle by a sixtieth of 0.1 m.
    centre = solid.center_mass - np.array([0.003, -0.002, 0.001])
    assert float(np.linalg.norm(centre)) < 0.002 * surface.voxel
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume == pytest.approx(4 / 3 * math.pi * 0.06**3, rel=0.005)


def test_logits_find_the_surface_better_than_occupancies() -> None:
    sphere = _sphere()

    def occupancy(points: Tensor) -> Tensor:
        return torch.sigmoid(3000 * sphere(points))

    def error(surface: ExtractedSurface) -> float:
        offset = surface.vertices - torch.tensor([0.003, -0.002, 0.001])
        return float((offset.norm(dim=-1) - 0.06).square().mean().sqrt()) / surface.voxel

    by_logits = error(extract_surface(logits_of(occupancy), LOWER, UPPER, 64))
    by_occupancy = error(extract_surface(occupancy, LOWER, UPPER, 64, level=0.5))
    assert by_logits < 0.01 and by_occupancy > 10 * by_logits


def test_corrections_find_the_surface_of_a_field_that_bends() -> None:
    """Within a voxel the values change as a decoder's do: steep at the surface, flat beside it."""
    distances = _sphere()
    centre = torch.tensor([0.003, -0.002, 0.001])

    def bent(points: Tensor) -> Tensor:
        return torch.asinh(5000 * distances(points)) + 600 * distances(points).square()

    errors, asked = [], []
    for corrections in (0, 1, 2):
        surface = extract_surface(bent, LOWER, UPPER, 64, corrections=corrections)
        assert _solid(surface).is_watertight and _solid(surface).volume > 0
        errors.append(float(((surface.vertices - centre).norm(dim=-1) - 0.06).abs().mean()))
        asked.append(surface.num_evaluations)
    assert errors[1] < 0.4 * errors[0] and errors[2] < 0.1 * errors[0]
    assert asked[2] - asked[1] == asked[1] - asked[0] == len(surface.vertices)


def test_corrections_leave_the_border_where_the_box_cuts_the_inside() -> None:
    plain, corrected = (
        extract_surface(lambda points: 0.2 - points.norm(dim=-1), LOWER, UPPER, 16, corrections=n)
        for n in (0, 2)
    )
    assert torch.equal(plain.vertices, corrected.vertices)


@pytest.mark.parametrize("field", [_sphere(), _torus], ids=["sphere", "torus"])
@pytest.mark.parametrize("coarsest", [6, 12])
def test_adaptive_equals_dense(field: Values, coarsest: int) -> None:
    dense = extract_surface(field, LOWER, UPPER, 48, coarsest=48)
    adaptive = extract_surface(field, LOWER, UPPER, 48, coarsest=coarsest)
    assert dense.num_evaluations == dense.num_dense == adaptive.num_dense == 49**3
    assert adaptive.num_evaluations < 0.4 * dense.num_evaluations
    assert _same(adaptive, dense)
    assert _solid(adaptive).is_watertight


def test_extraction_agrees_with_scikit_image() -> None:
    def bumpy(points: Tensor) -> Tensor:
        return _sphere()(points) + 0.006 * (90 * points).sin().prod(-1)

    ours = extract_surface(bumpy, LOWER, UPPER, 48)
    axis = torch.linspace(-0.1, 0.1, 49)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    values = bumpy(grid.reshape(-1, 3)).reshape(49, 49, 49).numpy()
    vertices, faces, _, _ = marching_cubes(
        values, 0.0, spacing=(0.2 / 48,) * 3, gradient_direction="ascent", method="lorensen"
    )
    theirs = trimesh.Trimesh(vertices - 0.1, faces, process=False)
    assert len(ours.faces) == len(theirs.faces)
    # Vertices lie on edges of the grid at the same share; float32 on both sides.
    order = np.lexsort(ours.vertices.numpy().round(5).T)
    other = np.lexsort(theirs.vertices.round(5).T)
    np.testing.assert_allclose(ours.vertices.numpy()[order], theirs.vertices[other], atol=2e-5)
    assert _solid(ours).volume == pytest.approx(abs(theirs.volume), rel=1e-4)


def test_noise_gives_a_closed_mesh() -> None:
    """Every ambiguous case of the cubes occurs here."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(17, 17, 17, generator=generator)

    def field(points: Tensor) -> Tensor:
        i, j, k = ((points + 0.1) * 80).round().long().unbind(-1)
        return noise[i, j, k]

    solid = _solid(extract_surface(field, LOWER, UPPER, 16))
    assert len(solid.faces) > 3000
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume > 0


def test_a_thin_finger_between_coarse_samples_is_found_by_its_seeds() -> None:
    def finger(points: Tensor) -> Tensor:
        along = points.clone()
        along[:, 0] = (points[:, 0].abs() - 0.05).clamp_min(0)
        along[:, 1:] -= 0.0061
        return 0.004 - along.norm(dim=-1)

    seeds = torch.tensor([[0.0, 0.0061, 0.0101]])
    lost = extract_surface(finger, LOWER, UPPER, 64, coarsest=8)
    assert len(lost.faces) == 0 and num_components(lost) == 0
    found = extract_surface(finger, LOWER, UPPER, 64, coarsest=8, seeds=seeds)
    assert _same(found, extract_surface(finger, LOWER, UPPER, 64, coarsest=64))


def test_what_the_box_cuts_is_closed_at_its_border() -> None:
    surface = extract_surface(_sphere(0.15), LOWER, UPPER, 32)
    solid = _solid(surface)
    assert solid.is_watertight and solid.volume == pytest.approx(0.2**3, rel=0.2)
    assert float(surface.vertices.abs().max()) <= 0.1


def test_boxes_need_not_be_cubes() -> None:
    lower, upper = torch.tensor([-0.1, -0.07, -0.065]), torch.tensor([0.1, 0.066, 0.07])
    whole = extract_surface(_sphere(), LOWER, UPPER, 64)
    fitted = extract_surface(_sphere(), lower, upper, 64)
    assert fitted.num_dense < 0.7 * whole.num_dense and fitted.voxel == whole.voxel
    assert _solid(fitted).volume == pytest.approx(_solid(whole).volume, rel=1e-3)


def test_pieces_are_counted_and_the_largest_is_kept() -> None:
    big, small = _sphere(0.05), _sphere(0.02, (0.075, 0.075, 0.0))
    both = extract_surface(lambda p: torch.maximum(big(p), small(p)), LOWER, UPPER, 64)
    only = largest_component(both)
    assert (num_components(both), num_components(only)) == (2, 1)
    assert _same(only, extract_surface(big, LOWER, UPPER, 64))
    nothing = extract_surface(lambda p: -p.norm(dim=-1) - 1, LOWER, UPPER, 16)
    assert largest_component(nothing) is nothing and nothing.vertices.shape == (0, 3)


def test_values_on_the_level_and_infinities_do_no_harm() -> None:
    def steps(points: Tensor) -> Tensor:
        """Zero exactly on many samples, infinite elsewhere."""
        value = 0.05 - points.abs().amax(-1)
        value = torch.where(value.abs() < 1e-6, 0.0, value)
        return torch.where(value.abs() > 0.02, torch.inf * value.sign(), value)

    surface = extract_surface(steps, LOWER, UPPER, 16)
    assert bool(torch.isfinite(surface.vertices).all()) and _solid(surface).is_watertight
    assert float(face_cross_products(surface.vertices, surface.faces).norm(dim=-1).min()) > 0


def test_bad_input_is_refused() -> None:
    def broken(points: Tensor) -> Tensor:
        return torch.where(points[:, 0] > 0.05, torch.nan, _sphere()(points))

    with pytest.raises(ValueError, match="answers NaN at"):
        extract_surface(broken, LOWER, UPPER, 16)
    with pytest.raises(ValueError, match="box with sides"):
        extract_surface(_sphere(), UPPER, LOWER, 16)
    with pytest.raises(ValueError, match="resolution 1"):
        extract_surface(_sphere(), LOWER, UPPER, 1)
    with pytest.raises(ValueError, match="nan"):
        extract_surface(_sphere(), LOWER, UPPER * torch.nan, 16)
