"""An optimiser's state as named tensors and JSON, and back, bit for bit."""

from typing import Any

import torch
from torch import Tensor

from handavatar.train.runs import CheckpointError


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Moments and step counters, named ``{parameter index}.{quantity}``."""
    return {
        f"{index}.{name}": value
        for index, entry in optimizer.state_dict()["state"].items()
        for name, value in entry.items()
        if torch.is_tensor(value)
    }


def optimizer_options(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Learning rates and the other options of each parameter group; JSON values only."""
    return {"param_groups": optimizer.state_dict()["param_groups"]}


def restore_optimizer(
    optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor], options: dict[str, Any]
) -> None:
    """Sets the state that ``optimizer_tensors`` and ``optimizer_options`` gave.

    Args:
        optimizer: built anew over the same parameters in the same order.
        tensors: from ``optimizer_tensors``.
        options: from ``optimizer_options``, after a trip through JSON.

    Raises:
        CheckpointError: if groups, parameters or shapes differ.
    """
    current = optimizer.state_dict()["param_groups"]
    saved = options["param_groups"]
    if [group["params"] for group in current] != [list(group["params"]) for group in saved]:
        raise CheckpointError(
            f"optimiser state: saved for groups of {[len(g['params']) for g in saved]} parameters, "
            f"this model has {[len(g['params']) for g in current]}",
            "",
            "continue with the options the run was started with (options.json)",
        )
    groups = [
        {
            name: tuple(value) if isinstance(now.get(name), tuple) else value
            for name, value in then.items()
        }
        for now, then in zip(current, saved, strict=True)
    ]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, _, name = key.partition(".")
        number = int(index)
        if number >= len(parameters) or (value.ndim and value.shape != parameters[number].shape):
            raise CheckpointError(
                f"optimiser state {key}: shape {tuple(value.shape)} fits no parameter {number}",
                "",
                "continue with the options the run was started with (options.json)",
            )
        state.setdefault(number, {})[name] = value
    optimizer.load_state_dict({"state": state, "param_groups": groups})
