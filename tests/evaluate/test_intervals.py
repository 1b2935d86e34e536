"""Confidence intervals against scipy, and what they promise."""

import pytest
import torch
from scipy import stats

from handavatar.evaluate.intervals import block_interval, mean_interval, time_blocks


def test_the_interval_agrees_with_scipys_test_of_the_mean() -> None:
    samples = torch.randn(17, generator=torch.Generator().manual_seed(0)) + 0.3
    found = mean_interval(samples, level=0.9)
    expected = stats.ttest_1samp(samples.double().numpy(), 0.0).confidence_interval(0.9)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert found.mean == pytest.approx(float(samples.mean()))


def test_nineteen_intervals_of_twenty_hold_the_truth() -> None:
    draws = torch.randn(2000, 8, generator=torch.Generator().manual_seed(1)) + 2
    intervals = [mean_interval(row) for row in draws]
    share = sum(found.low < 2 < found.high for found in intervals) / len(intervals)
    # Three standard deviations of a share of 2000.
    assert share == pytest.approx(0.95, abs=3 * (0.95 * 0.05 / 2000) ** 0.5)


def test_equal_samples_leave_no_doubt_and_one_sample_is_refused() -> None:
    found = mean_interval(torch.full((4,), 0.5))
    assert (found.mean, found.low, found.high) == (0.5, 0.5, 0.5)
    with pytest.raises(ValueError, match="needs two samples or more, found 1"):
        mean_interval(torch.ones(1))


def test_blocks_are_contiguous_in_time_and_at_least_four() -> None:
    times = torch.tensor([5.0, 0.0, 0.4, 0.9, 1.0, 5.3, 9.0, 20.0])
    assert time_blocks(times).tolist() == [2, 0, 0, 0, 1, 2, 3, 4]
    # Half a second of film: four blocks of nearly as many frames.
    times = torch.arange(10) / 20
    assert time_blocks(times).tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3]
    assert time_blocks(times.flip(0)).tolist() == [3, 3, 2, 2, 2, 1, 1, 0, 0, 0]
    assert time_blocks(torch.tensor([3.0, 3.1])).tolist() == [0, 1]
    assert time_blocks(torch.arange(60) / 10 + 7).unique().tolist() == list(range(6))


def test_the_block_bootstrap_is_wider_where_neighbours_err_together() -> None:
    generator = torch.Generator().manual_seed(0)
    blocks = torch.arange(12).repeat_interleave(8)
    shared = torch.randn(12, generator=generator)[blocks]
    alone = torch.randn(96, generator=generator)
    wide, narrow = block_interval(shared, blocks), block_interval(alone, blocks)
    assert wide is not None and narrow is not None
    assert wide.low < float(shared.mean()) < wide.high
    assert wide.mean == pytest.approx(float(shared.mean()))
    assert wide.high - wide.low > 1.8 * (narrow.high - narrow.low)
    # Frame by frame and block by block are the same where frames are independent.
    student = mean_interval(alone)
    assert (narrow.high - narrow.low) / (student.high - student.low) == pytest.approx(1, abs=0.5)
    assert block_interval(shared, blocks) == wide


def test_frames_without_a_figure_have_no_part_in_the_interval() -> None:
    samples = torch.tensor([1.0, 2.0, float("nan"), 4.0, float("nan")])
    blocks = torch.tensor([0, 0, 1, 2, 2])
    found = block_interval(samples, blocks)
    assert found is not None and found.mean == pytest.approx(7 / 3)
    # Two blocks drawn: twice the first, twice the last, or both.
    assert (found.low, found.high) == (1.5, 4.0)
    assert block_interval(samples[:3], blocks[:3]) is None
    assert block_interval(samples[2:3], blocks[2:3]) is None
