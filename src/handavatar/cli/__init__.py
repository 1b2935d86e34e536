"""The command line: ``handavatar COMMAND ...``.

Commands import what they need when they run, so that ``--help`` answers at once. A command's
options are a dataclass beside the code it serves; its summary here is its docstring.
"""

import difflib
import logging
import os
import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper

from handavatar import __version__
from handavatar.cli import avatar, bench, capture, default, motion, prior, rig, tracker
from handavatar.cli.failures import USAGE, WarningsShown, report_failure, shown
from handavatar.jobs.progress import Progress, shown_progress
from handavatar.jobs.signals import heard_signals

Command = Callable[[list[str], Progress], int]
"""Of the words after the command's name, and the progress of the whole command."""

COMMANDS: dict[str, Command] = {
    "demo": default.demo,
    "doctor": default.doctor,
    "capture video": capture.video,
    "capture webcam": capture.webcam,
    "capture synth": capture.synth,
    "capture benchmark": capture.benchmark,
    "capture degrade": capture.degrade,
    "capture check": capture.check,
    "motion from": motion.from_source,
    "motion to": motion.to_file,
    "rig info": rig.info,
    "rig import-mano": rig.import_mano,
    "rig refine": rig.refine,
    "prior train": prior.train,
    "prior evaluate": prior.evaluate,
    "prior picture": prior.picture,
    "tracker train": tracker.train,
    "tracker evaluate": tracker.evaluate,
    "train": avatar.train,
    "evaluate": avatar.evaluate,
    "edit": avatar.edit,
    "bench": bench.bench,
    "render": avatar.render,
    "export": avatar.export,
    "view": avatar.view,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code.

    Args:
        arguments: words after the program's name; those of the process by default.
    """
    with heard_signals(ends_at_once=True):
        return _run(list(sys.argv[1:] if arguments is None else arguments))


def _run(words: list[str]) -> int:
    # Before torch starts its threads: waiting threads that spin make busy machines crawl.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Read when CUDA starts; without it matrix products on a GPU are not repeatable.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    for stream in (sys.stdout, sys.stderr):
        # Names of files may hold what is no character: shown as codes, never an error.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    log = logging.getLogger("handavatar")
    if not any(isinstance(handler, WarningsShown) for handler in log.handlers):
        log.addHandler(WarningsShown())
    is_debugging = "--debug" in words
    # Of the processes that torchrun starts, the first one reports.
    is_quiet = "--quiet" in words or os.environ.get("RANK", "0") != "0"
    words = [word for word in words if word not in ("--debug", "--quiet")]
    if words[:1] == ["--version"]:
        print(f"handavatar {__version__}")
        return 0
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
        return 0
    name = next((" ".join(words[:n]) for n in (2, 1) if " ".join(words[:n]) in COMMANDS), None)
    if name is None:
        return _no_such_command(words)
    try:
        with shown_progress(name, is_quiet) as progress:
            return COMMANDS[name](words[len(name.split()) :], progress)
    except BrokenPipeError:  # the reader, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except SystemExit as request:
        return request.code if isinstance(request.code, int) else USAGE
    except BaseException as error:
        return report_failure(error, is_debugging)


def overview(group: str = "") -> str:
    """The list of commands, or of those of one group such as ``capture``."""
    chosen = {name: c for name, c in COMMANDS.items() if not group or name.split()[0] == group}
    width = max(len(name) for name in chosen)
    lines = [f"  {name:<{width}}  {_summary(command)}" for name, command in chosen.items()]
    title = "A personal, posable, editable avatar of a hand from an ordinary video."
    return "\n".join(
        [
            f"usage: handavatar {group or 'COMMAND'} ... [--quiet] [--debug]",
            "",
            *([] if group else [title, ""]),
            *lines,
            "",
            "handavatar COMMAND --help shows a command's options; --version the version.",
            "--quiet shows no progress; --debug adds the traceback to an error.",
        ]
    )


def _summary(command: Command) -> str:
    return (command.__doc__ or "").splitlines()[0].rstrip(".")


def _no_such_command(words: list[str]) -> int:
    groups = {name.split()[0] for name in COMMANDS if " " in name}
    if words[0] in groups:
        rest = words[1:]
        if not rest or rest[0] in ("-h", "--help"):
            print(overview(words[0]), file=sys.stdout if rest else sys.stderr)
            return 0 if rest else USAGE
    wanted = " ".join(words[:2] if words[0] in groups else words[:1])
    near = difflib.get_close_matches(wanted, COMMANDS, n=1)
    hint = f"did you mean 'handavatar {near[0]}'?" if near else "handavatar --help lists them all"
    print(shown(f"handavatar: there is no command '{wanted}'\n{hint}"), file=sys.stderr)
    return USAGE
