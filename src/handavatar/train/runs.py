"""The run folder: options, facts, log, checkpoints; survives a kill at any moment.

```
run/  options.json  run.json  seeds.json  log.jsonl  avatar.safetensors  .lock  .handavatar
      {geometry,samples,detail}.unfinished[.stage].safetensors
      checkpoints/step-000001000/{model,optimizer}.safetensors  state.json  MANIFEST.json
      corrupt/  evaluation/  renders/
```

A checkpoint is written aside, synced to disk and renamed into place, so a folder called ``step-*``
is whole unless the disk itself lied; the manifest's sizes and hashes find that out. What holds NaN
or infinity is not written, so the newest checkpoint is one to go on from; older versions wrote such
ones, which are put aside like broken ones. Tensors are safetensors, the rest is JSON: nothing here
can execute what it reads.
"""

import errno
import json
import logging
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from handavatar.avatar import CheckpointError
from handavatar.errors import raise_if_refused
from handavatar.jobs.files import (
    MARKER,
    FolderKind,
    is_empty,
    mark_folder,
    put_in_place,
    read_marker,
    read_plain,
    write_atomically,
)
from handavatar.jobs.finite import find_not_finite, require_finite
from handavatar.jobs.locks import LockHeld, hold_lock
from handavatar.jobs.logs import is_step, json_lines
from handavatar.train.provenance import package_versions, source_commit

Json = dict[str, Any]

_SCHEMA = 1
LOCK = ".lock"
"""Its name in the run's folder."""
_KEPT_CHECKPOINTS = 3
_MANIFEST = "MANIFEST.json"
_STATE = "state.json"
_STEP_FOLDER = re.compile(r"step-(\d{9,})")
_FILE_NAME = re.compile(r"[a-z][a-z0-9_]*\.(safetensors|json)")
_MAX_JSON_BYTES = 64 << 20
_MAX_MANIFEST_BYTES = 1 << 20

_log = logging.getLogger(__name__)


def _is_older_run(folder: Path) -> bool:
    """Whether a version that left no marker has begun the run."""
    try:
        facts = read_json(folder / "run.json", "")
    except (CheckpointError, OSError):
        return False
    return {"schema", "versions", "seed", "capture", "command"} <= facts.keys()


UNFINISHED_STAGES = ("geometry.unfinished", "samples.unfinished", "detail.unfinished")
"""Files of a run, without their endings, in which stages between checkpoints keep their state."""
RUN = FolderKind("run", is_older=_is_older_run)
"""The folder that :func:`create_run` makes."""


