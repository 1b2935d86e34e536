"""A run that is being trained, as a page shows it: its frames, its losses, its avatar as it is."""

import copy
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from handavatar.animate import pass_pictures
from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.frames import Capture, Frame, read_capture
from handavatar.capture.view import start_of
from handavatar.edit import Edit
from handavatar.hand.pose import HandPose
from handavatar.jobs.logs import finite_figures, is_step, json_lines
from handavatar.train.live import LiveState, live_avatar, live_poses, look_on, read_live
from handavatar.train.runs import Run
from handavatar.view.baked import BakedAvatar
from handavatar.view.scene import SceneError, View
from handavatar.view.studio import (
    Pixels,
    Shot,
    mesh_picture,
    posed_vertices,
    refined_picture,
    size_at,
)

MOST_POINTS = 300
"""Of a curve that is sent; more steps than that share a point, their mean."""
_AROUND = 1.25
"""A frame is shown as a square around its mask, so many times the longer side of that."""
_MOST_LOG = 64 * 2**20
"""Bytes of a log that are read at once."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture of an avatar in training.

    Attributes:
        pixels: of it.
        label: the job and the step after which the avatar was so.
    """

    pixels: Pixels
    label: str


@dataclass(frozen=True, eq=False)
class _Seen:
    """The avatar as the trainer last left it.

    Attributes:
        avatar: read only.
        twin: the same, a module of its own: the other's evaluations can be interrupted.
        version: of the file.
        poses: rotations and translations of all training frames; None as the capture has them.
    """

    avatar: HandAvatar
    twin: HandAvatar
    version: int
    poses: tuple[torch.Tensor, torch.Tensor] | None

    @property
    def label(self) -> str:
        """When it was left, such as ``train 120``."""
        live = self.avatar.info["live"]
        return f"{live['job']} {live['step']}"

    @cached_property
    def baked(self) -> BakedAvatar:
        """For one thread."""
        return BakedAvatar(self.twin, start_of(self.twin.view()))


class Watch:
    """Looks on at a run; nothing that it does is waited for by the trainer.

    :meth:`fluid` belongs to one thread, :meth:`refined` to another; all else may be called from
    any thread.
    """

    def __init__(self, folder: Path, settings: RenderSettings | None = None) -> None:
        """Of a run that may not have begun yet.

        Args:
            folder: of the run.
            settings: how the field is evaluated for a picture in full.
        """
        self._run = Run(folder)
        self._settings = settings or RenderSettings()
        self._state: LiveState | None = None
        self._capture: Capture | None = None
        self._numbers: tuple[int, ...] = ()
        self._seen: _Seen | None = None
        self._curves = _Curves(self._run.log)
        self._reading = threading.Lock()
        self._taking = threading.Lock()
        self._frames: dict[int, Frame] = {}
        self._is_asked = False
        self._begin = time.time()

    @property
    def has_ended(self) -> bool:
        """Whether the finished avatar lies in the run."""
        state = self._state
        return state is not None and state.phase == "finished" and self._run.avatar.is_file()

    def refresh(self) -> None:
        """Looks how far the trainer is, and tells it whether a page looks on.

        Raises:
            CaptureError: if the run's capture is no longer what it was.
        """
        state = read_live(self._run)
        # What an earlier trainer has left is not news.
        if state is None or not (state.is_going_on or state.time > self._begin):
            return
        self._state = state
        self._curves.add(state)
        if self._capture is None:
            self._capture = read_capture(Path(self._run.facts["capture"]["path"]))
            self._numbers = self._capture.split("train")
        if self._is_asked:
            self._is_asked = False
            look_on(self._run)

    def about(self) -> dict[str, Any]:
        """How far it is, as JSON."""
        self._is_asked = True
        state, capture = self._state, self._capture
        if state is None or capture is None:
            return {"phase": "waiting", "run": str(self._run.folder)}
        return {
            "phase": "training" if state.is_going_on else "stopped",
            "run": str(self._run.folder),
            "subject": capture.subject,
            "job": state.job,
            "step": state.step,
            "total": state.total,
            "steps_per_second": state.steps_per_second,
            "share": state.share,
            "seconds_left": state.seconds_left,
            "figures": state.figures,
            "frames": len(self._numbers),
            # As text: a page's numbers are not that long.
            "avatar": str(version) if (version := self._version()) else None,
        }

    def curves(self) -> dict[str, Any]:
        """Losses over steps, as JSON: by job, then by name, pairs of step and value."""
        return {"jobs": self._curves.as_json()}

    def picture(self, view: View) -> Pixels:
        """The training frame itself, the hand in its middle.

        Raises:
            SceneError: if there is no such frame.
        """
        frame = self._frame(view.frame)
        left, top, side = _square(frame)
        box = (left, top, left + side, top + side)
        picture = Image.fromarray(frame.shown.numpy()).transform(
            (view.size, view.size), Image.Transform.EXTENT, box, Image.Resampling.BILINEAR
        )
        pixels = np.asarray(picture)
        return np.ascontiguousarray(pixels[:, ::-1]) if self._side == "left" else pixels

    def fluid(self, view: View) -> Shown:
        """The newest avatar in the frame's pose, from its posed mesh.

        Raises:
            SceneError: if there is no such frame, or no avatar yet.
            CheckpointError: if the avatar cannot be read.
        """
        seen = self._newest()
        shot = self._shot(seen, view)
        if view.layer == "mesh":
            pixels = mesh_picture(posed_vertices(seen.twin, shot), seen.twin, shot, 1)
        else:
            rendering = seen.baked.render(shot.pose, shot.camera, shot.edit)
            pixels = pass_pictures(rendering, self._side)[view.layer]
        return Shown(pixels, seen.label)

    def refined(self, view: View, stage: str, is_stale: Callable[[], bool]) -> Shown:
        """The same by the field, of the avatar that the last fluid picture was of.

        Args:
            view: what is to be seen.
            stage: ``half`` or ``full``.
            is_stale: asked every few milliseconds whether to go on.

        Raises:
            Interrupted: as soon as it is stale.
            SceneError: if there is no such frame, or no avatar yet.
        """
        seen = self._seen or self._newest()
        shot = self._shot(seen, replace(view, size=size_at(stage, view.size)))
        pixels = refined_picture(seen.avatar, shot, view.layer, stage, self._settings, is_stale)
        return Shown(pixels, seen.label)

    @property
    def _side(self) -> str:
        return "right" if self._capture is None else self._capture.side

    def _version(self) -> int:
        """Of the avatar's file; zero where there is none."""
        try:
            return live_avatar(self._run).stat().st_mtime_ns
        except OSError:
            return 0

    def _newest(self) -> _Seen:
        with self._taking:
            before, version = self._seen, self._version()
            if version and (before is None or before.version != version):
                path = live_avatar(self._run)
                # Of the twin: what ends the other in mid-evaluation would be copied with it.
                avatar = HandAvatar.load(path) if before is None else before.twin.reloaded(path)
                self._seen = _Seen(avatar, copy.deepcopy(avatar), version, live_poses(avatar))
            if self._seen is None:
                raise SceneError("there is no avatar to be seen yet: try again")
            return self._seen

    def _shot(self, seen: _Seen, view: View) -> Shot:
        frame = self._frame(view.frame)
        pose = frame.pose
        if seen.poses is not None:
            rotations, translations = seen.poses
            pose = HandPose(rotations[view.frame], translations[view.frame])
        left, top, side = _square(frame)
        camera = frame.camera.cropped(left, top, side, side)
        return Shot(pose, camera.resized(view.size, view.size), Edit(light=frame.clip))

    def _frame(self, number: int) -> Frame:
        capture = self._capture
        if capture is None or number >= len(self._numbers):
            raise SceneError(f"frame: expected one below {len(self._numbers)}, found {number}")
        with self._reading:
            if number not in self._frames:
                while len(self._frames) >= 4:
                    self._frames.pop(next(iter(self._frames)))
                self._frames[number] = capture.frame(self._numbers[number])
            return self._frames[number]


