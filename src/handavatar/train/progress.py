"""How far a long piece of work has come: a live line, or JSON lines where nobody watches.

Everything goes to standard error, so that standard output stays free for results.
"""

import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from io import TextIOBase
from types import TracebackType
from typing import IO, Any, cast

from rich.console import Console
from rich.live import Live
from rich.text import Text

_SPEED_WINDOW = 30.0
"""Seconds over which the speed is averaged."""
_LINE_EVERY = 10.0
"""Seconds between JSON lines; the live line is drawn four times a second."""

Listener = Callable[[dict[str, Any], bool], None]
"""Is told a job's state, as its JSON line has it, at every step; and whether it begins or ends."""
_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def told_to(listener: Listener) -> Iterator[None]:
    """While it lasts, all progress of this thread is told to a listener, too.

    As with standard error, the jobs need not know who reads.
    """
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


class Progress:
    """Reports steps of one job; used in a ``with`` block.

    On a terminal one line that rewrites itself: step/total, steps/s, PSNR, time left. Elsewhere
    one JSON object every ten seconds, and one at the end.
    """

    def __init__(
        self,
        job: str,
        total: int,
        done: int = 0,
        stream: TextIOBase | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Starts the clock.

        Args:
            job: what is being done, such as ``train``.
            total: number of steps.
            done: steps done before, by the run that is being continued.
            stream: where to write; standard error by default.
            clock: seconds, ever growing.
        """
        self._job, self._total, self._step = job, total, done
        self._stream = cast(IO[str], stream or sys.stderr)
        self._clock = clock
        self._marks: deque[tuple[float, int]] = deque([(clock(), done)])
        self._figures: dict[str, float] = {}
        self._note = ""
        self._last_line = clock()
        self._live: Live | None = None

    def __enter__(self) -> "Progress":
        """Shows the line."""
        if self._stream.isatty():
            console = Console(file=self._stream)
            self._live = Live(self._text(), console=console, refresh_per_second=4, transient=False)
            self._live.start()
        self._tell(True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leaves the last state standing."""
        if self._live is not None:
            self._live.update(self._text())
            self._live.stop()
        else:
            self._write_line()
        self._tell(True)

    def update(self, step: int, note: str = "", /, **figures: float) -> None:
        """Says that ``step`` steps are done.

        Args:
            step: steps done, counted from the beginning of the whole job.
            note: what is being done now, if the job has several stages.
            figures: latest values to show, such as ``psnr`` in decibels; others stay as they were.
        """
        now = self._clock()
        self._step, self._note = step, note
        self._figures.update(figures)
        self._marks.append((now, step))
        while len(self._marks) > 2 and self._marks[0][0] < now - _SPEED_WINDOW:
            self._marks.popleft()
        if self._live is not None:
            self._live.update(self._text())
        elif now - self._last_line >= _LINE_EVERY:
            self._last_line = now
            self._write_line()
        self._tell(False)

    @property
    def steps_per_second(self) -> float:
        """Speed of the last half minute; zero before the first step."""
        (begin, first), (end, last) = self._marks[0], self._marks[-1]
        return (last - first) / (end - begin) if end > begin else 0.0

    @property
    def seconds_left(self) -> float:
        """At the present speed; infinity before the first step."""
        remaining, speed = self._total - self._step, self.steps_per_second
        return remaining / speed if speed > 0 else (math.inf if remaining else 0.0)

    def _text(self) -> Text:
        parts = [f"{self._job} {self._step}/{self._total}", f"{self.steps_per_second:.1f} steps/s"]
        parts += [_figure(name, value) for name, value in self._figures.items()]
        parts.append(f"{duration(self.seconds_left)} left")
        parts += [self._note] if self._note else []
        return Text("   ".join(parts), no_wrap=True, overflow="ellipsis")

    def _tell(self, is_turning_point: bool) -> None:
        if (listener := _LISTENER.get()) is not None:
            listener(self._record(), is_turning_point)

    def _write_line(self) -> None:
        # In one piece: others may write lines from another thread.
        self._stream.write(json.dumps(self._record()) + "\n")
        self._stream.flush()

    def _record(self) -> dict[str, Any]:
        record: dict[str, Any] = {
            "job": self._job,
            "step": self._step,
            "total": self._total,
            "steps_per_second": round(self.steps_per_second, 3),
            "seconds_left": round(self.seconds_left) if math.isfinite(self.seconds_left) else None,
        }
        if self._note:
            record["note"] = self._note
        for name, value in self._figures.items():
            record[name] = round(value, 4) if math.isfinite(value) else None
        return record


class StagedProgress:
    """Work whose stages follow one another, each with a :class:`Progress`; in a ``with`` block."""

    def __init__(self) -> None:
        """No stage has begun."""
        self._job = ""
        self._progress: Progress | None = None

    def __enter__(self) -> "StagedProgress":
        """Shows nothing yet."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leaves the last state of the last stage standing."""
        if self._progress is not None:
            self._progress.__exit__(kind, error, traceback)

    def __call__(self, job: str, step: int, total: int) -> None:
        """Says that ``step`` of ``total`` steps are done; another name begins another stage."""
        if self._progress is None or job != self._job:
            self.__exit__(None, None, None)
            self._job, self._progress = job, Progress(job, total).__enter__()
        self._progress.update(step)


def duration(seconds: float) -> str:
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
