"""Files and folders of frames that are filled aside, and renamed when they are whole.

What a killed process has finished stays, and the same command given again does only the rest.
"""

import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

_RECORD = "unfinished.json"


def write_whole(files: Mapping[Path, bytes]) -> None:
    """Writes all files aside and then renames them: nothing half written is ever at its place."""
    pending: dict[Path, Path] = {}
    try:
        for path, content in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            pending[path] = path.with_name(f".tmp-{os.getpid()}-{path.name}")
            pending[path].write_bytes(content)
        for path, aside in pending.items():
            os.replace(aside, path)
    finally:
        for aside in pending.values():
            aside.unlink(missing_ok=True)


def is_taken(folder: Path) -> bool:
    """Whether something lies where a folder is to be written."""
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


class UnfinishedFolder:
    """``NAME.unfinished`` beside the folder that it will become.

    A frame is finished when all its files are there: each is written aside and renamed.
    """

    def __init__(self, target: Path, record: dict[str, Any]) -> None:
        """Names the folder; nothing is written yet.

        Args:
            target: what it becomes.
            record: all that the frames depend on, as JSON; frames of another record are worthless.
        """
        self.target = target
        self.path = target.with_name(target.name + ".unfinished")
        self._record = json.dumps(record, sort_keys=True)

    def begin(self, overwrite: bool) -> None:
        """Makes the folder, or keeps what the same work has left there; one process alone.

        Raises:
            ValueError: if the target holds something and may not be overwritten.
        """
        target, record = self.target, self.path / _RECORD
        if is_taken(target) and not overwrite:
            raise ValueError(f"--out {target}: not empty; name another, or add --overwrite")
        if record.is_file() and record.read_text(encoding="utf-8") == self._record:
            return
        shutil.rmtree(self.path, ignore_errors=True)
        self.path.mkdir(parents=True)
        self.write(_RECORD, self._record.encode())

    def has(self, names: Iterable[str]) -> bool:
        """Whether all these files are there, whole."""
        return all((self.path / name).is_file() for name in names)

    def write(self, name: str, content: bytes) -> None:
        """Writes one file aside and renames it into place."""
        write_whole({self.path / name: content})

    def finish(self) -> None:
        """Takes the target's place; one process alone, when all is there."""
        (self.path / _RECORD).unlink()
        # Of killed processes.
        for left in self.path.rglob(".tmp-*"):
            left.unlink()
        if self.target.exists():
            shutil.rmtree(self.target)
        self.path.rename(self.target)

    def abandon(self) -> None:
        """Removes the folder unless a frame is finished: then a rerun goes on from it."""
        if not any(path.is_dir() for path in self.path.glob("*")):
            shutil.rmtree(self.path, ignore_errors=True)
