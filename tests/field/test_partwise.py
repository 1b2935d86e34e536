"""COAP's and the Transformer's decoder in the house of PairOF: its laws hold for them too."""

import pytest
import torch
from conftest import any_pose
from torch import Tensor

from handavatar.field.coap import CoapDecoder
from handavatar.field.layers import PointNet
from handavatar.field.occupancy import (
    CODE_WIDTH,
    LENGTH_SCALE,
    LOGIT_SCALE,
    HandCodes,
    contains,
    local_points,
)
from handavatar.field.partwise import PartwiseOccupancy
from handavatar.field.transformer import TransformerDecoder
from handavatar.geometry.rotations import apply_rigid
from handavatar.hand.parts import Parts
from handavatar.hand.pose import NUM_BONES
from handavatar.hand.rig import PosedHand, Rig

KINDS = ("coap", "transformer")


def _field(kind: str) -> PartwiseOccupancy:
    """Random weights; the zeroed last layers of the encoder's blocks filled."""
    torch.manual_seed(0)
    encoder = PointNet(6, CODE_WIDTH)
    with torch.no_grad():
        for name, parameter in encoder.named_parameters():
            if name.endswith("outer.weight"):
                parameter.normal_(std=0.1)
    decoder = CoapDecoder() if kind == "coap" else TransformerDecoder()
    return PartwiseOccupancy(encoder, decoder, chunk=200)


def _points(posed: PosedHand, count: int = 700) -> Tensor:
    """Some on the hand, some near, some far from every part."""
    generator = torch.Generator().manual_seed(2)
    chosen = torch.randint(len(posed.vertices), (count,), generator=generator)
    spread = torch.tensor([0.0, 0.005, 0.03, 0.3])[torch.arange(count) % 4]
    return posed.vertices[chosen] + spread[:, None] * torch.randn(count, 3, generator=generator)


def _slow_logits(field: PartwiseOccupancy, codes: HandCodes, point: Tensor) -> list[Tensor | None]:
    """One point, one part after the other; None where the part's box does not hold the point."""
    encodings = []
    for bone in range(NUM_BONES):
        local = apply_rigid(codes.boxes.bone_from_world[bone], point[None])[0]
        encodings.append(torch.cat([codes.part_codes[bone], LENGTH_SCALE * local]))
    if isinstance(field.decoder, CoapDecoder):
        answers = [field.decoder.mlp(encoding) for encoding in encodings]
    else:
        assert isinstance(field.decoder, TransformerDecoder)
        tokens = field.decoder.input(torch.stack(encodings))[None]
        for block in field.decoder.blocks:
            tokens = block(tokens)
        answers = [field.decoder.mlp(field.decoder.norm(token)) for token in tokens[0]]
    is_in_box = contains(codes.boxes, local_points(codes.boxes, point[None]))[0]
    return [
        LOGIT_SCALE * answer[0] if inside else None
        for answer, inside in zip(answers, is_in_box.tolist(), strict=True)
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_the_field_agrees_with_a_loop_over_points_and_parts(
    rig: Rig, parts: Parts, kind: str
) -> None:
    field, posed = _field(kind), any_pose(rig)
    codes, points = field.encode(parts, posed), _points(posed, 60)
    found = field(codes, points)
    for index, point in enumerate(points):
        with torch.no_grad():
            logits = _slow_logits(field, codes, point)
        for bone, logit in enumerate(logits):
            expected = -torch.inf if logit is None else float(logit)
            # float32 through a dozen layers, times LOGIT_SCALE
            assert float(found.logits[index, bone]) == pytest.approx(expected, abs=2e-4)
        of_parts = [float(logit.sigmoid()) for logit in logits if logit is not None]
        assert float(found.whole[index]) == pytest.approx(max(of_parts, default=0.0), abs=1e-4)
    assert 0.1 < float((found.whole > 0).float().mean()) < 0.95


@pytest.mark.parametrize("kind", KINDS)
def test_pieces_change_nothing_and_the_trainable_value_is_the_same(
    rig: Rig, parts: Parts, kind: str
) -> None:
    field, posed = _field(kind), any_pose(rig)
    codes, points = field.encode(parts, posed), _points(posed)
    whole = field.trainable_whole(codes, points)
    assert whole.requires_grad and not field(codes, points).whole.requires_grad
    torch.testing.assert_close(field(codes, points).whole, whole.detach(), atol=2e-5, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_moving_hand_and_points_together_changes_nothing(rig: Rig, parts: Parts, kind: str) -> None:
    field, here, there = _field(kind), any_pose(rig), any_pose(rig, turn=1.2, shift=0.1)
    there_from_here = there.world_from_bone[0] @ torch.linalg.inv(here.world_from_bone[0])
    points = _points(here)
    moved = apply_rigid(there_from_here, points)
    with torch.no_grad():
        first = field(field.encode(parts, here), points).whole
        second = field(field.encode(parts, there), moved).whole
    # Positions of 0.3 m in float32 are known to 3e-8 m, networks see them times LENGTH_SCALE and
    # answer times LOGIT_SCALE; a point on a box's border may fall on its other side.
    assert float(((first - second).abs() < 2e-3).float().mean()) > 0.995


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_lies_outside_every_box(rig: Rig, parts: Parts, kind: str) -> None:
    field, posed = _field(kind), any_pose(rig)
    codes, points = field.encode(parts, posed), _points(posed)
    is_in_box = contains(codes.boxes, local_points(codes.boxes, points))
    result = field(codes, points)
    assert float(result.whole[~is_in_box.any(-1)].max()) == 0
    assert torch.equal(result.logits > -torch.inf, is_in_box)
    torch.testing.assert_close(result.whole, result.logits.amax(-1).sigmoid())
    nothing = field(codes, torch.zeros(0, 3))
    assert nothing.whole.shape == (0,) and nothing.logits.shape == (0, NUM_BONES)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_agree_with_finite_differences(kind: str) -> None:
    decoder = _field(kind).decoder.double()
    generator = torch.Generator().manual_seed(5)
    codes, queries = (
        torch.randn(*shape, generator=generator, dtype=torch.float64, requires_grad=True)
        for shape in ((NUM_BONES, CODE_WIDTH), (3, NUM_BONES, 3))
    )
    is_wanted = torch.rand(3, NUM_BONES, generator=generator) < 0.2
    is_wanted[1] = False
    assert torch.autograd.gradcheck(
        lambda c, q: decoder(c, q, is_wanted), (codes, queries), fast_mode=True
    )


@pytest.mark.parametrize("kind", KINDS)
def test_training_reaches_every_weight(rig: Rig, parts: Parts, kind: str) -> None:
    field, posed = _field(kind), any_pose(rig)
    field.trainable_whole(field.encode(parts, posed), _points(posed, 200)).sum().backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()) and float(parameter.grad.abs().max()) > 0, name
