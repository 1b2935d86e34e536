"""How far fingers bend beyond their limits when a file is taken for what it is not."""

import math
from pathlib import Path

import pytest
import torch
from layout_files import make_truth

from handavatar.capture.motion_files.plausibility import (
    DOUBTFUL_BEND,
    MAX_BEND,
    bends_beyond_limits,
)
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.mano import absolute_rotations


def test_what_each_mistake_costs(tmp_path: Path) -> None:
    """Degrees in the worst tenth of 500 made poses; docs/motions.md has these figures."""
    truth = make_truth(tmp_path, steps=500)
    mean = truth.model.hands_mean.double()
    mirror = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    found = {
        name: math.degrees(
            float(
                bends_beyond_limits(truth.model.rig, matrix_from_axis_angle(turns))
                .mean(-1)
                .quantile(0.9)
            )
        )
        for name, turns in {
            "as it is": truth.rotations,
            "without the mean pose": absolute_rotations(truth.rotations, -mean),
            "mean pose twice": absolute_rotations(truth.rotations, mean),
            "the other side": truth.rotations * mirror,
        }.items()
    }
    expected = {
        "as it is": 0.0,
        "without the mean pose": 17.4,
        "mean pose twice": 10.5,
        "the other side": 49.9,
    }
    assert found == pytest.approx(expected, abs=0.1)
    refused, told = math.degrees(MAX_BEND), math.degrees(DOUBTFUL_BEND)
    assert found["without the mean pose"] > refused < found["the other side"]
    assert refused > found["mean pose twice"] > told
