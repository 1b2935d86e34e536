"""What the machine refuses: memory, disks, permissions, names. Each ends in a sentence."""

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from handavatar import cli
from handavatar.avatar import HandAvatar
from handavatar.cli.failures import BAD_DATA, OUR_BUG, OUT_OF_SPACE, USAGE, explanation
from handavatar.errors import OutOfSpace, PlaceRefused, machine_error
from handavatar.jobs.files import write_atomically
from handavatar.processes import is_first_process


def _raised(function: Callable[[], object]) -> BaseException:
    with pytest.raises(BaseException) as caught:
        function()
    return caught.value


# --- memory ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "allocate",
    [lambda: torch.empty(10**15), lambda: np.zeros(10**15), lambda: bytearray(2**62)],
    ids=["torch", "numpy", "python"],
)
def test_memory_that_there_is_not(allocate: Callable[[], object]) -> None:
    code, text = explanation(_raised(allocate))
    assert code == OUT_OF_SPACE
    assert text.startswith("out of memory (") and "--num-samples" in text.splitlines()[1]


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
        RuntimeError("CUDA error: out of memory"),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling cublasCreate(handle)"),
        RuntimeError("not enough memory: you tried to allocate 8000000000 bytes."),
        RuntimeError("std::bad_alloc"),
        RuntimeError("can't start new thread"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
    ],
    ids=lambda error: str(error)[:30],
)
def test_other_words_for_no_memory(error: BaseException) -> None:
    assert isinstance(machine_error(error), OutOfSpace)


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("mat1 and mat2 shapes cannot be multiplied"),
        ValueError("out of memory of ours"),
        SafetensorError("Error while deserializing header: header too large"),
        FileNotFoundError(errno.ENOENT, "No such file or directory", "a"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_what_is_not_the_machines_fault(error: BaseException) -> None:
    assert machine_error(error) is None


# --- disks ----------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of one megabyte, where such may be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1M", "tmpfs", str(place)]
    try:
        done = subprocess.run(mount, capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount here")
    if done.returncode:
        pytest.skip("no disk may be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_is_told_by_every_writer(small_disk: Path, small_avatar: HandAvatar) -> None:
    tensors = {"a": torch.zeros(10**6)}
    for write in (
        lambda: save_file(tensors, small_disk / "a.safetensors"),
        lambda: write_atomically({small_disk / "b": bytes(2**22)}),
        lambda: small_avatar.save(small_disk / "c.safetensors"),
    ):
        code, text = explanation(_raised(write))
        assert code == OUT_OF_SPACE and "No space left on device" in text
        assert text.splitlines()[1].startswith("make room and run it again")
        for left in small_disk.iterdir():
            left.unlink()


def test_a_read_only_disk(small_disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for write in (
        lambda: save_file({"a": torch.zeros(3)}, small_disk / "a.safetensors"),
        lambda: write_atomically({small_disk / "b": b"b"}),
    ):
        error = _raised(write)
        code, text = explanation(error)
        assert code == BAD_DATA and "Read-only file system" in text and "--out" in text
        assert isinstance(machine_error(error), PlaceRefused)


def test_a_full_disk_without_one(tmp_path: Path) -> None:
    """By the limit on the size of files, which needs no rights."""
    code = (
        "import resource, signal, sys, torch; from safetensors.torch import save_file\n"
        "from handavatar.cli.failures import report_failure\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))\n"
        "try: save_file({'a': torch.zeros(10**5)}, sys.argv[1])\n"
        "except Exception as error: sys.exit(report_failure(error))"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "a.safetensors")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == OUT_OF_SPACE, done.stderr
    assert "File too large" in done.stderr and "make room" in done.stderr


@pytest.mark.parametrize(
    ("number", "code", "remedy"),
    [
        (errno.ENOSPC, OUT_OF_SPACE, "make room and run it again"),
        (errno.EDQUOT, OUT_OF_SPACE, "make room and run it again"),
        (errno.EMFILE, OUT_OF_SPACE, "ulimit"),
        (errno.EROFS, BAD_DATA, "--out"),
        (errno.EACCES, BAD_DATA, "change its permissions"),
        (errno.EPERM, BAD_DATA, "change its permissions"),
        (errno.ENAMETOOLONG, BAD_DATA, "shorter name"),
    ],
)
def test_what_a_system_says_of_files(number: int, code: int, remedy: str) -> None:
    said = os.strerror(number)
    for error in (
        OSError(number, said, "/a/b"),
        OSError(number, said, b"/a/b"),
        OSError(number, said, "/a/b", None, "/a/c"),
        SafetensorError(f"Error while serializing: I/O error: {said} (os error {number})"),
    ):
        found, text = explanation(error)
        assert found == code
        assert said in text.splitlines()[0] and remedy in text.splitlines()[1]


def test_a_file_that_may_not_be_read_is_not_called_damaged(
    small_avatar: HandAvatar, tmp_path: Path
) -> None:
    path = tmp_path / "a.safetensors"
    small_avatar.save(path)
    path.chmod(0)
    code = (
        "import os, sys; from handavatar.avatar import HandAvatar\n"
        "from handavatar.cli.failures import report_failure\n"
        "os.geteuid() or os.setuid(65534)  # Root may read everything.\n"
        "try: HandAvatar.load(__import__('pathlib').Path(sys.argv[1]))\n"
        "except Exception as error: sys.exit(report_failure(error))"
    )
    words = [sys.executable, "-c", code, str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == BAD_DATA, done.stderr
    assert "change its permissions" in done.stderr and "damaged" not in done.stderr


def test_too_many_open_files_do_not_make_an_avatar_damaged(
    small_avatar: HandAvatar, tmp_path: Path
) -> None:
    path = tmp_path / "a.safetensors"
    small_avatar.save(path)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken = []
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (64, before[1]))
        with pytest.raises(OSError, match="Too many open files"):
            while True:
                taken.append(os.open(tmp_path, os.O_RDONLY))
        error = _raised(lambda: HandAvatar.load(path))
    finally:
        for number in taken:
            os.close(number)
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    code, text = explanation(error)
    assert code == OUT_OF_SPACE and "damaged" not in text
    assert HandAvatar.load(path) is not None


@pytest.mark.parametrize("kind", ["edit", "export"])
def test_a_disk_that_fills_up_under_a_command(
    kind: str,
    tmp_path: Path,
    small_avatar: HandAvatar,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run, out = tmp_path / "a.safetensors", tmp_path / "b"
    small_avatar.save(run)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(out))

    monkeypatch.setattr("os.fsync", full)
    words = ["edit", str(run), "--light-gain", "1.5"]
    if kind == "export":
        words = ["export", str(run), "ply"]
        out = out.with_suffix(".ply")
    assert cli.main([*words, "--out", str(out)]) == OUT_OF_SPACE
    said = capsys.readouterr().err
    assert "No space left on device" in said and "make room" in said
    assert list(tmp_path.iterdir()) == [run]


# --- names ----------------------------------------------------------------------------------------

_NO_UTF8 = os.fsdecode(b"f\xff")


@pytest.mark.skipif(sys.platform != "linux", reason="names there are always text")
def test_a_name_that_is_no_utf8_is_told_and_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], small_avatar: HandAvatar
) -> None:
    small_avatar.save(tmp_path / "a.safetensors")
    path = tmp_path / f"{_NO_UTF8}.safetensors"
    (tmp_path / "a.safetensors").rename(path)
    error = _raised(lambda: load_file(path))
    assert isinstance(machine_error(error), PlaceRefused)
    with pytest.raises(PlaceRefused, match="no UTF-8"):
        HandAvatar.load(path)
    assert cli.main(["render", str(path), "--out", str(tmp_path / "o")]) == BAD_DATA
    said = capfd.readouterr().err
    assert "rename the file or folder" in said and "damaged" not in said
    # What is to be written is refused before any work.
    assert cli.main(["render", "x", "--out", str(tmp_path / _NO_UTF8)]) == BAD_DATA
    path.rename(tmp_path / "a.safetensors")
    words = ["render", str(tmp_path / "a.safetensors"), "--out", str(tmp_path / _NO_UTF8)]
    capfd.readouterr()
    assert cli.main(words) == USAGE
    assert "--out: found" in capfd.readouterr().err
    assert explanation(_raised(lambda: _NO_UTF8.encode()))[0] == BAD_DATA


def test_text_that_is_damaged_is_not_a_name() -> None:
    assert explanation(_raised(b"\xff".decode))[0] == OUR_BUG


# --- several processes ----------------------------------------------------------------------------


def test_a_rank_without_other_processes_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RANK", "3")
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert is_first_process()
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert not is_first_process()


def test_a_world_without_torchrun_is_named(
    small_avatar: HandAvatar,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    small_avatar.save(tmp_path / "a.safetensors")
    for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WORLD_SIZE", "2")
    words = ["render", str(tmp_path / "a.safetensors"), "--out", str(tmp_path / "o")]
    assert cli.main([*words, "--size", "8", "--frames", "1"]) == BAD_DATA
    assert "unset WORLD_SIZE" in capsys.readouterr().err
