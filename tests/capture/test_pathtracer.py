"""The path tracer's choice of a variant."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mitsuba")
CHOICE = "from handavatar.capture.pathtracer import choose_variant; print(choose_variant())"
ABORTING = [*Path("/usr/lib").glob("*/libLLVM-15.so*"), *Path("/usr/lib").glob("*/libLLVM-16.so*")]


@pytest.mark.slow
@pytest.mark.skipif(not ABORTING, reason="there is no libLLVM 15 or 16 here")
def test_a_library_that_aborts_in_a_real_kernel_is_not_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(ABORTING[0]))
    done = subprocess.run([sys.executable, "-c", CHOICE], capture_output=True, text=True)
    assert done.stdout.strip() == "scalar_rgb", done.stderr
