"""Texture of the skin from made observations, and which of its points are seen."""

import pytest
import torch
from made_frames import calm_poses, camera_over, draw, observed, points_on, pose_at
from torch import Tensor
from torch.nn.functional import normalize

from handavatar.fit.appearance import SeenTexture, fit_texture, see_points, see_texture
from handavatar.fit.pictures import FramePicture
from handavatar.geometry.cameras import project
from handavatar.geometry.meshes import SurfacePoints
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig

POINTS = 300


def _made(frames: int, noise: float) -> tuple[list[SeenTexture], torch.Tensor]:
    """Half of the points, seen in each frame."""
    generator = torch.Generator().manual_seed(2)
    texture = 0.05 * torch.randn(POINTS, 3, generator=generator)
    seen = []
    for _ in range(frames):
        index = torch.randperm(POINTS, generator=generator)[: POINTS // 2].sort().values
        values = texture[index] + noise * torch.randn(POINTS // 2, 3, generator=generator)
        seen.append(SeenTexture(index, values, torch.ones(POINTS // 2)))
    return seen, texture


def test_the_texture_is_the_mean_of_what_is_seen_and_its_error_that_of_the_noise() -> None:
    seen, texture = _made(frames=80, noise=0.02)
    found, error = fit_texture(seen, POINTS)
    # Forty views of each: a sixth of the noise, and drawn to zero by 0.3 of 40.
    assert float((found.values - texture).abs().mean()) < 0.02 / 40**0.5 * 1.1
    # The median length of three normal errors is 1.54 of one; over the root of three, 0.89.
    assert error == pytest.approx(0.02 * 0.89, rel=0.1)


def test_frames_that_show_something_else_hardly_count() -> None:
    seen, texture = _made(frames=80, noise=0.02)
    found, _ = fit_texture(seen, POINTS)
    for part in seen[::8]:
        part.values[:40] = torch.tensor([0.6, -0.6, 0.6])
    spoilt, _ = fit_texture(seen, POINTS)
    before, after = ((each.values - texture).abs().mean() for each in (found, spoilt))
    assert float(after) < 1.15 * float(before)


def test_points_never_seen_have_no_trust_and_no_texture() -> None:
    seen, _ = _made(frames=40, noise=0.01)
    more, _ = fit_texture(seen, POINTS + 5)
    assert not more.trust[POINTS:].any() and not more.values[POINTS:].any()
    assert float(more.trust[:POINTS].median()) > 3
    none = SeenTexture(torch.zeros(0, dtype=torch.long), torch.zeros(0, 3), torch.zeros(0))
    nothing, error = fit_texture([none], 4)
    assert not nothing.trust.any() and error == float("inf")


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


def test_exposure_and_soft_light_leave_the_seen_texture_as_it_is(rig: Rig) -> None:
    hand, camera = rig.shaped(), camera_over(96)
    pose = pose_at(calm_poses(rig, 1), 0)
    color, coverage = draw(hand, pose, camera)
    across = torch.linspace(0.6, 1.2, 96)[None, :, None] * torch.tensor([1.1, 1.0, 0.8])
    known = torch.ones(96, 96, dtype=torch.bool)
    points, vertices = points_on(hand).surface, hand.posed(pose).vertices

    def texture_of(shown: Tensor, where: Tensor) -> SeenTexture:
        picture = FramePicture.of(camera, shown, coverage, where, torch.ones(3))
        return see_texture(rig, vertices, points, picture, picture.band(1.5))

    plain, lit = texture_of(color, known), texture_of(color * across, known)
    assert len(plain.index) > 400 and torch.equal(plain.index, lit.index)
    # Blotches of 2 cm are seen; light that changes by a factor of two over the picture is not.
    assert float(plain.values.std()) > 0.04
    assert float((lit.values - plain.values).abs().mean()) < 0.1 * float(plain.values.std())
    # What is unknown is not seen.
    half = known.clone()
    half[:, 48:] = False
    part = texture_of(color, half)
    positions = points.positions(vertices)[part.index]
    assert 0 < len(part.index) < len(plain.index)
    assert float(project(camera, positions)[0][:, 0].max()) < 48


def test_several_frames_agree_on_a_texture(rig: Rig) -> None:
    hand, camera = rig.shaped(), camera_over(128)
    poses = calm_poses(rig, 4)
    points = points_on(hand).surface
    seen = []
    for frame in range(4):
        pose = pose_at(poses, frame)
        picture = observed(hand, pose, camera).picture
        vertices = hand.posed(pose).vertices
        seen.append(see_texture(rig, vertices, points, picture, picture.band(2.0)))
    found, error = fit_texture(seen, len(points.faces))
    often = found.trust > 1.5
    assert int(often.sum()) > 200
    assert error < 0.5 * float(found.values[often].std())
