"""Cameras: pixels to rays and back; windows and sizes of the same view."""

import torch

from handavatar.geometry.cameras import (
    Camera,
    look_at,
    pixel_centers,
    project,
    rays_through_pixels,
)


def _camera() -> Camera:
    pose = look_at(
        torch.tensor([0.3, -0.2, 0.5]), torch.tensor([0.0, 0.1, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    )
    return Camera((120.0, 130.0), (30.5, 25.0), 64, 48, pose)


def test_rays_pass_through_their_pixels() -> None:
    camera = _camera()
    pixels = pixel_centers(camera).flatten(0, 1)
    rays = rays_through_pixels(camera, pixels)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(len(pixels)))
    for distance in (0.1, 2.0):
        found, depth = project(camera, rays.origins + distance * rays.directions)
        # float32: 64 pixels times 2^-23 times a dozen operations
        torch.testing.assert_close(found, pixels, atol=1e-4, rtol=0)
        assert bool((depth > 0).all()) and bool((depth <= distance * (1 + 1e-6)).all())


def test_the_first_pixels_centre_is_at_one_half() -> None:
    centers = pixel_centers(_camera())
    assert centers.shape == (48, 64, 2)
    assert centers[0, 0].tolist() == [0.5, 0.5] and centers[-1, -1].tolist() == [63.5, 47.5]


def test_axes_are_opencvs() -> None:
    """A point to the right and below the optical axis has larger x and larger y."""
    camera = Camera((100.0, 100.0), (32.0, 32.0), 64, 64, torch.eye(4))
    pixels, depth = project(camera, torch.tensor([[0.1, 0.2, 1.0]]))
    torch.testing.assert_close(pixels, torch.tensor([[42.0, 52.0]]))
    torch.testing.assert_close(depth, torch.tensor([1.0]))


def test_looking_at_a_point_puts_it_in_the_middle_and_up_is_up() -> None:
    eye, target = torch.tensor([0.3, -0.2, 0.5]), torch.tensor([0.0, 0.1, 0.0])
    camera = Camera((100.0, 100.0), (32.0, 24.0), 64, 48, look_at(eye, target, torch.eye(3)[1]))
    above = target + torch.tensor([0.0, 0.01, 0.0])
    pixels, depth = project(camera, torch.stack([target, above]))
    torch.testing.assert_close(pixels[0], torch.tensor([32.0, 24.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(depth[0], (eye - target).norm())
    assert float(pixels[1, 1]) < float(pixels[0, 1])


def test_windows_and_sizes_show_the_same_world() -> None:
    camera = _camera()
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    pixels, _ = project(camera, points)
    half, _ = project(camera.resized(32, 24), points)
    torch.testing.assert_close(half, pixels / 2)
    shifted, _ = project(camera.cropped(5.0, -3.0, 20.0, 10.0), points)
    torch.testing.assert_close(shifted, pixels - torch.tensor([5.0, -3.0]))
    assert camera.cropped(5.0, -3.0, 20.0, 10.0).width == 20
