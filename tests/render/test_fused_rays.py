"""The Triton kernels of rays and coverage: see ``ray_checks.py``."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from conftest import passed_kernel_checks


@pytest.mark.slow
@pytest.mark.skipif(find_spec("triton") is None, reason="needs triton")
def test_the_kernels_of_rays() -> None:
    assert passed_kernel_checks(Path(__file__).with_name("ray_checks.py")) == 10
