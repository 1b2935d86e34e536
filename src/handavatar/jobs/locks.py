"""One process at a time: a lock on a file that falls with the process, however that ends.

The lock is the system's own (``flock`` and its like, by filelock), never a file whose mere presence
means something: that would outlive a process that is killed. Where a disk has no locks, as some
network disks, work goes on without, and a warning says what is then not protected.
"""

import contextlib
import errno
import logging
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock

from handavatar.errors import HandAvatarError

# A disk without locks, or a system without them.
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
_MOST_SAID = 200

_log = logging.getLogger(__name__)


class LockHeld(HandAvatarError):
    """Another process holds a lock; ``found`` says which."""


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Holds a lock while the block lasts; a second one, in this process too, is refused.

    Args:
        path: of the lock's file, in a folder that exists. Who holds it is written beside, into
            ``NAME-holder``.

    Raises:
        LockHeld: another holds it.
        OSError: the file cannot be made: the disk is full, cannot be written, or forbids it.
    """
    beside = path.with_name(f"{path.name}-holder")
    before = _read_holder(beside)
    with contextlib.ExitStack() as held:
        if not (filelock.has_fcntl or sys.platform == "win32"):
            _warn_of_no_lock(path, "this system has no locks", before)
        else:
            lock = filelock.FileLock(path, timeout=0, fallback_to_soft=False, thread_local=False)
            try:
                held.enter_context(lock)
            except filelock.Timeout as error:
                raise LockHeld(before or "another process") from error
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                _warn_of_no_lock(path, f"its disk has no locks: {error.strerror}", before)
        beside.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield


def _read_holder(path: Path) -> str:
    """Who holds, or held, a lock; empty if nobody says so."""
    try:
        with path.open("rb") as file:
            said = file.read(_MOST_SAID).decode("utf-8", "replace").strip()
    except OSError:
        return ""
    return said if said.isprintable() else ascii(said)


def _warn_of_no_lock(path: Path, why: str, before: str) -> None:
    _log.warning(
        "%s: cannot be locked (%s). Nothing keeps two processes from writing there at once, which "
        "would spoil both: start one alone%s",
        path.parent,
        why,
        f"; the last one was {before}" if before else "",
    )
