"""A share of a core: it is kept in the long run; what was saved can be spent at once."""

import pytest

from handavatar.view.share import Share


class Clocks:
    """Time that passes while a process computes or sleeps."""

    def __init__(self) -> None:
        self.now = self.own = self.slept = 0.0

    def compute(self, seconds: float) -> None:
        self.now += seconds
        self.own += seconds

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds
        self.slept += seconds

    def share(self, of_a_core: float) -> Share:
        return Share(of_a_core, lambda: self.now, lambda: self.own, self.sleep)


def never() -> bool:
    return False


def test_in_the_long_run_the_share_is_kept() -> None:
    clocks = Clocks()
    share = clocks.share(0.05)
    for work in (0.3, 0.002, 0.04, 1.5) * 20:
        clocks.compute(work)
        share.rest(never)
    assert clocks.own / clocks.now == pytest.approx(0.05, rel=0.02)


def test_others_who_take_the_core_are_no_work_of_its_own() -> None:
    clocks = Clocks()
    share = clocks.share(0.1)
    clocks.compute(0.1)
    clocks.now += 2.0
    share.rest(never)
    assert clocks.slept == 0


def test_half_a_second_at_most_is_saved_up() -> None:
    clocks = Clocks()
    share = clocks.share(0.05)
    share.rest(never)
    clocks.now += 1000
    clocks.compute(0.45)
    share.rest(never)
    assert clocks.slept == 0
    clocks.compute(0.25)
    share.rest(never)
    assert clocks.slept == pytest.approx((0.45 + 0.25 - 0.5) / 0.05, rel=0.2)


def test_who_is_not_wanted_any_more_rests_no_longer() -> None:
    clocks = Clocks()
    share = clocks.share(0.01)
    clocks.compute(5.0)
    share.rest(lambda: clocks.slept > 1)
    assert 1 < clocks.slept < 1.2
