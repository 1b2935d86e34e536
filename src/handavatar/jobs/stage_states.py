"""How far a long work is, kept in files, so that who is interrupted goes on from there.

The work is a row of stages. ``NAME.safetensors`` holds the state of the whole where a stage began;
``NAME.stage.safetensors`` what that stage says of itself, when the work is told to stop and now and
then. Both are written aside first, and only if all of it is finite; who reads them compares what is
in them with what was written.
"""

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from handavatar.errors import raise_if_refused
from handavatar.jobs.files import write_atomically
from handavatar.jobs.finite import find_not_finite, require_finite
from handavatar.jobs.signals import unbroken

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
            state: of the stage now, whole wherever the block is not :func:`unbroken`.

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
        except KeyboardInterrupt:  # Anywhere but in what is unbroken: there alone a state changes.
            with unbroken():
                self.write(state())
            raise


NOT_KEPT = StageState()
"""For who has no place to keep anything."""


class StageStates:
    """The stages of one work, in a folder."""

    def __init__(self, path: Path, fingerprint: str, names: Sequence[str]) -> None:
        """Reads the files, if there are some that can be gone on from.

        Args:
            path: of both, without their endings.
            fingerprint: of all that the states depend on; states of another one are worthless.
            names: of the stages, in order.
        """
        whole, stage = state_files(path)
        self._whole_file, self._stage_file = whole, stage
        self._fingerprint, self._names = fingerprint, tuple(names)
        self._whole = WorkState({})
        self._name = ""
        self._read: WorkState | None = None
        found = _read_state(whole, {"fingerprint": fingerprint})
        if found is not None and found.facts["name"] in names:
            self._name, self._whole = found.facts["name"], WorkState(found.tensors, found.facts)
            begun = _read_state(stage, {"fingerprint": fingerprint, "name": self._name})
            self._read = None if begun is None else WorkState(begun.tensors, begun.facts)

    @property
    def whole(self) -> WorkState | None:
        """The state of the whole where the stage to go on with began; None begins the work."""
        return WorkState(self._whole.tensors, self._whole.facts["facts"]) if self._name else None

    def is_done(self, name: str) -> bool:
        """Whether a stage lies before the one to go on with."""
        return bool(self._name) and self._names.index(name) < self._names.index(self._name)

    def begin(self, name: str, whole: Callable[[], WorkState]) -> StageState:
        """The state of a stage that begins, or goes on.

        Args:
            name: of the stage.
            whole: its state now.

        Raises:
            NotFinite: if something of it is not finite; nothing is written then.
            OSError: if the disk refuses.
        """
        if name != self._name:
            with unbroken():
                self._stage_file.unlink(missing_ok=True)
                now = whole()
                self._write(self._whole_file, name, now)
            facts = {"name": name, "facts": now.facts}
            self._name, self._whole, self._read = name, WorkState(now.tensors, facts), None
        return _KeptStage(self)

    def read(self) -> WorkState | None:
        """What the present stage has said of itself, before this process."""
        return (
            None if self._read is None else WorkState(self._read.tensors, self._read.facts["facts"])
        )

    def write(self, stage: WorkState) -> None:
        """Writes the state of the present stage; raises as :meth:`begin`."""
        self._write(self._stage_file, self._name, stage)

    def _write(self, path: Path, name: str, state: WorkState) -> None:
        require_finite({**state.tensors, "facts": state.facts}, f"stage {name}: not kept")
        tensors = {
            key: value.detach().cpu().contiguous().clone() for key, value in state.tensors.items()
        }
        facts = json.loads(json.dumps(state.facts, allow_nan=False))  # As they will be read.
        record = {"fingerprint": self._fingerprint, "name": name, "facts": facts}
        text = json.dumps(record | {"sha256": _digest(tensors, record)})
        write_atomically({path: safetensors.torch.save(tensors, {"state": text})})

    def remove(self) -> None:
        """Forgets all: the work is done."""
        for path in (self._stage_file, self._whole_file):
            path.unlink(missing_ok=True)


def state_files(path: Path) -> tuple[Path, Path]:
    """The files of a work: the whole, and the present stage.

    Args:
        path: of both, without their endings.
    """
    return path.with_name(f"{path.name}.safetensors"), path.with_name(
        f"{path.name}.stage.safetensors"
    )


def _digest(tensors: Mapping[str, Tensor], record: Json) -> str:
    """Of all that a file holds beside this."""
    digest = sha256(json.dumps(record, sort_keys=True).encode())
    for name, values in sorted(tensors.items()):
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
        digest.update(values.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _read_state(path: Path, expected: Json) -> WorkState | None:
    """A state whose facts are those that are expected; None, with a warning, where it is not."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, "pt") as file:
            record = json.loads(file.metadata()["state"])
            written = record.pop("sha256")
            # Cloned: products of matrices are rounded otherwise where memory begins elsewhere.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        if {key: record[key] for key in expected} != expected:
            _log.warning("%s: is of other work, which is begun anew", path)
            return None
        if not isinstance(record["name"], str) or not isinstance(record["facts"], dict):
            raise ValueError("its facts are no state's")
        if written != _digest(tensors, record):
            raise ValueError("it was changed after it was written")
        if found := find_not_finite({**tensors, "facts": record}):
            raise ValueError(found)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
        raise_if_refused(error)
        _log.warning("%s: cannot be gone on from (%s)", path, error)
        return None
    return WorkState(tensors, record)


class _KeptStage(StageState):
    """The present stage of a file."""

    def __init__(self, states: StageStates) -> None:
        self._states = states

    def read(self) -> WorkState | None:
        return self._states.read()

    def write(self, state: WorkState) -> None:
        self._states.write(state)
