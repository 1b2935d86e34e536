"""Errors are types: their kinds, their parts, and the arguments and flags that they name."""

import ast
import dataclasses
import importlib
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import write_tiny_capture
from source_tree import modules

from handavatar import cli
from handavatar.capture.checks import CaptureError
from handavatar.cli import arguments, bench
from handavatar.cli.failures import shown, with_flags
from handavatar.errors import (
    ARGUMENT_MARK,
    ArgumentError,
    ErrorKind,
    HandAvatarError,
    argument,
    printable,
)
from handavatar.hand.rig import LicensedRigMissing
from handavatar.jobs.files import FolderInUse
from handavatar.jobs.finite import NotFinite
from handavatar.jobs.progress import SILENT

FLAG = re.compile(r"(^|[\s(\[\"'`])--[a-z]")
# What is no flag of ours, or speaks of the command line as such.
FLAGS_ALLOWED = {
    "handavatar.doctor",  # Its remedies are commands for a shell.
    "handavatar.evaluate.perceptual",  # pip install --no-deps
    "handavatar.capture.video_cameras",  # colmap model_converter
    "handavatar.evaluate.report",  # Variables of a style sheet.
    "handavatar.train.provenance",  # git describe
}
TREES = modules()


def _messages(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """All texts of a module but its docstrings; what an f-string fills in is ``1``."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(id(node.value))
        if isinstance(node, ast.JoinedStr):
            skipped |= {id(part) for part in ast.walk(node)} - {id(node)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "1" for part in node.values]
            yield node.lineno, "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


_Options = tuple[type, tuple[Any, ...], frozenset[str]]


class _Asked(BaseException):
    """A command has said which options it takes."""


def _commands(monkeypatch: pytest.MonkeyPatch) -> dict[str, _Options]:
    """Options, extras and what no word sets, of every command and every table of ``bench``."""
    asked: list[_Options] = []

    def note(options: type, extras: tuple[Any, ...], *_: object, **named: Any) -> None:
        asked.append((options, extras, frozenset(named.get("given") or ())))
        raise _Asked

    found = {}
    with monkeypatch.context() as patched:
        patched.setattr(arguments, "parse_with", note)
        names = [name for name in cli.COMMANDS if name != "bench"]
        for name in [*names, *(f"bench --table {table}" for table in bench._TABLES)]:
            words = name.split()
            with pytest.raises(_Asked):
                cli.COMMANDS["bench" if words[0] == "bench" else name](words[1:], SILENT)
            found[name] = asked[-1]
    return found


# --- kinds ----------------------------------------------------------------------------------------


def _error_classes() -> list[type[BaseException]]:
    """All classes of the package that are errors, but those of its own control flow."""
    found = []
    for module, tree in TREES.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                made = getattr(importlib.import_module(module), node.name)
                if issubclass(made, BaseException):
                    found.append(made)
    return found


def test_every_error_that_is_a_value_error_has_a_kind() -> None:
    classes = _error_classes()
    assert {CaptureError, FolderInUse, NotFinite, LicensedRigMissing} <= set(classes)
    wrong = [c for c in classes if issubclass(c, ValueError | OSError | ArithmeticError)]
    assert not [c for c in wrong if not issubclass(c, HandAvatarError)]


def test_kinds_are_exit_codes() -> None:
    assert [int(kind) for kind in ErrorKind] == [2, 3, 4, 5, 6]
    assert FolderInUse("d", "r").kind is ErrorKind.USAGE
    assert CaptureError("d").kind is ErrorKind.BAD_DATA
    assert LicensedRigMissing("d").kind is ErrorKind.LICENSED_FILE_MISSING
    assert NotFinite("d").kind is ErrorKind.NUMERICAL
    assert isinstance(NotFinite("d"), FloatingPointError)


def test_an_error_keeps_its_parts_and_travels_between_processes() -> None:
    error = ArgumentError("num_samples", "0", "1 to 4096", "raise `num_samples`")
    text = "`num_samples`: found 0, expected 1 to 4096\nraise `num_samples`"
    assert str(error) == text and error.what == text.splitlines()[0]
    for one in (error, CaptureError("a", "b"), NotFinite("w holds NaN"), FolderInUse("d", "r")):
        again = pickle.loads(pickle.dumps(one))
        assert type(again) is type(one) and str(again) == str(one)
        assert (again.found, again.expected, again.remedy) == (one.found, one.expected, one.remedy)
    assert str(HandAvatarError("a", "b", "c")) == "a, expected b\nc"


# --- arguments and flags --------------------------------------------------------------------------


def test_no_message_of_the_library_names_a_flag() -> None:
    wrong = [
        f"{module}, line {line}: {text[:80]!r}"
        for module, tree in TREES.items()
        if not module.startswith("handavatar.cli") and module not in FLAGS_ALLOWED
        for line, text in _messages(tree)
        if FLAG.search(text)
    ]
    assert not wrong, "\n".join(wrong)


def test_every_argument_that_a_message_names_is_an_option_of_a_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = set()
    for options, extras, _ in _commands(monkeypatch).values():
        known |= {field.name for field in dataclasses.fields(options)}
        known |= {extra.name for extra in extras}
    # Of functions that no command hands on.
    known |= {"table", "name", "count", "cameras"}
    named = {
        match[1]: f"{module}, line {line}"
        for module, tree in TREES.items()
        for line, text in _messages(tree)
        for match in ARGUMENT_MARK.finditer(text)
    }
    assert {"overwrite", "device", "side", "resume", "max_frames"} <= set(named)
    assert not {name: where for name, where in named.items() if name not in known}


@pytest.mark.parametrize(
    ("text", "flags"),
    [
        ("use `overwrite=True`", "use --overwrite"),
        ("`num_samples`: found 0", "--num-samples: found 0"),
        ("say `side='left'` or `side='right'`", "say --side left or --side right"),
        ("(`max_frames`)", "(--max-frames)"),
        ("with `seed=12`, `rate=0.001`.", "with --seed 12, --rate 0.001."),
        ("`fit.focal_share`: found 0", "--fit.focal-share: found 0"),
        (f"in {argument('out', 'my hand')}", "in --out 'my hand'"),
        (f"in {argument('out', 'it`s')}", "in --out 'it`s'"),
        (argument("out", "a'b\"c"), "--out 'a'\"'\"'b\"c'"),
        # Neither a path nor a command that happens to have such signs.
        ("/tmp/`seed`/x: not empty", "/tmp/`seed`/x: not empty"),
        ("`handavatar doctor`", "`handavatar doctor`"),
        ("``seed``", "``seed``"),
    ],
)
def test_the_command_line_shows_arguments_as_flags(text: str, flags: str) -> None:
    assert with_flags(text) == flags
    assert shown(text + "\x1b") == printable(flags + "\x1b")


COMMAND = re.compile(r"\bhandavatar ([a-z]+)(?: ([a-z][a-z-]*))?([^;\n]*)")
# Sentences that speak of the program.
NO_COMMANDS = {"again", "block", "cannot", "import", "imported", "metadata", "wrote"}


def test_every_command_that_a_message_advises_exists_and_takes_its_flags(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = {
        name: {field.name for field in dataclasses.fields(options)} | {e.name for e in extras}
        for name, (options, extras, _) in _commands(monkeypatch).items()
    }
    for name in [name for name in taken if name.startswith("bench ")]:
        taken["bench"] = taken.get("bench", set()) | taken[name]
    groups = {name.split()[0] for name in cli.COMMANDS if " " in name}
    wrong, advised = [], set()
    for module, tree in TREES.items():
        for line, text in _messages(tree):
            for first, second, rest in COMMAND.findall(text):
                name = f"{first} {second}" if first in groups else first
                if first in NO_COMMANDS or name == "capture of":
                    continue
                advised.add(name)
                # "capture video, webcam or synth"
                listed = re.match(r"(?:, [a-z]+)* or [a-z]+", rest) if first in groups else None
                for other in re.findall(r"(?:, | or )([a-z]+)", listed[0] if listed else ""):
                    if f"{first} {other}" not in cli.COMMANDS:
                        wrong.append(f"{module}, line {line}: {first} {other}")
                flags = re.findall(r"--([a-z][a-z.-]*)", with_flags(rest))
                unknown = {f.replace("-", "_") for f in flags} - taken.get(name, set())
                unknown -= {"help", "version", "quiet", "debug"}
                if name not in cli.COMMANDS or unknown:
                    wrong.append(f"{module}, line {line}: {name} {sorted(unknown)}")
    assert {"capture video", "train", "render", "motion from"} <= advised
    assert not wrong, "\n".join(wrong)


# --- numbers --------------------------------------------------------------------------------------


def _numbers(options: type, prefix: str = "") -> Iterator[tuple[str, type]]:
    """All numbers that an options class takes, with those of the classes within it."""
    for field in dataclasses.fields(options):
        if dataclasses.is_dataclass(field.type) and isinstance(field.type, type):
            yield from _numbers(field.type, f"{prefix}{field.name}.")
        elif re.search(r"\b(int|float)\b", str(field.type)):
            is_float = "float" in str(field.type)
            yield f"{prefix}{field.name}", float if is_float else int


def _needed(options: type, extras: tuple[Any, ...], fixed: frozenset[str]) -> list[str]:
    """Words for what has no default, and what stands without a name."""
    given = []
    for field in dataclasses.fields(options):
        has_none = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if has_none and field.name not in {*fixed, *(extra.name for extra in extras)}:
            given.append((field.name, "glb" if field.name == "format" else "x.glb"))
    given += [(extra.name, "x") for extra in extras if extra.default is ...]
    return [word for name, value in given for word in (f"--{name}", value)]


class _Taken(BaseException):
    """All options were taken: work would begin now."""


def _outcome(command: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> BaseException:
    real = arguments.parse_with

    def parse(*given: Any, **named: Any) -> None:
        # By name, all of them, and no path is looked at.
        real(*given[:4], **{**named, "positional": (), "reads": None})
        raise _Taken

    with monkeypatch.context() as patched:
        patched.setattr(arguments, "parse_with", parse)
        try:
            cli.COMMANDS["bench" if command.startswith("bench") else command](words, SILENT)
        except (Exception, SystemExit, _Taken) as error:
            return error
    raise AssertionError("parsing always ends in an error here")


# What is meant to be endless, or is a switch or an id.
_UNBOUNDED = {
    f"register.energy.{name}" for name in ("contact_error", "texture_outlier", "landmark_outlier")
}


def test_every_number_of_every_command_has_a_range(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong, asked = [], 0
    for command, (options, extras, fixed) in _commands(monkeypatch).items():
        numbers = dict(_numbers(options))
        numbers |= {e.name: e.kind for e in extras if e.kind in (int, float)}
        needed = _needed(options, extras, fixed)
        table = command.split()[1:] if command.startswith("bench") else []
        for name, kind in numbers.items():
            flag = f"--{name.replace('_', '-')}"
            for value in ("-1", *(["nan", "inf"] if kind is float else [f"1{30 * '0'}"])):
                asked += 1
                words = [*table, *needed, f"{flag}={value}"]
                outcome = _outcome(command, words, monkeypatch)
                is_named = isinstance(outcome, ArgumentError) and outcome.argument == name
                if not is_named and not (name in _UNBOUNDED and value.strip("0") in ("1", "inf")):
                    wrong.append(f"{command} {flag}={value}: {outcome!r}")
    assert asked > 200
    assert not wrong, "\n".join(wrong)


def test_no_command_prints_what_a_terminal_would_obey() -> None:
    """Results go through ``say``, all else through ``shown``; what is fixed may be printed."""
    wrong = []
    for module, tree in modules().items():
        if not module.startswith("handavatar.cli") or module == "handavatar.cli.failures":
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "print":
                said = ast.unparse(node.args[0])
                if not said.startswith(("shown(", "overview(")) and said not in _FIXED:
                    wrong.append(f"{module}:{node.lineno}: {said}")
    assert not wrong, "\n".join(wrong)


_FIXED = {
    "f'handavatar {__version__}'",
    "f'usage: handavatar bench --table NAME\\n\\nNAME is {known}'",
    "f'handavatar bench: {found}, expected --table with {known}'",
    "(out / 'loss.json').read_text()",
}
"""Made of this program's own words."""


def test_a_folder_s_name_is_shown_and_not_obeyed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_tiny_capture(tmp_path / "a\x1b[31m\u202e", "ab", size=24)
    assert cli.main(["capture", "check", str(folder)]) == 0
    assert capsys.readouterr().out.endswith("a\\x1b[31m\\u202e: sound\n")
