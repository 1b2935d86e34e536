"""Stages are timed by a clock that the test turns."""

import pytest

from handavatar.train.stage_times import StageTimes


def test_shares_of_the_time_sum_to_one() -> None:
    now = [0.0]
    times = StageTimes(lambda: now[0])
    for seconds in (1.0, 2.0):
        with times.stage("labels"):
            now[0] += seconds
        now[0] += 0.5
    with pytest.raises(ZeroDivisionError), times.stage("decode"):
        now[0] += 1.0
        raise ZeroDivisionError
    assert times.seconds == 5.0
    assert times.shares() == pytest.approx({"labels": 0.6, "decode": 0.2, "other": 0.2})
