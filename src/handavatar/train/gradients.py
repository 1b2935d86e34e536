"""Gradients of several losses at once, a thread each."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

from handavatar.field.threads import mapped

Piece = TypeVar("Piece")


def set_mean_gradient(
    parameters: Sequence[nn.Parameter],
    loss_of: Callable[[Piece], tuple[Tensor, float]],
    pieces: Sequence[Piece],
) -> float:
    """Sets the gradients of some parameters to the mean over the pieces' losses.

    Every piece runs on one core: two cores that share small operations wait for each other for
    longer than they work. The result does not depend on the number of threads.

    Args:
        parameters: of the networks; others get no gradient.
        loss_of: the loss of a piece, and what is to be told of it.
        pieces: one or more; random numbers must have been drawn before.

    Returns:
        The mean of what is told.
    """

    def differentiated(piece: Piece) -> tuple[tuple[Tensor, ...], float]:
        with torch.enable_grad():
            loss, told = loss_of(piece)
            gradient = torch.autograd.grad(
                loss, parameters, allow_unused=True, materialize_grads=True
            )
        return gradient, told

    gradients, values = zip(*mapped(differentiated, pieces), strict=True)
    for parameter, parts in zip(parameters, zip(*gradients, strict=True), strict=True):
        parameter.grad = torch.stack(parts).mean(0)
    return sum(values) / len(values)
