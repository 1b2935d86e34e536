"""Colours of the skin and the light on them, from made observations."""

import pytest
import torch
from made_frames import calm_poses, camera_over, observed, painted, points_on, pose_at
from torch import Tensor
from torch.nn.functional import normalize

from handavatar.fit.appearance import (
    SeenColors,
    SkinColors,
    fit_colors,
    harmonics,
    see_colors,
    see_points,
)
from handavatar.geometry.cameras import project
from handavatar.geometry.meshes import SurfacePoints
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig

POINTS = 300


def _made(frames: int, noise: float) -> tuple[list[SeenColors], torch.Tensor, torch.Tensor]:
    """Points seen at random normals under one light; half of them in each frame."""
    generator = torch.Generator().manual_seed(2)
    albedo = 0.3 + 0.5 * torch.rand(POINTS, 3, generator=generator)
    light = torch.zeros(9, 3)
    light[0] = torch.tensor([1.05, 1.0, 0.95])
    light[1:4] = 0.15 * torch.randn(3, 3, generator=generator)
    light[4:] = 0.02 * torch.randn(5, 3, generator=generator)
    seen = []
    for _ in range(frames):
        index = torch.randperm(POINTS, generator=generator)[: POINTS // 2].sort().values
        normals = normalize(torch.randn(POINTS // 2, 3, generator=generator), dim=-1)
        values = albedo[index] * (harmonics(normals) @ light)
        values = values + noise * torch.randn(values.shape, generator=generator)
        seen.append(SeenColors(index, values, normals, torch.ones(POINTS // 2)))
    return seen, albedo, light


def _apart(found: SkinColors, albedo: torch.Tensor, light: torch.Tensor) -> tuple[float, float]:
    """Largest relative errors of albedo and light, up to one factor of each channel."""
    scale = (found.albedo / albedo).median(0).values
    return (
        float((found.albedo / albedo / scale - 1).abs().max()),
        float((found.light * scale - light).abs().max()),
    )


def test_albedo_and_light_are_recovered_up_to_a_factor_per_channel() -> None:
    seen, albedo, light = _made(frames=80, noise=0.005)
    found, error = fit_colors(seen, POINTS)
    in_albedo, in_light = _apart(found, albedo, light)
    # A point seen 40 times is drawn towards the mean by 0.3 of 40.
    assert in_albedo < 0.03 and in_light < 0.03 and error < 0.01
    assert float(found.light[0].mean()) == pytest.approx(1, abs=1e-5)


def test_the_error_is_that_of_the_noise_and_outliers_do_not_count() -> None:
    seen, albedo, light = _made(frames=80, noise=0.02)
    found, error = fit_colors(seen, POINTS)
    # The median length of three normal errors is 1.54 of one; over the root of three, 0.89.
    assert error == pytest.approx(0.02 * 0.89, rel=0.1)
    for part in seen[::8]:
        part.values[:40] = torch.tensor([0.9, 0.1, 0.9])
    spoilt, _ = fit_colors(seen, POINTS)
    in_albedo, in_light = _apart(spoilt, albedo, light)
    before = _apart(found, albedo, light)
    assert in_albedo < before[0] + 0.02 and in_light < before[1] + 0.02


def test_points_never_seen_have_no_trust_and_the_mean_colour() -> None:
    seen, _, _ = _made(frames=40, noise=0.01)
    more, _ = fit_colors(seen, POINTS + 5)
    assert not more.trust[POINTS:].any() and float(more.trust[:POINTS].median()) > 3
    middle = more.albedo[:POINTS].mean(0)
    torch.testing.assert_close(more.albedo[POINTS:], middle.expand(5, 3), rtol=0.05, atol=0.02)
    picked = more.select(torch.tensor([4, POINTS]))
    assert torch.equal(picked.albedo, more.albedo[[4, POINTS]])


def _blocked(vertices: Tensor, faces: Tensor, eye: Tensor) -> Tensor:
    """Whether a face lies more than 3 mm before a vertex on its way to the eye, one by one."""
    first, second, third = vertices[faces].unbind(1)
    beside, below = second - first, third - first
    blocked = torch.zeros(len(vertices), dtype=torch.bool)
    for number, start in enumerate(vertices):
        way = normalize(eye - start, dim=0).expand_as(beside)
        across = torch.linalg.cross(way, below)
        scale = 1 / (beside * across).sum(-1)
        u = scale * ((start - first) * across).sum(-1)
        turned = torch.linalg.cross(start - first, beside)
        v = scale * (way * turned).sum(-1)
        distance = scale * (below * turned).sum(-1)
        blocked[number] = ((u > 0) & (v > 0) & (u + v < 1) & (distance > 0.003)).any()
    return blocked


@pytest.mark.parametrize("bend", [0.0, 1.4])
def test_what_lies_behind_is_hidden(rig: Rig, bend: float) -> None:
    """A palm seen from its side, with stretched and with closed fingers, against rays."""
    camera = camera_over(256)
    rotations = torch.zeros(16, 3)
    rotations[0, 0] = torch.pi
    rotations[1:13, 2] = bend
    vertices = rig.shaped().posed(HandPose(rotations, torch.zeros(3))).vertices
    every = torch.arange(rig.num_vertices)
    corners = torch.tensor([1.0, 0.0, 0.0]).expand(len(every), 3)
    seen = see_points(rig, vertices, SurfacePoints(every[:, None].expand(-1, 3), corners), camera)
    placed = camera.camera_from_world
    hidden = _blocked(vertices, rig.faces, -(placed[:3, :3].T @ placed[:3, 3]))
    faces_camera = seen.facing > 0.2
    assert not seen.is_visible[~faces_camera].any()
    # Closed fingers hide points of the palm that face the camera; stretched ones nearly none.
    assert (int((hidden & faces_camera).sum()) > 30) == (bend > 0)
    # A z-buffer has pixels: at their border both may differ.
    differ = seen.is_visible[faces_camera] == hidden[faces_camera]
    assert float(differ.float().mean()) < 0.05
    pixels, _ = project(camera, vertices)
    assert torch.equal(seen.pixels, pixels)


def test_seen_colours_are_the_paints(rig: Rig) -> None:
    hand, camera = rig.shaped(), camera_over(96)
    pose = pose_at(calm_poses(rig, 1), 0)
    picture = observed(hand, pose, camera).picture
    points = points_on(hand).surface
    seen = see_colors(rig, hand.posed(pose).vertices, points, picture, picture.blurred(0.7))
    light = (seen.normals @ torch.tensor([0.3, 0.5, 0.2])) * 0.4 + 0.6
    expected = points.positions(painted(rig))[seen.index] * light[:, None]
    assert len(seen.index) > 400
    # Blotches of 2 cm are 7 pixels: the blur of a pixel takes a sixth of their contrast of a
    # quarter, and a grazing pixel sees several.
    apart = (seen.values - expected).abs()
    assert float(apart.mean()) < 0.02 and float(apart.median()) < 0.015
    # What is unknown is not seen.
    known = torch.ones(96, 96, dtype=torch.bool)
    known[:, 48:] = False
    half = observed(hand, pose, camera, known=known).picture
    part = see_colors(rig, hand.posed(pose).vertices, points, half, half.blurred(0.7))
    positions = points.positions(hand.posed(pose).vertices)[part.index]
    assert 0 < len(part.index) < len(seen.index)
    assert float(project(camera, positions)[0][:, 0].max()) < 48
