"""Systems that lack what Linux has: nothing dies when it is imported."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from source_tree import SOURCE, modules

ONLY_UNIX = ("fcntl", "grp", "pwd", "resource", "termios")
IMPORTS = """
import os, signal, socket, sys
for name in {missing!r}:
    sys.modules[name] = None
for owner, name in ((os, "nice"), (os, "sched_getaffinity"), (os, "fork"), (signal, "SIGKILL"),
                    (os, "getuid"), (os, "sysconf"), (socket, "AF_UNIX")):
    if hasattr(owner, name):
        delattr(owner, name)
import importlib
for name in {names!r}:
    importlib.import_module(name)
print("all")
"""


@pytest.mark.slow
def test_every_module_imports_where_nothing_is_as_on_linux() -> None:
    names = [name for name in modules() if not name.endswith("__main__")]
    program = IMPORTS.format(missing=ONLY_UNIX, names=names)
    environment = {**os.environ, "PYTHONPATH": str(Path(SOURCE).parent)}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment
    )
    assert done.stdout.strip() == "all", done.stderr[-2000:]
