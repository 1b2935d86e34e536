"""Some of the kills of ``scripts/kills.py``."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "kills.py"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="commands are begun by forks")
def test_killed_at_random_moments_every_command_leaves_old_or_new() -> None:
    # A capture from a video takes half a minute each time; that one by hand.
    command = [sys.executable, str(SCRIPT), "--count", "20", "--only", "^(?!video)"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert done.stdout.count('"wrong": []') == len(done.stdout.splitlines()) > 8
