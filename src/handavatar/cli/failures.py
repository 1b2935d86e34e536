"""Errors as exit codes and as a few lines that say what, where, why and what to do."""

import errno
import sys
import traceback

OUR_BUG = 1
USAGE = 2
BAD_DATA = 3
LICENSED_FILE_MISSING = 4
OUT_OF_SPACE = 5
NUMERICAL = 6
INTERRUPTED = 130

_MAX_LINES = 6
_MAX_LINE = 400
_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.ENOMEM, errno.EFBIG}
# Which extra brings a package that is not there.
_EXTRAS = {
    "mediapipe": "video",
    "cv2": "video",
    "mitsuba": "synth",
    "drjit": "synth",
    "anny": "anny",
}


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


def explanation(error: BaseException) -> tuple[int, str]:
    """Exit code and text of an error."""
    text = str(error).strip() or type(error).__name__
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, f"interrupted: {error}" if str(error) else "interrupted"
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or "").split(".")[0]
        if package in _EXTRAS:
            return USAGE, (
                f"this command needs the package {package}, which is not installed\n"
                f"install it: pip install 'handavatar[{_EXTRAS[package]}]' (or scripts/setup)"
            )
        return OUR_BUG, f"{type(error).__name__}: {text}"
    # By name: torch, whose error this is, may not have been imported.
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return OUT_OF_SPACE, (
            f"out of memory ({text.splitlines()[0]})\nclose other programs, or use smaller pictures"
        )
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        if error.errno in _NO_SPACE:
            return OUT_OF_SPACE, (
                f"{where}{error.strerror}\nmake room and run it again; what was finished is kept"
            )
        return BAD_DATA, f"{where}{error.strerror or text}"
    if isinstance(error, FloatingPointError):
        return NUMERICAL, text
    if type(error).__name__ == "LicensedRigMissing":
        return LICENSED_FILE_MISSING, text
    if type(error).__name__ == "FolderInUse":  # An option names a place that cannot be written.
        return USAGE, text
    # RigError, CaptureError, CheckpointError: the kinds that a user's file can cause.
    if isinstance(error, ValueError) and type(error).__module__.startswith("handavatar."):
        return BAD_DATA, text
    # The library names the option that it cannot honour, such as --device cuda without a GPU.
    if isinstance(error, ValueError) and text.startswith("--"):
        return USAGE, text
    return OUR_BUG, f"{type(error).__name__}: {text}"
