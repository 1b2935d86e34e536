"""Shading of a sphere: lit from the upper left, dark below, white beside it."""

import torch
import trimesh

from handavatar.geometry.cameras import Camera, look_at
from handavatar.render.shaded import shaded_mesh


def test_a_sphere_is_lit_from_the_upper_left_and_moves_with_the_camera() -> None:
    solid = trimesh.creation.icosphere(subdivisions=3)
    vertices = torch.tensor(solid.vertices, dtype=torch.float32)
    faces = torch.tensor(solid.faces)
    pictures = []
    for eye in (torch.tensor([0.0, 0.0, 4.0]), torch.tensor([4.0, 0.0, 0.0])):
        camera = Camera(
            (40.0, 40.0),
            (16.0, 16.0),
            32,
            32,
            look_at(eye, torch.zeros(3), torch.tensor([0, 1.0, 0])),
        )
        pictures.append(shaded_mesh(vertices, faces, camera))
    first, second = pictures
    assert first.shape == (32, 32, 3) and bool(((first >= 0) & (first <= 1)).all())
    assert first[0, 0].tolist() == [1, 1, 1]
    assert float(first[11, 11].mean()) > float(first[20, 20].mean()) + 0.2
    # A sphere looks alike from everywhere, and so does the light that moves with the camera.
    assert float((first - second).abs().mean()) < 0.01
