"""PLY and OBJ, read back by trimesh."""

import io
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

from handavatar.export.polygons import eight_bits, obj_bytes, ply_bytes
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.rig import Rig


def test_a_ply_holds_places_normals_colours_and_faces(rig: Rig) -> None:
    vertices, faces = rig.template_vertices, rig.faces
    normals = vertex_normals(vertices, faces)
    colors = torch.rand(len(vertices), 3, generator=torch.Generator().manual_seed(0))
    content = ply_bytes(vertices, normals, colors, faces, ("a comment",))
    read = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
    assert np.array_equal(read.vertices.astype(np.float32), vertices.numpy())
    assert np.array_equal(read.faces, faces.numpy())
    assert np.array_equal(read.visual.vertex_colors[:, :3], eight_bits(colors))
    np.testing.assert_allclose(read.vertex_normals, normals, atol=1e-5)


def test_an_obj_holds_places_faces_and_its_chart(rig: Rig, tmp_path: Path) -> None:
    vertices, faces = rig.template_vertices, rig.faces
    normals = vertex_normals(vertices, faces)
    texts = obj_bytes(vertices, normals, rig.uv_coordinates, faces, rig.uv_faces, "my_hand")
    (tmp_path / "my_hand.obj").write_bytes(texts.mesh)
    (tmp_path / "my_hand.mtl").write_bytes(texts.material)
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "my_hand.png")
    read = trimesh.load(tmp_path / "my_hand.obj", process=False)
    corners = read.vertices[read.faces]
    np.testing.assert_allclose(corners, vertices[faces], atol=1e-7)
    np.testing.assert_allclose(read.vertex_normals[read.faces], normals[faces], atol=1e-5)
    # Trimesh, as OBJ, counts v from below.
    expected = rig.uv_coordinates[rig.uv_faces].numpy() * [1, -1] + [0, 1]
    np.testing.assert_allclose(read.visual.uv[read.faces], expected, atol=1e-6)
    assert np.array_equal(np.asarray(read.visual.material.image)[..., :3], pixels)


def test_eight_bits_are_rounded_and_clipped() -> None:
    values = torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0])
    assert eight_bits(values).tolist() == [0, 0, 128, 255, 255]
