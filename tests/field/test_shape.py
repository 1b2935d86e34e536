"""The personal rest shape."""

import torch

from handavatar.field.layers import positional_encoding
from handavatar.field.shape import (
    HAND_SCALE,
    NUM_FREQUENCIES,
    OFFSET_SCALE,
    ShapeOffsets,
    personal_hand,
)
from handavatar.hand.detail import subdivided
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import NUM_BONES


def _rotations() -> torch.Tensor:
    return 0.3 * torch.randn(NUM_BONES, 3, generator=torch.Generator().manual_seed(0))


def test_offsets_start_near_zero_and_know_nothing_of_the_wrists_rotation() -> None:
    torch.manual_seed(0)
    rest, rotations, field = load_open_hand("778").shaped(), _rotations(), ShapeOffsets()
    offsets = field(rest, rotations)
    assert float(offsets.abs().max()) < 0.002  # two millimetres
    turned = rotations.clone()
    turned[0] += 1
    assert torch.equal(field(rest, turned), offsets)
    turned[5] += 1
    assert not torch.equal(field(rest, turned), offsets)


def test_the_pose_as_a_bias_equals_the_pose_as_an_input() -> None:
    """Slowly: every vertex is given its encoding and the whole finger pose, 84 numbers."""
    torch.manual_seed(0)
    rig = load_open_hand("778")
    rest, rotations, field = rig.shaped(), _rotations(), ShapeOffsets()
    centred = (
        rest.rest_vertices - (rig.joint_regressor @ rig.template_vertices).mean(0)
    ) / HAND_SCALE
    encoded = positional_encoding(centred, NUM_FREQUENCIES)
    pose = rotations[1:].flatten().expand(len(encoded), -1)
    inputs = torch.cat([encoded, pose], dim=-1)
    assert inputs.shape[-1] == 84
    expected = OFFSET_SCALE * field.mlp(inputs)
    torch.testing.assert_close(field(rest, rotations), expected, atol=1e-6, rtol=1e-4)


def test_what_is_fitted_at_the_vertices_holds_between_them() -> None:
    """Waves shorter than the mesh's edges would fold the finer mesh of the same hand."""
    torch.manual_seed(0)
    rig = load_open_hand("778")
    fine = subdivided(rig, 1)
    rest, rotations, field = rig.shaped(), _rotations(), ShapeOffsets()

    def wanted(vertices: torch.Tensor) -> torch.Tensor:
        return 0.003 * torch.sin(vertices * 100)  # a wave of 63 mm

    optimizer = torch.optim.Adam(field.parameters(), lr=4e-3)
    for _ in range(60):
        optimizer.zero_grad()
        error = 1e3 * (field(rest, rotations) - wanted(rest.rest_vertices))
        error.square().mean().backward()
        optimizer.step()
    with torch.no_grad():
        between = field(fine.shaped(), rotations) - wanted(fine.shaped().rest_vertices)
    assert float(between[rig.num_vertices :].norm(dim=-1).mean()) < 3e-4


def test_the_wrist_stays_whatever_the_offsets() -> None:
    rest = load_open_hand("778").shaped()
    generator = torch.Generator().manual_seed(1)
    offsets = 0.005 * torch.randn(rest.rest_vertices.shape, generator=generator) + 0.02
    hand = personal_hand(rest, offsets)
    torch.testing.assert_close(hand.rest_joints[0], rest.rest_joints[0], atol=1e-6, rtol=0)
    edge = hand.rest_vertices[7] - hand.rest_vertices[3]
    expected = (rest.rest_vertices + offsets)[7] - (rest.rest_vertices + offsets)[3]
    torch.testing.assert_close(edge, expected, atol=1e-6, rtol=0)
    same = personal_hand(rest, torch.zeros_like(offsets))
    torch.testing.assert_close(same.rest_vertices, rest.rest_vertices, atol=1e-6, rtol=0)
