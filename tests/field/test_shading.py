"""Directed soft occupancy, albedo and illumination."""

import math

import torch
from torch import Tensor

from handavatar.field.anchors import Neighbours
from handavatar.field.shading import (
    AlbedoField,
    IlluminationField,
    OrientedCues,
    PaperCues,
    directed_occupancy,
)
from handavatar.hand.pose import NUM_BONES

NO_LIGHT = torch.zeros(6, 0)


def _soft(rays: int = 5, samples: int = 9) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(rays, samples, NUM_BONES, generator=generator)


def test_directed_occupancy_agrees_with_equation_4_as_printed() -> None:
    soft = _soft()
    found = directed_occupancy(soft)
    for ray in range(5):
        for sample in range(9):
            for bone in range(NUM_BONES):
                met = [float(soft[ray, i, bone]) for i in range(sample + 1)]
                assert float(found[ray, sample, bone]) == max(met)


def test_directed_is_at_least_soft_and_never_falls_along_the_ray() -> None:
    soft = _soft()
    found = directed_occupancy(soft)
    assert bool((found >= soft).all())
    assert bool((found[:, 1:] >= found[:, :-1]).all())
    assert torch.equal(found[:, 0], soft[:, 0])


def test_what_lies_behind_a_sample_does_not_darken_it() -> None:
    soft = _soft()
    changed = soft.clone()
    changed[:, 5:] = 1
    assert torch.equal(directed_occupancy(changed)[:, :5], directed_occupancy(soft)[:, :5])


def _neighbours(queries: int = 6, anchors: int = 50) -> Neighbours:
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(queries, 4, generator=generator)
    indices = torch.randint(anchors, (queries, 4), generator=generator)
    return Neighbours(indices, weights / weights.sum(-1, keepdim=True))


def test_albedo_and_illumination_are_in_range_and_of_the_papers_sizes() -> None:
    torch.manual_seed(0)
    albedo = AlbedoField(50)
    illumination = IlluminationField(torch.rand(50, 3), PaperCues())
    color = albedo(_neighbours())
    light = illumination(
        torch.zeros(NUM_BONES, 3),
        _neighbours(),
        torch.rand(6, NUM_BONES),
        torch.rand(6, 3),
        NO_LIGHT,
    )
    for value in (color.detach(), light.detach()):
        assert 0 <= float(value.min()) <= float(value.max()) <= 1
    assert color.shape == (6, 3) and light.shape == (6,)
    # Paper appendix, the table of MLPs: 128 -> 4 x 256 -> 3 and 85 -> 4 x 256 -> 1.
    assert albedo.codes.shape == (50, 128) and albedo.mlp.hidden[0].in_features == 128
    assert illumination.mlp.hidden[0].in_features == 85
    assert illumination.position_codes.shape == (50, 21)
    for mlp in (albedo.mlp, illumination.mlp):
        assert [layer.out_features for layer in mlp.hidden] == [256] * 4


def test_light_depends_on_pose_and_shadow() -> None:
    torch.manual_seed(0)
    field, there = IlluminationField(torch.rand(50, 3), PaperCues()), _neighbours()
    up = torch.tensor([[0.0, 1.0, 0.0]]).expand(6, -1)
    flat = torch.zeros(NUM_BONES, 3)
    clear = torch.zeros(6, NUM_BONES)
    light = field(flat, there, clear, up, NO_LIGHT)
    assert not torch.allclose(light, field(flat + 0.5, there, clear, up, NO_LIGHT))
    assert not torch.allclose(light, field(flat, there, clear + 0.5, up, NO_LIGHT))
    assert torch.equal(light, field(flat, there, clear, -up, NO_LIGHT)), (
        "the paper's cues hold no normal"
    )


def test_oriented_light_depends_on_the_normal_and_a_pose_per_query_is_the_same_pose() -> None:
    torch.manual_seed(0)
    field, there = IlluminationField(torch.rand(50, 3), OrientedCues()), _neighbours()
    flat, clear = torch.zeros(NUM_BONES, 3), torch.zeros(6, NUM_BONES)
    up = torch.tensor([[0.0, 1.0, 0.0]]).expand(6, -1)
    assert field.mlp.hidden[0].in_features == 88
    light = field(flat, there, clear, up, NO_LIGHT)
    assert not torch.allclose(light, field(flat, there, clear, -up, NO_LIGHT))
    assert torch.equal(light, field(flat.expand(6, -1, -1), there, clear, up, NO_LIGHT))


def test_a_wrist_half_a_turn_away_is_one_input_whichever_vector_means_it() -> None:
    torch.manual_seed(0)
    field = IlluminationField(torch.rand(50, 3), PaperCues())
    others = _neighbours(), torch.rand(6, NUM_BONES), torch.rand(6, 3), NO_LIGHT
    pose = 0.2 * torch.randn(NUM_BONES, 3)
    axis = torch.tensor([0.6, 0.0, 0.8])
    just_before, just_after = pose.clone(), pose.clone()
    just_before[0], just_after[0] = 3.1 * axis, (3.2 - 2 * math.pi) * axis
    with torch.no_grad():
        shades = [field(just_before, *others), field(just_after, *others)]
    # Without a reference the two lie on opposite sides.
    assert float((shades[0] - shades[1]).abs().max()) > 1e-2
    field.wrist_reference.copy_(3 * axis)
    with torch.no_grad():
        shades = [field(just_before, *others), field(just_after, *others)]
    assert float((shades[0] - shades[1]).abs().max()) < 5e-3
    rotated = pose.expand(6, -1, -1).clone()
    rotated[:, 0] = just_after[0]
    torch.testing.assert_close(field(rotated, *others), shades[1])


def test_weights_of_before_there_was_a_reference_are_read() -> None:
    field = IlluminationField(torch.rand(50, 3), PaperCues())
    field.wrist_reference.fill_(1.0)
    old = {k: v for k, v in field.state_dict().items() if k != "wrist_reference"}
    field.load_state_dict(old)
    assert torch.equal(field.wrist_reference, torch.zeros(3))


def test_each_light_has_a_column_of_its_own_and_one_light_has_none() -> None:
    torch.manual_seed(0)
    one = IlluminationField(torch.rand(50, 3), PaperCues())
    assert one.mlp.hidden[0].in_features == PaperCues.width
    field = IlluminationField(torch.rand(50, 3), PaperCues(), num_lights=3)
    cues = torch.zeros(NUM_BONES, 3), _neighbours(), torch.rand(6, NUM_BONES), torch.rand(6, 3)
    assert field.mlp.hidden[0].in_features == PaperCues.width + 3
    with torch.no_grad():
        lights = [field(*cues, NO_LIGHT, which) for which in range(3)]
        assert not torch.allclose(lights[0], lights[1])
        assert torch.equal(field(*cues, NO_LIGHT), lights[0])
        each = torch.tensor([0, 2, 1, 1, 0, 2])
        mixed = field(*cues, NO_LIGHT, each)
        torch.testing.assert_close(mixed, torch.stack(lights)[each, torch.arange(6)])
        # A light is what its column says, and no other's.
        field.mlp.hidden[0].weight[:, -2] += 0.5
        assert torch.equal(field(*cues, NO_LIGHT, 0), lights[0])
        assert not torch.allclose(field(*cues, NO_LIGHT, 1), lights[1])
