"""The share of a command that is done, the time that is left, the line and its JSON form."""

import io
import json
import sys

import pytest

from handavatar.jobs.progress import SILENT, Board, Progress, duration, shown_progress


class _Clock:
    """Seconds that pass when told."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def _board(stream: io.StringIO, clock: _Clock) -> Board:
    """Of a command that is begun now; shown when it is asked."""
    return Board("train", stream, clock)


def test_without_a_terminal_a_json_line_soon_and_then_every_eight_seconds() -> None:
    stream, clock = io.StringIO(), _Clock()
    board = _board(stream, clock)
    step = Progress(board).stages({"steps": 50.0})["steps"]
    for number in range(1, 51):
        clock.now += 0.5  # Two steps a second for 25 seconds.
        step(number, 100, psnr=20.0 + number / 10, loss=float("nan"))
        board.show()
    board.end(is_whole=False)
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["step"] for line in lines] == [8, 24, 40, 50]
    assert lines[1] == {
        "command": "train",
        "share": 0.24,
        "seconds_left": 38,
        "job": "steps",
        "step": 24,
        "total": 100,
        "steps_per_second": 2.0,
        "psnr": 22.4,
        "loss": None,
    }


def test_something_can_be_read_before_anything_is_told() -> None:
    stream, clock = io.StringIO(), _Clock()
    board = _board(stream, clock)
    clock.now = 9.0  # Imports last.
    board.show()
    line = json.loads(stream.getvalue())
    assert (line["command"], line["share"], line["seconds_left"]) == ("train", 0.0, None)


def test_a_short_command_that_tells_nothing_shows_nothing() -> None:
    stream, clock = io.StringIO(), _Clock()
    board = _board(stream, clock)
    clock.now = 1.0
    board.show()
    board.end()
    assert stream.getvalue() == ""


def test_the_time_left_is_that_of_the_whole_command() -> None:
    clock = _Clock()
    board = _board(io.StringIO(), clock)
    first, second = Progress(board).stages({"first": 10.0, "second": 30.0}).values()
    first(0.0)
    # Before anything is seen it is what it usually is.
    assert board.seconds_left == pytest.approx(40.0)
    # A machine half as fast: the second stage will take twice its time, too.
    clock.now = 10.0
    first(0.5)
    assert board.seconds_left == pytest.approx(10.0 + 60.0, rel=0.15)
    clock.now = 20.0
    first(1.0)
    assert board.seconds_left == pytest.approx(60.0, rel=0.15)
    # Within a stage its own speed counts, whatever the others' was.
    clock.now = 25.0
    second(0.5)
    assert board.seconds_left == pytest.approx(5.0, rel=0.15)
    second(1.0)
    board.end()
    assert board.record()["share"] == 1.0 and board.seconds_left == 0.0


def test_what_was_done_before_takes_no_time() -> None:
    clock = _Clock()
    board = _board(io.StringIO(), clock)
    first, second = Progress(board).stages({"first": 90.0, "second": 10.0}).values()
    first.skip()
    second.skip(50, 100)
    clock.now = 10.0
    second(60, 100)  # A step a second.
    assert board.record()["share"] == pytest.approx(0.96)
    assert board.steps_per_second == pytest.approx(1.0)
    assert board.seconds_left == pytest.approx(40.0)


def test_a_stage_of_which_nothing_was_told_takes_no_time() -> None:
    clock = _Clock()
    board = _board(io.StringIO(), clock)
    stages = Progress(board).stages({"first": 50.0, "left out": 40.0, "last": 10.0})
    clock.now = 50.0
    stages["first"](1.0)
    stages["last"](0.0)
    assert board.record()["share"] == pytest.approx(0.9)
    assert board.seconds_left == pytest.approx(10.0)


def test_parts_lie_within_the_whole() -> None:
    board = _board(io.StringIO(), _Clock())
    shares = []
    board.listeners.append(lambda state, _: shares.append(state["share"]))
    outer = Progress(board).stages({"a": 1.0, "b": 3.0})
    for part in outer["a"].equal_parts(2):
        part(1.0)
    for part in outer["b"].stages({"c": 1.0, "d": 2.0}).values():
        part(1, 2)
        part(2, 2)
    assert shares == pytest.approx([0.125, 0.25, 0.375, 0.5, 0.75, 1.0])


def test_a_stage_whose_first_steps_are_quicker_counts_all_of_them() -> None:
    board = _board(io.StringIO(), _Clock())
    states = []
    board.listeners.append(lambda state, is_new: states.append((state, is_new)))
    quick, slow = Progress(board).stages({"train": 1.0})["train"].split(8, 10, 4.0)
    quick(8, 8)
    slow(1, 2)
    assert [(state["job"], state["step"], state["total"]) for state, _ in states] == [
        ("train", 8, 10),
        ("train", 9, 10),
    ]
    assert [state["share"] for state, _ in states] == [0.5, 0.75]


def test_the_speed_is_that_of_the_last_half_minute() -> None:
    clock = _Clock()
    board = _board(io.StringIO(), clock)
    progress = Progress(board)
    for step in range(1, 101):  # Slow.
        clock.now += 1.0
        progress(step, 10**6)
    for step in range(101, 1001):  # Fast.
        clock.now += 0.1
        progress(step, 10**6)
    assert board.steps_per_second == pytest.approx(10.0, rel=0.02)


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_on_a_terminal_one_line_with_psnr_and_time_left() -> None:
    stream, clock = _Terminal(), _Clock()
    board = _board(stream, clock)
    stage = Progress(board).stages({"joint": 20.0})["joint"]
    clock.now += 10.0
    stage(50, 100, "second part", psnr=21.239)
    board.show()
    text = stream.getvalue()
    for part in ("train 50%", "joint 50/100", "5.0 steps/s", "PSNR 21.24 dB", "10 s left"):
        assert part in text
    # It is written over, until it ends.
    assert text.startswith("\x1b[2K") and text.endswith("\r")
    board.end()
    assert stream.getvalue().count("\n") == 1


def test_who_is_quiet_says_nothing_and_who_is_silent_costs_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with shown_progress("train", is_quiet=True) as progress, progress:
        progress(1, 2)
        assert progress.is_silent
    SILENT.stages({"first": 1.0})["first"](1, 2, loss=0.5)
    with SILENT.heard_by(lambda state, _: print(state["step"], file=sys.stdout)) as heard:
        heard(3, 4)
    captured = capsys.readouterr()
    assert captured.err == "" and captured.out.split() == ["3", "4"][:1]


def test_results_can_be_printed_as_soon_as_the_block_ends(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with shown_progress("evaluate") as progress:
        with progress:
            progress(1, 2)
        assert json.loads(capsys.readouterr().err)["share"] == 1.0
        print("result")
    captured = capsys.readouterr()
    assert captured.out == "result\n" and captured.err == ""


def test_who_reads_no_more_ends_nothing() -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    board = _board(Closed(), _Clock())
    Progress(board)(1, 2)
    board.end()


def test_durations_read_well() -> None:
    seconds = [0.4, 59.0, 60.0, 185.0, 3600.0, 7800.0, float("inf")]
    expected = ["0 s", "59 s", "1:00 min", "3:05 min", "1:00 h", "2:10 h", "?"]
    assert [duration(value) for value in seconds] == expected