@dataclass(frozen=True)
class Run:
    """A run folder on disk.

    Attributes:
        folder: holds everything that one training wrote.
    """

    folder: Path

    @property
    def checkpoints(self) -> Path:
        """Folder of the ``step-*`` folders."""
        return self.folder / "checkpoints"

    @property
    def log(self) -> Path:
        """One JSON object a line, each with its ``step``."""
        return self.folder / "log.jsonl"

    @property
    def avatar(self) -> Path:
        """The finished avatar, one file."""
        return self.folder / "avatar.safetensors"

    @property
    def options(self) -> Json:
        """The options the run was started with."""
        return read_json(self.folder / "options.json", "start a new run: handavatar train CAPTURE")

    @property
    def facts(self) -> Json:
        """Contents of ``run.json``: versions, commit, seed, capture, command, perceptual loss."""
        return read_json(self.folder / "run.json", "start a new run: handavatar train CAPTURE")


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint folder whose manifest was found true.

    Attributes:
        folder: ``.../checkpoints/step-000001000``.
        step: training steps done when it was written.
    """

    folder: Path
    step: int


@dataclass(frozen=True)
class CheckpointContents:
    """What a checkpoint holds.

    Attributes:
        tensors: file stem (``model``, ``optimizer``) to named tensors, on the CPU.
        state: everything else, as JSON.
    """

    tensors: dict[str, dict[str, Tensor]]
    state: Json


# --- the folder -----------------------------------------------------------------------------------


def default_run_folder(capture: Path, method: str, outputs: Path = Path("outputs")) -> Path:
    """``outputs/{capture}/{method}/{time}``, local time to the second; always in UTF-8."""
    name = capture.resolve().name.encode("utf-8", "replace").decode().replace("?", "_")
    return outputs / name / method / datetime.now().strftime("%Y-%m-%d_%H%M%S")


def interrupted_run_folder(
    capture_sha256: str, method: str, outputs: Path = Path("outputs")
) -> Path | None:
    """The run to go on with: of those that are not finished, the one that was begun last.

    What a run is of, when it was begun and whether it is finished it says itself; names and dates
    of folders say nothing. Of what cannot be read, a warning tells.

    Args:
        capture_sha256: fingerprint of the capture.
        method: of the training.
        outputs: whose runs, three folders deep, are asked.
    """
    found: list[tuple[datetime, Path]] = []
    for path in sorted(outputs.glob("*/*/*/run.json")):
        run = Run(path.parent)
        if run.avatar.exists():
            continue
        try:
            facts, options = run.facts, run.options
            is_of = facts["capture"]["sha256"], options["method"]
            begun = datetime.fromisoformat(facts["started"])
        except (CheckpointError, OSError, KeyError, TypeError, ValueError) as error:
            what = str(error).splitlines()[0] if isinstance(error, CheckpointError) else repr(error)
            _log.warning("%s: is passed over (%s)", run.folder, what)
            continue
        if is_of == (capture_sha256, method):
            # Without a zone it is local time.
            found.append((begun.astimezone(), run.folder))
    return max(found)[1] if found else None


def create_run(
    folder: Path,
    options: Json,
    *,
    seed: int,
    capture: Path,
    capture_sha256: str,
    perceptual: str,
) -> Run:
    """Makes the folder with ``options.json`` and ``run.json``.

    Args:
        folder: must not exist, be empty or hold the beginnings of a start that was killed.
        options: what to train, JSON values only.
        seed: of the training.
        capture: folder of the capture.
        capture_sha256: fingerprint of the capture's files.
        perceptual: the perceptual loss in use, ``lpips-vgg`` or the substitute's name.

    Raises:
        CheckpointError: if the folder holds something already.
    """
    facts = {
        "schema": _SCHEMA,
        "versions": package_versions(),
        "commit": source_commit(),
        "seed": seed,
        "capture": {"path": str(capture.resolve()), "sha256": capture_sha256},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "perceptual": perceptual,
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    if not is_empty(folder) and not is_unfinished_start(folder):
        raise CheckpointError(
            f"{folder}: not empty, expected a new folder",
            "",
            "name another with `out`, or continue the run that is there with `resume='auto'`",
        )
    run = Run(folder)
    folder.mkdir(parents=True, exist_ok=True)
    mark_folder(folder, RUN)
    run.checkpoints.mkdir(exist_ok=True)
    write_json(folder / "options.json", options)
    write_json(folder / "run.json", facts)
    return run


def is_unfinished_start(folder: Path) -> bool:
    """Whether a folder is what :func:`create_run` leaves if it is killed between its files."""
    if not folder.is_dir():
        return False
    if (folder / "checkpoints").is_dir() and any((folder / "checkpoints").iterdir()):
        return False
    names = {path.name for path in folder.iterdir() if not path.name.startswith(".tmp-")}
    if not names or not names <= {MARKER, "checkpoints", "options.json"}:
        return False
    if MARKER in names:
        return (read_marker(folder) or {}).get("kind") == RUN.name
    # Before there were markers. Nothing is lost with what is not somebody else's.
    options = read_json(folder / "options.json", "") if "options.json" in names else {}
    return "checkpoints" in names and (not options or "avatar_schema" in options)


def open_run(folder: Path) -> Run:
    """An existing run folder.

    Raises:
        CheckpointError: if it is none.
    """
    if not (folder / "run.json").is_file():
        raise CheckpointError(
            f"{folder}: no run.json in it, so it is not a run folder",
            "",
            "give the folder that handavatar train printed, under outputs/",
        )
    return Run(folder)


@contextmanager
def locked(run: Run) -> Iterator[None]:
    """One writer per run folder; the lock falls with the process, however that ends.

    Raises:
        CheckpointError: if another process holds it.
    """
    with ExitStack() as held:
        try:
            held.enter_context(hold_lock(run.folder / LOCK))
        except LockHeld as error:
            raise CheckpointError(
                f"{run.folder}: {error.found} is writing this run",
                "",
                "wait until it has ended or stop it, or train into another folder with `out`",
            ) from error
        yield


def write_json(path: Path, value: Json) -> None:
    """Replaces a JSON file in one step; NaN is refused."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_atomically({path: text.encode()})


