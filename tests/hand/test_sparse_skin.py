"""Weights as files hold them."""

from pathlib import Path

import pytest
import torch

from handavatar.hand.detail import refined, subdivided
from handavatar.hand.open_hand import Level, load_open_hand
from handavatar.hand.rig import RigError
from handavatar.hand.skin_refinement import strongest_bones
from handavatar.hand.sparse_skin import SparseSkin


def _skin() -> SparseSkin:
    rig = load_open_hand("778")
    return SparseSkin.of(strongest_bones(subdivided(rig, 1).skin_weights), rig, 1)


def test_sixteen_bits_lose_next_to_nothing_and_sums_are_exact(tmp_path: Path) -> None:
    rig = load_open_hand("778")
    weights = strongest_bones(subdivided(rig, 1).skin_weights)
    skin = _skin()
    assert bool((skin.shares.sum(-1) == 65535).all())
    # Each share is rounded to a neighbouring step.
    torch.testing.assert_close(skin.dense(), weights, atol=1.0 / 65535, rtol=0)
    file = tmp_path / "skin.safetensors"
    skin.save(file, {"made": "in a test"})
    assert torch.equal(SparseSkin.load(file).dense(), skin.dense())
    assert refined(rig, 1, file).skin_weights.equal(skin.dense())


def test_more_than_four_bones_are_refused() -> None:
    rig = load_open_hand("778")
    with pytest.raises(RigError, match="at most 4"):
        SparseSkin.of(rig.skin_weights, rig, 0)


def test_a_file_for_another_rig_or_a_damaged_one_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "skin.safetensors"
    with pytest.raises(RigError, match="rig refine"):
        refined(load_open_hand("778"), 1, file)
    _skin().save(file)
    with pytest.raises(RigError, match="expected"):
        refined(load_open_hand("full"), 1, file)
    with pytest.raises(RigError, match="2"):
        refined(load_open_hand("778"), 2, file)
    file.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(RigError, match="rig refine"):
        refined(load_open_hand("778"), 1, file)


def test_a_rig_without_refined_weights_keeps_the_averaged_ones() -> None:
    rig = load_open_hand("778")
    assert torch.equal(refined(rig, 1).skin_weights, subdivided(rig, 1).skin_weights)


@pytest.mark.parametrize("level", ["778", "full"])
def test_the_shipped_weights_are_refined_ones_of_the_open_hand(level: Level) -> None:
    rig = load_open_hand(level)
    averaged, fine = subdivided(rig), refined(rig)
    weights = fine.skin_weights
    assert not torch.equal(weights, averaged.skin_weights)
    assert int((weights > 0).sum(-1).max()) <= 4
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(weights)))
    for name in ("template_vertices", "faces", "joint_regressor", "shape_directions"):
        assert torch.equal(getattr(fine, name), getattr(averaged, name))
    # They move a little along joints and nothing changes its finger.
    assert float((weights - averaged.skin_weights).abs().mean()) < 0.02
    changed = weights.argmax(-1) != averaged.skin_weights.argmax(-1)
    assert float(changed.float().mean()) < 0.05
