"""The command line: help, exit codes, errors without tracebacks, and nothing else on stdout."""

import errno
import json
import logging
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from handavatar import __version__, cli
from handavatar.avatar import CheckpointError
from handavatar.capture.checks import CaptureError
from handavatar.cli.arguments import JSON, Extra, parse, parse_with
from handavatar.errors import ArgumentError
from handavatar.hand.rig import LicensedRigMissing, RigError
from handavatar.jobs.files import FolderInUse
from handavatar.jobs.finite import NotFinite
from handavatar.jobs.progress import Progress


def test_help_lists_every_command_and_answers_quickly() -> None:
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "handavatar", "--help"], capture_output=True, text=True, check=True
    )
    # It takes 0.15 s; on a machine that is busy with other tests, ten times that may pass.
    assert time.monotonic() - begin < 5
    for name in cli.COMMANDS:
        assert f"  {name} " in done.stdout


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from handavatar.cli import main; main(['--help']);"
        "print([m for m in ('torch', 'numpy', 'tyro', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"handavatar {__version__}\n"


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*command.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"usage: handavatar {command}" in shown


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["trian"], "did you mean 'handavatar train'"),
        (["capture"], "capture check"),
        (["capture", "vidoe"], "did you mean 'handavatar capture video'"),
        (["capture", "check"], "CAPTURE"),
        (["rig", "import-mano", "a.pkl", "--left-shape", "x"], "'kept', 'mirrored'"),
        (["rig", "info", "--lvl", "full"], "--lvl"),
    ],
)
def test_wrong_usage_is_exit_2(
    words: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and expected in captured.err and "Traceback" not in captured.err


@pytest.mark.parametrize(
    ("error", "code", "expected"),
    [
        (CaptureError("frame 3: pose is NaN", "drop the frame"), 3, "drop the frame"),
        (RigError("rig x: broken"), 3, "rig x"),
        (CheckpointError("model.safetensors: cut\ntrain again"), 3, "train again"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "a.mp4"), 3, "a.mp4"),
        (OSError(errno.ENOSPC, "No space left on device", "/out"), 5, "make room"),
        (MemoryError(), 5, "memory"),
        (torch.OutOfMemoryError("CUDA out of memory"), 5, "memory"),
        (FloatingPointError("loss is not finite at step 7"), 6, "step 7"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (KeyboardInterrupt("stopped at step 7"), 130, "step 7"),
        (ModuleNotFoundError("No module named 'mediapipe'", name="mediapipe"), 2, "[video]"),
        (ModuleNotFoundError("No module named 'handavatar.x'", name="handavatar.x"), 1, "--debug"),
        (ArgumentError("num_samples", "0", "1 to 9"), 2, "--num-samples: found 0, expected 1 to 9"),
        (FolderInUse("d: not empty", "or use `overwrite=True`"), 2, "or use --overwrite"),
        (LicensedRigMissing("mano-left"), 4, "mano-left"),
        (NotFinite("step 7: w holds NaN", "give `seed=1`"), 6, "give --seed 1"),
        (KeyboardInterrupt("continue with `resume='auto'`"), 130, "continue with --resume auto"),
        (ValueError("--device cuda: there is no GPU"), 1, "--debug"),
        (ValueError("a slip of ours"), 1, "--debug"),
        (CaptureError("\n".join(f"line {i}" for i in range(50))), 3, "line 0"),
    ],
)
def test_errors_become_exit_codes_and_a_few_lines(
    error: BaseException,
    code: int,
    expected: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(words: list[str], progress: Progress) -> int:
        """Fails."""
        raise error

    monkeypatch.setitem(cli.COMMANDS, "train", fail)
    assert cli.main(["train"]) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert expected in captured.err and "Traceback" not in captured.err
    assert len(captured.err.splitlines()) <= 6
    assert cli.main(["train", "--debug"]) == code
    assert "Traceback" in capsys.readouterr().err


def test_warnings_are_printed_once_with_flags_and_nothing_raw(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def warn(words: list[str], progress: Progress) -> int:
        """Warns."""
        logging.getLogger("handavatar.train.runs").warning("%s: use `overwrite=True`", "a\x1b[2J")
        return 0

    monkeypatch.setitem(cli.COMMANDS, "train", warn)
    for _ in range(2):
        assert cli.main(["train"]) == 0
        assert capsys.readouterr().err == "handavatar: a\\x1b[2J: use --overwrite\n"


def test_rig_info_prints_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["rig", "info", "--rig", "open-hand-778", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["vertices"] == 778 and facts["bones"] == 16
    # The paper's counts (Sec. 3.1).
    assert facts["high_resolution"] == {"vertices": 12337, "faces": 24608}


def test_doctor_names_a_remedy_for_whatever_is_absent(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    code = cli.main(["doctor", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert (code == 0) == report["able"]
    by_name = {finding["name"]: finding for finding in report["findings"]}
    assert {"torch", "cuda", "cores", "memory", "disk", "video files", "prior"} <= set(by_name)
    for finding in report["findings"]:
        assert finding["found"] and (finding["state"] == "ok" or finding["remedy"])
    assert by_name["lpips"]["state"] == "optional" and str(tmp_path) in by_name["lpips"]["found"]
    assert cli.main(["doctor"]) == code
    assert "lpips" in capsys.readouterr().out


def test_capture_check_of_no_capture_is_exit_3(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cli.main(["capture", "check", str(tmp_path)]) == 3
    assert "transforms.json" in capsys.readouterr().out
    assert cli.main(["capture", "check", str(tmp_path), "--json"]) == 3
    report = json.loads(capsys.readouterr().out)
    assert not report["sound"] and report["problems"][0]["remedy"]


@dataclass(frozen=True)
class _Options:
    """Does something.

    Attributes:
        run: a folder.
        passes: pictures to write.
        shift: added to the colour.
    """

    run: Path
    passes: tuple[str, ...] = ("rgb",)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)


def test_options_come_in_any_order_and_lists_by_commas() -> None:
    words = ["--shift", "-0.1,0,0.5", "out", "--passes", "rgb,albedo"]
    options = parse(_Options, words, "render", positional=("run",))
    assert options == _Options(Path("out"), ("rgb", "albedo"), (-0.1, 0.0, 0.5))
    assert type(options) is _Options


def test_a_command_may_have_options_of_its_own() -> None:
    name = Extra("name", str, "what to call it")
    options, extras = parse_with(
        _Options, (JSON, name), ["--name", "a", "r", "--json"], "x", ("run",)
    )
    assert options == _Options(Path("r")) and extras == {"json": True, "name": "a"}


@pytest.mark.parametrize("words", [["r", "--shift", "1,2"], ["r", "--shift", "a,b,c"], []])
def test_malformed_options_are_usage_errors(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        parse(_Options, words, "render", positional=("run",))
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
