"""How what is only compared with is fitted."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from handavatar.jobs.finite import require_finite
from handavatar.jobs.signals import stop_point

_DECAY = 0.05
"""The learning rate falls by this factor until the end, exponentially."""


def descend(module: nn.Module, loss_of_step: Callable[[], Tensor], steps: int, rate: float) -> None:
    """Adam on all parameters of a module.

    Args:
        module: what is fitted.
        loss_of_step: the loss of the next step, on pixels of its own choice.
        steps: how many.
        rate: learning rate at the start.

    Raises:
        NotFinite: if a loss, or a weight in the end, is NaN or infinite.
    """
    optimizer = torch.optim.Adam(module.parameters(), lr=rate)
    falling = torch.optim.lr_scheduler.ExponentialLR(optimizer, _DECAY ** (1 / max(steps, 1)))
    for step in range(steps):
        stop_point()
        loss = loss_of_step()
        require_finite({"loss": loss}, f"{type(module).__name__}, step {step + 1}")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        falling.step()
    require_finite(module.state_dict(), f"{type(module).__name__}, step {steps}")
