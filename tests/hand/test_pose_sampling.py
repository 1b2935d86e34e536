"""Joint limits, the sampler, penetration, gestures and motion."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from mano_files import write_mano

from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.mano import read_mano
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import (
    GESTURES,
    JOINT_LIMITS,
    PENETRATION_LIMIT,
    PenetrationProbe,
    angles_from_rotations,
    clamped_angles,
    gesture_rotations,
    interpolate_rotations,
    limit_excess,
    resolve_penetration,
    rotations_from_angles,
    sample_poses,
)
from handavatar.hand.rig import Rig

ANGLE_TOLERANCE = 1e-5
"""Radians: float32 rounding through a matrix and back."""


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_open_hand("778")


@pytest.fixture(scope="module")
def probe(rig: Rig) -> PenetrationProbe:
    return PenetrationProbe(rig)


@pytest.fixture(scope="module")
def sampled(rig: Rig) -> torch.Tensor:
    return sample_poses(rig, 40, torch.Generator().manual_seed(3))


def posed_tips(rig: Rig, rotations: torch.Tensor) -> torch.Tensor:
    posed = rig.shaped().posed(HandPose(rotations, torch.zeros(3)))
    return posed.vertices[rig.vertex_sets["fingertips"]]


def test_every_joint_but_the_wrist_has_limits() -> None:
    assert set(JOINT_LIMITS) == set(BONE_NAMES) - {"wrist"}


def test_angles_and_rotations_are_inverse(rig: Rig) -> None:
    generator = torch.Generator().manual_seed(0)
    angles = torch.rand(50, 16, 3, generator=generator) * 2 - 1
    angles = angles * torch.tensor([2.5, 1.2, 2.5])
    rotations = rotations_from_angles(rig, angles)
    torch.testing.assert_close(angles_from_rotations(rig, rotations), angles, atol=2e-4, rtol=0)


def test_a_pure_flexion_turns_about_the_flexion_axis(rig: Rig) -> None:
    angles = torch.zeros(16, 3)
    angles[:, 0] = 0.8
    expected = 0.8 * rig.joint_axes[:, 0]
    torch.testing.assert_close(rotations_from_angles(rig, angles), expected, atol=1e-5, rtol=0)


def test_limit_excess_counts_radians_beyond_the_limits(rig: Rig) -> None:
    angles = torch.zeros(16, 3)
    second = FINGER_BONES["index"][1]
    angles[second, 0] = math.radians(105) + 0.2
    angles[second, 2] = -0.1
    angles[0] = torch.tensor([2.0, 0.5, -1.0])  # the wrist is free
    excess = limit_excess(rig, rotations_from_angles(rig, angles))
    expected = torch.zeros(16)
    expected[second] = 0.3
    torch.testing.assert_close(excess, expected, atol=ANGLE_TOLERANCE, rtol=0)


def test_a_bent_finger_cannot_be_spread(rig: Rig) -> None:
    angles = torch.zeros(2, 16, 3)
    first = FINGER_BONES["index"][0]
    angles[:, first, 1] = math.radians(14)
    angles[1, first, 0] = math.radians(80)
    excess = limit_excess(rig, rotations_from_angles(rig, angles))[:, first]
    assert float(excess[0]) < ANGLE_TOLERANCE
    assert float(excess[1]) > math.radians(8)


def test_limit_excess_is_a_usable_penalty(rig: Rig) -> None:
    flat = torch.zeros(16, 3, requires_grad=True)
    limit_excess(rig, flat).sum().backward()
    assert bool(torch.isfinite(flat.grad).all())
    generator = torch.Generator().manual_seed(4)
    rotations = (0.8 * torch.randn(16, 3, generator=generator)).requires_grad_()
    optimizer = torch.optim.Adam([rotations], lr=0.05)
    start = float(limit_excess(rig, rotations.detach()).sum())
    for _ in range(150):
        loss = limit_excess(rig, rotations).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float(limit_excess(rig, rotations.detach()).sum()) < 0.1 * start


def test_clamped_angles_are_inside_and_leave_the_inside_alone(rig: Rig) -> None:
    generator = torch.Generator().manual_seed(5)
    wild = 2 * torch.randn(30, 16, 3, generator=generator)
    inside = clamped_angles(wild)
    torch.testing.assert_close(clamped_angles(inside), inside)
    inside[:, 0] = 0
    excess = limit_excess(rig, rotations_from_angles(rig, inside))
    assert float(excess.max()) < ANGLE_TOLERANCE


def test_a_hand_held_upright_has_a_gradient(rig: Rig) -> None:
    """Its wrist is turned by a right angle of abduction, where flexion and twist are one."""
    upright = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    rotations = torch.zeros(16, 3)
    rotations[0] = axis_angle_from_matrix(upright)
    rotations.requires_grad_()
    angles = angles_from_rotations(rig, rotations)
    assert abs(math.degrees(float(angles[0, 1].detach()))) == pytest.approx(90, abs=0.1)
    (gradient,) = torch.autograd.grad(angles.square().sum(), rotations)
    assert bool(gradient.isfinite().all())


def test_samples_are_inside_the_limits_repeatable_and_varied(
    rig: Rig, sampled: torch.Tensor
) -> None:
    assert sampled.shape == (40, 16, 3)
    assert float(limit_excess(rig, sampled).max()) < ANGLE_TOLERANCE
    again = sample_poses(rig, 40, torch.Generator().manual_seed(3))
    assert torch.equal(again, sampled)
    assert float(sampled[:, 0].abs().max()) == 0
    flexion = angles_from_rotations(rig, sampled)[:, FINGER_BONES["middle"][0], 0].rad2deg()
    assert float(flexion.min()) < 15 and float(flexion.max()) > 65
    fingers = torch.stack(
        [
            angles_from_rotations(rig, sampled)[:, FINGER_BONES[name][1], 0]
            for name in ("index", "middle", "ring", "little")
        ]
    )
    assert float(torch.corrcoef(fingers)[1, 2]) > 0.3, "fingers move together"


def test_penetration_probe_sees_a_thumb_pushed_through_the_palm(
    rig: Rig, probe: PenetrationProbe
) -> None:
    assert float(probe.depths(torch.zeros(1, 16, 3))[0]) == 0
    angles = GESTURES["fist"].angles()
    angles[FINGER_BONES["index"][0], 0] += 0.5
    angles[FINGER_BONES["index"][1], 0] += 0.4
    assert float(probe.depths(rotations_from_angles(rig, angles)[None])[0]) > 3e-3


def test_resolving_opens_only_what_overlaps(
    rig: Rig, probe: PenetrationProbe, sampled: torch.Tensor
) -> None:
    before = probe.depths(sampled)
    resolved = resolve_penetration(rig, sampled)
    after = probe.depths(resolved)
    assert bool((before > PENETRATION_LIMIT).any()), "the test needs poses that overlap"
    assert float(after.max()) <= PENETRATION_LIMIT
    fine = before <= PENETRATION_LIMIT
    assert torch.equal(resolved[fine], sampled[fine])
    assert float(limit_excess(rig, resolved).max()) < ANGLE_TOLERANCE


@pytest.mark.parametrize("level", ["full", "778"])
def test_gestures_do_not_overlap(level: Literal["full", "778"]) -> None:
    rig = load_open_hand(level)
    rotations = torch.stack([gesture_rotations(rig, name) for name in GESTURES])
    depths = dict(zip(GESTURES, PenetrationProbe(rig).depths(rotations).tolist(), strict=True))
    assert {name: depth for name, depth in depths.items() if depth > PENETRATION_LIMIT} == {}


def test_an_imported_rig_is_sampled_and_opened_like_the_open_hand(
    tmp_path: Path, rig: Rig, sampled: torch.Tensor
) -> None:
    none = np.zeros((778, 3, 135))  # The tests' own pose blend shapes are noise: no hand's.
    mano = read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl", posedirs=none)).rig
    poses = sample_poses(mano, 40, torch.Generator().manual_seed(3))
    assert float(limit_excess(mano, poses).max()) < ANGLE_TOLERANCE
    # The same angles, though about axes of its own.
    torch.testing.assert_close(
        angles_from_rotations(mano, poses),
        angles_from_rotations(rig, sampled),
        atol=ANGLE_TOLERANCE,
        rtol=0,
    )
    depths = PenetrationProbe(mano).depths
    assert float(depths(poses).max()) > PENETRATION_LIMIT, "the test needs poses that overlap"
    assert float(depths(resolve_penetration(mano, poses)).max()) <= PENETRATION_LIMIT


@pytest.mark.parametrize("name", sorted(GESTURES))
def test_gestures_keep_to_the_limits(rig: Rig, name: str) -> None:
    rotations = gesture_rotations(rig, name)
    # Crossing pushes two fingers beyond their own limits, by less than 20 degrees in all.
    allowed = math.radians(20) if name == "crossed_fingers" else ANGLE_TOLERANCE
    assert float(limit_excess(rig, rotations).sum()) < allowed


def test_gestures_look_like_their_names(rig: Rig) -> None:
    tips = {name: posed_tips(rig, gesture_rotations(rig, name)) for name in GESTURES}
    wrist_to_tip = {name: places.norm(dim=-1) for name, places in tips.items()}
    # Thumb, index, middle, ring, little.
    assert float(wrist_to_tip["fist"][1:].max()) < 0.11
    assert float(wrist_to_tip["flat"][1:].min()) > 0.14
    assert float(wrist_to_tip["point"][1]) > 0.17 > 0.11 > float(wrist_to_tip["point"][2])
    assert float(wrist_to_tip["victory"][1:3].min()) > 0.17
    assert float((tips["victory"][1] - tips["victory"][2]).norm()) > 0.05
    for touching in ("pinch", "ok"):
        assert float((tips[touching][0] - tips[touching][1]).norm()) < 0.02
    assert float((tips["spread"][1] - tips["spread"][4]).norm()) > 0.13
    thumb_and_index = tips["thumbs_up"][0] - tips["thumbs_up"][1]
    assert float(thumb_and_index.norm()) > 0.08
    crossed = tips["crossed_fingers"]
    assert float(crossed[1, 2]) < float(crossed[2, 2]), "index tip lies beyond the middle's"


def test_unknown_gesture_is_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="expected one of"):
        gesture_rotations(rig, "salute")


def test_motion_passes_through_its_key_poses_along_the_shortest_turn(rig: Rig) -> None:
    keys = torch.stack([gesture_rotations(rig, name) for name in ("flat", "fist", "victory")])
    at_keys = interpolate_rotations(keys, torch.tensor([-1.0, 0.0, 1.0, 2.0, 5.0]))
    torch.testing.assert_close(at_keys, keys[[0, 0, 1, 2, 2]], atol=1e-5, rtol=0)
    halfway = interpolate_rotations(keys, torch.tensor([0.5]))[0]
    torch.testing.assert_close(halfway, keys[1] / 2, atol=1e-5, rtol=0)
    # Steps of 1/100 turn no joint by more than the eased peak speed of 1.5 times the average.
    times = torch.linspace(0, 2, 201)
    matrices = matrix_from_axis_angle(interpolate_rotations(keys, times))
    turns = matrices[:-1].mT @ matrices[1:]
    cosines = ((turns.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)
    assert float(cosines.acos().max()) < 1.5 * math.pi / 100


def test_one_key_pose_is_held(rig: Rig) -> None:
    key = gesture_rotations(rig, "ok")[None]
    still = interpolate_rotations(key, torch.tensor([0.0, 0.7]))
    torch.testing.assert_close(still, key.expand(2, -1, -1), atol=1e-5, rtol=0)
