"""Other processes."""

import os
import subprocess
import sys

from handavatar.jobs.processes import is_running


def test_a_process_is_there_until_it_has_ended() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert is_running(os.getpid()) and is_running(1) and not is_running(child.pid)
    assert not is_running(2**70), "no number of a process"
