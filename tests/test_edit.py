"""Edits are values: what they do to albedo, light and shadow, and which names they know."""

import pytest
import torch

from handavatar.edit import Edit, Paint, bones_named
from handavatar.field.anchors import Neighbours
from handavatar.hand.pose import BONE_NAMES, NUM_BONES


def test_the_default_changes_nothing() -> None:
    edit, values = Edit(), torch.rand(5, 3)
    assert torch.equal(edit.of_albedo(values), values)
    assert torch.equal(edit.of_illumination(values[:, 0]), values[:, 0])
    assert edit.of_directed(torch.ones(5, NUM_BONES)).all()


def test_light_is_scaled_and_not_clipped_above() -> None:
    light = torch.tensor([0.2, 0.9])
    torch.testing.assert_close(
        Edit(light_gain=2.0).of_illumination(light), torch.tensor([0.4, 1.8])
    )


def test_albedo_is_shifted_and_stays_in_range() -> None:
    albedo = torch.tensor([[0.0, 0.5, 1.0]])
    shifted = Edit(albedo_shift=(-0.1, 0.25, 0.1)).of_albedo(albedo)
    torch.testing.assert_close(shifted, torch.tensor([[0.0, 0.75, 1.0]]))


def test_lifted_bones_cast_no_shadow_and_others_still_do() -> None:
    directed = torch.rand(4, NUM_BONES) + 0.1
    before = directed.clone()
    lifted = Edit(lifted_bones=(3, 15)).of_directed(directed)
    assert not bool(lifted[:, [3, 15]].any())
    kept = [bone for bone in range(NUM_BONES) if bone not in (3, 15)]
    assert torch.equal(lifted[:, kept], directed[:, kept])
    assert torch.equal(directed, before)


def _coat(color: float, opacity: float) -> Paint:
    return Paint(torch.full((3, 3), color), torch.full((3,), opacity))


def test_paint_covers_as_far_as_it_is_opaque_and_runs_together() -> None:
    paint = Paint(torch.eye(3), torch.tensor([1.0, 0.0, 0.5]))
    indices = torch.tensor([[0, 1], [1, 2], [2, 2]])
    weights = torch.tensor([[0.5, 0.5], [1.0, 0.0], [0.5, 0.5]])
    skin = torch.full((3, 3), 0.2)
    found = Edit(paint=paint).painted(skin, Neighbours(indices, weights))
    # Half of an opaque red coat; no paint; half of the last anchor's blue.
    expected = torch.tensor([[0.6, 0.1, 0.1], [0.2, 0.2, 0.2], [0.1, 0.1, 0.6]])
    torch.testing.assert_close(found, expected)
    assert Edit().painted(skin, Neighbours(indices, weights)) is skin


def test_edits_follow_one_another() -> None:
    first = Edit(0.5, (0.1, 0.0, 0.0), (3, 13), _coat(1.0, 0.5))
    second = Edit(3.0, (0.0, 0.2, 0.0), (13, 14), _coat(0.0, 0.5))
    both = first.then(second)
    assert both.light_gain == 1.5 and both.lifted_bones == (3, 13, 14)
    assert both.albedo_shift == pytest.approx((0.1, 0.2, 0.0))
    # Black at one half over white at one half: a third of what shows is white, a quarter is skin.
    assert both.paint is not None
    torch.testing.assert_close(both.paint.opacity, torch.full((3,), 0.75))
    torch.testing.assert_close(both.paint.colors, torch.full((3, 3), 1 / 3))
    assert Edit().then(first) == first and first.then(Edit()) == first
    assert Edit(light=1).then(first).light == 1
    assert Edit(light=1).then(Edit(light=0)).light == 0


def test_fingers_and_bones_are_known_by_name() -> None:
    assert bones_named(("thumb",)) == (13, 14, 15)
    assert bones_named(("ring2", "ring", "wrist")) == (11, 10, 12, 0)
    assert bones_named(BONE_NAMES) == tuple(range(NUM_BONES))
    assert bones_named(()) == ()


@pytest.mark.parametrize("name", ["pinky", "", "thumb4", "Thumb"])
def test_an_unknown_name_is_an_error_that_names_the_choices(name: str) -> None:
    with pytest.raises(ValueError, match=r"neither a finger nor a bone; choose from .*thumb"):
        bones_named(("index", name))
