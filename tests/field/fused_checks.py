"""The Triton kernels of the field against torch's operations; run by ``test_fused.py``."""

from collections.abc import Callable

import pytest
import torch
from conftest import any_pose, bent_pose, camera_above
from torch import Tensor

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.field.anchors import nearest_anchors
from handavatar.field.kernels import Kernel
from handavatar.field.occupancy import Occupancy, PairOccupancy
from handavatar.hand.parts import Parts
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import PosedHand, Rig
from handavatar.train.prior import load_prior

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def _random_field() -> PairOccupancy:
    torch.manual_seed(0)
    field = PairOccupancy()
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            # Biases too, which start as zeros and would hide that one is read for another.
            if name.endswith(("outer.weight", "bias")):
                parameter.normal_(std=0.1)
    return field.to(DEVICE)


def _trained_field() -> PairOccupancy:
    field = PairOccupancy()
    load_prior(field)
    return field.to(DEVICE)


def _points(posed: PosedHand, count: int) -> Tensor:
    """At the skin, inside, beside it, and out of every box."""
    generator = torch.Generator().manual_seed(2)
    chosen = torch.randint(len(posed.vertices), (count,), generator=generator)
    spread = torch.tensor([0.0, 0.002, 0.01, 0.3])[torch.arange(count) % 4]
    moved = spread[:, None] * torch.randn(count, 3, generator=generator)
    return (posed.vertices[chosen.to(posed.vertices.device)] + moved.to(posed.vertices)).to(DEVICE)


def _evaluated(
    field: PairOccupancy, parts: Parts, posed: PosedHand, points: Tensor, kernel: Kernel
) -> Occupancy:
    with torch.no_grad():
        return field(field.encode(parts, posed), points, kernel)


@pytest.mark.parametrize("gesture", ["flat", "fist", "pinch"])
@pytest.mark.parametrize("make", [_random_field, _trained_field], ids=["random", "trained"])
def test_the_kernels_equal_torchs_operations(
    rig: Rig, parts: Parts, make: Callable[[], PairOccupancy], gesture: str
) -> None:
    pose = HandPose(gesture_rotations(rig, gesture), torch.zeros(3)).to(DEVICE)
    posed = rig.to(DEVICE).shaped().posed(pose)
    field, points = make(), _points(posed, 70)
    expected = _evaluated(field, parts.to(DEVICE), posed, points, "torch")
    found = _evaluated(field, parts.to(DEVICE), posed, points, "triton")
    assert 0.2 < float((expected.whole > 1e-6).float().mean()) < 0.95
    torch.testing.assert_close(found.whole, expected.whole, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.soft_parts, expected.soft_parts, atol=1e-5, rtol=0)
    assert torch.equal(found.items.points, expected.items.points)
    assert torch.equal(found.items.pairs, expected.items.pairs)
    assert torch.equal(found.items.is_wanted, expected.items.is_wanted)


@pytest.mark.parametrize("kernel", ["triton-tf32", "triton-bf16"])
def test_shorter_factors_stay_near(rig: Rig, parts: Parts, kernel: Kernel) -> None:
    posed = any_pose(rig.to(DEVICE))
    field, points = _trained_field(), _points(posed, 70)
    expected = _evaluated(field, parts.to(DEVICE), posed, points, "torch")
    found = _evaluated(field, parts.to(DEVICE), posed, points, kernel)
    assert float((found.soft_parts - expected.soft_parts).abs().max()) < 0.1
    is_sure = (expected.whole - 0.5).abs() > 0.49
    assert int(is_sure.sum()) > 40
    assert torch.equal(found.whole[is_sure] > 0.5, expected.whole[is_sure] > 0.5)


def test_nothing_near_the_hand_is_nothing(rig: Rig, parts: Parts) -> None:
    posed = any_pose(rig.to(DEVICE))
    for points in (torch.full((5, 3), 9.0, device=DEVICE), torch.zeros(0, 3, device=DEVICE)):
        found = _evaluated(_random_field(), parts.to(DEVICE), posed, points, "triton")
        assert len(found.whole) == len(points) and not found.whole.any()


def test_weights_that_a_step_has_changed_are_read_anew(rig: Rig, parts: Parts) -> None:
    posed = any_pose(rig.to(DEVICE))
    field, points = _random_field(), _points(posed, 20)
    before = _evaluated(field, parts.to(DEVICE), posed, points, "triton")
    with torch.no_grad():
        field.decoder.mlp.output.bias += 0.05
    expected = _evaluated(field, parts.to(DEVICE), posed, points, "torch")
    found = _evaluated(field, parts.to(DEVICE), posed, points, "triton")
    assert float((found.whole - before.whole).abs().max()) > 0.01
    torch.testing.assert_close(found.whole, expected.whole, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("kernel", "largest"), [("triton", 1e-4), ("triton-tf32", 0.002), ("triton-bf16", 0.002)]
)
def test_a_picture_is_the_same(small_avatar: HandAvatar, kernel: Kernel, largest: float) -> None:
    """With shorter factors too: what can be seen is evaluated again."""
    avatar = small_avatar.moved_to(DEVICE)
    pose, camera = bent_pose(3), camera_above(12)
    expected = avatar.render(pose, camera, settings=RenderSettings(edge_rays=1))
    found = avatar.render(pose, camera, settings=RenderSettings(edge_rays=1, kernel=kernel))
    assert float(expected.alpha.sum()) > 15
    error = (found.color - expected.color).abs()
    assert float(error.max()) < largest


def test_the_nearest_anchors_are_found() -> None:
    generator = torch.Generator().manual_seed(4)
    anchors = torch.randn(300, 3, generator=generator).to(DEVICE)
    for count in (0, 1, 70):
        queries = torch.randn(count, 3, generator=generator).to(DEVICE)
        expected = nearest_anchors(anchors, queries)
        found = nearest_anchors(anchors, queries, kernel="triton")
        assert torch.equal(found.indices, expected.indices)
        torch.testing.assert_close(found.weights, expected.weights)


def test_few_or_equal_anchors_are_found_once_each() -> None:
    anchors = torch.zeros(4, 3, device=DEVICE)
    found = nearest_anchors(anchors, torch.ones(3, 3, device=DEVICE), kernel="triton").indices
    assert found.sort(dim=1).values.tolist() == 3 * [[0, 1, 2, 3]]
