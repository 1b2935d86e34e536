"""``handavatar view``: an HTTP server of its own, for a page of its own; nothing else is loaded.

Of no viewer library, because none checks who asks; docs/viewer.md says more. A page sends its whole
scene with every wish for a picture, so the server keeps nothing of a client but its newest order,
and the pictures that it has sent as paint.
"""

import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch

from handavatar.avatar import HandAvatar, RenderSettings, chosen_device
from handavatar.capture.motion import MOTIONS, Motion, read_motion
from handavatar.errors import printable, require_range, require_ranges
from handavatar.field.kernels import Kernel, chosen_kernel
from handavatar.jobs.signals import awaited_signals
from handavatar.jobs.threads import step_back
from handavatar.train.live import read_live
from handavatar.train.runs import Run
from handavatar.view.answers import AvatarAnswers
from handavatar.view.connections import bound
from handavatar.view.films import Films
from handavatar.view.guard import Guard, guard_of, is_loopback
from handavatar.view.share import Share
from handavatar.view.studio import Studio
from handavatar.view.training import Watch
from handavatar.view.training_answers import TrainingAnswers
from handavatar.view.turns import Turns

MOST_WAITING = 64
"""Clients whose picture has not been begun; more are asked to try again."""
_LOW_PRIORITY = 14
"""Of pictures beside a training: where no core is idle they get a twenty-fifth of one (Linux)."""
_SHARE = 0.04
"""Of all cores together, for a page beside a training, be the cores idle or not."""
_LOOK_EVERY = 1.0
"""Seconds between two looks at a training."""


@dataclass(frozen=True)
class ViewOptions:
    """Shows an avatar in the browser: pose it, light it, paint it, save it.

    A run that is still being trained is looked on at, and shown as soon as it is done.

    Attributes:
        run: run folder, or an avatar file; it stays as it is.
        port: of the page; if it is taken, the next free one.
        host: where to listen. Beyond this machine a token is needed; without ``token`` one is made.
        token: letters, digits, - and _; who does not know it is not served.
        motion: motion files for the timeline, besides the built-in motions.
        out: folder for avatars saved from the page; they get names that are free.
        device: where the fields run.
        kernel: what decodes pairs of parts, as for ``handavatar render``.
    """

    run: Path
    port: int = 7007
    host: str = "127.0.0.1"
    token: str = ""
    motion: tuple[Path, ...] = ()
    out: Path = Path("edited")
    device: str = "auto"
    kernel: Kernel = "auto"

    def __post_init__(self) -> None:
        """Refuses numbers that are out of range."""
        require_ranges(self, port=(0, 65_535))


class PageServer:
    """Serves a page to those whom its guard lets in."""

    def __init__(self, guard: Guard, port: int) -> None:
        """Binds the port; :meth:`serve` answers.

        Args:
            guard: who is let in, and where to listen.
            port: the first to try; 0 is any.

        Raises:
            OSError: if no port is free, or there is no such host.
        """
        self._http = bound(guard.host, port)
        self.port: int = self._http.server_address[1]
        self.guard = replace(guard, cookie=f"{guard.cookie}-{self.port}")
        self._http.guard = self.guard

    @property
    def address(self) -> str:
        """What to open in a browser, the token included."""
        host = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(
            self.guard.host, self.guard.host
        )
        host = f"[{host}]" if ":" in host else host
        query = f"?token={self.guard.token}" if self.guard.token else ""
        return f"http://{host}:{self.port}/{query}"

    def serve(self) -> None:
        """Answers until :meth:`close` is called from another thread."""
        self._http.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stops answering and frees the port."""
        self._http.shutdown()
        self._http.server_close()
        self._http.connections.end_all()


Served = TypeVar("Served", bound=PageServer)


class ViewServer(PageServer):
    """The page, and what it asks for."""

    def __init__(self, shown: Studio | Watch, guard: Guard, port: int, out: Path) -> None:
        """Binds the port; :meth:`serve` answers.

        Args:
            shown: an avatar, or a training.
            guard: who is let in, and where to listen.
            port: the first to try; 0 is any.
            out: folder for saved avatars.

        Raises:
            OSError: if no port is free, or there is no such host.
        """
        super().__init__(guard, port)
        self.out = out
        self._cores = torch.get_num_threads()
        self.turns, self.films = self._begin(shown)

    def show(self, shown: Studio | Watch) -> None:
        """Goes over to something else; what is being made is dropped."""
        before = self.turns, self.films
        self.turns, self.films = self._begin(shown)
        _end(*before)

    def _begin(self, shown: Studio | Watch) -> tuple[Turns, Films | None]:
        if isinstance(shown, Watch):
            share = Share(_SHARE * self._cores)
            turns = Turns({"fluid": _step_back, "field": _step_back}, MOST_WAITING, share)
            self._http.answers = TrainingAnswers(shown, turns)
            return turns, None
        # One core for what must be there at once: torch's threads are of no use to it, and it would
        # wait for the field's pieces. Torch would give the other lane the number last set.
        turns = Turns(
            {
                "fluid": lambda: torch.set_num_threads(1),
                "field": lambda: torch.set_num_threads(self._cores),
            },
            MOST_WAITING,
        )
        films = Films(shown, turns)
        self._http.answers = AvatarAnswers(shown, turns, films, self.out)
        return turns, films

    def close(self) -> None:
        """Stops answering, drops what is being made, frees the port."""
        super().close()
        _end(self.turns, self.films)


def _step_back() -> None:
    """Leaves the cores to others, in a lane's thread."""
    torch.set_num_threads(1)
    step_back(_LOW_PRIORITY)


