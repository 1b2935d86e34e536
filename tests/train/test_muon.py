"""Muon: against torch's own, and what its steps are."""

import pytest
import torch
from torch import nn

from handavatar.train.muon import Muon, nearly_orthogonal
from handavatar.train.optimizer_state import (
    optimizer_options,
    optimizer_tensors,
    restore_optimizer,
)

SHAPES = ((64, 128), (128, 64), (64, 64), (64, 128), (16, 300))


def _matrices(seed: int = 0) -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(seed)
    return [nn.Parameter(0.1 * torch.randn(shape, generator=generator)) for shape in SHAPES]


def _run(optimizer: torch.optim.Optimizer, matrices: list[nn.Parameter], first: int = 0) -> None:
    for step in range(first, first + 3):
        generator = torch.Generator().manual_seed(100 + step)
        for matrix in matrices:
            matrix.grad = torch.randn(matrix.shape, generator=generator) + matrix.detach()
        optimizer.step()


def test_singular_values_come_near_one_and_vectors_stay() -> None:
    matrices = torch.randn(3, 20, 50, generator=torch.Generator().manual_seed(0))
    for given in (matrices, matrices.transpose(-1, -2)):
        found = nearly_orthogonal(given)
        values = torch.linalg.svdvals(found)
        assert found.shape == given.shape
        assert float(values.min()) > 0.6 and float(values.max()) < 1.3
        left, _, right = torch.linalg.svd(given, full_matrices=False)
        mixed = left.transpose(-1, -2) @ found @ right.transpose(-1, -2)
        off = mixed - torch.diag_embed(mixed.diagonal(dim1=-2, dim2=-1))
        assert float(off.abs().max()) < 1e-4


def test_a_zero_matrix_stays_zero() -> None:
    assert not nearly_orthogonal(torch.zeros(1, 4, 6)).any()


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="torch has Muon since 2.9")
def test_it_steps_as_torch_does() -> None:
    """To the precision of bfloat16, in which torch iterates: two or three digits of a step."""
    ours, theirs = _matrices(), _matrices()
    start = _matrices()
    _run(Muon(ours, lr=1e-2), ours)
    reference = torch.optim.Muon(
        theirs, lr=1e-2, weight_decay=0.0, adjust_lr_fn="match_rms_adamw", momentum=0.95
    )
    _run(reference, theirs)
    for a, b, s in zip(ours, theirs, start, strict=True):
        assert float(((a - b).norm() / (b - s).norm()).detach()) < 0.03


def test_a_step_is_as_long_as_the_rate_says() -> None:
    """0.2 times the rate for the root of the mean square, as Adam's steps measured large models."""
    matrices, start = _matrices(), _matrices()
    optimizer = Muon(matrices, lr=1e-2)
    for matrix in matrices:
        matrix.grad = torch.randn(matrix.shape, generator=torch.Generator().manual_seed(5))
    optimizer.step()
    for after, before in zip(matrices, start, strict=True):
        length = float((after - before).detach().square().mean().sqrt())
        assert 0.6 * 0.2e-2 < length < 1.2 * 0.2e-2


def test_matrices_without_a_gradient_stay() -> None:
    matrices, start = _matrices(), _matrices()
    matrices[1].grad = torch.ones_like(matrices[1])
    Muon(matrices).step()
    for index, (after, before) in enumerate(zip(matrices, start, strict=True)):
        assert torch.equal(after, before) == (index != 1)


def test_it_goes_on_bit_for_bit_from_its_saved_state() -> None:
    whole, halves = _matrices(), _matrices()
    _run(Muon(whole), whole)
    first = Muon(halves)
    for step in range(3):
        generator = torch.Generator().manual_seed(100 + step)
        if step == 1:
            second = Muon(halves)
            restore_optimizer(second, optimizer_tensors(first), optimizer_options(first))
            first = second
        for matrix in halves:
            matrix.grad = torch.randn(matrix.shape, generator=generator) + matrix.detach()
        first.step()
    for a, b in zip(whole, halves, strict=True):
        assert torch.equal(a, b)


def test_what_is_no_matrix_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(3,\), expected matrices"):
        Muon([nn.Parameter(torch.zeros(3))])
    with pytest.raises(ValueError, match="closure"):
        Muon([nn.Parameter(torch.zeros(3, 3))]).step(lambda: 0.0)