# --- the log --------------------------------------------------------------------------------------


def append_log(run: Run, step: int, record: Json) -> None:
    """Adds one line, ``{"step": step, ...}``, in one write."""
    line = json.dumps({"step": step} | record, allow_nan=False) + "\n"
    with open(run.log, "ab", buffering=0) as file:
        file.write(line.encode())


def read_log(run: Run) -> list[Json]:
    """All whole lines; a line that a kill tore is left out."""
    return [record for _, record in _log_lines(run)]


def truncate_log(run: Run, step: int) -> None:
    """Forgets what was logged after ``step``, so that a resumed log equals an uninterrupted one."""
    kept = b"".join(line for line, record in _log_lines(run) if record["step"] <= step)
    write_atomically({run.log: kept})


def _log_lines(run: Run) -> Iterator[tuple[bytes, Json]]:
    if run.log.exists():
        for line, record in json_lines(read_plain(run.log)):
            if is_step(record.get("step")):
                yield line, record


# --- checkpoints ----------------------------------------------------------------------------------


def save_checkpoint(
    run: Run, step: int, tensors: Mapping[str, Mapping[str, Tensor]], state: Json
) -> Checkpoint:
    """Writes a checkpoint so that at every moment a whole one lies on the disk.

    Args:
        run: whose lock the caller holds.
        step: training steps done.
        tensors: file stem (``model``, ``optimizer``) to named tensors.
        state: everything else; JSON values only, no NaN.

    Raises:
        NotFinite: if a tensor or the state holds NaN or infinity; nothing is written then.
        OSError: if the disk is full or refuses; earlier checkpoints stay as they were.
    """
    require_finite({**tensors, "state": state}, f"checkpoint of step {step}")
    for stem in tensors:
        if not _FILE_NAME.fullmatch(f"{stem}.safetensors"):
            raise ValueError(f"checkpoint file {stem!r}: expected lower-case letters and _")
    payloads = {
        f"{stem}.safetensors": safetensors.torch.save(
            {name: value.detach().cpu().contiguous().clone() for name, value in group.items()}
        )
        for stem, group in tensors.items()
    }
    payloads[_STATE] = json.dumps(state, allow_nan=False).encode()
    files = {
        name: {"size": len(data), "sha256": sha256(data).hexdigest()}
        for name, data in payloads.items()
    }
    manifest = json.dumps({"schema": _SCHEMA, "step": step, "files": files}, indent=2).encode()

    run.checkpoints.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(run)
    _require_free_space(run.checkpoints, 2 * sum(len(data) for data in payloads.values()))
    final = run.checkpoints / f"step-{step:09d}"
    aside = run.checkpoints / f".tmp-{os.getpid()}-{step}"
    try:
        aside.mkdir()
        for name, data in payloads.items():
            (aside / name).write_bytes(data)
        (aside / _MANIFEST).write_bytes(manifest)
        put_in_place(aside, final)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    _remove_leftovers(run)
    for _, folder in _step_folders(run)[_KEPT_CHECKPOINTS:]:
        # Renamed first: a kill half way through the removal leaves no step-* folder with holes.
        doomed = run.checkpoints / f".tmp-{os.getpid()}-pruned-{folder.name}"
        folder.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)
    return Checkpoint(final, step)


def latest_checkpoint(run: Run) -> Checkpoint | None:
    """The newest that is whole and finite; others move to ``corrupt/`` with a warning."""
    for step, folder in _step_folders(run):
        checkpoint = Checkpoint(folder, step)
        try:
            load_checkpoint(checkpoint)
        except CheckpointError as error:
            _log.warning("%s; moved to corrupt/", str(error).splitlines()[0])
            _move_to_corrupt(run, folder)
        else:
            return checkpoint
    return None


