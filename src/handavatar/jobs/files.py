"""Files and folders that are written aside, and put in place when they are whole.

Every folder that the program makes carries a marker, ``.handavatar``: what it is, the version that
made it, when, and, where a folder is put in place at once, the names of its files. Only what
carries the marker is ever removed or replaced, and only while it holds nothing of somebody else's.

A folder of frames is filled under the name ``NAME.unfinished``: what a killed process has finished
stays, and the same command given again does only the rest.
"""

import contextlib
import ctypes
import errno
import fnmatch
import json
import logging
import os
import shutil
import socket
import stat
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

from handavatar import __version__
from handavatar.errors import ErrorKind, HandAvatarError
from handavatar.jobs.processes import is_running

MARKER = ".handavatar"
"""Name of the file that says that, and how, the program made a folder."""
_MAX_MARKER_BYTES = 64 * 2**20
_OF_THE_SYSTEM = {".DS_Store", "Thumbs.db", "desktop.ini"}
_NAMED_STRANGERS = 3
_KEPT_OF_A_NAME = 40
_NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.ENOSYS}
"""A file system that keeps nothing says one of these, and it is none's fault."""
_AT_WORKING_FOLDER, _EXCHANGE = -100, 2
"""Of ``renameat2``: AT_FDCWD and RENAME_EXCHANGE, as Linux's headers have them."""

_log = logging.getLogger(__name__)


class FolderInUse(HandAvatarError):
    """A place where a folder cannot be written: what lies there, and what to do about it."""

    kind = ErrorKind.USAGE

    def __init__(self, found: str, remedy: str = "") -> None:
        """Nothing else is expected than a place that is free."""
        super().__init__(found, "", remedy)


def _never(folder: Path) -> bool:
    return False


@dataclass(frozen=True)
class FolderKind:
    """One kind of folders that the program makes.

    Attributes:
        name: in the marker and in messages, such as ``capture``.
        files: patterns of the files that the program writes there, relative to the folder; a
            ``*`` stands for folders as well.
        is_older: whether a folder without a marker was made by a version that wrote none.
    """

    name: str
    files: tuple[str, ...] = ()
    is_older: Callable[[Path], bool] = _never


@contextlib.contextmanager
def write_aside(path: Path, is_durable: bool = True) -> Iterator[Path]:
    """Gives the name of a file to be written, which takes its place when the block ends.

    If the block fails, what lay at ``path`` is as it was, and what was written is gone.

    Args:
        path: of the file; folders above it are made.
        is_durable: whether the file must outlive a crash of the machine from then on.

    Yields:
        A name in the same folder, with the same ending.

    Raises:
        OSError: if it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Of a long name the end alone: the whole would be longer than a name may be.
    unique = f"{os.getpid()}-{threading.get_ident()}"
    aside = path.with_name(f".tmp-{unique}-{path.name[-_KEPT_OF_A_NAME:]}")
    try:
        yield aside
        if is_durable:
            _sync(aside)
        os.replace(aside, path)
        if is_durable:
            _sync(path.parent)
    finally:
        aside.unlink(missing_ok=True)


def write_atomically(files: dict[Path, bytes], is_durable: bool = True) -> None:
    """Writes all files aside, then renames them in this order: nothing half written is in place.

    Args:
        files: contents by path.
        is_durable: as of :func:`write_aside`.

    Raises:
        OSError: if one cannot be written; then none is renamed, unless renaming is what failed.
    """
    with contextlib.ExitStack() as stack:
        for path, content in reversed(files.items()):  # The last to enter is the first to leave.
            stack.enter_context(write_aside(path, is_durable)).write_bytes(content)


def _sync(path: Path) -> None:
    """Has the disk keep a file, or the names in a folder."""
    if os.name == "nt":  # which opens no folders, and files for reading only to no avail
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise
    finally:
        os.close(descriptor)


def _sync_tree(folder: Path) -> None:
    for top, _, names in os.walk(folder):
        for name in names:
            if not (Path(top) / name).is_symlink():
                _sync(Path(top) / name)
        _sync(Path(top))


# --- the marker -----------------------------------------------------------------------------------


def mark_folder(folder: Path, kind: FolderKind, facts: Mapping[str, Any] | None = None) -> None:
    """Writes the marker of a folder that is there.

    Args:
        folder: that the program has made.
        kind: what it is.
        facts: what else the marker says, as JSON.
    """
    marker = {
        "program": "handavatar",
        "version": __version__,
        "kind": kind.name,
        "time": datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    text = json.dumps(marker | dict(facts or {}), allow_nan=False) + "\n"
    write_atomically({folder / MARKER: text.encode()})


def read_plain(path: Path, most: int = 1 << 30) -> bytes:
    """All of a plain file.

    Args:
        path: of the file.
        most: bytes.

    Raises:
        OSError: it is missing, larger, or no plain file: into a pipe nobody may ever write.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "is not a plain file", str(path))
    if found.st_size > most:
        raise OSError(
            errno.EINVAL, f"has {found.st_size} bytes, at most {most} are read", str(path)
        )
    return path.read_bytes()


