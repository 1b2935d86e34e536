import json

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
        torch.randn(5, 16, 3, generator=generator),
        torch.randn(5, 3, generator=generator),
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
