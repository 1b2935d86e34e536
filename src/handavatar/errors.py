"""Errors that a user can cause: five kinds, each with what was found, expected, and what to do.

A message of the library never names a flag of the command line: it names an argument, between
backticks, as Python writes it, with a value as in overwrite=True or without. The command line shows
such a name as the flag it is there, as in --overwrite.
"""

import errno
import os
import re
import sys
from enum import IntEnum
from pathlib import Path
from typing import ClassVar


class ErrorKind(IntEnum):
    """What is wrong, as far as a caller may want to tell; the value is the command's exit code."""

    USAGE = 2
    BAD_DATA = 3
    LICENSED_FILE_MISSING = 4
    OUT_OF_SPACE = 5
    NUMERICAL = 6


class HandAvatarError(ValueError):
    """What a user, or a user's file or machine, can cause.

    Attributes:
        kind: which of the five.
        found: what is there; the whole text where it does not divide.
        expected: what should be; may be empty.
        remedy: what to do; may be empty.
    """

    kind: ClassVar[ErrorKind] = ErrorKind.BAD_DATA

    def __init__(self, found: str, expected: str = "", remedy: str = "") -> None:
        """Keeps the parts apart: who knows the remedy is often not who finds it."""
        super().__init__(found, expected, remedy)
        self.found = found
        self.expected = expected
        self.remedy = remedy

    @property
    def what(self) -> str:
        """What was found and expected, in one line, without the remedy."""
        return f"{self.found}, expected {self.expected}" if self.expected else self.found

    def __str__(self) -> str:
        """All parts, the remedy in a line of its own."""
        return f"{self.what}\n{self.remedy}" if self.remedy else self.what

    def __reduce__(self) -> tuple[object, ...]:
        """Errors travel between processes, whatever their constructors take."""
        return _restored, (type(self), self.args, self.__dict__)


def _restored(
    kind: type[HandAvatarError], args: tuple[object, ...], facts: dict[str, object]
) -> HandAvatarError:
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(facts)
    return error


class ArgumentError(HandAvatarError):
    """An argument, or an option, whose value cannot be.

    Attributes:
        argument: its name, as in Python.
    """

    kind = ErrorKind.USAGE

    def __init__(
        self, argument: str, found: str = "", expected: str = "", remedy: str = ""
    ) -> None:
        """Names the argument.

        Args:
            argument: its name, as in Python.
            found: its value; or, if nothing is expected, what is wrong with it.
            expected: what its value should be.
            remedy: what to do.
        """
        super().__init__(found, expected, remedy)
        self.argument = argument

    @property
    def what(self) -> str:
        """The argument, what was found and expected."""
        found = f"found {self.found}, expected {self.expected}" if self.expected else self.found
        return f"{argument(self.argument)}: {found}"


class OutOfSpace(HandAvatarError):
    """No room: neither in memory, nor on a disk."""

    kind = ErrorKind.OUT_OF_SPACE


class PlaceRefused(HandAvatarError):
    """The system does not allow to read or write what a path names."""


# --- names of arguments in messages ---------------------------------------------------------------

ARGUMENT_MARK = re.compile(
    r"(?<![\w/`])`([a-z][a-z0-9_]*(?:\.[a-z][a-z0-9_]*)*)"
    r"(?:=('(?:[^'\\\n]|\\.)*'|\"(?:[^\"\\\n]|\\.)*\"|[^`'\"\s][^`\s]*))?`(?![\w/`])"
)
"""An argument named in a message, with its value as Python writes it."""


def argument(name: str, value: object = None) -> str:
    """An argument's name for a message, as :data:`ARGUMENT_MARK` finds it there.

    Args:
        name: as in Python.
        value: the one to give; none is shown if it is None.
    """
    shown = str(value) if isinstance(value, Path) else value
    return f"`{name}`" if value is None else f"`{name}={shown!r}`"


def printable(text: str) -> str:
    """A text that may hold anything, so that a terminal shows it and obeys nothing in it.

    What controls a terminal or turns the direction of writing is written as its code, and so is
    what is no character at all. Line breaks stay.

    Args:
        text: with parts that come from a file or a file's name.
    """
    return "".join(
        sign
        if sign == "\n" or sign.isprintable()
        else sign.encode("unicode_escape").decode("ascii")
        for sign in text
    )


_VAST = 10**6
SEEDS = (0, 2**32 - 1)
"""What all generators here take as a seed."""


def require_ranges(options: object, **ranges: tuple[int | float, int | float]) -> None:
    """Refuses options out of range; NaN is out of every range.

    Args:
        options: with numbers, or several each, by these names; None is not looked at.
        ranges: the least and the most of each, both allowed.

    Raises:
        ArgumentError: which, what it is, and what it may be.
    """
    for name, (least, most) in ranges.items():
        value = getattr(options, name)
        require_range(name, value, least, most)


