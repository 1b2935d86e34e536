"""Even motion, against dense algebra; and what must not depend on the frame rate."""

import math

import pytest
import torch

from handavatar.fit.kinematics import NUM_UNKNOWNS, moved_pose
from handavatar.fit.motion import MotionTerms, motion_terms, solve_chain
from handavatar.hand.pose import NUM_BONES, HandPose


def _smooth(times: torch.Tensor) -> HandPose:
    """Fingers that close and open once a second, a wrist that turns and moves."""
    phase = 2 * math.pi * times
    rotations = torch.zeros(len(times), NUM_BONES, 3)
    rotations[:, 1:13, 2] = 0.5 * torch.sin(phase)[:, None]
    rotations[:, 0, 1] = 0.3 * torch.cos(0.7 * phase)
    shift = torch.stack([0.03 * torch.sin(phase), 0.02 * torch.cos(phase), 0 * phase], dim=-1)
    return HandPose(rotations, shift)


def _sampled(rate: float, seconds: float = 4.0) -> tuple[MotionTerms, int]:
    times = torch.arange(round(seconds * rate)) / rate
    return motion_terms(_smooth(times), times), len(times)


def _rough(count: int = 7) -> tuple[HandPose, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    times = torch.cumsum(0.03 + 0.05 * torch.rand(count, generator=generator), 0)
    rotations = 0.2 * torch.randn(count, NUM_BONES, 3, generator=generator)
    return HandPose(rotations, 0.05 * torch.randn(count, 3, generator=generator)), times


def _dense(terms: MotionTerms, blocks: torch.Tensor) -> torch.Tensor:
    """Frames' own matrices, and all triples written out one by one."""
    size = len(blocks) * NUM_UNKNOWNS
    whole = torch.block_diag(*blocks.double())
    for number, first in enumerate(terms.first.tolist()):
        for unknown in range(NUM_UNKNOWNS):
            row = torch.zeros(size, dtype=torch.float64)
            for offset in range(3):
                place = (first + offset) * NUM_UNKNOWNS + unknown
                row[place] = terms.weights[number, offset, unknown]
            whole += row[:, None] * row
    return whole


def test_even_motion_costs_nothing() -> None:
    # A turn about one axis, and a straight way, at constant speed but uneven times.
    times = torch.tensor([0.0, 0.03, 0.1, 0.15, 0.22])
    rotations = torch.zeros(5, NUM_BONES, 3)
    rotations[:, :, 1] = 2.0 * times[:, None]
    poses = HandPose(rotations, times[:, None] * torch.tensor([0.3, -0.2, 0.1]))
    terms = motion_terms(poses, times)
    assert len(terms.first) == 3
    # Rounding of float32 turns and times, 1e-7, divided by the gaps twice and by 3 and 40.
    assert float(terms.frame_energy(5).sum()) < 1e-5
    still = HandPose(rotations[:1].expand(5, -1, -1), torch.ones(5, 3))
    assert float(motion_terms(still, times).frame_energy(5).sum()) < 1e-9


def test_energy_is_that_of_accelerations() -> None:
    """One joint that speeds up by 80 rad/s^2, twice the expected: four a triple."""
    times = torch.arange(9) / 30
    rotations = torch.zeros(9, NUM_BONES, 3)
    rotations[:, 5, 0] = 40.0 * times.square()
    terms = motion_terms(HandPose(rotations, torch.zeros(9, 3)), times)
    energy = terms.frame_energy(9)
    assert float(energy.sum()) == pytest.approx(7 * 4.0, rel=1e-2)
    assert float(energy[4]) == pytest.approx(4.0, rel=1e-2)


def test_a_frame_costs_the_same_at_any_frame_rate() -> None:
    """What pictures say grows with their number; so must what motion says.

    A triple's residual is an acceleration over the expected one and knows no rate. Its energy,
    summed over a second, is therefore as many times larger as there are more pictures, as that of
    the observations is: the balance of both, and with it what is smoothed away, stays. Second
    differences of a sine of one hertz are off by (2 pi / rate)^2 / 12: 3 % of it at ten a second,
    6 % of its square.
    """
    per_frame = {}
    for rate in (10, 30, 60):
        terms, count = _sampled(rate)
        assert len(terms.first) == count - 2
        per_frame[rate] = float(terms.frame_energy(count).sum()) / (count - 2)
    assert per_frame[30] == pytest.approx(per_frame[60], rel=0.02)
    assert per_frame[10] == pytest.approx(per_frame[60], rel=0.08)


def test_long_gaps_say_nothing() -> None:
    poses, _ = _rough(6)
    assert len(motion_terms(poses, torch.arange(6) * 0.5).first) == 0
    assert len(motion_terms(poses, torch.zeros(6)).first) == 0
    # One gap in the middle parts the six frames into two groups of three.
    times = torch.tensor([0.0, 0.1, 0.2, 0.6, 0.7, 0.8])
    assert motion_terms(poses, times).first.tolist() == [0, 3]
    for count in range(3):
        few = HandPose(poses.rotations[:count], poses.translation[:count])
        terms = motion_terms(few, times[:count])
        assert not terms.frame_energy(count).any() and not terms.gradient(count).any()


def test_the_gradient_is_the_energys() -> None:
    """Half of it; exact for shifts, and for turns as far as they commute: here to a few percent."""
    poses, times = _rough()
    # Turns about one axis commute.
    poses = HandPose(poses.rotations * torch.tensor([0.0, 1.0, 0.0]), poses.translation)
    gradient = motion_terms(poses, times).gradient(7)
    for frame, unknown in [(0, 4), (2, 16), (3, 22), (4, 48), (6, 50)]:
        ends = []
        for step in (1e-3, -1e-3):
            change = torch.zeros(7, NUM_UNKNOWNS)
            change[frame, unknown] = step
            energy = motion_terms(moved_pose(poses, change), times).frame_energy(7).sum()
            ends.append(float(energy))
        slope = (ends[0] - ends[1]) / 2e-3
        assert 2 * float(gradient[frame, unknown]) == pytest.approx(slope, rel=0.02)


def test_curvature_and_chain_are_those_of_dense_algebra() -> None:
    poses, times = _rough()
    terms = motion_terms(poses, times)
    generator = torch.Generator().manual_seed(9)
    root = torch.randn(7, NUM_UNKNOWNS, NUM_UNKNOWNS, generator=generator)
    blocks = root @ root.mT + 5 * torch.eye(NUM_UNKNOWNS)
    whole = _dense(terms, blocks)
    own = _dense(terms, torch.zeros_like(blocks)).diagonal().reshape(7, NUM_UNKNOWNS)
    torch.testing.assert_close(terms.curvature(7).double(), own, rtol=1e-5, atol=1e-8)
    right = torch.randn(7, NUM_UNKNOWNS, 2, generator=generator)
    expected = torch.linalg.solve(whole, right.double().flatten(0, 1)).float()
    found = solve_chain(blocks, terms, right).flatten(0, 1)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_frames_apart_are_solved_apart() -> None:
    poses, times = _rough(3)
    generator = torch.Generator().manual_seed(9)
    root = torch.randn(3, NUM_UNKNOWNS, NUM_UNKNOWNS, generator=generator)
    blocks = root @ root.mT + 5 * torch.eye(NUM_UNKNOWNS)
    right = torch.randn(3, NUM_UNKNOWNS, 1, generator=generator)
    found = solve_chain(blocks, motion_terms(poses, 10 * times), right)
    torch.testing.assert_close(blocks @ found, right, rtol=0, atol=1e-3)
