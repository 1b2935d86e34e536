"""What others may see of a run while it is being trained: how far it is, and the avatar as it is.

```
run/live/  progress.json  avatar.safetensors  watched
```

The trainer says once a second how far it is. Who looks on touches ``watched``; while that goes on,
the trainer also leaves the avatar there as it is, every few seconds. Files are renamed into place,
so whoever reads finds them whole; nothing that is read here can hold up or end a training.
"""

import copy
import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError

from handavatar.avatar import HandAvatar
from handavatar.capture.frames import Frame
from handavatar.errors import printable
from handavatar.jobs.files import read_plain, write_atomically
from handavatar.jobs.finite import NotFinite
from handavatar.jobs.processes import is_running
from handavatar.jobs.progress import Progress
from handavatar.train.corrections import PoseCorrections
from handavatar.train.runs import Run

Phase = Literal["training", "finished", "stopped"]
_OWN_FILES = ("progress.json", "avatar.safetensors", "watched")
_TELL_EVERY = 1.0
"""Seconds between two reports of how far a job is."""
_SHOW_EVERY = 3.0
"""Seconds between two copies of the avatar, at least."""
_MOST_SHARE = 0.01
"""Of the time may go into these copies."""
_PATIENCE = 30.0
"""Seconds; who has not touched ``watched`` for so long does not look on any more."""


_MOST_BYTES = 1 << 20
"""Of what a trainer says of itself."""


@dataclass(frozen=True)
class LiveState:
    """How far a training is.

    Attributes:
        phase: ``training`` says what the trainer last said; it may have been killed since.
        job: the stage, such as ``outlines`` or ``train``; empty before the first.
        step: of the stage, done.
        total: steps of the stage.
        steps_per_second: at present.
        share: of the whole training that is done, in [0, 1].
        seconds_left: of the whole training; None if it is not known.
        figures: latest values, such as ``loss``.
        process: number of the trainer's process.
        host: name of its machine.
        time: when it was said, seconds since 1970.
    """

    phase: Phase
    job: str = ""
    step: int = 0
    total: int = 0
    steps_per_second: float = 0.0
    share: float = 0.0
    seconds_left: float | None = None
    figures: dict[str, float] = field(default_factory=dict)
    process: int = 0
    host: str = ""
    time: float = 0.0

    @property
    def is_going_on(self) -> bool:
        """Whether a trainer works on the run now; of another machine's, whether it said so last."""
        if self.phase != "training" or self.host != socket.gethostname():
            return self.phase == "training"
        return is_running(self.process)


def live_folder(run: Run) -> Path:
    """Where a run's trainer leaves what others may see."""
    return run.folder / "live"


def live_avatar(run: Run) -> Path:
    """The avatar as it is now, where somebody looks on; else as somebody last saw it, or none."""
    return live_folder(run) / "avatar.safetensors"


def read_live(run: Run) -> LiveState | None:
    """How far a run's training is; None where no trainer has said so."""
    try:
        content = json.loads(read_plain(live_folder(run) / "progress.json", _MOST_BYTES))
        # A whole number may stand for any.
        for name in ("steps_per_second", "share", "seconds_left", "time"):
            if content.get(name) is not None:
                content[name] = float(content[name])
        figures = {name: float(value) for name, value in content["figures"].items()}
        return LiveState(**{**content, "figures": figures})
    except (
        *(OSError, ValueError, TypeError, KeyError, AttributeError),
        *(OverflowError, RecursionError),
    ):
        return None


def look_on(run: Run) -> None:
    """Tells a run's trainer that somebody looks on; nothing where there is none."""
    with suppress(OSError):
        (live_folder(run) / "watched").touch()


