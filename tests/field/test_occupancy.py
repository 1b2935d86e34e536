"""The pair occupancy field: the paper's equations, and the fast against the plain evaluation."""

import math

import pytest
import torch
from conftest import any_pose
from torch import Tensor

from handavatar.field.occupancy import (
    HandCodes,
    MaximumFusion,
    PairOccupancy,
    SoftmaxFusion,
    box_fade,
    contains,
    local_points,
    soft_occupancy,
)
from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.parts import Parts
from handavatar.hand.pose import CONNECTED_PAIRS, NUM_BONES
from handavatar.hand.rig import PosedHand, Rig


def _field(fusion: MaximumFusion | SoftmaxFusion | None = None) -> PairOccupancy:
    """Random weights; the zeroed last layers of its blocks filled, so that all of it matters."""
    torch.manual_seed(0)
    field = PairOccupancy(fusion, chunk=200)
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            if name.endswith("outer.weight"):
                parameter.normal_(std=0.1)
    return field


def _points(posed: PosedHand, count: int = 700) -> Tensor:
    """Some on the hand, some near, some far from every part."""
    generator = torch.Generator().manual_seed(2)
    chosen = torch.randint(len(posed.vertices), (count,), generator=generator)
    spread = torch.tensor([0.0, 0.005, 0.03, 0.3])[torch.arange(count) % 4]
    return posed.vertices[chosen] + spread[:, None] * torch.randn(count, 3, generator=generator)


def test_the_sizes_are_those_of_the_papers_table() -> None:
    assert sum(parameter.numel() for parameter in PairOccupancy().parameters()) == 232_513


# --- equations ------------------------------------------------------------------------------------


def _answers(count: int = 200, num_slots: int = 40) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    logits = 4 * torch.randn(count, generator=generator, dtype=torch.float64)
    return logits, torch.randint(num_slots - 3, (count,), generator=generator)


@pytest.mark.parametrize("slope", [1.0, 0.05])
def test_maximum_fusion_agrees_with_equation_1_as_printed(slope: float) -> None:
    """Equation 1 with sigma, and with the soft sigma of equation 3 in its place."""
    logits, slots = _answers()
    found = MaximumFusion().over_pairs(logits, slots, 40, slope)
    for slot in range(40):
        of_pairs = [logit for logit, s in zip(logits, slots, strict=True) if int(s) == slot]
        expected = (
            soft_occupancy(torch.stack(of_pairs).max(), slope)
            if of_pairs
            else torch.zeros(()).double()
        )
        torch.testing.assert_close(found[slot], expected)


def test_the_whole_is_the_largest_part() -> None:
    values = torch.rand(9, NUM_BONES, generator=torch.Generator().manual_seed(0))
    expected = torch.tensor([max(row) for row in values.tolist()])
    assert torch.equal(MaximumFusion().over_parts(values), expected)


def test_softmax_fusion_agrees_with_a_loop() -> None:
    logits, slots = _answers()
    fusion = SoftmaxFusion()
    found = fusion.over_pairs(logits, slots, 40, 1.0)
    for slot in range(40):
        values = [1 / (1 + math.exp(-float(x))) for x in logits[slots == slot]]
        weights = [math.exp(value / fusion.temperature) for value in values]
        mean = sum(w * v for w, v in zip(weights, values, strict=True)) / (sum(weights) + 1e-5)
        assert float(found[slot]) == pytest.approx(mean)


def test_occupancy_is_the_logistic_function_of_the_logit() -> None:
    logits = torch.linspace(-30, 30, 101, dtype=torch.float64)
    expected = torch.tensor([1 / (1 + math.exp(-x)) for x in logits.tolist()]).double()
    torch.testing.assert_close(soft_occupancy(logits, 1.0), expected)
    assert float(soft_occupancy(torch.tensor(-torch.inf), 1.0)) == 0
    assert float(soft_occupancy(torch.tensor(0.0), 1.0)) == 0.5


