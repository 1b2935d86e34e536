"""Errors as exit codes and as a few lines that say what, where, why and what to do."""

import ast
import logging
import re
import shlex
import sys
import traceback

from handavatar.errors import (
    ARGUMENT_MARK,
    ErrorKind,
    HandAvatarError,
    machine_error,
    printable,
)

OUR_BUG = 1
USAGE = int(ErrorKind.USAGE)
BAD_DATA = int(ErrorKind.BAD_DATA)
LICENSED_FILE_MISSING = int(ErrorKind.LICENSED_FILE_MISSING)
OUT_OF_SPACE = int(ErrorKind.OUT_OF_SPACE)
NUMERICAL = int(ErrorKind.NUMERICAL)
INTERRUPTED = 130

_MAX_LINES = 6
_MAX_LINE = 400
# Which extra brings a package that is not there.
_EXTRAS = {
    "mediapipe": "video",
    "cv2": "video",
    "mitsuba": "synth",
    "drjit": "synth",
    "anny": "anny",
}


class WarningsShown(logging.Handler):
    """Warnings of the library, on standard error as its errors are."""

    def emit(self, record: logging.LogRecord) -> None:
        """Prints one; what no handler would have shown is not shown here either."""
        if record.levelno >= logging.WARNING:
            print(shown(f"handavatar: {self.format(record)}"), file=sys.stderr, flush=True)


def report_failure(error: BaseException, is_debugging: bool = False) -> int:
    """Prints what went wrong to standard error, and gives the exit code."""
    if is_debugging:
        traceback.print_exception(error)
    code, message = explanation(error)
    lines = [printable(line.rstrip()[:_MAX_LINE]) for line in message.splitlines() if line.strip()]
    if code == OUR_BUG and not is_debugging:
        lines = [*lines[: _MAX_LINES - 1], "this is a mistake in handavatar: --debug shows where"]
    print("\n".join(["handavatar: " + lines[0], *lines[1:_MAX_LINES]]), file=sys.stderr)
    return code


def say(text: object) -> None:
    """A line of results on standard output, in which names of files may stand.

    Args:
        text: with nothing that is to be shown as a flag.
    """
    print(printable(str(text)), flush=True)


def with_flags(text: str) -> str:
    """A message of the library as the command line says it: arguments are flags.

    Args:
        text: in which arguments stand as Python writes them, between backticks.
    """
    return ARGUMENT_MARK.sub(_flag, text)


def shown(text: str) -> str:
    """A message of the library, for a terminal: with flags, and with nothing it would obey."""
    return printable(with_flags(text))


def _flag(found: re.Match[str]) -> str:
    name, value = found[1], found[2]
    flag = f"--{name.replace('_', '-')}"
    if value is None or value == "True":
        return flag
    if value[0] in "'\"":
        try:
            return f"{flag} {shlex.quote(ast.literal_eval(value))}"
        except (ValueError, SyntaxError):
            return f"{flag} {value}"
    return f"{flag} {value}"


def explanation(error: BaseException) -> tuple[int, str]:
    """Exit code and text of an error."""
    code, text = _explained(error)
    return code, with_flags(text)


def _explained(error: BaseException) -> tuple[int, str]:
    text = str(error).strip() or type(error).__name__
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, f"interrupted: {error}" if str(error) else "interrupted"
    if isinstance(error, HandAvatarError):
        return int(error.kind), text
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or "").split(".")[0]
        if package in _EXTRAS:
            return USAGE, (
                f"this command needs the package {package}, which is not installed\n"
                f"install it: pip install 'handavatar[{_EXTRAS[package]}]' (or scripts/setup)"
            )
    if (refused := machine_error(error)) is not None:
        return int(refused.kind), str(refused)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return BAD_DATA, f"{where}{error.strerror or text}"
    if isinstance(error, FloatingPointError):
        return NUMERICAL, text
    return OUR_BUG, f"{type(error).__name__}: {text}"