def _end(turns: Turns, films: Films | None) -> None:
    if films is not None:
        films.close()
    turns.close()


@contextmanager
def serving(server: Served) -> Iterator[Served]:
    """A server that answers, from a thread of its own, as long as the block lasts."""
    thread = threading.Thread(target=server.serve, name="view", daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.close()
        thread.join()


def view(options: ViewOptions) -> None:
    """Serves until SIGINT or SIGTERM; for the main thread.

    Raises:
        CheckpointError: if the avatar cannot be read.
        CaptureError: if a motion cannot be read.
        ValueError: for a port or token that cannot be.
        OSError: if no port is free, or there is no such host.
    """
    guard = checked_guard(options.host, options.port, options.token)
    motions = _named(options.motion)
    device = chosen_device(options.device)
    settings = RenderSettings(kernel=chosen_kernel(options.kernel, str(device)))

    def studio() -> Studio:
        return Studio(HandAvatar.load(options.run).moved_to(device), motions, settings)

    live = read_live(Run(options.run))
    shown = Watch(options.run) if live is not None and live.is_going_on else studio()
    server = ViewServer(shown, guard, options.port, options.out)
    greet(server, options.port)
    with awaited_signals() as is_stopped, serving(server):
        print("Ctrl-C ends it", flush=True)
        keep_serving(server, shown, studio, is_stopped)


def checked_guard(host: str, port: int, token: str) -> Guard:
    """Who is let in, if the options mean anything.

    Raises:
        ValueError: for a port or token that cannot be.
    """
    require_range("port", port, 0, 65535)
    return guard_of(host, token)


def keep_serving(
    server: ViewServer,
    shown: Studio | Watch,
    studio: Callable[[], Studio],
    is_stopped: Callable[[], bool],
) -> None:
    """Until it is stopped: looks on at a training, and goes over to the avatar when that is made.

    Args:
        server: that answers.
        shown: by it now.
        studio: the finished avatar's.
        is_stopped: asked ten times a second.
    """
    if isinstance(shown, Watch):
        looked, said = 0.0, ""
        while not is_stopped() and not shown.has_ended:
            time.sleep(0.1)
            if time.monotonic() - looked < _LOOK_EVERY:
                continue
            try:
                shown.refresh()
            except (OSError, ValueError) as error:  # of a file; said, and tried again
                if (why := str(error).splitlines()[0]) != said:
                    print(printable(f"view: {why}"), file=sys.stderr, flush=True)
                    said = why
            looked = time.monotonic()
        if not is_stopped():
            server.show(studio())
    while not is_stopped():
        time.sleep(0.1)


def greet(server: PageServer, wanted_port: int) -> None:
    """Prints where the page is; warnings to standard error."""
    warnings, lines = greeting(server, wanted_port)
    for line in warnings:
        print(line, file=sys.stderr)
    for line in lines:
        print(line, flush=True)


def greeting(server: PageServer, wanted_port: int) -> tuple[list[str], list[str]]:
    """Warnings, and where the page is."""
    warnings = []
    if server.port != wanted_port and wanted_port:
        warnings.append(f"port {wanted_port} is taken; this is {server.port}")
    if not is_loopback(server.guard.host):
        warnings.append(
            f"warning: {server.guard.host} is not loopback: whoever knows the token below can "
            "watch, edit, and save avatars here, and all is sent unencrypted"
        )
    lines = [f"open {server.address}"]
    if is_loopback(server.guard.host):
        user = os.environ.get("USER", "you")
        lines.append(
            f"from elsewhere: ssh -L {server.port}:127.0.0.1:{server.port} "
            f"{user}@{socket.gethostname()}, then open it there"
        )
    return warnings, lines


def _named(paths: tuple[Path, ...]) -> dict[str, Motion]:
    """Motions of files, by the files' names; a name that is taken is counted on."""
    motions: dict[str, Motion] = {}
    for path in paths:
        stem = "".join(c if c.isalnum() or c in "-_. " else "_" for c in path.stem)[:30] or "file"
        name, count = stem, 1
        while name in motions or name in MOTIONS:
            count += 1
            name = f"{stem} {count}"
        motions[name] = read_motion(path)
    return motions
