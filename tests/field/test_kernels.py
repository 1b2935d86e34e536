"""Which kernel may run where."""

import pytest

from handavatar.field import kernels
from handavatar.field.kernels import chosen_kernel


@pytest.mark.parametrize("is_there", [True, False])
def test_torch_runs_everywhere(monkeypatch: pytest.MonkeyPatch, is_there: bool) -> None:
    monkeypatch.setattr(kernels, "_has_triton", lambda: is_there)
    for name in ("torch", "auto"):
        assert chosen_kernel(name, "cpu") == "torch"
    assert chosen_kernel("torch", "cuda") == "torch"


def test_a_kernel_that_cannot_run_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "_has_triton", lambda: True)
    assert chosen_kernel("triton-tf32", "cuda:0") == "triton-tf32"
    with pytest.raises(ValueError, match="`kernel`: triton needs a CUDA device, found cpu"):
        chosen_kernel("triton", "cpu")
    monkeypatch.setattr(kernels, "_has_triton", lambda: False)
    with pytest.raises(ValueError, match="no package 'triton'"):
        chosen_kernel("triton", "cuda")


@pytest.mark.parametrize("has_triton", [True, False])
@pytest.mark.parametrize("has_cores", [True, False])
def test_on_a_gpu_the_kernels_run_where_they_can(
    monkeypatch: pytest.MonkeyPatch, has_triton: bool, has_cores: bool
) -> None:
    monkeypatch.setattr(kernels, "_has_triton", lambda: has_triton)
    monkeypatch.setattr(kernels, "_has_tensor_cores", lambda: has_cores)
    expected = "triton" if has_triton and has_cores else "torch"
    assert chosen_kernel("auto", "cuda") == expected
