import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from handavatar.capture.frames import CaptureError
from handavatar.capture.motion import (
    MORE_GESTURES,
    MOTIONS,
    Motion,
    gesture,
    middle_of_hand,
    named_motion,
    read_motion,
    write_motion,
)
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import PenetrationProbe, limit_excess


@pytest.fixture(scope="module")
def rig():
    return load_open_hand("778")


@pytest.fixture(scope="module")
def start():
    rotations = torch.zeros(16, 3)
    rotations[0] = torch.tensor([0.4, -0.3, 1.1])
    return HandPose(rotations, torch.tensor([0.05, 0.02, 0.4]))


def a_motion() -> Motion:
    generator = torch.Generator().manual_seed(0)
    return Motion(
        24.0,
        0.5 * torch.randn(5, 16, 3, generator=generator),
        0.1 * torch.randn(5, 3, generator=generator),
    )


def test_a_file_keeps_every_bit(tmp_path):
    motion = a_motion()
    write_motion(tmp_path / "m.json", motion)
    again = read_motion(tmp_path / "m.json")
    assert again.fps == motion.fps
    assert len(again) == 5
    assert torch.equal(again.rotations, motion.rotations)
    assert torch.equal(again.pose(3).translation, motion.translations[3])
    assert [path.name for path in tmp_path.iterdir()] == ["m.json"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, "schema"),
        ({"fps": 0}, "fps"),
        ({"rotations": []}, "rotations"),
        ({"rotations": [[[0.0] * 3] * 15] * 5}, "rotations"),
        ({"rotations": [[[90.0, 0.0, 0.0]] * 16] * 5}, "degrees"),
        ({"translations": [[0.0] * 3] * 4}, "translations"),
        ({"translations": [[0.0, 0.0, 1e999]] * 5}, "not JSON|translations"),
    ],
)
def test_bad_files_are_refused_with_a_remedy(tmp_path, change, message):
    path = tmp_path / "m.json"
    write_motion(path, a_motion())
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(CaptureError, match=message) as caught:
        read_motion(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


def _written(path, rotations, translations, fps=30):
    path.write_text(
        json.dumps({"schema": 1, "fps": fps, "rotations": rotations, "translations": translations})
    )
    return path


def _closing(step, scale=1.0):
    """A fist that closes, a few degrees a step; radians times a scale."""
    return [[0.0, 0.0, 0.0], *[[0.0, 0.0, scale * 0.04 * step]] * 15]


@pytest.mark.parametrize(
    ("rotations", "translations", "says"),
    [
        ([[[1.0, 0, 0, 0]] * 16] * 4, [[0, 0, 0.5]] * 4, "quaternions"),
        ([np.tile(np.eye(3), (16, 1, 1)).tolist()] * 4, [[0, 0, 0.5]] * 4, "matrices"),
        ([[[0.0] * 3] * 15] * 4, [[0, 0, 0.5]] * 4, "15 joints: the wrist is missing"),
        ([[0.0] * 48] * 4, [[0, 0, 0.5]] * 4, "48 numbers in one list"),
        ([[[0.0] * 3] * 21] * 4, [[0, 0, 0.5]] * 4, "21 joints"),
        ([[[0.0] * 3] * 20] * 4, [[0, 0, 0.5]] * 4, "a list of 20 where 16"),
        ([_closing(s, 57.3) for s in range(40)], [[0, 0, 0.5]] * 40, "degrees"),
        ([_closing(s, 57.3) for s in range(3)], [[0, 0, 0.5]] * 3, "degrees"),
        ([_closing(20, 57.3)], [[0, 0, 0.5]], "degrees"),
        ([[[0.0, 0, 0]] * 16] * 4, [[0, 0, 500.0]] * 4, "looks like millimetres"),
        ([[[0.0, 0, 0]] * 16] * 4, [[0, 0, 50.0]] * 4, "centimetres or millimetres"),
        ([[[0.0, 0, 0]] * 16] * 4, [[3.0 * k, 0, 9] for k in range(4)], "m a second"),
        ([[[0.0, 0, 0]] * 16] * 4, [0.0, 0, 0.5], "one place for 4 steps"),
        ([["\x1b[31mRED"]], [[0, 0, 0]], "rotations has"),
        ([5], [[0, 0, 0]], "rotations has"),
        ({}, [], "rotations is dict"),
    ],
)
def test_other_layouts_and_units_are_named(tmp_path, rotations, translations, says):
    with pytest.raises(CaptureError, match=says) as caught:
        read_motion(_written(tmp_path / "m.json", rotations, translations))
    assert caught.value.remedy


def test_more_than_a_full_circle_is_the_same_turn(tmp_path):
    # A hand that goes round and round: 8 radians are neither degrees nor a fault.
    steps = [[[0.0, 0.0, 0.4 * k], *[[0.0] * 3] * 15] for k in range(21)]
    motion = read_motion(_written(tmp_path / "m.json", steps, [[0, 0, 0.5]] * 21))
    meant = torch.tensor(steps)
    turns = matrix_from_axis_angle(motion.rotations.double())
    # Stored as floats.
    torch.testing.assert_close(turns, matrix_from_axis_angle(meant.double()), atol=1e-5, rtol=0)
    assert float(motion.rotations.norm(dim=-1).max()) <= 2 * math.pi
    assert torch.equal(motion.rotations[:16], meant[:16])


@pytest.mark.parametrize(
    ("case", "says"),
    [
        ("15joints", "15 joints"),
        ("degrees_small", "degrees"),
        ("mm", "millimetres"),
        ("quat", "quaternions"),
    ],
)
def test_the_cases_kept_with_the_project_are_named(case, says):
    path = Path(__file__).parents[3] / "shared/cases/motion" / f"{case}.json"
    if not path.is_file():
        pytest.skip("the cases are not here")
    with pytest.raises(CaptureError, match=says):
        read_motion(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="missing"):
        read_motion(tmp_path / "none.json")


def test_poses_that_are_not_finite_are_not_written(tmp_path):
    motion = a_motion()
    motion.rotations[2, 3, 1] = float("inf")
    with pytest.raises(CaptureError, match="finite"):
        write_motion(tmp_path / "m.json", motion)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", sorted(MORE_GESTURES))
def test_gestures_are_possible(rig, name):
    rotations = gesture(rig, name)
    # A tenth of a degree: what axis-angle and back costs in float32 is far less.
    assert float(limit_excess(rig, rotations).max()) < 2e-3
    # Motions open up whatever sinks in deeper than 2 mm, but from 5 mm on the gesture would change.
    assert float(PenetrationProbe(rig).depths(rotations[None])[0]) < 5e-3


@pytest.mark.parametrize("name", sorted(MOTIONS))
def test_named_motions_stay_where_they_start(rig, start, name):
    motion = named_motion(rig, name, start, fps=10.0)
    assert len(motion) == round((len(MOTIONS[name]) - 1) * 8) + 1
    torch.testing.assert_close(motion.rotations[0, 0], start.rotations[0], atol=1e-5, rtol=0)
    for step in (0, len(motion) // 3, len(motion) - 1):
        # The palm's middle is what turns stay about; float32 of lengths below a metre.
        torch.testing.assert_close(
            middle_of_hand(rig, motion.pose(step)), middle_of_hand(rig, start), atol=1e-5, rtol=0
        )


def test_unknown_names_are_refused(rig, start):
    with pytest.raises(CaptureError, match="gestures"):
        named_motion(rig, "dance", start)
    with pytest.raises(CaptureError, match="fist"):
        gesture(rig, "dance")
