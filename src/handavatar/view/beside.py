"""A page beside a training: a process of its own, so that nothing it does can end the training."""

import multiprocessing
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from handavatar.avatar import HandAvatar
from handavatar.jobs.signals import awaited_signals
from handavatar.view.server import ViewServer, checked_guard, greeting, keep_serving, serving
from handavatar.view.studio import Studio
from handavatar.view.training import Watch

_DEFAULT_OUT = Path("edited")
_LOOK_EVERY = 0.2
"""Seconds between two looks whether to end."""
_PATIENCE = 10.0
"""Seconds for a page to end by itself."""


@dataclass(frozen=True)
class PageOptions:
    """Where the page of a training is.

    Attributes:
        run: folder of the run, which need not be there yet.
        port: of the page; if it is taken, the next free one.
        host: where to listen.
        token: who does not know it is not served; beyond this machine one is made.
    """

    run: Path
    port: int
    host: str
    token: str


class Beside:
    """The process, as the training sees it."""

    def __init__(self, process: multiprocessing.process.BaseProcess) -> None:
        """Of a process that was started."""
        self._process = process
        self.is_closing = False

    def stay(self) -> None:
        """Waits until the page's process ends, or this one is told to stop."""
        if self._process.is_alive():
            print("the page goes over to the avatar; Ctrl-C ends it", file=sys.stderr, flush=True)
        # Noted, not raised: where a shell has begun this in the background, Ctrl-C is ignored else.
        with awaited_signals() as is_stopped:
            while self._process.is_alive() and not is_stopped():
                self._process.join(_LOOK_EVERY)


@contextmanager
def page_beside(options: PageOptions) -> Iterator[Beside]:
    """A page on a run's training, as long as the block lasts, or until the page's process ends.

    What it has to say goes to standard error.

    Raises:
        ValueError: for a port or token that cannot be.
    """
    checked_guard(options.host, options.port, options.token)
    # Spawned, not forked: a fork would start with this process's threads' locks.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(options, theirs), name="page", daemon=True)
    process.start()
    theirs.close()
    beside = Beside(process)
    teller = threading.Thread(target=_tell, args=(beside, process, ours), daemon=True)
    teller.start()
    try:
        yield beside
    finally:
        beside.is_closing = True
        process.terminate()
        process.join(_PATIENCE)
        process.kill()  # One that hangs, or was halted.
        process.join()
        teller.join()


def _tell(beside: Beside, process: multiprocessing.process.BaseProcess, lines: Connection) -> None:
    with suppress(EOFError):
        while True:
            # In one piece: the training's progress goes the same way, from another thread.
            sys.stderr.write(lines.recv_bytes().decode() + "\n")
            sys.stderr.flush()
    process.join()
    if not beside.is_closing:
        print(
            f"view: the page has ended (exit code {process.exitcode}); the training is not touched",
            file=sys.stderr,
            flush=True,
        )


def _serve(options: PageOptions, lines: Connection) -> None:
    """In the page's process: until it is terminated, or the training's process is gone."""
    is_stopped: list[int] = []
    # Ctrl-C reaches both; the training says when it is over.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: is_stopped.append(1))
    parent = multiprocessing.parent_process()
    guard = checked_guard(options.host, options.port, options.token)
    watch = Watch(options.run)
    server = ViewServer(watch, guard, options.port, _DEFAULT_OUT)
    with serving(server):
        warnings, places = greeting(server, options.port)
        for line in [*warnings, *places]:
            lines.send_bytes(line.encode())
        keep_serving(
            server,
            watch,
            lambda: Studio(HandAvatar.load(options.run)),
            lambda: bool(is_stopped) or parent is None or not parent.is_alive(),
        )
