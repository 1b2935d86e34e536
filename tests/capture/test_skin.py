import numpy as np
import pytest
import torch

from handavatar.capture.skin import SkinOptions, chart_texels, paint_skin
from handavatar.hand.open_hand import load_open_hand

RESOLUTION = 192


@pytest.fixture(scope="module")
def rig():
    return load_open_hand()


@pytest.fixture(scope="module")
def texture(rig):
    return paint_skin(rig, SkinOptions(seed=1), RESOLUTION)


def colors_at_corners(rig, texture):
    """Colour under every texture coordinate, nearest texel."""
    column, row = (rig.uv_coordinates * RESOLUTION).long().clamp(0, RESOLUTION - 1).T
    return texture[row, column]


def vertex_colors(rig, texture):
    colors = torch.zeros(rig.num_vertices, 3)
    colors[rig.faces.flatten()] = colors_at_corners(rig, texture)[rig.uv_faces.flatten()]
    return colors


def test_texels_know_their_place(rig):
    texels = chart_texels(rig, 64)
    uv = rig.uv_coordinates[rig.uv_faces[texels.faces]].double().numpy()
    found = np.einsum("tk,tkc->tc", texels.barycentric, uv)
    rows, columns = np.nonzero(texels.is_inside)
    expected = (np.stack([columns, rows], axis=-1) + 0.5) / 64
    # Exact up to float32 texture coordinates.
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert 0.3 < texels.is_inside.mean() < 0.6


def test_a_seed_is_a_subject(rig, texture):
    assert torch.equal(paint_skin(rig, SkinOptions(seed=1), RESOLUTION), texture)
    other = paint_skin(rig, SkinOptions(seed=2), RESOLUTION)
    assert 0.005 < float((other - texture).abs().mean()) < 0.1


def test_colors_are_those_of_skin(texture):
    assert texture.shape == (RESOLUTION, RESOLUTION, 3)
    assert 0 < float(texture.min()) < float(texture.max()) < 1
    red, green, blue = texture.mean(dim=(0, 1))
    assert red > green > blue


def test_the_chart_has_no_visible_seams(rig, texture):
    corners = torch.stack([rig.faces.flatten(), rig.uv_faces.flatten()], dim=-1).unique(dim=0)
    colors = colors_at_corners(rig, texture)
    same = corners[1:, 0] == corners[:-1, 0]
    jump = (colors[corners[1:, 1]] - colors[corners[:-1, 1]])[same].abs().mean()
    # Texels here are 2 mm wide; neighbours differ by as much in the middle of the chart.
    assert float(jump) < 0.05


def test_tone_darkens_the_back_more_than_the_palm(rig):
    dark = vertex_colors(rig, paint_skin(rig, SkinOptions(tone=1.0), RESOLUTION))
    light = vertex_colors(rig, paint_skin(rig, SkinOptions(tone=0.0), RESOLUTION))
    places = rig.template_vertices
    on_hand = (places[:, 0] > -0.08) & (places[:, 2].abs() < 0.02)
    back, palm = on_hand & (places[:, 1] > 0.002), on_hand & (places[:, 1] < -0.02)
    assert float(dark[back].mean()) < 0.5 * float(light[back].mean())
    assert float(dark[palm].mean()) > 1.3 * float(dark[back].mean())


def test_nails_are_paler_than_the_finger_around_them(rig, texture):
    colors = vertex_colors(rig, texture)
    for finger in ("thumb", "index", "middle", "ring", "little"):
        nail = rig.vertex_sets[f"nail_{finger}"]
        center = rig.template_vertices[nail].mean(0)
        middle = nail[(rig.template_vertices[nail] - center).norm(dim=-1).argmin()]
        assert float(colors[middle].mean()) > float(colors.mean())


def test_strengths_of_zero_leave_plain_skin(rig):
    plain = SkinOptions(redness=0.0, lines=0.0, veins=0.0, mottling=0.0, num_spots=0)
    colors = vertex_colors(rig, paint_skin(rig, plain, RESOLUTION))
    places = rig.template_vertices
    back = (places[:, 0] > -0.07) & (places[:, 1] > 0.005) & (places[:, 2].abs() < 0.02)
    assert int(back.sum()) > 10
    # Only the tone darkens knuckles now, and there are none so near the wrist.
    assert float(colors[back].std(0).max()) < 0.01