def load_checkpoint(checkpoint: Checkpoint) -> CheckpointContents:
    """Reads a checkpoint; every byte is checked against the manifest first.

    Raises:
        CheckpointError: if a file is missing, cut, changed or of another version, or if it holds
            NaN or infinity.
    """
    payloads = _verified_payloads(checkpoint)
    tensors: dict[str, dict[str, Tensor]] = {}
    state: Json = {}
    for name, data in payloads.items():
        path = checkpoint.folder / name
        try:
            if name == _STATE:
                state = json.loads(data)
            else:
                tensors[path.stem] = safetensors.torch.load(data)
        except (ValueError, RecursionError, SafetensorError) as error:
            raise_if_refused(error)
            raise _broken(path, f"cannot be read ({error})") from error
    if found := find_not_finite({**tensors, "state": state}):
        raise _broken(checkpoint.folder, f"cannot be gone on from: {found}")
    return CheckpointContents(tensors, state)


def _verified_payloads(checkpoint: Checkpoint) -> dict[str, bytes]:
    path = checkpoint.folder / _MANIFEST
    try:
        manifest = json.loads(read_plain(path, _MAX_MANIFEST_BYTES))
        files = {
            str(name): (int(entry["size"]), str(entry["sha256"]))
            for name, entry in manifest["files"].items()
        }
        schema, step = int(manifest["schema"]), int(manifest["step"])
    except FileNotFoundError as error:
        raise _broken(path, "is missing") from error
    except OSError as error:
        raise_if_refused(error)
        raise _broken(path, f"cannot be read ({error.strerror})") from error
    except (
        *(ValueError, KeyError, TypeError, AttributeError),
        *(RecursionError, OverflowError),
    ) as error:
        raise _broken(path, "is not a manifest (cut or overwritten)") from error
    if schema > _SCHEMA:
        raise CheckpointError(
            f"{path}: written by a newer version (schema {schema}, this one knows {_SCHEMA})",
            "",
            "update handavatar, or train again with this version",
        )
    if step != checkpoint.step or _STATE not in files:
        raise _broken(path, f"does not belong to step {checkpoint.step}")
    payloads = {}
    for name, (size, digest) in files.items():
        member = checkpoint.folder / name
        if not _FILE_NAME.fullmatch(name):
            raise _broken(path, f"names a file outside the folder: {name!r}")
        try:
            found = member.stat().st_size
            data = read_plain(member, size) if found == size else b""
        except OSError as error:
            raise_if_refused(error)
            raise _broken(member, f"cannot be read ({error.strerror})") from error
        if found != size:
            raise _broken(member, f"has {found} bytes, the manifest says {size}")
        if sha256(data).hexdigest() != digest:
            raise _broken(member, "has other contents than the manifest says")
        payloads[name] = data
    return payloads


def _broken(path: Path, what: str) -> CheckpointError:
    return CheckpointError(
        f"{path}: {what}",
        "",
        "continue from the newest whole checkpoint with `resume='auto'`, or train again",
    )


def _step_folders(run: Run) -> list[tuple[int, Path]]:
    """All ``step-*`` folders, newest first."""
    if not run.checkpoints.is_dir():
        return []
    matches = ((_STEP_FOLDER.fullmatch(path.name), path) for path in run.checkpoints.iterdir())
    return sorted(((int(match[1]), path) for match, path in matches if match), reverse=True)


def _move_to_corrupt(run: Run, folder: Path) -> None:
    corrupt = run.folder / "corrupt"
    corrupt.mkdir(exist_ok=True)
    target, number = corrupt / folder.name, 1
    while target.exists():
        target, number = corrupt / f"{folder.name}.{number}", number + 1
    folder.rename(target)


def _remove_leftovers(run: Run) -> None:
    """What a killed process left half written or half removed; the caller is the one writer."""
    for path in run.checkpoints.glob(".tmp-*"):
        shutil.rmtree(path, ignore_errors=True)


def _require_free_space(folder: Path, num_bytes: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        raise OSError(
            errno.ENOSPC, f"a checkpoint needs {num_bytes} bytes free, found {free}", str(folder)
        )


def read_json(path: Path, remedy: str) -> Json:
    """A JSON object from a file of the run.

    Args:
        path: of the file.
        remedy: what to do if there is none.

    Raises:
        CheckpointError: if the file is missing or holds something else.
    """
    try:
        value = json.loads(read_plain(path, _MAX_JSON_BYTES))
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: is missing\n{remedy}") from error
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: is not JSON ({error})\n{remedy}") from error
    if not isinstance(value, dict):
        raise CheckpointError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value
