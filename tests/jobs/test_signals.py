"""Being told to stop: at stop points, within seconds, and once more at once."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest
import torch

from handavatar.jobs import signals
from handavatar.jobs.progress import SILENT
from handavatar.jobs.signals import (
    INTERRUPTED,
    Interrupted,
    awaited_signals,
    heard_signals,
    is_stopping,
    stop_point,
    unbroken,
)
from handavatar.jobs.threads import mapped

BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    """All handlers are afterwards what they were."""
    watched = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    before = [signal.getsignal(number) for number in watched]
    yield
    assert [signal.getsignal(number) for number in watched] == before


def _tell(number: int = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


@BOTH
def test_the_work_ends_at_its_next_stop_point_and_this_is_said_at_once(
    number: int, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(Interrupted), heard_signals():
        stop_point()
        assert not is_stopping()
        _tell(number)
        assert is_stopping()
        assert signal.Signals(number).name in capfd.readouterr().err
        stop_point()
    stop_point()  # It is over.


def test_to_tell_how_far_it_is_is_a_stop_point() -> None:
    with pytest.raises(Interrupted), heard_signals():
        _tell()
        SILENT(1, 2)


def test_what_must_not_be_broken_off_ends_before() -> None:
    done = []
    with pytest.raises(Interrupted), heard_signals():
        with unbroken():
            _tell()
            stop_point()
            done.append("step")
        stop_point()
    assert done == ["step"]


def test_where_no_stop_point_is_it_is_interrupted_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signals, "_PATIENCE", 0.1)
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt) as stopped, heard_signals():
        _tell()
        time.sleep(30)
    assert not isinstance(stopped.value, Interrupted) and time.monotonic() - begin < 20
    with pytest.raises(KeyboardInterrupt), heard_signals():
        with unbroken():
            _tell()
            time.sleep(0.3)
            done = True
        time.sleep(30)
    assert done


def test_who_is_heard_already_is_heard_once() -> None:
    with pytest.raises(Interrupted), heard_signals():
        with heard_signals():
            _tell()
        stop_point()


@pytest.mark.parametrize("count", [1, 3])
def test_pieces_on_several_threads_are_not_begun_any_more(count: int) -> None:
    begun: list[int] = []

    def work(number: int) -> torch.Tensor:
        begun.append(number)
        if number == 2:
            _tell()
        time.sleep(0.01)
        return torch.zeros(1)

    with pytest.raises(Interrupted), heard_signals():
        mapped(work, range(200), count)
    assert len(begun) < 100


def test_work_of_another_thread_goes_on() -> None:
    """A page goes on answering while the training beside it stops."""
    found: list[list[int]] = []
    with pytest.raises(Interrupted), heard_signals():
        _tell()
        other = threading.Thread(target=lambda: found.append(mapped(abs, [-1, -2, -3], 2)))
        other.start()
        other.join()
        stop_point()
    assert found == [[1, 2, 3]]


def test_a_server_asks_and_what_comes_after_it_goes_on() -> None:
    with heard_signals():
        with awaited_signals() as is_stopped:
            assert not is_stopped()
            _tell()
            assert is_stopped()
            stop_point()
        stop_point()
        with awaited_signals() as is_stopped:
            assert not is_stopped()


def _run(code: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", f"import time\nfrom handavatar.jobs import signals\n{code}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@BOTH
def test_a_second_signal_kills(number: int) -> None:
    process = _run(
        "with signals.heard_signals():\n"
        "    with signals.unbroken():\n"
        "        print('begun', flush=True)\n"
        "        time.sleep(60)\n"
    )
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    assert process.stderr is not None
    process.send_signal(number)
    assert "once more" in process.stderr.readline()
    process.send_signal(number)
    process.communicate(timeout=30)
    assert process.returncode == -number


@BOTH
def test_before_anything_is_begun_the_first_one_ends_the_process(number: int) -> None:
    process = _run(
        "with signals.heard_signals(ends_at_once=True):\n"
        "    print('importing', flush=True)\n"
        "    while True:\n"
        "        try:\n"
        "            time.sleep(60)\n"
        "        except BaseException:\n"  # Some imports swallow what is raised in them.
        "            pass\n"
    )
    assert process.stdout is not None and process.stdout.readline() == "importing\n"
    process.send_signal(number)
    _, told = process.communicate(timeout=30)
    assert process.returncode == INTERRUPTED and "nothing was begun" in told
