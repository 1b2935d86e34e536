"""The Triton kernels of rays and coverage against torch's; run by ``test_fused_rays.py``."""

import math
from itertools import pairwise

import pytest
import torch
from conftest import any_pose, camera_above
from torch import Tensor

from handavatar.geometry.cameras import Camera, Rays, pixel_centers, rays_through_pixels
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.rig import Rig
from handavatar.render.fused_coverage import mesh_coverage
from handavatar.render.fused_rays import (
    box_intervals,
    dim,
    largest_met,
    sample_places,
    sample_weights,
    samples_between,
)
from handavatar.render.rasterize import covered_pixels
from handavatar.render.sampling import intervals_through_boxes
from handavatar.render.volume import visibility

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
NUM_RAYS, NUM_SAMPLES, NUM_BONES = 37, 10, 16
LOOKED_AT = (0, 4, 8, 9)


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)).to(DEVICE)


def _rays() -> Rays:
    directions = torch.nn.functional.normalize(_random(NUM_RAYS, 3, seed=1) - 0.5, dim=-1)
    # Some along an axis: they are parallel to sides of boxes.
    directions[:3] = torch.eye(3, device=DEVICE)
    return Rays(1.5 * _random(NUM_RAYS, 3, seed=2) - 0.75, directions)


def test_rays_meet_the_same_boxes() -> None:
    rays = _rays()
    transforms = torch.eye(4, device=DEVICE).repeat(NUM_BONES, 1, 1)
    transforms[1:, :3, :3] = matrix_from_axis_angle(_random(NUM_BONES - 1, 3, seed=3))
    transforms[:, :3, 3] = _random(NUM_BONES, 3, seed=4) - 0.5
    upper = 0.1 + 0.3 * _random(NUM_BONES, 3, seed=5)
    near, far, is_hit = intervals_through_boxes(rays, transforms, -upper, upper)
    found_near, found_far = box_intervals(rays, transforms, -upper, upper)
    assert 5 < int(is_hit.sum()) < NUM_RAYS - 5
    assert torch.equal(found_near < found_far, is_hit)
    assert torch.equal(found_near, near) and torch.equal(found_far, far)


def test_samples_of_dark_rays_are_nowhere() -> None:
    rays, depths = _rays(), _random(NUM_RAYS, NUM_SAMPLES)
    light = torch.ones(NUM_RAYS, device=DEVICE)
    light[::2] = 0.01
    samples = torch.arange(0, depths.numel(), 3, device=DEVICE)
    found = sample_places(rays, depths, samples, light, 0.01)
    ray = samples // NUM_SAMPLES
    expected = rays.origins[ray] + depths.flatten()[samples][:, None] * rays.directions[ray]
    expected[ray % 2 == 0] = math.nan
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0, equal_nan=True)


def test_light_is_held_back() -> None:
    occupancy, light = _random(NUM_RAYS, NUM_SAMPLES), _random(NUM_RAYS, seed=1)
    window = torch.tensor([2, 3, 7], device=DEVICE)
    expected = light * (1 - occupancy[:, window]).prod(1)
    dim(light, occupancy, window)
    torch.testing.assert_close(light, expected)


def test_samples_are_found_between() -> None:
    # Half of the rays go dark at the first or second sample; few parts are near.
    occupancy = _random(NUM_RAYS, NUM_SAMPLES) * 0.5
    occupancy[::4, 0] = 1
    occupancy[1::4, 4] = 1
    soft = 0.14 * _random(NUM_RAYS, NUM_SAMPLES, NUM_BONES, seed=1)
    soft[:, :, 1:] *= 0.2
    looked_at = torch.tensor(LOOKED_AT, device=DEVICE)
    expected = []
    for ray in range(NUM_RAYS):
        for here, following in pairwise(LOOKED_AT):
            light = math.prod(
                float(1 - occupancy[ray, place]) for place in LOOKED_AT if place <= here
            )
            near = max(float(soft[ray, place].max()) for place in (here, following))
            if light > 1e-4 and near > 0.12:
                expected += range(ray * NUM_SAMPLES + here + 1, ray * NUM_SAMPLES + following)
    assert 20 < len(expected) < 0.5 * NUM_RAYS * NUM_SAMPLES
    assert samples_between(occupancy, soft, looked_at, 0.12, 1e-4).tolist() == expected


def test_weights_and_what_a_ray_has_met() -> None:
    occupancy = _random(NUM_RAYS, NUM_SAMPLES)
    torch.testing.assert_close(sample_weights(occupancy), visibility(occupancy))
    values = _random(NUM_RAYS, NUM_SAMPLES, NUM_BONES, seed=6)
    samples = torch.randperm(NUM_RAYS * NUM_SAMPLES, generator=torch.Generator().manual_seed(1))
    samples = samples[:100].to(DEVICE)
    expected = values.cummax(1).values.flatten(0, 1)[samples]
    assert torch.equal(largest_met(values, samples), expected)


def test_no_rays_are_no_trouble() -> None:
    none = torch.zeros(0, NUM_SAMPLES, device=DEVICE)
    nobody = torch.zeros(0, 3, device=DEVICE)
    samples = torch.zeros(0, dtype=torch.long, device=DEVICE)
    looked_at = torch.tensor(LOOKED_AT, device=DEVICE)
    rays, light = Rays(nobody, nobody), none[:, 0]
    soft = none[..., None].expand(-1, -1, NUM_BONES)
    dim(light, none, looked_at)
    assert len(sample_weights(none)) == len(largest_met(soft, samples)) == 0
    assert len(sample_places(rays, none, samples, light, 0.5)) == 0
    assert len(samples_between(none, soft, looked_at, 0.12, 1e-4)) == 0
    corners = torch.zeros(1, 3, device=DEVICE)
    near, far = box_intervals(rays, torch.eye(4, device=DEVICE)[None], corners, corners)
    assert len(near) == len(far) == 0


@pytest.mark.parametrize(
    "camera",
    [camera_above(48), camera_above(40).cropped(16, 18, 30, 11), camera_above(5)],
    ids=["all of the hand", "over the border", "few pixels"],
)
def test_a_mesh_covers_the_same_pixels(rig: Rig, camera: Camera) -> None:
    rig, camera = rig.to(DEVICE), camera.to(DEVICE)
    vertices = any_pose(rig).vertices
    expected = covered_pixels(vertices, rig.faces, camera)
    assert 0 < int(expected.sum()) < expected.numel()
    assert torch.equal(mesh_coverage(vertices, rig.faces, camera), expected)


def test_what_has_no_place_covers_nothing(rig: Rig) -> None:
    rig, camera = rig.to(DEVICE), camera_above(24).to(DEVICE)
    vertices = any_pose(rig).vertices.clone()
    vertices[::3] = math.nan
    expected = covered_pixels(vertices, rig.faces, camera)
    assert torch.equal(mesh_coverage(vertices, rig.faces, camera), expected)
    middle = rays_through_pixels(camera, pixel_centers(camera).flatten(0, 1)).origins[0]
    behind = any_pose(rig).vertices + 2 * (middle - vertices[1])
    assert not mesh_coverage(behind, rig.faces, camera).any()
    assert not mesh_coverage(behind, rig.faces[:0], camera).any()
