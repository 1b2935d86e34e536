"""Texture charts, atlases and texels."""

from dataclasses import replace

import pytest
import torch
from mano_files import write_mano

from handavatar.export.surface import split_at_seams
from handavatar.hand.detail import subdivided
from handavatar.hand.mano import read_mano
from handavatar.hand.rig import Rig
from handavatar.render.chart import charted, is_fair, packed_atlas, texels_of


@pytest.fixture(scope="module")
def mano(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """A rig whose chart is seen from above and below, too thin where the hand is upright."""
    return read_mano(write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")).rig


def test_a_texel_shows_the_face_that_its_centre_lies_in(rig: Rig) -> None:
    texels = texels_of(rig, 64)
    corners = rig.uv_coordinates[rig.uv_faces[texels.faces]]
    found = (corners * texels.barycentric[..., None]).sum(1)
    centres = torch.stack([texels.columns + 0.5, texels.rows + 0.5], dim=-1) / 64
    torch.testing.assert_close(found, centres, atol=1e-5, rtol=0)
    assert float(texels.barycentric.min()) > -1e-6
    assert 0.3 < len(texels.rows) / 64**2 < 0.5


def test_beyond_the_chart_the_nearest_texel_is_repeated(rig: Rig) -> None:
    texels = texels_of(rig, 32)
    own = torch.stack([texels.rows, texels.columns], dim=-1).float()
    picture = texels.filled(own)
    assert torch.equal(picture[texels.rows, texels.columns], own)
    everywhere = torch.cartesian_prod(torch.arange(32.0), torch.arange(32.0))
    nearest = torch.cdist(everywhere, own).amin(1)
    taken = (picture.view(-1, 2) - everywhere).norm(dim=-1)
    torch.testing.assert_close(taken, nearest, atol=1e-4, rtol=0)


def test_the_open_hands_chart_serves_and_a_bad_one_does_not(rig: Rig, mano: Rig) -> None:
    assert is_fair(rig) and not is_fair(mano)
    assert charted(rig, rig, 0) is rig
    heaped = replace(rig, uv_coordinates=rig.uv_coordinates.clone())
    heaped.uv_coordinates[:, 0] = (heaped.uv_coordinates[:, 0] - 0.5).abs()
    assert not is_fair(heaped)


def test_an_atlas_gives_every_face_its_own_texels(mano: Rig) -> None:
    coordinates, corners = packed_atlas(len(mano.faces))
    assert bool((coordinates > 0).all() and (coordinates < 1).all())
    base = replace(mano, uv_coordinates=coordinates, uv_faces=corners)
    assert is_fair(base)
    fine = charted(mano, subdivided(mano, 1), 1)
    texels = texels_of(fine, 512)
    assert len(texels.faces.unique()) == len(fine.faces)
    # Between two triangles lie at least two texels, so that filtering mixes no two of them.
    owner = torch.full((1024, 1024), -1)
    coarse = texels_of(base, 1024)
    owner[coarse.rows, coarse.columns] = coarse.faces
    for step in (1, 2):
        for a, b in ((owner[step:], owner[:-step]), (owner[:, step:], owner[:, :-step])):
            assert not bool(((a >= 0) & (b >= 0) & (a != b)).any())


def test_vertices_are_split_at_seams_and_nowhere_else(rig: Rig, mano: Rig) -> None:
    for hand in (rig, charted(mano, mano, 0)):
        seamed = split_at_seams(hand)
        assert torch.equal(seamed.sources[seamed.faces], hand.faces)
        assert torch.equal(seamed.places[seamed.faces], hand.uv_coordinates[hand.uv_faces])
        pairs = torch.cat([seamed.sources[:, None].float(), seamed.places], dim=-1)
        assert len(pairs.unique(dim=0)) == len(pairs)
    assert len(split_at_seams(rig).sources) < 1.2 * rig.num_vertices
