"""COAP's published query: found where it is installed, named where it is not."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from conftest import bent_pose

from handavatar.avatar import HandAvatar
from handavatar.evaluate.published_coap import published_coap_query

_PACKAGE = '''
from types import SimpleNamespace

import torch
{extra}

class Partitioner:
    def __init__(self, body):
        raise TypeError("bodies only")


class COAPBodyModel(torch.nn.Module):
    """The interface of the published class; the answer is in how many boxes a point lies."""

    def __init__(self, body):
        super().__init__()
        self.partitioner = Partitioner(body)
        self.encoder = SimpleNamespace(out_dim=128)
        self.bbox_padding = 1.125
        self.impl_code = None

    def query(self, points):
        code = self.impl_code
        assert code["latent_code"].shape == (1, self.partitioner.num_parts, 128)
        bones = code["bone_trans"]
        local = bones[:, :, None, :3, :3] @ points[:, None, :, :, None]
        local = local[..., 0] + bones[:, :, None, :3, 3]
        inside = (local - code["bbox_center"]).abs() < code["bbox_size"] / 2
        return inside.all(-1).sum(1).float()
'''


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that packages are imported from; none of coap is left from elsewhere."""
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("coap", "coap.coap"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield tmp_path
    for name in ("coap", "coap.coap"):
        sys.modules.pop(name, None)


def _install(site: Path, extra: str = "") -> None:
    (site / "coap").mkdir()
    (site / "coap" / "__init__.py").write_text("")
    (site / "coap" / "coap.py").write_text(_PACKAGE.replace("{extra}", extra))


def test_the_published_query_gets_the_boxes_of_the_posed_hand(
    site: Path, small_avatar: HandAvatar
) -> None:
    _install(site)
    with torch.no_grad():
        state = small_avatar.prepare(bent_pose(3))
    query = published_coap_query(state.codes.boxes)
    assert not isinstance(query, str)
    vertices = state.posed.vertices
    assert bool((query(vertices) > 0).all())
    assert int(query(vertices + 1.0).max()) == 0


def test_where_it_is_missing_the_table_says_so(site: Path, small_avatar: HandAvatar) -> None:
    boxes = small_avatar.prepare(bent_pose(3)).codes.boxes
    absent = published_coap_query(boxes)
    assert isinstance(absent, str) and "github.com/markomih/COAP" in absent
    # The name is also that of an unrelated package.
    (site / "coap.py").write_text("")
    assert published_coap_query(boxes) == absent


def test_a_broken_installation_is_named(site: Path, small_avatar: HandAvatar) -> None:
    _install(site, "import pytorch3d_of_somebody")
    boxes = small_avatar.prepare(bent_pose(3)).codes.boxes
    told = published_coap_query(boxes)
    assert isinstance(told, str) and "pytorch3d_of_somebody" in told