def live_poses(avatar: HandAvatar) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Rotations and translations of the training frames, as the trainer of a live avatar has them.

    None where the capture's own are taken as they are.
    """
    poses = avatar.info.get("live", {}).get("poses")
    if poses is None:
        return None
    return torch.tensor(poses["rotations"]), torch.tensor(poses["translations"])


@contextmanager
def shown_live(
    run: Run,
    avatar: HandAvatar,
    corrections: PoseCorrections | None,
    frames: Sequence[Frame],
    progress: Progress,
) -> Iterator[Progress]:
    """While it lasts, others can see how far the training is.

    Args:
        run: whose lock the caller holds.
        avatar: that is trained; read only.
        corrections: of the frames' poses; read only.
        frames: of training.
        progress: of the training.

    Yields:
        The same progress, which others see, too.
    """
    live = _Live(run, avatar, corrections, frames)
    live.begin()
    phase: Phase = "stopped"
    try:
        with progress.heard_by(live.hear) as heard:
            yield heard
        phase = "finished"
    finally:
        live.end(phase)


class _Live:
    """Writes what others may see; a disk that refuses is told of once, and training goes on."""

    def __init__(
        self,
        run: Run,
        avatar: HandAvatar,
        corrections: PoseCorrections | None,
        frames: Sequence[Frame],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._run = run
        self._avatar = avatar
        self._corrections = corrections
        self._poses = [frame.pose for frame in frames]
        self._clock = clock
        self._last: dict[str, Any] = {}
        self._told = self._shown = -1e9
        self._cost = 0.0
        self._is_broken = False

    def begin(self) -> None:
        """Forgets what an earlier trainer has left."""
        self._attempt(self._clear)
        self._attempt(lambda: self._tell("training"))

    def hear(self, record: dict[str, Any], is_turning_point: bool) -> None:
        """A job's progress."""
        now = self._clock()
        self._last = record
        if is_turning_point or now - self._told >= _TELL_EVERY:
            self._told = now
            self._attempt(lambda: self._tell("training"))
        if now - self._shown >= max(_SHOW_EVERY, self._cost / _MOST_SHARE) and self._is_watched():
            self._shown = now
            self._attempt(self._show)
            self._cost = self._clock() - now

    def end(self, phase: Phase) -> None:
        """Says how it ended, and takes the avatar away that is not the finished one."""
        self._attempt(lambda: self._tell(phase))
        if phase == "finished":
            self._attempt(self._clear)
            self._attempt(lambda: self._tell(phase))

    def _attempt(self, write: Callable[[], None]) -> None:
        if self._is_broken:
            return
        try:
            write()
        except NotFinite:
            return  # The trainer itself asks after every step, and says what to do.
        except (OSError, SafetensorError) as error:
            self._is_broken = True
            print(
                printable(
                    f"{live_folder(self._run)}: {error}; nobody can look on, training goes on"
                ),
                file=sys.stderr,
            )

    def _clear(self) -> None:
        folder = live_folder(self._run)
        folder.mkdir(exist_ok=True)
        for path in folder.iterdir():
            if path.name in _OWN_FILES or path.name.startswith(".tmp-"):
                path.unlink()

    def _is_watched(self) -> bool:
        try:
            touched = (live_folder(self._run) / "watched").stat().st_mtime
        except OSError:
            return False
        return time.time() - touched < _PATIENCE

    def _tell(self, phase: Phase) -> None:
        last = dict(self._last)
        known = ("job", "step", "total", "steps_per_second", "share", "seconds_left")
        state = {name: last.pop(name) for name in known if name in last}
        for name in ("command", "note"):
            last.pop(name, None)
        figures = {name: value for name, value in last.items() if value is not None}
        state |= {"phase": phase, "figures": figures}
        state |= {"process": os.getpid(), "host": socket.gethostname(), "time": time.time()}
        path = live_folder(self._run) / "progress.json"
        # Written anew all the time: after a crash of the machine nobody misses it.
        write_atomically({path: json.dumps(state, allow_nan=False).encode()}, is_durable=False)

    def _show(self) -> None:
        live: dict[str, Any] = {"job": self._last["job"], "step": self._last["step"]}
        if self._corrections is not None:
            with torch.no_grad():
                poses = [
                    self._corrections(number, pose.to(self._avatar.device))
                    for number, pose in enumerate(self._poses)
                ]
            live["poses"] = {
                "rotations": [pose.rotations.tolist() for pose in poses],
                "translations": [pose.translation.tolist() for pose in poses],
            }
        shown = copy.copy(self._avatar)
        shown.info = self._avatar.info | {"live": live}
        shown.save(live_avatar(self._run))