class _Curves:
    """Losses as far as they are known: those of the log, and those that were told meanwhile."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._place = 0
        self._file = 0
        self._lock = threading.Lock()
        self._jobs: dict[str, dict[str, _Curve]] = {}

    def add(self, state: LiveState) -> None:
        """What the trainer has just told; and what is new in the log."""
        with self._lock:
            if state.job and state.job != "train":
                self._note(state.job, state.step, state.figures)
            self._read_log()

    def as_json(self) -> dict[str, dict[str, list[list[float]]]]:
        with self._lock:
            return {
                job: {name: curve.points() for name, curve in curves.items()}
                for job, curves in self._jobs.items()
            }

    def _note(self, job: str, step: int, figures: dict[str, float]) -> None:
        curves = self._jobs.setdefault(job, {})
        for name, value in figures.items():
            curves.setdefault(name, _Curve()).add(step, value)

    def _read_log(self) -> None:
        if not self._log.is_file():
            return
        try:
            with open(self._log, "rb") as file:
                number = os.fstat(file.fileno()).st_ino
                if number != self._file:  # A resumed training has replaced it.
                    self._jobs.pop("train", None)
                    self._file, self._place = number, 0
                file.seek(self._place)
                data = file.read(_MOST_LOG)
        except OSError:
            return
        whole = data[: data.rfind(b"\n") + 1]
        self._place += len(whole)
        for _, record in json_lines(whole):
            step = record.pop("step", None)
            if is_step(step):
                self._note("train", step, finite_figures(record))


class _Curve:
    """Values over steps in at most ``MOST_POINTS`` bins of equal width."""

    def __init__(self) -> None:
        self._width = 1
        self._bins: dict[int, list[float]] = {}

    def add(self, step: int, value: float) -> None:
        """One more value."""
        while step // self._width >= MOST_POINTS:
            self._width *= 2
            halved = list(self._bins.items())
            self._bins = {}
            for number, sums in halved:
                self._add(number // 2, sums)
        self._add(step // self._width, [1.0, float(step), float(value)])

    def points(self) -> list[list[float]]:
        """Pairs of step and value, the means of each bin."""
        return [
            [round(steps / count, 1), float(f"{total / count:.5g}")]
            for _, (count, steps, total) in sorted(self._bins.items())
        ]

    def _add(self, number: int, sums: list[float]) -> None:
        before = self._bins.get(number, [0.0, 0.0, 0.0])
        self._bins[number] = [a + b for a, b in zip(before, sums, strict=True)]


def _square(frame: Frame) -> tuple[float, float, float]:
    """Left, top and side of a square around a frame's hand, pixels; the whole picture without."""
    places = frame.mask.nonzero()
    height, width = frame.mask.shape
    if len(places) == 0:
        side = float(max(height, width))
        return (width - side) / 2, (height - side) / 2, side
    lower, upper = places.amin(0), places.amax(0) + 1
    side = float((upper - lower).max()) * _AROUND
    middle = (lower + upper) / 2
    return float(middle[1]) - side / 2, float(middle[0]) - side / 2, side
