"""Figures of known displacements."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from handavatar.bench.measures import (
    BLOCK,
    ClipScores,
    Hands,
    are_right,
    brought_to_depth,
    in_crop,
    joint_angles_apart,
    measure_displacements,
    measure_overlap,
)
from handavatar.geometry.cameras import Camera
from handavatar.geometry.rotations import matrix_from_axis_angle

FRAMES, VERTICES = 6, 40


def _points(seed: int = 0) -> Tensor:
    """A cloud of the size of a hand, half a metre away, in every frame another."""
    generator = torch.Generator().manual_seed(seed)
    cloud = torch.randn(FRAMES, VERTICES, 3, generator=generator) * 0.03
    return cloud + torch.tensor([0.02, -0.01, 0.5])


def _bones(seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return matrix_from_axis_angle(torch.randn(FRAMES, 2, 3, generator=generator))


OWNER = torch.arange(VERTICES) % 2


def _hands(vertices: Tensor) -> Hands:
    none = torch.zeros(FRAMES, 2, 3)
    return Hands(vertices, vertices[:, :5], none, matrix_from_axis_angle(none), 0.07)


def test_a_shift_along_the_rays_is_all_sight() -> None:
    truth = _points()
    ray = torch.nn.functional.normalize(truth, dim=-1)
    apart = measure_displacements(truth + 0.004 * ray, truth, _bones(), OWNER)
    assert apart.sight == pytest.approx(4.0, abs=1e-3)
    assert apart.lateral == pytest.approx(0.0, abs=1e-3)
    assert apart.mean == pytest.approx(4.0, abs=1e-3) == apart.worst
    assert apart.of_frames == pytest.approx([4.0] * FRAMES, abs=1e-3)


def test_a_shift_across_the_rays_is_all_lateral() -> None:
    truth = _points()
    ray = torch.nn.functional.normalize(truth, dim=-1)
    across = torch.nn.functional.normalize(
        torch.linalg.cross(ray, torch.tensor([0.0, 1.0, 0.0]).expand_as(ray)), dim=-1
    )
    apart = measure_displacements(truth + 0.003 * across, truth, _bones(), OWNER)
    assert apart.lateral == pytest.approx(3.0, abs=1e-3)
    assert apart.sight == pytest.approx(0.0, abs=1e-3)


def test_what_stays_in_the_axes_of_the_bone_does_not_vary() -> None:
    truth, bones = _points(), _bones()
    offset = torch.tensor([[0.002, 0.0, 0.001], [0.0, -0.003, 0.0]])[OWNER]
    moved = truth + (bones[:, OWNER] @ offset[..., None])[..., 0]
    apart = measure_displacements(moved, truth, bones, OWNER)
    assert apart.varying == pytest.approx(0.0, abs=1e-4)
    assert apart.constant == pytest.approx(500 * (math.sqrt(5e-6) + 3e-3), abs=1e-3)
    # In the camera's axes it is another thing: the bones turn.
    fixed = measure_displacements(truth + torch.tensor([0.003, 0.0, 0.0]), truth, bones, OWNER)
    assert fixed.varying > 1.0 and fixed.constant < 2.9


def test_the_worst_twentieth_is_of_vertices() -> None:
    truth = _points()
    moved = truth.clone()
    # 2 of 40 vertices of every frame: the twentieth.
    moved[:, :2, 0] += 0.010
    apart = measure_displacements(moved, truth, _bones(), OWNER)
    assert apart.worst == pytest.approx(10.0, abs=1e-3)
    assert apart.mean == pytest.approx(0.5, abs=1e-3)


def test_angles_are_root_mean_squares_over_bones() -> None:
    generator = torch.Generator().manual_seed(3)
    truth = torch.randn(FRAMES, 16, 3, generator=generator) * 0.4
    found = truth.clone()
    found[:, 4] = truth[:, 4] * (1 + math.radians(8) / truth[:, 4].norm(dim=-1, keepdim=True))
    torch.testing.assert_close(
        joint_angles_apart(found, truth), torch.full((FRAMES,), 2.0).double(), atol=1e-3, rtol=0
    )


def test_size_and_focal_length_are_taken_out_before_films_are_judged() -> None:
    truth = _hands(_points())
    # Twice as far and twice as large, through a lens of 1.25 times the focal length.
    seen = truth.vertices * torch.tensor([1 / 1.25, 1 / 1.25, 1.0]) * 2
    found = brought_to_depth(_hands(seen), truth, focal=800.0, true_focal=640.0)
    torch.testing.assert_close(found.vertices, truth.vertices)
    torch.testing.assert_close(found.landmarks, truth.landmarks)


def test_a_pose_is_right_if_a_similarity_lays_it_onto_the_truth() -> None:
    truth = _points()
    turn = matrix_from_axis_angle(torch.tensor([0.3, -0.2, 0.5]))
    assert bool(are_right(1.3 * truth @ turn.T + 0.1, truth).all())
    wrong = truth.clone()
    wrong[2, :, 0] = -wrong[2, :, 0]
    assert are_right(wrong, truth).tolist() == [True, True, False, True, True, True]


def test_overlap_of_shifted_squares() -> None:
    first, second = np.zeros((2, 128, 128), bool)
    first[40:80, 40:80] = True
    second[40:80, 42:82] = True
    everything = np.ones_like(first)
    overlap = measure_overlap(first, second, everything)
    assert overlap.iou == pytest.approx(38 / 42)
    # Two pixels on two of four sides, doubled by the crop of 256; corners are nearer.
    assert overlap.border == pytest.approx(2.0, rel=0.12)
    assert measure_overlap(first, first, everything).border == 0
    # What lies outside the picture is nobody's fault.
    left = everything.copy()
    left[:, 60:] = False
    half = second.copy()
    half[:, 60:] = ~half[:, 60:]
    assert measure_overlap(second, half, left).iou == 1.0
    assert measure_overlap(second, half, left).border == 0
    assert measure_overlap(first, np.zeros_like(first), everything).border is None


def test_a_crop_shows_what_its_camera_sees() -> None:
    picture = np.zeros((100, 120))
    picture[30:50, 20:60] = 1
    whole = Camera((200.0, 200.0), (60.0, 50.0), 120, 100, torch.eye(4))
    # Twice as large, its corner at (-10, 20) of the picture.
    crop = Camera((400.0, 400.0), (140.0, 60.0), 128, 128, torch.eye(4))
    values, inside = in_crop(picture, whole, crop)
    assert not inside[:, :20].any() and inside[:, 20:].all()
    rows, columns = np.nonzero(values > 0.5)
    assert (rows.min(), rows.max() + 1) == (20, 60)
    assert (columns.min(), columns.max() + 1) == (60, 128)


def test_blocks_are_stretches_of_time() -> None:
    scores = ClipScores({}, tuple(float(i) for i in range(2 * BLOCK + 2)))
    assert scores.blocks() == [(BLOCK - 1) / 2, BLOCK + (BLOCK - 1) / 2]
    assert ClipScores({}, (1.0, 3.0)).blocks() == [2.0]
    assert ClipScores({}, ()).blocks() == []
