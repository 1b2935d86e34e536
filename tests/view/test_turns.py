"""The newest wish of a client is what is made; nobody waits for a stranger's old wishes."""

import threading
import time

import pytest
from patience import PATIENCE

from handavatar.view.share import Share
from handavatar.view.turns import Busy, Job, Overtaken, Turns


def nothing() -> None:
    pass


@pytest.fixture
def turns():  # type: ignore[no-untyped-def]
    made = Turns({"fluid": nothing, "field": nothing}, most_waiting=4)
    yield made
    made.close()


class Slow:
    """Work that lasts until it is stale or let go."""

    def __init__(self) -> None:
        self.begun = threading.Event()
        self.go = threading.Event()

    def __call__(self, job: Job) -> str:
        self.begun.set()
        while not job.is_stale() and not self.go.wait(0.005):
            pass
        return f"{job.client} {job.order}"


def test_jobs_are_done_and_give_what_they_made_or_raised(turns: Turns) -> None:
    assert turns.submit("fluid", "a", 1, lambda job: job.order * 2).result() == 2
    with pytest.raises(ZeroDivisionError):
        turns.submit("fluid", "a", 2, lambda job: 1 // 0).result()
    # The lane goes on.
    assert turns.submit("fluid", "a", 3, lambda job: "on").result() == "on"


def test_a_newer_wish_ends_the_older_ones_in_all_lanes(turns: Turns) -> None:
    slow = Slow()
    running = turns.submit("field", "a", 1, slow)
    assert slow.begun.wait(PATIENCE)
    begin = time.monotonic()
    newer = turns.submit("fluid", "a", 2, lambda job: "newest")
    assert newer.result() == "newest"
    with pytest.raises(Overtaken):
        running.result()
    assert time.monotonic() - begin < 2
    with pytest.raises(Overtaken):
        turns.submit("field", "a", 1, slow)


def test_of_many_wishes_that_wait_only_the_newest_is_made(turns: Turns) -> None:
    slow, made = Slow(), []
    turns.submit("field", "other", 1, slow)
    assert slow.begun.wait(PATIENCE)

    def note(job: Job) -> int:
        made.append(job.order)
        return job.order

    jobs = [turns.submit("field", "a", order, note) for order in range(1, 100)]
    slow.go.set()
    assert jobs[-1].result() == 99 and made == [99]
    for job in jobs[:-1]:
        with pytest.raises(Overtaken):
            job.result()


def test_one_client_does_not_end_anothers_wishes(turns: Turns) -> None:
    slow = Slow()
    first = turns.submit("field", "a", 1, slow)
    assert slow.begun.wait(PATIENCE)
    for order in range(50):
        assert turns.submit("fluid", "b", order, lambda job: job.order).result() == order
    assert not first.is_stale()
    slow.go.set()
    assert first.result() == "a 1"


def test_clients_take_turns(turns: Turns) -> None:
    slow, made = Slow(), []
    turns.submit("field", "first", 1, slow)
    assert slow.begun.wait(PATIENCE)
    jobs = []
    for order in (1, 2, 3):
        for client in "abc":
            jobs.append(turns.submit("field", client, order, lambda job: made.append(job.client)))
    slow.go.set()
    for job in jobs[-3:]:
        job.result()
    assert made == ["a", "b", "c"]


def test_too_many_that_wait_are_sent_away(turns: Turns) -> None:
    slow = Slow()
    turns.submit("field", "first", 1, slow)
    assert slow.begun.wait(PATIENCE)
    waiting = [turns.submit("field", f"{n}", 1, lambda job: job.client) for n in range(4)]
    with pytest.raises(Busy):
        turns.submit("field", "one more", 1, lambda job: None)
    # Who waits already may change its mind.
    changed = turns.submit("field", "3", 2, lambda job: "changed")
    slow.go.set()
    assert changed.result() == "changed" and [job.result() for job in waiting[:3]] == [*"012"]


def test_a_dropped_job_is_not_begun_and_a_closed_house_takes_none() -> None:
    turns = Turns({"field": nothing})
    slow = Slow()
    running = turns.submit("field", "a", 1, slow)
    assert slow.begun.wait(PATIENCE)
    waiting = turns.submit("field", "b", 1, lambda job: pytest.fail("it was begun"))
    waiting.drop()
    turns.close()
    for job in (running, waiting):
        with pytest.raises(Overtaken):
            job.result()
    with pytest.raises(Overtaken):
        turns.submit("field", "c", 1, lambda job: None)


def test_what_is_remembered_of_clients_is_bounded(turns: Turns) -> None:
    for n in range(3000):
        turns.submit("fluid", f"{n}", 1, lambda job: None).result()
    assert len(turns._newest) <= 1024


@pytest.mark.slow
def test_lanes_that_must_keep_to_a_share_rest_in_their_work_and_between() -> None:
    turns = Turns({"field": nothing}, share=Share(0.2))
    begin, own = time.monotonic(), time.process_time()

    def compute(job: Job) -> None:
        for _ in range(10):
            end = time.thread_time() + 0.01
            while time.thread_time() < end:
                pass
            assert not job.is_to_end()

    try:
        for order in range(1, 9):
            turns.submit("field", "a", order, compute).result()
        # The last job's last piece of work is rested for after it.
        assert time.monotonic() - begin > (time.process_time() - own - 0.02) / 0.2
    finally:
        turns.close()


def test_rest_ends_with_the_wish_and_with_the_lanes() -> None:
    turns = Turns({"field": nothing}, share=Share(0.001))

    def greedy(job: Job) -> None:
        end = time.thread_time() + 0.2
        while time.thread_time() < end:
            pass
        while not job.is_to_end():
            pass

    running = turns.submit("field", "a", 1, greedy)
    time.sleep(0.5)
    turns.submit("field", "a", 2, lambda job: None)
    with pytest.raises(Overtaken):
        running.result()
    begin = time.monotonic()
    turns.close()
    assert time.monotonic() - begin < 2
