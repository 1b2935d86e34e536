"""What was filmed drives an avatar."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from handavatar.capture.checks import CaptureError
from handavatar.capture.default import default_capture
from handavatar.capture.frames import Capture
from handavatar.capture.motion import read_motion
from handavatar.capture.motion_import import motion_of_capture
from handavatar.cli import main
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import NUM_BONES, HandPose


def _capture(times: list[float], angles: list[float]) -> Capture:
    """A hand whose wrist turns about an axis and moves to the right as it does."""
    base = default_capture()
    records = []
    for time, angle in zip(times, angles, strict=True):
        rotations = torch.zeros(NUM_BONES, 3)
        rotations[0] = torch.tensor([0.0, angle, 0.0])
        pose = HandPose(rotations, torch.tensor([0.1 * angle, 0.0, 0.5]))
        records.append(replace(base.records[0], time=time, pose=pose))
    return replace(base, records=tuple(records))


def test_steps_are_even_where_frames_are_not() -> None:
    """A steady turn, some frames of which were left out, is steady again."""
    times = [0.0, 0.1, 0.2, 0.5, 0.6, 1.6]
    notes: list[str] = []
    motion = motion_of_capture(_capture(times, times), None, notes.append)
    assert motion.fps == pytest.approx(10.0) and len(motion) == 17
    expected = torch.arange(17) / 10
    torch.testing.assert_close(motion.rotations[:, 0, 1], expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(motion.translations[:, 0], 0.1 * expected, atol=1e-6, rtol=0)
    assert notes == ["no pose from 0.6 s for 1.0 s: the hand glides there"]
    finer = motion_of_capture(_capture(times, times), 50.0, notes.append)
    assert len(finer) == 81 and finer.fps == 50


def test_turns_go_the_short_way() -> None:
    motion = motion_of_capture(_capture([0.0, 1.0], [3.0, -3.0]), 2.0, lambda _: None)
    middle = matrix_from_axis_angle(motion.rotations[1, 0])
    half_turn = matrix_from_axis_angle(torch.tensor([0.0, math.pi, 0.0]))
    apart = axis_angle_from_matrix(middle.mT @ half_turn).norm()
    assert float(apart) < 1e-4


def test_frames_without_times_are_refused() -> None:
    with pytest.raises(CaptureError, match="do not have times that grow"):
        motion_of_capture(_capture([0.0, 0.0], [0.0, 1.0]), None, lambda _: None)


def test_times_that_are_too_far_apart_are_refused() -> None:
    for times in ([0.0, 1e308], [-1e308, 1e308], [0.0, 1e-3, 1e9], [0.0, 1e5]):
        with pytest.raises(CaptureError, match="a second"):
            motion_of_capture(_capture(times, [0.1] * len(times)), None, lambda _: None)


def test_the_command_writes_a_motion_that_is_read_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = default_capture()
    out = tmp_path / "m.json"
    assert main(["motion", "from", str(capture.folder), "--out", str(out)]) == 0
    assert "next: handavatar render RUN --motion" in capsys.readouterr().out
    motion = read_motion(out)
    first = min(capture.records, key=lambda record: record.time)
    torch.testing.assert_close(
        matrix_from_axis_angle(motion.rotations[0]),
        matrix_from_axis_angle(first.pose.rotations),
        atol=1e-5,
        rtol=0,
    )
    assert main(["motion", "from", str(tmp_path / "none.mp4"), "--out", str(out)]) == 3
    assert "no such file" in capsys.readouterr().err