@pytest.mark.parametrize("softness", [0.05, 0.5])
def test_soft_occupancy_agrees_with_equation_3_as_printed(softness: float) -> None:
    logits = torch.linspace(-300, 300, 101, dtype=torch.float64)
    expected = [1 / (1 + math.exp(-softness * x)) for x in logits.tolist()]
    torch.testing.assert_close(soft_occupancy(logits, softness), torch.tensor(expected).double())


def test_soft_occupancy_keeps_order_and_surface_and_tells_far_from_near() -> None:
    logits = torch.linspace(-200, 200, 401, dtype=torch.float64)
    soft, hard = soft_occupancy(logits, 0.05), soft_occupancy(logits, 1.0)
    assert bool((soft[1:] > soft[:-1]).all())
    assert float(soft[200]) == 0.5
    outside = logits < 0
    assert bool((soft[outside] > hard[outside]).all())
    # Where occupancy is zero to float32, soft occupancy still falls.
    assert float(soft[50] - soft[0]) > 1e-4 > float(hard[50])


# --- the field ------------------------------------------------------------------------------------


@pytest.mark.parametrize("fusion", [MaximumFusion(), SoftmaxFusion()])
def test_the_fast_evaluation_equals_the_plain_one(
    rig: Rig, parts: Parts, fusion: MaximumFusion | SoftmaxFusion
) -> None:
    field, posed = _field(fusion), any_pose(rig)
    codes, points = field.encode(parts, posed), _points(posed)
    with torch.no_grad():
        whole, soft = field.plain(codes, points)
        fast = field(codes, points)
    # float32 through a dozen layers, times LOGIT_SCALE
    torch.testing.assert_close(fast.whole, whole, atol=2e-5, rtol=0)
    torch.testing.assert_close(fast.soft_parts, soft, atol=2e-5, rtol=0)
    assert 0.1 < float((whole > 0).float().mean()) < 0.95


def test_a_sharper_field_has_the_same_surface_and_a_shorter_tail(rig: Rig, parts: Parts) -> None:
    posed = any_pose(rig)
    points = _points(posed)
    field = _field()
    codes = field.encode(parts, posed)
    soft = field(codes, points)
    field.sharpness = 3.0
    sharp = field(codes, points)
    torch.testing.assert_close(sharp.whole.logit(), 3 * soft.whole.logit(), rtol=1e-3, atol=1e-3)
    assert bool(((sharp.whole > 0.5) == (soft.whole > 0.5)).all())
    # Directed soft occupancy is the prior's own: what the illumination depends on stays.
    assert torch.equal(sharp.soft_parts, soft.soft_parts)
    plain, _ = field.plain(codes, points)
    torch.testing.assert_close(sharp.whole, plain, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        field.of_items(codes, points, sharp.items), plain, rtol=1e-4, atol=1e-5
    )


def test_the_gradient_through_the_winning_pairs_is_the_whole_gradient(
    rig: Rig, parts: Parts
) -> None:
    field, posed = _field(), any_pose(rig)
    points = _points(posed, 300)
    items = field(field.encode(parts, posed), points).items
    parameters = list(field.parameters())
    scale = torch.randn(300, generator=torch.Generator().manual_seed(4))

    codes = field.encode(parts, posed)
    whole, _ = field.plain(codes, points)
    expected = torch.autograd.grad((whole * scale).sum(), parameters)
    codes = field.encode(parts, posed)
    sparse = field.of_items(codes, points, items)
    found = torch.autograd.grad((sparse * scale).sum(), parameters)

    torch.testing.assert_close(sparse, whole, atol=2e-5, rtol=0)
    assert len(items.points) <= 300 < len(CONNECTED_PAIRS) * 300
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4 * float(theirs.abs().max()), rtol=1e-3)


def test_moving_hand_and_points_together_changes_nothing(rig: Rig, parts: Parts) -> None:
    field, here, there = _field(), any_pose(rig), any_pose(rig, turn=1.2, shift=0.1)
    there_from_here = there.world_from_bone[0] @ torch.linalg.inv(here.world_from_bone[0])
    points = _points(here)
    moved = apply_rigid(there_from_here, points)
    with torch.no_grad():
        first = field(field.encode(parts, here), points)
        second = field(field.encode(parts, there), moved)
    # Positions of 0.3 m in float32 are known to 3e-8 m, networks see them times LENGTH_SCALE and
    # answer times LOGIT_SCALE; a point on a box's border may fall on its other side.
    is_same = (first.whole - second.whole).abs() < 2e-3
    assert float(is_same.float().mean()) > 0.995


