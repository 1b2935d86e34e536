"""The live line and its JSON form."""

import io
import json

import pytest

from handavatar.train.progress import Progress, StagedProgress, duration


class _Clock:
    """Seconds that pass when told."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_without_a_terminal_one_json_line_every_ten_seconds() -> None:
    stream, clock = io.StringIO(), _Clock()
    with Progress("train", 100, stream=stream, clock=clock) as progress:
        for step in range(1, 51):
            clock.now += 0.5  # two steps a second for 25 seconds
            progress.update(step, psnr=20.0 + step / 10, loss=float("nan"))
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["step"] for line in lines] == [20, 40, 50]
    assert lines[0] == {
        "job": "train",
        "step": 20,
        "total": 100,
        "steps_per_second": 2.0,
        "seconds_left": 40,
        "psnr": 22.0,
        "loss": None,
    }


def test_the_time_left_of_a_resumed_job_counts_only_its_own_steps() -> None:
    clock = _Clock()
    progress = Progress("train", 1000, done=900, stream=io.StringIO(), clock=clock)
    clock.now = 10.0
    progress.update(910)
    assert progress.steps_per_second == pytest.approx(1.0)
    assert progress.seconds_left == pytest.approx(90.0)


def test_the_speed_is_that_of_the_last_half_minute() -> None:
    clock = _Clock()
    progress = Progress("train", 10**6, stream=io.StringIO(), clock=clock)
    for step in range(1, 101):  # slow
        clock.now += 1.0
        progress.update(step)
    for step in range(101, 1001):  # fast
        clock.now += 0.1
        progress.update(step)
    assert progress.steps_per_second == pytest.approx(10.0, rel=0.02)


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_on_a_terminal_one_line_with_psnr_and_time_left() -> None:
    stream, clock = _Terminal(), _Clock()
    with Progress("train", 100, stream=stream, clock=clock) as progress:
        clock.now += 10.0
        progress.update(50, "second stage", psnr=21.239)
    text = stream.getvalue()
    for part in ("train 50/100", "5.0 steps/s", "PSNR 21.24 dB", "10 s left", "second stage"):
        assert part in text


def test_durations_read_well() -> None:
    seconds = [0.4, 59.0, 60.0, 185.0, 3600.0, 7800.0, float("inf")]
    expected = ["0 s", "59 s", "1:00 min", "3:05 min", "1:00 h", "2:10 h", "?"]
    assert [duration(value) for value in seconds] == expected


def test_stages_follow_one_another(capsys: pytest.CaptureFixture[str]) -> None:
    with StagedProgress() as progress:
        for job, total in (("fields", 3), ("network", 2)):
            for step in range(total):
                progress(job, step + 1, total)
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [(line["job"], line["step"], line["total"]) for line in lines] == [
        ("fields", 3, 3),
        ("network", 2, 2),
    ]
