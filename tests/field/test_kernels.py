"""Which kernel may run where."""

import pytest

from handavatar.field.kernels import chosen_kernel


def test_a_kernel_that_cannot_run_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen_kernel("torch", "cpu") == "torch"
    monkeypatch.setattr("handavatar.field.kernels.find_spec", lambda name: object())
    assert chosen_kernel("triton-tf32", "cuda:0") == "triton-tf32"
    with pytest.raises(ValueError, match="--kernel triton: needs a CUDA device, found cpu"):
        chosen_kernel("triton", "cpu")
    monkeypatch.setattr("handavatar.field.kernels.find_spec", lambda name: None)
    with pytest.raises(ValueError, match="no package 'triton'"):
        chosen_kernel("triton", "cuda")
