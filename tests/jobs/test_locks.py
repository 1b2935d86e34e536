"""Locks: one holder, named; they fall with a killed process; disks and systems without any."""

import errno
import fcntl
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import filelock
import pytest

from handavatar.jobs.locks import LockHeld, hold_lock

_HOLDER = (
    "import pathlib, sys, time; from handavatar.jobs.locks import hold_lock\n"
    "with hold_lock(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
)


def test_a_second_one_is_refused_and_told_who_holds_it(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    with hold_lock(lock), pytest.raises(LockHeld, match=f"^process {os.getpid()} on "):
        hold_lock(lock).__enter__()
    with hold_lock(lock):
        pass


def test_a_killed_process_leaves_no_lock(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    holder = subprocess.Popen([sys.executable, "-c", _HOLDER, str(lock)], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        with pytest.raises(LockHeld, match=f"process {holder.pid} on "), hold_lock(lock):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        holder.stdout.close()
    with hold_lock(lock):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL])
def test_on_a_disk_without_locks_work_goes_on_with_a_warning(
    number: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def refuse(file: int, operation: int) -> None:
        if operation != fcntl.LOCK_UN:
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    lock = tmp_path / ".lock"
    for _ in range(2):
        with caplog.at_level(logging.WARNING), hold_lock(lock):
            pass
    first, second = (record.getMessage() for record in caplog.records)
    assert "has no locks" in first and "Nothing keeps two processes" in first
    # Nothing that a killed process left is in the way; who was there last is said.
    assert f"the last one was process {os.getpid()}" in second


def test_on_a_system_without_locks_work_goes_on_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(filelock, "has_fcntl", False)
    with caplog.at_level(logging.WARNING), hold_lock(tmp_path / ".lock"):
        pass
    assert "this system has no locks" in caplog.text


@pytest.mark.slow
def test_the_package_imports_where_there_is_no_fcntl() -> None:
    code = (
        "import sys, warnings; sys.modules['fcntl'] = None; warnings.simplefilter('ignore')\n"
        "import handavatar.train.runs, filelock; print(filelock.has_fcntl)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "False", done.stderr


def test_a_disk_that_refuses_the_file_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(file: int, operation: int) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError, match="Read-only"), hold_lock(tmp_path / ".lock"):
        pass
