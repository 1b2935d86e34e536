"""How far a command is: one line that rewrites itself, or JSON lines where nobody watches.

Every function that works for long takes a :class:`Progress` and tells it what is done; the command
line makes one for the whole command. A stage's weight is its usual duration; what the stages that
have ended really took corrects the time that is said to be left.

Everything goes to standard error, so that standard output stays free for results.
"""

import json
import math
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import TextIOBase
from types import TracebackType
from typing import IO, Any, cast

from handavatar.jobs.signals import stop_point

Listener = Callable[[dict[str, Any], bool], None]
"""Is told the state, as its JSON line has it, at every step; and whether a stage begins or ends."""

Number = int | float

_SPEED_WINDOW = 30.0
"""Seconds over which the speed of a stage's steps is averaged."""
_FIRST_LINE, _LINE_EVERY = 4.0, 8.0
"""Seconds until the first JSON line, and between two."""
_FIRST_DRAWN, _DRAWN_EVERY = 0.7, 0.25
"""Seconds until the line on a terminal, and between two drawings."""
_BELIEF = 0.03
"""Share of a command for which usual durations count as much as what was seen of it."""


class Progress:
    """How far a piece of work is, which may be a part of a larger one.

    Called with what is done. Each call is a stop point of the command
    (:func:`handavatar.jobs.signals.stop_point`).
    """

    def __init__(
        self,
        board: "Board | None" = None,
        first: float = 0.0,
        width: float = 1.0,
        job: str = "",
        counted: tuple[int, int] | None = None,
    ) -> None:
        """A span of the whole.

        Args:
            board: where it is shown; None shows nothing.
            first: share of the whole that lies before.
            width: share of the whole that this is.
            job: name of the stage.
            counted: steps of the stage that lie before, and all of them; None as it is told.
        """
        self._board, self._first, self._width, self._job = board, first, width, job
        self._counted = counted

    @property
    def is_silent(self) -> bool:
        """Whether nothing is shown."""
        return self._board is None or not self._board.is_shown

    def __enter__(self) -> "Progress":
        """For the whole command; see :meth:`__exit__`."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """As :meth:`end`."""
        self.end(is_whole=error is None)

    def end(self, is_whole: bool = True) -> None:
        """Leaves the last state standing; from then on, results can be printed.

        Args:
            is_whole: whether all is done.
        """
        if self._board is not None:
            self._board.end(is_whole)

    def __call__(
        self, done: Number, total: Number = 1.0, note: str = "", /, **figures: float
    ) -> None:
        """Says how much is done.

        Args:
            done: of ``total``; with one argument, the share in [0, 1].
            total: steps, frames or whatever is counted.
            note: what is being done now.
            figures: latest values to show, such as ``psnr`` in decibels; others stay as they were.

        Raises:
            Interrupted: if the command was told to stop.
        """
        if self._board is not None:
            share = self._share(done, total)
            self._board.tell(self._span(), share, self._count(done, total), note, figures)
        stop_point()

    def skip(self, done: Number = 1.0, total: Number = 1.0) -> None:
        """Says that so much had been done before, or is not to be done: it took no time."""
        if self._board is not None:
            self._board.skip(self._span(), self._share(done, total), self._count(done, total))

    def stages(self, seconds: Mapping[str, Number]) -> "dict[str, Progress]":
        """Divides the work into stages that follow one another.

        Args:
            seconds: usual duration of each on two cores; within a part, only their ratios count.
        """
        whole = float(sum(seconds.values())) or 1.0
        if self._board is not None and self._width == 1.0:
            self._board.expect(whole)
        found, first = {}, self._first
        for name, duration_of_stage in seconds.items():
            width = self._width * duration_of_stage / whole
            found[name] = Progress(self._board, first, width, name)
            first += width
        return found

    def equal_parts(self, count: int) -> "list[Progress]":
        """The stage in so many parts that follow one another.

        Args:
            count: of the parts.
        """
        width = self._width / max(count, 1)
        return [
            Progress(self._board, self._first + number * width, width, self._job)
            for number in range(count)
        ]

    def split(self, num_first: int, total: int, factor: float) -> "tuple[Progress, Progress]":
        """One stage whose first steps take another time than the others.

        Args:
            num_first: steps that are the first.
            total: steps of the stage.
            factor: by which one of the others takes longer.
        """
        seconds = num_first + factor * (total - num_first)
        width = self._width * (num_first / seconds if seconds else 0.0)
        rest = self._first + width
        return (
            Progress(self._board, self._first, width, self._job, (0, total)),
            Progress(self._board, rest, self._width - width, self._job, (num_first, total)),
        )

    @contextmanager
    def heard_by(self, listener: Listener) -> "Iterator[Progress]":
        """The same, and as long as the block lasts a listener is told the states, too."""
        board = self._board or Board("")
        board.listeners.append(listener)
        try:
            yield Progress(board, self._first, self._width, self._job, self._counted)
        finally:
            board.listeners.remove(listener)

    def _count(self, done: Number, total: Number) -> tuple[Number, Number]:
        return (
            (done, total) if self._counted is None else (self._counted[0] + done, self._counted[1])
        )

    def _span(self) -> tuple[str, float, float]:
        return self._job, self._first, self._width

    def _share(self, done: Number, total: Number) -> float:
        return self._first + self._width * min(max(done / total, 0.0), 1.0) if total else 1.0


SILENT = Progress()
"""Shows nothing."""


class Board:
    """Where a command's progress comes together; its own thread shows it."""

    def __init__(
        self,
        command: str,
        stream: TextIOBase | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Starts the clock.

        Args:
            command: what is being done, such as ``train``.
            stream: where to show it; None shows it nowhere.
            clock: seconds, ever growing.
        """
        self.listeners: list[Listener] = []
        self._command = command
        self._stream = cast(IO[str] | None, stream)
        self._clock = clock
        self._lock = threading.RLock()
        self._begin = self._last_told = clock()
        self._expected = math.nan
        self._share = self._skipped = 0.0
        self._span = ("", 0.0, 0.0)
        self._span_begin, self._span_share = self._begin, 0.0
        self._counted: tuple[Number, Number] = (0.0, 1.0)
        self._marks: deque[tuple[float, Number]] = deque([(self._begin, 0.0)])
        self._note = ""
        self._figures: dict[str, float] = {}
        self._has_told = self._has_ended = False
        self._is_terminal = stream is not None and stream.isatty()
        self._has_drawn = False
        self._next = self._begin + (_FIRST_DRAWN if self._is_terminal else _FIRST_LINE)
        self._woken = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_shown(self) -> bool:
        """Whether it is shown somewhere, or was until it ended."""
        return self._stream is not None

    def start(self) -> None:
        """Shows it from now on, whether or not something is told."""
        if self._stream is not None:
            self._thread = threading.Thread(target=self._keep_showing, daemon=True)
            self._thread.start()

    def expect(self, seconds: Number) -> None:
        """How long the whole usually takes."""
        with self._lock:
            self._expected = seconds

    def tell(
        self,
        span: tuple[str, float, float],
        share: float,
        counted: tuple[Number, Number],
        note: str,
        figures: Mapping[str, float],
    ) -> None:
        """Takes note of how far it is."""
        with self._lock:
            is_new = self._enter(span)
            self._share, self._counted, self._note = share, counted, note
            self._figures.update(figures)
            self._has_told = True
            now = self._clock()
            self._last_told = now
            self._marks.append((now, counted[0]))
            while len(self._marks) > 2 and self._marks[0][0] < now - _SPEED_WINDOW:
                self._marks.popleft()
        for listener in self.listeners:
            listener(self.record(), is_new or counted[0] >= counted[1])

    def skip(
        self, span: tuple[str, float, float], share: float, counted: tuple[Number, Number]
    ) -> None:
        """Takes note of what takes no time."""
        with self._lock:
            is_new = self._enter(span)
            self._skipped += max(share - self._share, 0.0)
            self._share = self._span_share = share
            self._counted = counted
            self._last_told = self._clock()
            self._marks.clear()
            self._marks.append((self._last_told, counted[0]))
        for listener in self.listeners:
            listener(self.record(), is_new)

    def _enter(self, span: tuple[str, float, float]) -> bool:
        """Begins another stage; what was left out of those before took no time."""
        if span == self._span:
            return False
        is_same_job = span[0] == self._span[0]
        now = self._last_told  # What came since then belongs to it, too.
        self._skipped += max(span[1] - max(self._share, self._span[1] + self._span[2]), 0.0)
        self._span, self._span_begin, self._span_share = span, now, span[1]
        self._marks.clear()
        if not is_same_job:
            self._figures, self._note = {}, ""
            self._marks.append((now, 0.0))
        return not is_same_job

    @property
    def steps_per_second(self) -> float:
        """Of the stage, in the last half minute; zero before the first step."""
        if not self._marks:
            return 0.0
        (begin, first), (end, last) = self._marks[0], self._marks[-1]
        return (last - first) / (end - begin) if end > begin else 0.0

    @property
    def seconds_left(self) -> float:
        """Of the whole; infinity where nothing is known of it.

        The stage ends at its own speed. What comes after it takes its usual time, longer or shorter
        by what was seen of this machine until now.
        """
        now = self._clock()
        remaining = max(1.0 - self._share, 0.0)
        if remaining == 0.0 or self._has_ended:
            return 0.0
        done, seconds = self._share - self._skipped, now - self._begin
        if math.isfinite(self._expected):
            done, seconds = done + _BELIEF, seconds + _BELIEF * self._expected
        whole = done / seconds if seconds > 0 else 0.0
        own, own_seconds = self._share - self._span_share, now - self._span_begin
        within = min(max(self._span[1] + self._span[2] - self._share, 0.0), remaining)
        if not self._span[2]:
            within = 0.0
        speed = own / own_seconds if own > 0 and own_seconds > 0 else whole
        if whole <= 0 or speed <= 0:
            return math.inf
        return within / speed + (remaining - within) / whole

    def record(self) -> dict[str, Any]:
        """The state as JSON."""
        with self._lock:
            done, total = self._counted
            if total == 1.0 and isinstance(total, float):
                done, total = 100 * done, 100
            left = self.seconds_left
            record: dict[str, Any] = {
                "command": self._command,
                "share": round(self._share, 4),
                "seconds_left": round(left) if math.isfinite(left) else None,
                "job": self._span[0] or self._command,
                "step": round(done),
                "total": round(total),
                "steps_per_second": round(self.steps_per_second, 3),
            }
            if self._note:
                record["note"] = self._note
            for name, value in self._figures.items():
                record[name] = round(value, 4) if math.isfinite(value) else None
            return record

    def text(self) -> str:
        """The state as a line."""
        with self._lock:
            done, total = self._counted
            parts = [f"{self._command} {self._share:.0%}"]
            if self._span[0]:
                counts = total != 1.0 or not isinstance(total, float)
                parts.append(f"{self._span[0]} {done:.0f}/{total:.0f}" if counts else self._span[0])
                if counts and self.steps_per_second > 0:
                    parts.append(f"{self.steps_per_second:.1f} steps/s")
            parts += [_figure(name, value) for name, value in self._figures.items()]
            if self._has_told:
                parts.append(f"{duration(self.seconds_left)} left")
            parts += [self._note] if self._note else []
            return "   ".join(parts)

    def show(self) -> None:
        """Shows the state, if it is time to; asked by the thread again and again."""
        now = self._clock()
        if self._stream is None or now < self._next:
            return
        if self._is_terminal:
            self._next = now + _DRAWN_EVERY
            self._draw()
        else:
            self._next = now + _LINE_EVERY
            self._write_line()

    def end(self, is_whole: bool = True) -> None:
        """Shows the last state, if anything was told, and nothing from then on."""
        with self._lock:
            if self._has_ended:
                return
            if is_whole:
                self._share = 1.0
            self._woken.set()
        if self._thread is not None:
            self._thread.join()
        try:
            if self._stream is None or not (self._has_told or self._has_drawn):
                pass
            elif self._is_terminal:
                self._draw("\n")
            else:
                self._write_line()
        except (OSError, ValueError):  # Standard error is closed: nobody reads.
            self._stream = None
        self._has_ended = True
        for listener in self.listeners:
            listener(self.record(), True)

    def _keep_showing(self) -> None:
        try:
            while not self._woken.wait(max(self._next - self._clock(), 0.02)):
                self.show()
        except (OSError, ValueError):  # Standard error is closed: nobody reads.
            self._stream = None

    def _draw(self, end: str = "\r") -> None:
        # The next drawing, or what others write, begins at the left again.
        assert self._stream is not None
        width = shutil.get_terminal_size().columns - 1
        self._stream.write("\x1b[2K" + self.text()[:width] + end)
        self._stream.flush()
        self._has_drawn = True

    def _write_line(self) -> None:
        # In one piece: others may write lines from another thread.
        assert self._stream is not None
        self._stream.write(json.dumps(self.record()) + "\n")
        self._stream.flush()


@contextmanager
def shown_progress(command: str, is_quiet: bool = False) -> Iterator[Progress]:
    """A command's progress on standard error, from its beginning to its end.

    Args:
        command: its name.
        is_quiet: shows nothing.
    """
    board = Board(command, None if is_quiet else cast(TextIOBase, sys.stderr))
    board.start()
    is_whole = False
    try:
        yield Progress(board)
        is_whole = True
    finally:
        board.end(is_whole)


def duration(seconds: Number) -> str:
    """``45 s``, ``3:05 min`` or ``2:10 h``; ``?`` if it is not known."""
    if not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


def _figure(name: str, value: float) -> str:
    return f"PSNR {value:.2f} dB" if name == "psnr" else f"{name} {value:.4g}"
