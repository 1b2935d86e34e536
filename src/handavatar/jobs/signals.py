"""Being told to stop: SIGINT (Ctrl-C) and SIGTERM (a scheduler), heard in one place.

The first signal is a wish. It is answered at once on standard error, and the work ends at its next
stop point, with :class:`Interrupted`: who catches that saves what there is. Where no stop point is
come by within some more than a second, the main thread is interrupted as by Python itself. The
second signal kills at once. Before the first stop point, as long as imports last and nothing has
been begun, the first one ends the process, too.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

INTERRUPTED = 130
"""Exit code of a process that was told to stop."""
_WATCHED = (signal.SIGINT, signal.SIGTERM)
_PATIENCE = 1.2
"""Seconds within which a stop point should be come by."""
_AGAIN = 0.1
"""Seconds after which it is tried again, where something must not be broken off."""


class Interrupted(KeyboardInterrupt):
    """The work was told to stop and has done so, at a place where its state is whole."""


@dataclass
class _Listening:
    """While signals are heard.

    Attributes:
        ends_at_once: nothing is begun yet, so that nothing can be saved.
        received: whether a first signal has come.
        is_awaited: somebody asks again and again whether it has; nobody needs to be interrupted.
        num_unbroken: blocks that are to be ended before.
    """

    ends_at_once: bool
    received: bool = False
    is_awaited: bool = False
    num_unbroken: int = 0


_listening: _Listening | None = None
_thread = threading.local()


@contextmanager
def heard_signals(ends_at_once: bool = False) -> Iterator[None]:
    """As long as the block lasts, SIGINT and SIGTERM are heard here.

    Who is heard already, or is not the main thread, changes nothing.

    Args:
        ends_at_once: a signal before the first stop point ends the process.
    """
    global _listening
    if _listening is not None or threading.current_thread() is not threading.main_thread():
        yield
        return
    _listening = _Listening(ends_at_once)
    before = [signal.signal(number, _hear) for number in _WATCHED]
    alarm = signal.signal(signal.SIGALRM, _interrupt) if hasattr(signal, "SIGALRM") else None
    try:
        yield
    finally:
        _set_alarm(0.0)
        _listening = None
        for number, handler in zip(_WATCHED, before, strict=True):
            signal.signal(number, handler)
        if alarm is not None:
            signal.signal(signal.SIGALRM, alarm)


@contextmanager
def awaited_signals() -> Iterator[Callable[[], bool]]:
    """Whether a signal has come, as long as the block lasts; for the main thread, which asks.

    For what has nothing to save, such as a server. Afterwards the signal is forgotten.
    """
    with heard_signals():
        listening = _listening
        if listening is None or threading.current_thread() is not threading.main_thread():
            yield lambda: False
            return
        listening.ends_at_once, listening.is_awaited = False, True
        try:
            yield lambda: listening.received
        finally:
            listening.is_awaited = listening.received = False
            for number in _WATCHED:
                signal.signal(number, _hear)


def stop_point() -> None:
    """A place where the work can be broken off.

    Raises:
        Interrupted: if a signal has come, and this is the thread that heeds it.
    """
    listening = _listening
    if listening is None:
        return
    if listening.ends_at_once and threading.current_thread() is threading.main_thread():
        listening.ends_at_once = False
    if listening.received and not listening.is_awaited and not listening.num_unbroken and heeds():
        _set_alarm(0.0)
        raise Interrupted


def is_stopping() -> bool:
    """Whether a signal has come that this thread heeds: for who stops by agreement with others."""
    listening = _listening
    return listening is not None and listening.received and not listening.is_awaited and heeds()


@contextmanager
def unbroken() -> Iterator[None]:
    """What must not be broken off, such as one step of an optimiser, or the saving itself.

    Inside there are no stop points.
    """
    listening = _listening
    if listening is None or not heeds():
        yield
        return
    listening.num_unbroken += 1
    try:
        yield
    finally:
        listening.num_unbroken -= 1


def heeds() -> bool:
    """Whether this thread's work is what a signal stops: the main thread's, unless it was said."""
    said: bool | None = getattr(_thread, "heeds", None)
    return threading.current_thread() is threading.main_thread() if said is None else said


def heed(does_heed: bool) -> None:
    """Says whether this thread's work is what a signal stops.

    Args:
        does_heed: as :func:`heeds` of the thread whose work this one does.
    """
    _thread.heeds = does_heed


def _hear(number: int, _: FrameType | None) -> None:
    listening = _listening
    if listening is None:
        return
    listening.received = True
    for watched in _WATCHED:  # The second one kills.
        signal.signal(watched, signal.SIG_DFL)
    if listening.is_awaited:
        return
    name = signal.Signals(number).name
    if listening.ends_at_once:
        _say(f"handavatar: {name}: nothing was begun")
        os._exit(INTERRUPTED)
    _say(f"handavatar: {name}: it stops and saves; once more ends it at once")
    _set_alarm(_PATIENCE)


def _interrupt(number: int, _: FrameType | None) -> None:
    """Where no stop point was come by."""
    listening = _listening
    if listening is None or not listening.received or listening.is_awaited:
        return
    if listening.num_unbroken:
        _set_alarm(_AGAIN)
        return
    raise KeyboardInterrupt


def _set_alarm(seconds: float) -> None:
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _say(text: str) -> None:
    # Not by sys.stderr, in the middle of whose work this may happen.
    try:
        os.write(2, f"\n{text}\n".encode() if os.isatty(2) else f"{text}\n".encode())
    except OSError:
        return
