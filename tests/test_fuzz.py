"""Readers of files refuse what is wrong in words: never a traceback, a hang or an escape sequence.

Each format is tried with 2,000 mutants in the slow suite, and with a few in the fast one.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_formats import FORMATS
from fuzzing import fault_of

MANY = 2000
_FEWER = {"mano": 300}
"""Of large files, which take a fifth of a second each."""
FEW = 10
_QUICK = ("capture", "mask", "motion", "paint", "rig", "run.json", "log.jsonl", "progress.json")
_QUICK += ("cameras", "given masks", "pictures", "skin", "film truth", "stage state")
_QUICK += ("kept figures",)


def _faults(count: int, *names: str) -> dict[str, dict[str, int]]:
    """Of each format: how often its reader failed, and how."""
    command = [sys.executable, str(Path(__file__).with_name("fuzz_formats.py")), str(count), *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    # The last line before names the mutant, where a decoder has ended the process.
    assert done.returncode == 0, done.stderr[-2000:]
    # What decoders print by themselves.
    assert "Traceback" not in done.stderr and "\x1b" not in done.stderr, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_mutants_are_refused_in_words() -> None:
    assert _faults(FEW, *_QUICK) == {name: {} for name in _QUICK}


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_2000_mutants_are_refused_in_words(name: str) -> None:
    assert _faults(_FEWER.get(name, MANY), name) == {name: {}}


def test_a_mistake_a_hang_and_a_refusal_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(error: Exception) -> None:
        raise error

    assert "KeyError" in fault_of(lambda: fail(KeyError("x")))
    assert fault_of(lambda: fail(OSError(5, "\x1b[31m"))) == ""
    assert fault_of(lambda: 1) == ""
    monkeypatch.setattr("fuzzing.MOST_SECONDS", 1)

    def hang() -> None:
        while True:
            pass

    assert fault_of(hang) == "hangs for 1 s"
