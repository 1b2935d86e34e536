"""Confidence intervals against scipy, and what they promise."""

import pytest
import torch
from scipy import stats

from handavatar.evaluate.intervals import mean_interval


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