def test_nothing_lies_outside_every_box(rig: Rig, parts: Parts) -> None:
    field, posed = _field(), any_pose(rig)
    codes = field.encode(parts, posed)
    points = _points(posed)
    is_in_box = contains(codes.boxes, local_points(codes.boxes, points))
    result = field(codes, points)
    assert float(result.whole[~is_in_box.any(-1)].abs().max()) == 0
    assert float(result.soft_parts[~is_in_box].abs().max()) == 0
    assert result.whole.shape == (700,) and float(result.whole.max()) <= 1


def test_nothing_lies_behind_the_wrist(rig: Rig, parts: Parts) -> None:
    """Three millimetres behind the farthest point of the hand's end, in the box of the wrist."""
    field, posed = _field(), any_pose(rig, turn=0.7)
    codes = field.encode(parts, posed)
    rim = posed.vertices[rig.rim]
    inwards = torch.nn.functional.normalize(posed.vertices.mean(0) - rim.mean(0), dim=0)
    # The wrist's own axis, across the ring: its least spread.
    across = torch.linalg.svd(rim - rim.mean(0)).Vh[2]
    across = across if float(across @ inwards) > 0 else -across
    before = ((rim - rim.mean(0)) @ across).amin()
    middle = rim.mean(0) + before * across
    steps = torch.tensor([0.003, -0.003])
    points = middle + steps[:, None] * across
    local = local_points(codes.boxes, points)[:, 0]
    margin = codes.boxes.margin
    lower, upper = codes.boxes.lower[0] - margin, codes.boxes.upper[0] + margin
    assert bool(((local > lower) & (local < upper)).all())
    result, (whole, soft) = field(codes, points), field.plain(codes, points)
    for found in (result.whole, whole, result.soft_parts[:, 0], soft[:, 0]):
        assert found.detach()[0] > 0 and found.detach()[1] == 0


def test_no_points_give_no_values(rig: Rig, parts: Parts) -> None:
    field = _field()
    result = field(field.encode(parts, any_pose(rig)), torch.zeros(0, 3))
    assert result.whole.shape == (0,) and result.soft_parts.shape == (0, NUM_BONES)


def test_local_points_are_those_of_the_inverse_bone_transforms(rig: Rig, parts: Parts) -> None:
    posed = any_pose(rig, turn=0.7, shift=0.2)
    boxes = parts.boxes(posed, 0.01)
    points = _points(posed, 20)
    found = local_points(boxes, points)
    for bone in range(NUM_BONES):
        expected = apply_rigid(torch.linalg.inv(posed.world_from_bone[bone]), points)
        torch.testing.assert_close(found[:, bone], expected, atol=1e-6, rtol=0)


def test_the_fade_is_one_inside_and_gone_at_the_margin(rig: Rig, parts: Parts) -> None:
    boxes = parts.boxes(any_pose(rig), 0.01)
    middle = (boxes.lower + boxes.upper) / 2
    outward = torch.zeros(5, NUM_BONES, 3)
    steps = torch.tensor([-0.001, 0.0, 0.005, 0.01, 0.02])
    outward[:, :, 0] = boxes.upper[:, 0] - middle[:, 0] + steps[:, None]
    faded = box_fade(middle + outward, boxes)
    expected = torch.tensor([1.0, 1.0, 0.5, 0.0, 0.0])[:, None].expand(5, NUM_BONES)
    torch.testing.assert_close(faded, expected, atol=1e-4, rtol=0)


def test_a_point_decided_by_no_part_has_no_item(rig: Rig, parts: Parts) -> None:
    field, posed = _field(), any_pose(rig)
    codes: HandCodes = field.encode(parts, posed)
    points = torch.cat([posed.vertices[:3], torch.full((2, 3), 5.0)])
    assert field(codes, points).items.points.tolist() == [0, 1, 2]
