"""Videos that pages ask for: made a frame at a time, between the pictures of other clients."""

import secrets
import tempfile
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from handavatar.jobs.video_writer import VideoWriter
from handavatar.view.scene import Moment, Scene
from handavatar.view.studio import FLUID_SIZE, STAGES, Interrupted, Pixels, Studio
from handavatar.view.turns import Busy, Job, Overtaken, Turns

MOST_FRAMES = 3000
MOST_RUNNING = 2
_KEPT = 4
_PATIENCE = 20.0
"""Seconds; who has not asked for so long does not want it any more."""


@dataclass(frozen=True)
class FilmOrder:
    """A video that is wished for.

    Attributes:
        scene: camera, layer, size and edits; its moment names the motion.
        stage: how every frame is made, one of ``STAGES``.
        every: so many steps of the motion make a frame.
    """

    scene: Scene
    stage: str
    every: int


class _Film:
    """A video in the making."""

    def __init__(self, total: int, path: Path) -> None:
        self.name = secrets.token_hex(8)
        self.total = total
        self.path = path
        self.done = 0
        self.state = "running"
        self.why = ""
        self.asked = time.monotonic()


class Films:
    """All videos of a server; the oldest are forgotten."""

    def __init__(self, studio: Studio, turns: Turns) -> None:
        """None yet.

        Args:
            studio: makes the pictures.
            turns: with lanes ``fluid`` and ``field``.
        """
        self._studio = studio
        self._turns = turns
        self._folder = tempfile.TemporaryDirectory(prefix="handavatar-view-")
        self._films: OrderedDict[str, _Film] = OrderedDict()
        self._lock = threading.Lock()
        self._count = 0

    def start(self, order: FilmOrder) -> str:
        """Begins a video, and gives the name by which to ask for it.

        Raises:
            SceneError: if the scene cannot be shown.
            Busy: if too many are being made.
        """
        motion = self._studio.motion(order.scene.moment.motion if order.scene.moment else "")
        self._studio.shot(order.scene)
        steps = range(0, len(motion), order.every)[:MOST_FRAMES]
        with self._lock:
            if sum(film.state == "running" for film in self._films.values()) >= MOST_RUNNING:
                raise Busy
            self._count += 1
            film = _Film(len(steps), Path(self._folder.name) / f"{self._count}.mp4")
            self._films[film.name] = film
            for name in [n for n, old in self._films.items() if old.state != "running"][:-_KEPT]:
                self._films.pop(name).path.unlink(missing_ok=True)
        fps = motion.fps / order.every
        threading.Thread(target=self._make, args=(film, order, steps, fps), daemon=True).start()
        return film.name

    def progress(self, name: str) -> dict[str, Any] | None:
        """How far a video is, as JSON; None if there is none of that name."""
        film = self._films.get(name)
        if film is None:
            return None
        film.asked = time.monotonic()
        return {"state": film.state, "done": film.done, "total": film.total, "why": film.why}

    def file(self, name: str) -> bytes | None:
        """A finished video; None if there is none of that name."""
        film = self._films.get(name)
        return film.path.read_bytes() if film is not None and film.state == "finished" else None

    def cancel(self, name: str) -> None:
        """Ends a video that is being made."""
        film = self._films.get(name)
        if film is not None:
            film.asked = -_PATIENCE

    def close(self) -> None:
        """Forgets all and removes the files."""
        for name in list(self._films):
            self.cancel(name)
        self._folder.cleanup()

    def _make(self, film: _Film, order: FilmOrder, steps: range, fps: float) -> None:
        try:
            size = order.scene.size
            shown = min(size, FLUID_SIZE) if order.stage == STAGES[0] else size
            with VideoWriter(film.path, fps, shown) as writer:
                for number, step in enumerate(steps):
                    writer.add(self._frame(film, order, number, step))
                    film.done = number + 1
            film.state = "finished"
        except (Overtaken, Interrupted):
            film.state, film.why = "cancelled", "nobody asked for it any more"
        except Exception as error:  # whatever it is, the page is told and the server goes on
            film.state, film.why = "failed", str(error)[:200]

    def _frame(self, film: _Film, order: FilmOrder, number: int, step: int) -> Pixels:
        moment = order.scene.moment
        assert moment is not None
        scene = replace(order.scene, moment=Moment(moment.motion, step))

        def is_unwanted() -> bool:
            return time.monotonic() - film.asked > _PATIENCE

        def work(job: Job) -> Pixels:
            if order.stage == STAGES[0]:
                return self._studio.fluid(scene)
            return self._studio.refined(scene, order.stage, lambda: job.is_stale() or is_unwanted())

        lane = "fluid" if order.stage == STAGES[0] else "field"
        while not is_unwanted():
            try:
                job = self._turns.submit(lane, f"film {film.name}", number, work)
            except Busy:
                time.sleep(0.2)
                continue
            pixels: Pixels = job.result()
            return pixels
        raise Interrupted
