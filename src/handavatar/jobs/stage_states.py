"""How far a long work is, kept in one file, so that who is interrupted goes on from there.

The work is a row of stages. The file holds the state of the whole where a stage began, and what
that stage says of itself. It is written where a stage begins, when the work is told to stop, and
now and then; aside first, and only if all of it is finite.
"""

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from handavatar.jobs.files import write_atomically
from handavatar.jobs.finite import find_not_finite, require_finite
from handavatar.jobs.signals import Interrupted, unbroken

Json = dict[str, Any]

_EVERY = 30.0
"""Seconds between two states of a stage that are kept."""
_WHOLE, _STAGE = "whole.", "stage."

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WorkState:
    """A state of the whole work, or of a stage.

    Attributes:
        tensors: by name.
        facts: everything else, as JSON.
    """

    tensors: Mapping[str, Tensor]
    facts: Json = field(default_factory=dict)


def named_tensors(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Those whose names begin with a prefix, without it."""
    return {name[len(prefix) :]: v for name, v in tensors.items() if name.startswith(prefix)}


class StageState:
    """Where one stage keeps its state; this one keeps nothing."""

    def read(self) -> WorkState | None:
        """The state to go on from; None begins the stage."""
        return None

    def write(self, state: WorkState) -> None:
        """Keeps a state."""

    @contextmanager
    def kept(self, state: Callable[[], WorkState]) -> Iterator[Callable[[], None]]:
        """As long as the block lasts, its state is kept when the work is told to stop.

        Args:
            state: of the stage now, which is asked for at stop points and between steps.

        Yields:
            To be called after every step: then the state is kept now and then.
        """
        last = time.monotonic()

        def now_and_then() -> None:
            nonlocal last
            if time.monotonic() - last >= _EVERY:
                with unbroken():
                    self.write(state())
                last = time.monotonic()

        try:
            yield now_and_then
        except Interrupted:
            with unbroken():
                self.write(state())
            raise


NOT_KEPT = StageState()
"""For who has no place to keep anything."""


class StageStates:
    """The stages of one work, in a file."""

    def __init__(self, path: Path, fingerprint: str, names: Sequence[str]) -> None:
        """Reads the file, if there is one that can be gone on from.

        Args:
            path: of the file.
            fingerprint: of all that the states depend on; states of another one are worthless.
            names: of the stages, in order.
        """
        self._path, self._fingerprint, self._names = path, fingerprint, tuple(names)
        self._whole = WorkState({})
        self._name = ""
        self._read: WorkState | None = None
        found = self._from_file()
        if found is not None:
            self._name, self._whole, self._read = found

    @property
    def whole(self) -> WorkState | None:
        """The state of the whole where the stage to go on with began; None begins the work."""
        return self._whole if self._name else None

    def is_done(self, name: str) -> bool:
        """Whether a stage lies before the one to go on with."""
        return bool(self._name) and self._names.index(name) < self._names.index(self._name)

    def begin(self, name: str, whole: Callable[[], WorkState]) -> StageState:
        """The state of a stage that begins, or goes on.

        Args:
            name: of the stage.
            whole: its state now.
        """
        if name != self._name:
            now = whole()
            tensors = {key: value.detach().cpu().clone() for key, value in now.tensors.items()}
            self._name, self._whole, self._read = name, WorkState(tensors, now.facts), None
            self.write(None)
        return _KeptStage(self)

    def read(self) -> WorkState | None:
        """What the present stage has said of itself, before this process."""
        return self._read

    def write(self, stage: WorkState | None) -> None:
        """Writes the state of the whole, and of the present stage.

        Raises:
            NotFinite: if something of it is not finite; nothing is written then.
            OSError: if the disk refuses.
        """
        parts = {_WHOLE: self._whole.tensors} | ({_STAGE: stage.tensors} if stage else {})
        tensors = {
            f"{prefix}{name}": value.detach().cpu().contiguous().clone()
            for prefix, group in parts.items()
            for name, value in group.items()
        }
        facts = {"whole": self._whole.facts, "stage": None if stage is None else stage.facts}
        require_finite({**tensors, "facts": facts}, f"stage {self._name}: not kept")
        record = {"fingerprint": self._fingerprint, "name": self._name} | facts
        text = json.dumps(record, allow_nan=False)
        write_atomically({self._path: safetensors.torch.save(tensors, {"state": text})})

    def remove(self) -> None:
        """Forgets all: the work is done."""
        self._path.unlink(missing_ok=True)

    def _from_file(self) -> tuple[str, WorkState, WorkState | None] | None:
        if not self._path.is_file():
            return None
        try:
            with safe_open(self._path, "pt") as file:
                record = json.loads(file.metadata()["state"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if record["fingerprint"] != self._fingerprint or record["name"] not in self._names:
                _log.warning("%s: of other work; it is begun anew", self._path)
                return None
            if found := find_not_finite({**tensors, "facts": record}):
                raise ValueError(found)
            parts = [
                WorkState({k[len(at) :]: v for k, v in tensors.items() if k.startswith(at)}, facts)
                for at, facts in ((_WHOLE, record["whole"]), (_STAGE, record["stage"] or {}))
            ]
        except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
            _log.warning("%s: cannot be gone on from (%s); it is begun anew", self._path, error)
            return None
        return record["name"], parts[0], None if record["stage"] is None else parts[1]


class _KeptStage(StageState):
    """The present stage of a file."""

    def __init__(self, states: StageStates) -> None:
        self._states = states

    def read(self) -> WorkState | None:
        return self._states.read()

    def write(self, state: WorkState) -> None:
        self._states.write(state)