def require_range(name: str, value: object, least: int | float, most: int | float) -> None:
    """Refuses one argument out of range, as :func:`require_ranges`.

    Args:
        name: of the argument.
        value: a number, several, or None, which is not looked at.
        least: allowed.
        most: allowed; finite.

    Raises:
        ArgumentError: what it is, and what it may be.
    """
    for number in value if isinstance(value, tuple | list) else (value,):
        if number is None:
            continue
        if not (isinstance(number, int | float) and least <= number <= most):
            is_small = isinstance(number, int | float) and number < least and most >= _VAST
            span = f"at least {least:g}" if is_small else f"{_plain(least)} to {_plain(most)}"
            raise ArgumentError(name, str(number)[:40], span)


def _plain(number: int | float) -> str:
    """A bound without an exponent, where it is a whole number."""
    return str(int(number)) if float(number).is_integer() else f"{number:g}"


# --- what the machine refuses ---------------------------------------------------------------------

_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {errno.EACCES, errno.EPERM}
_TOO_MANY_FILES = {errno.EMFILE, errno.ENFILE}
# Packages without error types of their own say it in words: torch for the memory of a CPU, CUDA's
# libraries, C++, and Python for threads.
_NO_MEMORY = re.compile(
    r"DefaultCPUAllocator|not enough memory|Cannot allocate memory|std::bad_alloc"
    r"|CUDA error: out of memory|CUDA out of memory|STATUS_ALLOC_FAILED|can't start new thread"
)
# Safetensors hands on in words what the system said: "I/O error: No space left on device (os error
# 28)", and "Path ... is not valid UTF-8".
_IN_WORDS = re.compile(r"\(os error (\d{1,4})\)")
_MISSING = re.compile(r"No such file or directory: (.+)")
_NO_UTF8 = re.compile(r"Path (.+) is not valid UTF-8")
_LESS_AT_ONCE = (
    "close other programs, or ask for less at once: fewer pixels or frames (`size`, `frames`, "
    "`max_frames`, `num_samples`, as far as the command has them)"
)
_MAKE_ROOM = "make room and run it again; what was finished is kept"


def machine_error(error: BaseException) -> HandAvatarError | None:
    """What the machine refuses, as an error with a remedy: memory, disks, permissions, names.

    For those who take whatever a package raises for damage of a file, and for the command line.

    Args:
        error: as Python or a package raised it.

    Returns:
        None if it is something else, or has a kind already.
    """
    if isinstance(error, HandAvatarError):
        return None
    text = (str(error).strip() or type(error).__name__).splitlines()[0]
    if _is_out_of_memory(error, text):
        return OutOfSpace(f"out of memory ({text[:200]})", "", _LESS_AT_ONCE)
    if isinstance(error, OSError):
        return _file_error(_as_the_system_says(error, text))
    if isinstance(error, UnicodeEncodeError) and "surrogate" in error.reason:
        return _not_utf8(error.object)
    safetensors = sys.modules.get("safetensors")
    if safetensors is not None and isinstance(error, safetensors.SafetensorError):
        if said := _IN_WORDS.search(text):
            return _file_error(OSError(int(said[1]), os.strerror(int(said[1]))))
        if said := _NO_UTF8.search(text):
            return _not_utf8(said[1])
    return None


def raise_if_refused(error: BaseException) -> None:
    """Raises what the machine refuses as such, for those who take all else for damage of a file.

    Args:
        error: that a reader has caught.

    Raises:
        HandAvatarError: as :func:`machine_error` gives it.
    """
    if (refused := machine_error(error)) is not None:
        raise refused from error


def _is_out_of_memory(error: BaseException, text: str) -> bool:
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    # It is not imported for this: who has not, cannot have caught its error.
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(error, torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and bool(_NO_MEMORY.search(text))


def _as_the_system_says(error: OSError, text: str) -> OSError:
    """Safetensors calls whatever it cannot open missing: asked again, the system says why."""
    said = _MISSING.fullmatch(text)
    if error.errno is None and said:
        try:
            with open(said[1], "rb"):
                pass
        except OSError as true:
            return true
    return error


def _not_utf8(name: str) -> PlaceRefused:
    return PlaceRefused(
        f"a name or text holds bytes that are no UTF-8: {name[:200]}",
        "",
        "rename the file or folder, in plain letters",
    )


def _file_error(error: OSError) -> HandAvatarError | None:
    """None for what says nothing of the machine, such as a file that is not there."""
    names = [
        os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes)
    ]
    what = f"{' -> '.join(names)}: {error.strerror}" if names else str(error.strerror)
    if error.errno in _DISK_FULL:
        return OutOfSpace(what, "", _MAKE_ROOM)
    if error.errno in _TOO_MANY_FILES:
        return OutOfSpace(what, "", "close other programs, or allow more: ulimit -n 4096")
    if error.errno == errno.EROFS:
        return PlaceRefused(what, "", "name a place on a disk that can be written: `out`")
    if error.errno in _FORBIDDEN:
        return PlaceRefused(
            what,
            "",
            "you may not read or write there: change its permissions (ls -l), or name "
            "another place",
        )
    if error.errno == errno.ENAMETOOLONG:
        return PlaceRefused(what[:200], "", "choose a shorter name")
    return None
