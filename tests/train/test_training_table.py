"""The table of training's speed: less work and memory, the same gradient."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from told import Told

from handavatar.avatar import HandAvatar
from handavatar.train.training_table import TrainingTableOptions, gradient_error, training_table


@pytest.mark.slow
def test_training_is_cheaper_and_has_the_same_gradient(
    small_avatar: HandAvatar, tmp_path: Path
) -> None:
    small_avatar.save(tmp_path / "avatar.safetensors")
    sharp = HandAvatar.load(tmp_path / "avatar.safetensors")
    sharp.occupancy.sharpness = 3.0  # As it is trained.
    sharp.save(tmp_path / "avatar.safetensors")
    options = TrainingTableOptions(
        tmp_path / "avatar.safetensors", patch=32, plain_rays=32, steps=1, points=128
    )
    told = Told()
    table = training_table(options, told.progress)
    exact, trained = list(table.rows.values())[1:3]
    for row, most in ((exact, 1e-3), (trained, 0.1)):
        assert isinstance(row["gradient error"], float) and row["gradient error"] < most
        assert isinstance(row["MB ratio"], float) and row["MB ratio"] > 10
    assert set(table.rows) >= {"patch, plain", "pre-training step, plain", "pre-training step"}
    assert told.steps[-1] == options.total_steps
    assert json.loads(json.dumps(table.record(), allow_nan=False)) is not None
    with pytest.raises(ValueError, match="`plain_rays`: found 1025, expected 1 to 1024"):
        training_table(replace(options, plain_rays=32**2 + 1))


def test_gradients_are_compared_tensor_by_tensor() -> None:
    expected = {"large": torch.tensor([1.0, 2.0]), "small": torch.tensor([0.0, 0.01])}
    found = {"large": torch.tensor([1.0, 2.002]), "small": torch.tensor([0.0005, 0.01])}
    assert gradient_error(expected, found) == pytest.approx(0.05)
    # A sum that cancels is rounding alone.
    noise = {"noise": torch.tensor([1e-9])}
    assert gradient_error(expected | noise, found | {"noise": -noise["noise"]}) == pytest.approx(
        0.05
    )
