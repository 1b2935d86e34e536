"""The Triton kernels of the field: see ``fused_checks.py``."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from conftest import passed_kernel_checks


@pytest.mark.slow
@pytest.mark.skipif(find_spec("triton") is None, reason="needs triton")
def test_the_fused_pair_decoder() -> None:
    assert passed_kernel_checks(Path(__file__).with_name("fused_checks.py")) == 15