def read_marker(folder: Path) -> dict[str, Any] | None:
    """What the marker of a folder says; None if it has none, or one that is not ours."""
    path = folder / MARKER
    try:
        if path.is_symlink():
            return None
        marker = json.loads(read_plain(path, _MAX_MARKER_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(marker, dict) or marker.get("program") != "handavatar":
        return None
    return marker if isinstance(marker.get("kind"), str) else None


def make_folder(folder: Path, kind: FolderKind) -> None:
    """Makes a folder, with those above it, and marks it; one that holds something stays as it is.

    Raises:
        OSError: if it cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not any(folder.iterdir()):
        mark_folder(folder, kind)


def claim_folder(folder: Path, kind: FolderKind) -> None:
    """Makes a folder in which files are written one by one, or goes on in one of the same kind.

    Nothing is removed.

    Raises:
        FolderInUse: if it holds something else, whose files might be written over.
    """
    if folder.exists() and not folder.is_dir():
        raise FolderInUse(f"{folder} is a file, expected a folder", "name a folder")
    if is_empty(folder):
        make_folder(folder, kind)
        return
    marker = read_marker(folder)
    if marker is None and kind.is_older(folder):
        mark_folder(folder, kind)
    elif marker is None or marker["kind"] != kind.name:
        raise FolderInUse(
            f"{folder}: not empty, and {_refused(marker, kind)}",
            "name a folder that is new or empty",
        )


def name_files(folder: Path, patterns: Iterable[str] = ("*",)) -> None:
    """Adds to a folder's marker which files are the program's: from now on all others are not.

    Args:
        folder: that carries the marker.
        patterns: as of :class:`FolderKind`; all the files that are there by default.

    Raises:
        FolderInUse: if it carries none.
    """
    marker = read_marker(folder)
    if marker is None:
        raise FolderInUse(f"{folder} carries no {MARKER}", "mark it first")
    names = sorted(path.relative_to(folder).as_posix() for path in _files_in(folder))
    marker["files"] = [name for name in names if name != MARKER and _fits(name, patterns)]
    write_atomically({folder / MARKER: (json.dumps(marker) + "\n").encode()})


def strangers_in(folder: Path, kind: FolderKind) -> list[str]:
    """Files in a folder that the program has not written, relative to it.

    Args:
        folder: of this kind. If its marker lists files, these are the program's, else those that
            the kind's patterns fit.
        kind: what the program writes there.
    """
    listed = (read_marker(folder) or {}).get("files")
    own = set(listed) if isinstance(listed, list) else None
    strangers = []
    for path in _files_in(folder):
        relative = path.relative_to(folder).as_posix()
        if relative == MARKER or path.name in _OF_THE_SYSTEM or _is_leftover(path):
            continue
        is_own = relative in own if own is not None else _fits(relative, kind.files)
        if path.is_symlink() or not is_own:
            strangers.append(relative)
    return sorted(strangers)


def _files_in(folder: Path) -> list[Path]:
    """All files and links below a folder; links are not followed."""
    found = []
    for top, folders, names in os.walk(folder):
        links = [name for name in folders if (Path(top) / name).is_symlink()]
        found += [Path(top) / name for name in (*links, *names)]
    return found


def _fits(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _is_leftover(path: Path) -> bool:
    """Whether a killed process has left a file half written."""
    return fnmatch.fnmatchcase(path.name, ".tmp-[0-9]*-*")


def _refused(marker: Mapping[str, Any] | None, kind: FolderKind) -> str:
    """Why a folder is not of this kind."""
    if marker is None:
        return f"holds no {kind.name} of this program's making"
    return f"is marked as {_printable(marker['kind'])}, not as {kind.name}"


def _printable(name: str) -> str:
    """A name from outside without what a terminal would obey."""
    return name[:200] if name.isprintable() else ascii(name[:200])


def is_empty(folder: Path) -> bool:
    """Whether nothing lies where a folder is to be written, or an empty folder."""
    return not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))


def files_named(*names: str | Path | None) -> list[Path]:
    """Those of the names that are files: a word of an option can mean one, or something else."""
    return [Path(name) for name in names if name is not None and Path(name).is_file()]


def refuse_file_in_use(path: Path, overwrite: bool = False, inputs: Iterable[Path] = ()) -> None:
    """Refuses a place for a new file where something lies.

    Args:
        path: where the file is to be.
        overwrite: whether a file, which nothing marks as the program's, may be replaced; never a
            link, nor what is read.
        inputs: files that are read.

    Raises:
        FolderInUse: if a file lies there, or something that is none.
    """
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not path.is_file():
        kind = "a link" if path.is_symlink() else "no file"
        raise FolderInUse(f"{path} is {kind}, expected none or a file", "name another file")
    if any(_is_same(path, other) for other in inputs):
        raise FolderInUse(f"{path} is what is read", "name another file")
    if not overwrite:
        raise FolderInUse(f"{path} exists", "name another file, or use `overwrite=True`")


# --- replacing a folder ---------------------------------------------------------------------------


def refuse_folder_in_use(
    target: Path, kind: FolderKind, overwrite: bool = False, inputs: Iterable[Path] = ()
) -> None:
    """Refuses a place for a new folder, unless nothing of anybody's is lost there.

    Args:
        target: where a whole folder is to be put.
        kind: what it will be.
        overwrite: whether a folder of the same kind, and nothing else, may be replaced.
        inputs: files and folders that are read; the target may not hold them.

    Raises:
        FolderInUse: if something else lies there: a file, a link, a folder that the program has
            not made, one of another kind, one with a stranger's file in it, a home directory, the
            folder the command was started in or one above it or above an input.
    """
    target = _absolute(target)
    if target.is_symlink():
        raise FolderInUse(
            f"{target} is a link, expected a folder", "give what it leads to, or another name"
        )
    if not target.exists():
        return
    if not target.is_dir():
        raise FolderInUse(f"{target} is a file, expected a folder", "name another folder")
    for path, what in _irreplaceable(inputs):
        if _is_within(path, target):
            holds = "is" if _is_same(path, target) else "holds"
            raise FolderInUse(f"{target} {holds} {what}", "name another folder")
    if os.path.ismount(target):
        raise FolderInUse(f"{target} is where a disk is mounted", "name a folder in it")
    if is_empty(target):
        return
    if not overwrite:
        raise FolderInUse(f"{target}: not empty", "name another folder, or use `overwrite=True`")
    marker = read_marker(target)
    if not kind.is_older(target) if marker is None else marker["kind"] != kind.name:
        raise FolderInUse(
            f"{target} {_refused(marker, kind)}: it will not be overwritten",
            "name another folder, or move away what lies there",
        )
    strangers = strangers_in(target, kind)
    if strangers:
        raise FolderInUse(
            f"{target} holds {_listed(strangers)}, not written by this program: it will not be "
            "overwritten",
            "move that away, or name another folder",
        )


def swap_folder(
    whole: Path,
    target: Path,
    kind: FolderKind,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
) -> None:
    """Puts a whole folder where it belongs; what it replaces is removed when it is in place.

    The two exchange their names in one step: at every moment the old or the new folder is at its
    place. Where the system cannot do that (only Linux can), the old one takes a hidden name beside
    and the new one its place; if that fails the old one is put back, and a process that is killed
    between the two leaves both, whole, for :func:`restore_folder`.

    Args:
        whole: folder on the same disk as ``target``, with its marker.
        target: as in :func:`refuse_folder_in_use`, and so are the others.
        kind: what it is.
        overwrite: whether a folder of the same kind may be replaced.
        inputs: what the target may not hold.

    Raises:
        FolderInUse: as :func:`refuse_folder_in_use`; nothing has changed then.
    """
    target = _absolute(target)
    refuse_folder_in_use(target, kind, overwrite, inputs)
    if is_empty(target):
        put_in_place(whole, target)
        return
    if read_marker(target) is None:
        mark_folder(target, kind)
    hidden = _hidden_name(target)
    os.rename(whole, hidden)
    try:
        put_in_place(hidden, target)
    except BaseException:
        os.rename(hidden, whole)
        raise
    for left in _hidden_folders(target):
        try:
            if any(left.iterdir()):
                remove_folder(left)
            else:
                left.rmdir()
        except OSError as error:
            _log.warning("%s: replaced, but cannot be removed (%s)", left, error)


def put_in_place(whole: Path, target: Path) -> None:
    """Gives a whole folder its place, kept by the disk; what lay there is left beside, hidden.

    Args:
        whole: folder on the same disk, of a hidden name. A folder that it replaces has this name
            afterwards, or this one, ``-old`` and a number.
        target: an empty place, or a folder.

    Raises:
        OSError: if it cannot be; then all is as it was.
    """
    _sync_tree(whole)
    if is_empty(target):
        os.rename(whole, target)
    elif not _exchange(whole, target):
        old = _free_number(whole.with_name(f"{whole.name}-old"))
        os.rename(target, old)
        try:
            os.rename(whole, target)
        except BaseException:
            os.rename(old, target)
            raise
    _sync(target.parent)


def _exchange(first: Path, second: Path) -> bool:
    """Lets two folders exchange their names in one step; False where the system cannot."""
    if sys.platform != "linux":
        return False
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    here = ctypes.c_int(_AT_WORKING_FOLDER)
    names = os.fsencode(first), os.fsencode(second)
    if rename(here, names[0], here, names[1], ctypes.c_uint(_EXCHANGE)) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), str(second))


def restore_folder(target: Path) -> None:
    """Puts a folder back that a process, killed while it replaced it, left under a hidden name."""
    target = _absolute(target)
    if target.exists() or target.is_symlink():
        return
    for old in _hidden_folders(target):
        if any(old.iterdir()):
            os.rename(old, target)
            return


def remove_folder(folder: Path) -> None:
    """Removes a folder that carries the marker, the marker last.

    Raises:
        FolderInUse: if it carries none.
        OSError: if it cannot be removed; what is left carries the marker still.
    """
    if folder.is_symlink() or read_marker(folder) is None:
        raise FolderInUse(f"{folder} is nothing that this program made", "remove it yourself")
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != MARKER:
            path.unlink()
    (folder / MARKER).unlink()
    folder.rmdir()


def _hidden_name(target: Path) -> Path:
    return _free_name(target, "replaced")


def _free_name(target: Path, what: str) -> Path:
    return _free_number(target.with_name(f".{target.name}.{what}-{os.getpid()}"))


def _free_number(begin: Path) -> Path:
    """The first name that is free of those that begin so."""
    for number in count():
        name = begin.with_name(f"{begin.name}-{number}")
        if not os.path.lexists(name):
            return name
    raise AssertionError("there is always a number that is free")


def _hidden_folders(target: Path) -> list[Path]:
    """Replaced folders of this name that a process, ended before its time, left; or their last."""
    if not target.parent.is_dir():
        return []
    begin = f".{target.name}.replaced-"
    found = (path for path in target.parent.iterdir() if path.name.startswith(begin))
    folders = [path for path in found if path.is_dir() and not path.is_symlink()]
    return sorted(p for p in folders if read_marker(p) is not None or not any(p.iterdir()))


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _irreplaceable(inputs: Iterable[Path]) -> list[tuple[Path, str]]:
    """What nobody wants to lose, and what to call it."""
    home = os.path.expanduser("~")
    places = [(Path(home), "a home directory")] if os.path.isabs(home) else []
    with contextlib.suppress(FileNotFoundError):  # It was removed meanwhile.
        places.append((Path.cwd(), "the folder that the command was started in"))
    return [*places, *((Path(path), f"what is read: {path}") for path in inputs)]


def _is_within(path: Path, folder: Path) -> bool:
    path = Path(os.path.realpath(path))
    return any(_is_same(place, folder) for place in (path, *path.parents))


def _is_same(path: Path, other: Path) -> bool:
    try:
        return os.path.samefile(path, other)
    except OSError:
        return False


def _listed(names: list[str]) -> str:
    shown = ", ".join(_printable(name) for name in names[:_NAMED_STRANGERS])
    more = len(names) - _NAMED_STRANGERS
    return f"{shown} and {more} more" if more > 0 else shown


# --- folders that are made at once ----------------------------------------------------------------


@contextlib.contextmanager
def fill_folder(
    target: Path,
    kind: FolderKind,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
) -> Iterator[Path]:
    """Gives a folder to be filled, which takes its place when the block ends, marked and whole.

    If the block fails, what was there before is as it was, and what was written is gone. What
    killed processes of this machine have left is removed.

    Args:
        target: as in :func:`refuse_folder_in_use`, and so are the others.
        kind: what it will be.
        overwrite: whether a folder of the same kind may be replaced.
        inputs: what the target may not hold.

    Yields:
        An empty folder beside ``target``, with the marker.

    Raises:
        FolderInUse: as :func:`refuse_folder_in_use`; before the block, and after it if something
            has come meanwhile.
        OSError: if it cannot be made.
    """
    target = _absolute(target)
    inputs = tuple(inputs)
    restore_folder(target)
    refuse_folder_in_use(target, kind, overwrite, inputs)
    target.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(target, kind)
    aside = _free_name(target, "unfinished")
    aside.mkdir()
    try:
        mark_folder(aside, kind, {"process": os.getpid(), "host": socket.gethostname()})
        yield aside
        mark_folder(aside, kind)
        name_files(aside)
        swap_folder(aside, target, kind, overwrite, inputs)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _remove_abandoned(target: Path, kind: FolderKind) -> None:
    """Removes what killed processes have left of :func:`fill_folder`."""
    begin = f".{target.name}.unfinished-"
    for path in target.parent.iterdir():
        if path.name.startswith(begin) and path.is_dir() and not path.is_symlink():
            marker = read_marker(path) or {}
            is_ours = marker.get("kind") == kind.name and marker.get("host") == socket.gethostname()
            process = marker.get("process")
            if is_ours and isinstance(process, int) and not is_running(process):
                remove_folder(path)  # One killed before it could mark its folder leaves it empty.


# --- folders that fill slowly ---------------------------------------------------------------------


class UnfinishedFolder:
    """``NAME.unfinished`` beside the folder that it will become.

    A frame is finished when all its files are there: each is written aside and renamed.
    """

    def __init__(
        self,
        target: Path,
        kind: FolderKind,
        record: dict[str, Any],
        inputs: Iterable[Path] = (),
    ) -> None:
        """Names the folder; nothing is written yet.

        Args:
            target: what it becomes.
            kind: what that will be.
            record: all that the frames depend on, as JSON; frames of another record are worthless.
            inputs: files and folders that are read; the target may not hold them.
        """
        self.target = _absolute(target)
        self.path = self.target.with_name(self.target.name + ".unfinished")
        self._kind = kind
        self._inputs = tuple(inputs)
        # As JSON gives them back: tuples are lists there.
        self._facts = json.loads(json.dumps({"becomes": self.target.name, "record": record}))
        self._overwrite = False
        self._is_begun = False

    def begin(self, overwrite: bool) -> None:
        """Makes the folder, or keeps what the same work has left there; one process alone.

        Raises:
            FolderInUse: if the target holds something that may not be replaced, or if what has
                the name of the unfinished folder was not left there by this program.
        """
        restore_folder(self.target)
        refuse_folder_in_use(self.target, self._kind, overwrite, self._inputs)
        self._overwrite = overwrite
        if os.path.lexists(self.path) and not self._keeps_what_is_there():
            remove_folder(self.path)
        if not self.path.exists():
            self.path.mkdir(parents=True)
            mark_folder(self.path, self._kind, self._facts)
        self._is_begun = True

    def _keeps_what_is_there(self) -> bool:
        """Whether frames of the same work lie there; False if they are of other work of ours."""
        is_folder = self.path.is_dir() and not self.path.is_symlink()
        if is_folder and all(_is_leftover(path) for path in self.path.iterdir()):
            # Of a process that was killed before it could mark it.
            mark_folder(self.path, self._kind, self._facts)
        marker = (read_marker(self.path) if is_folder else None) or {}
        is_ours = (marker.get("kind"), marker.get("becomes")) == (
            self._kind.name,
            self.target.name,
        )
        if is_ours and marker.get("record") == self._facts["record"]:
            return True
        strangers = strangers_in(self.path, self._kind) if is_ours else []
        if not is_ours or strangers:
            what = "is in the way: this program did not leave it there"
            if strangers:
                what = f"holds {_listed(strangers)}, which this program did not leave there"
            raise FolderInUse(
                f"{self.path} {what}: it stays",
                "move it away, or name another folder",
            )
        return False

    def has(self, names: Iterable[str]) -> bool:
        """Whether all these files are there, whole."""
        return all((self.path / name).is_file() for name in names)

    def write(self, name: str, content: bytes) -> None:
        """Writes one file aside and renames it into place."""
        write_atomically({self.path / name: content}, is_durable=False)

    def finish(self) -> None:
        """Takes the target's place; one process alone, when all is there.

        Raises:
            FolderInUse: if something lies there by now that may not be replaced.
        """
        for left in self.path.rglob(".tmp-*"):
            if _is_leftover(left):  # Of killed processes.
                left.unlink()
        name_files(self.path, self._kind.files)
        swap_folder(self.path, self.target, self._kind, self._overwrite, self._inputs)

    def abandon(self) -> None:
        """Removes the folder unless a frame is finished: then a rerun goes on from it."""
        if self._is_begun and not any(path.is_dir() for path in self.path.glob("*")):
            shutil.rmtree(self.path, ignore_errors=True)
