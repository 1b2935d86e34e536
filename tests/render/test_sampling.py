"""Where to look along each ray: intervals and sample places."""

import torch

from handavatar.geometry.cameras import Rays
from handavatar.geometry.rotations import apply_rigid, matrix_from_axis_angle, rigid_transform
from handavatar.render.sampling import depths_along, intervals_through_boxes


def _scene(dtype: torch.dtype = torch.float64) -> tuple[Rays, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(100, 3, generator=generator, dtype=dtype)
    origins = 2 * torch.randn(100, 3, generator=generator, dtype=dtype)
    rays = Rays(origins, torch.nn.functional.normalize(directions, dim=-1))
    rotations = matrix_from_axis_angle(torch.randn(4, 3, generator=generator, dtype=dtype))
    shifts = torch.randn(4, 3, generator=generator, dtype=dtype)
    sizes = 0.3 + torch.rand(4, 3, generator=generator, dtype=dtype)
    return rays, rigid_transform(rotations, shifts), sizes


def test_intervals_agree_with_walking_along_the_rays() -> None:
    rays, box_from_world, upper = _scene()
    near, far, is_hit = intervals_through_boxes(rays, box_from_world, -upper, upper)
    steps = torch.linspace(0, 12, 6001, dtype=torch.float64)  # 2 mm apart
    points = rays.origins[:, None] + steps[:, None] * rays.directions[:, None]
    is_inside = torch.zeros(points.shape[:2], dtype=torch.bool)
    for transform, size in zip(box_from_world, upper, strict=True):
        local = apply_rigid(transform, points.flatten(0, 1)).view_as(points)
        is_inside |= (local.abs() < size).all(-1)
    is_seen = is_inside.any(1)
    assert bool((is_hit | ~is_seen).all())  # a clipped corner may be thinner than a step
    assert 10 < int(is_seen.sum()) < 90
    first = steps[is_inside.int().argmax(1)][is_seen]
    last = steps[-1 - is_inside.flip(1).int().argmax(1)][is_seen]
    assert float((near[is_seen] - first).abs().max()) < 2.1e-3
    assert float((far[is_seen] - last).abs().max()) < 2.1e-3


def test_a_ray_along_an_axis_and_an_origin_inside() -> None:
    rays = Rays(torch.tensor([[0.0, 0, 0], [0, 2, 0]]), torch.tensor([[1.0, 0, 0], [1, 0, 0]]))
    one = torch.ones(1, 3)
    near, far, is_hit = intervals_through_boxes(rays, torch.eye(4)[None], -one, one)
    assert is_hit.tolist() == [True, False]
    assert (float(near[0]), float(far[0])) == (0.0, 1.0)


def test_samples_ascend_inside_the_interval() -> None:
    near, far = torch.tensor([1.0, 2.0]), torch.tensor([3.0, 2.5])
    centres = depths_along(near, far, 64)
    jittered = depths_along(near, far, 64, torch.Generator().manual_seed(0))
    for depths in (centres, jittered):
        assert bool((depths[:, 1:] > depths[:, :-1]).all())
        assert bool((depths > near[:, None]).all()) and bool((depths < far[:, None]).all())
    # One sample in each of the 64 bins: at most half a bin from its centre.
    half = (far - near)[:, None] / 128
    assert bool(((jittered - centres).abs() <= half * (1 + 1e-4)).all())
    torch.testing.assert_close(centres.mean(1), (near + far) / 2)
