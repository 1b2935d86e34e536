import io
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import write_tiny_capture
from PIL import Image, ImageFilter
from scipy.ndimage import distance_transform_edt

from handavatar.capture.checks import CaptureError
from handavatar.capture.degraded import DegradeOptions, degrade_capture
from handavatar.capture.frames import read_capture
from handavatar.capture.motion import read_motion
from handavatar.capture.soundness import find_problems
from handavatar.errors import ArgumentError
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle


def test_nothing_asked_for_changes_nothing(tiny_capture: Path, tmp_path: Path) -> None:
    source = read_capture(tiny_capture)
    copy = degrade_capture(tmp_path / "copy", DegradeOptions(tiny_capture))
    assert find_problems(copy.folder) == [] and copy.is_tracked == source.is_tracked
    for index, record in enumerate(copy.records):
        before, after = source.frame(index), copy.frame(index)
        assert torch.equal(before.image, after.image)
        assert torch.equal(before.coverage, after.coverage)
        torch.testing.assert_close(before.pose.rotations, after.pose.rotations)
        assert record.split == source.records[index].split


def test_every_joint_is_off_by_as_much_as_asked(tiny_capture: Path, tmp_path: Path) -> None:
    source = read_capture(tiny_capture)
    options = DegradeOptions(tiny_capture, pose_noise=5.0, seed=3)
    noisy = degrade_capture(tmp_path / "noisy", options)
    assert noisy.is_tracked and not source.is_tracked
    turns, shifts = [], []
    for index in range(len(source.records)):
        true, read = source.frame(index).pose, noisy.frame(index).pose
        between = matrix_from_axis_angle(true.rotations).transpose(-1, -2) @ matrix_from_axis_angle(
            read.rotations
        )
        turns.append(axis_angle_from_matrix(between).norm(dim=-1))
        shifts.append(read.translation - true.translation)
    # 80 joints: their root mean square angle has a relative deviation of 1 / sqrt(6 * 80).
    angle = math.degrees(float(torch.cat(turns).square().mean().sqrt()))
    assert angle == pytest.approx(5.0, rel=0.2)
    assert 0.5e-3 < float(torch.cat(shifts).square().mean().sqrt()) < 5e-3
    # The truth goes with it, frame by frame; the same seed misreads alike.
    true = read_motion(noisy.folder / "truth" / "poses.json")
    torch.testing.assert_close(true.rotations[2], source.frame(2).pose.rotations)
    again = degrade_capture(tmp_path / "again", options)
    assert torch.equal(again.frame(1).pose.rotations, noisy.frame(1).pose.rotations)


def test_masks_shrink_and_pictures_blur_as_the_libraries_say(
    tiny_capture: Path, tmp_path: Path
) -> None:
    source = read_capture(tiny_capture).frame(0)
    options = DegradeOptions(tiny_capture, mask_erosion=2, blur=1.0, jpeg=40)
    worse = degrade_capture(tmp_path / "worse", options).frame(0)
    inside = distance_transform_edt(np.pad(source.mask.numpy(), 1))[1:-1, 1:-1]
    assert np.array_equal(worse.mask.numpy(), inside > 2)
    stream = io.BytesIO()
    blurred = Image.fromarray(source.image.numpy()).filter(ImageFilter.GaussianBlur(1.0))
    blurred.save(stream, "JPEG", quality=40)
    assert np.array_equal(worse.image.numpy(), np.array(Image.open(stream)))


@pytest.mark.parametrize(
    "wrong", [{"pose_noise": -1.0}, {"pose_noise": 90.0}, {"jpeg": 0}, {"mask_erosion": 100}]
)
def test_what_makes_no_sense_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ArgumentError, match=f"`{next(iter(wrong))}`: found .*expected"):
        DegradeOptions(Path("x"), **wrong)  # type: ignore[arg-type]


def test_a_folder_in_use_stays_as_it_is(tiny_capture: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("precious")
    with pytest.raises(CaptureError, match="not empty"):
        degrade_capture(tmp_path, DegradeOptions(tiny_capture))
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.slow
def test_noise_may_last(tmp_path: Path) -> None:
    source = write_tiny_capture(tmp_path / "source", "a" * 50)
    frames = read_capture(source)
    times = np.array([record.time for record in frames.records])
    lasting = DegradeOptions(source, pose_noise=4.0, pose_noise_correlation=0.1, seed=2)
    noisy = degrade_capture(tmp_path / "noisy", lasting)
    turns = []
    for before, after in zip(frames.records, noisy.records, strict=True):
        true, read = (matrix_from_axis_angle(r.pose.rotations.double()) for r in (before, after))
        turns.append(axis_angle_from_matrix(true.mT @ read))
    series = np.rad2deg(torch.stack(turns).numpy()).reshape(len(turns), -1)
    # The root mean square over joints does not depend on how long the noise lasts.
    assert math.sqrt((series**2).mean() * 3) == pytest.approx(4.0, rel=0.1)
    step = float(np.diff(times).mean())
    for lag in (1, 3):
        alike = (series[lag:] * series[:-lag]).mean() / (series**2).mean()
        assert alike == pytest.approx(math.exp(-lag * step / 0.1), abs=0.06)
