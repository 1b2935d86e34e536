"""A known camera: its lens, its way, and how long its unit is."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from handavatar.capture.camera_path import in_metres, metres_of_unit
from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import opencv_from_opengl
from handavatar.capture.video_cameras import Lens, pinhole_of, read_camera
from handavatar.geometry.rotations import (
    apply_rigid,
    invert_rigid,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    mirror_rigid,
    quaternion_from_matrix,
    rigid_transform,
)
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose

SIZE = (640, 480)
LENS = Lens(SIZE, (600.0, 605.0), (322.0, 236.5), (-0.12, 0.03), (0.001, -0.002))


def _views(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    turns = matrix_from_axis_angle(0.5 * torch.randn(count, 3, generator=generator).double())
    return rigid_transform(turns, torch.randn(count, 3, generator=generator).double()).float()


def _nerfstudio(folder: Path, views: torch.Tensor, **changes: object) -> Path:
    content = {
        "camera_model": "OPENCV",
        "w": SIZE[0],
        "h": SIZE[1],
        "fl_x": LENS.focal[0],
        "fl_y": LENS.focal[1],
        "cx": LENS.center[0],
        "cy": LENS.center[1],
        "k1": LENS.radial[0],
        "k2": LENS.radial[1],
        "p1": LENS.tangential[0],
        "p2": LENS.tangential[1],
        "frames": [
            {
                "file_path": f"images/frame_{number:05d}.png",
                "transform_matrix": (
                    invert_rigid(view.double())
                    @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
                ).tolist(),
            }
            for number, view in enumerate(views)
        ],
        **changes,
    }
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def _colmap(folder: Path, views: torch.Tensor, camera: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    values = (*LENS.focal, *LENS.center, *LENS.radial, *LENS.tangential)
    camera = camera or f"1 OPENCV {SIZE[0]} {SIZE[1]} {' '.join(map(str, values))}"
    (folder / "cameras.txt").write_text(f"# Camera list\n{camera}\n")
    lines = ["# Image list with two lines of data per image:"]
    for number, view in enumerate(views):
        turn = quaternion_from_matrix(view[:3, :3].double()).tolist()
        words = [number + 1, *turn, *view[:3, 3].tolist(), 1, f"frame_{number:05d}.png"]
        # Points of the picture, or none.
        lines += [" ".join(map(str, words)), "" if number % 2 else "1.5 2.5 -1 3.5 4.5 7"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_the_points_of_colmap_s_pictures_take_no_memory(tmp_path: Path) -> None:
    """Each of their words was an object of its own."""
    folder = _colmap(tmp_path / "model", _views(2))
    lines = (folder / "images.txt").read_text().splitlines()
    lines[2] = "1 2 -1 " * 500_000
    (folder / "images.txt").write_text("\n".join(lines))
    tracemalloc.start()
    try:
        camera = read_camera(folder)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(camera.camera_from_world) == 2
    assert peak < 40e6  # A line has 3.5 million letters.


def test_the_names_of_colmap_s_pictures_may_hold_blanks(tmp_path: Path) -> None:
    folder = _colmap(tmp_path / "model", _views(2))
    text = (folder / "images.txt").read_text().replace("frame_00001", "my frame  1")
    (folder / "images.txt").write_text(text)
    assert list(read_camera(folder).camera_from_world) == ["frame_00000.png", "my frame  1.png"]


@pytest.mark.parametrize("write", [_nerfstudio, _colmap])
def test_both_kinds_of_files_say_the_same(tmp_path: Path, write: object) -> None:
    views = _views(5)
    camera = read_camera(write(tmp_path / "model", views))  # type: ignore[operator]
    assert camera.lens == LENS
    assert list(camera.camera_from_world) == [f"frame_{number:05d}.png" for number in range(5)]
    found = torch.stack(list(camera.camera_from_world.values()))
    assert torch.allclose(found, views, atol=1e-5)


def test_a_lens_bends_as_opencv_says() -> None:
    cv2 = pytest.importorskip("cv2")
    directions = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    points = np.concatenate([directions, np.ones((50, 1))], axis=1)
    matrix = np.array([[600.0, 0, 322], [0, 605, 236.5], [0, 0, 1]])
    coefficients = np.array([*LENS.radial, *LENS.tangential])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    assert np.allclose(LENS.project(directions), expected[:, 0], atol=1e-8)


def _scene(directions: np.ndarray) -> np.ndarray:
    """What is seen in a direction: smooth, and nowhere the same twice."""
    x, y = directions[..., 0], directions[..., 1]
    colors = [127 + 250 * x, 127 + 250 * y, 127 + 100 * np.sin(20 * x) * np.sin(20 * y)]
    return np.stack(colors, axis=-1).clip(0, 255).round().astype(np.uint8)


def _centers(size: tuple[int, int]) -> np.ndarray:
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return np.stack([x, y], axis=-1)


@pytest.mark.parametrize("bend", [-0.12, 0.12])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_pictures_of_a_lens_become_those_of_a_pinhole(bend: float, scale: float) -> None:
    pytest.importorskip("cv2")
    lens = Lens(SIZE, (600.0, 605.0), (322.0, 236.5), (bend, 0.02), (0.001, -0.002))
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    small = lens.resized(size)
    # The lens's picture: what lies in the direction that it shows at each pixel, by iteration.
    wanted = _centers(size)
    directions = (wanted - np.array(small.center)) / np.array(small.focal)
    for _ in range(60):
        directions -= (small.project(directions) - wanted) / np.array(small.focal)
    notes: list[str] = []
    pinhole = pinhole_of(lens, size, "model", notes.append)
    found = pinhole.straighten(_scene(directions))
    expected = _scene((wanted - np.array(pinhole.principal_point)) / pinhole.focal)
    apart = np.abs(found.astype(int) - expected)
    # To the border: nothing is repeated there. A tenth of a pixel is 0.04 steps of 255.
    assert apart.max() <= 4 and apart.mean() < 0.5
    assert "resampled to those of a pinhole" in notes[0]
    assert pinhole.focal >= (600.0 * 605.0) ** 0.5 * scale - 1e-6


def test_a_pinhole_s_pictures_stay_as_they_are() -> None:
    lens = Lens(SIZE, (600.0, 600.0), (330.0, 200.0))
    notes: list[str] = []
    pinhole = pinhole_of(lens, (320, 240), "model", notes.append)
    picture = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    assert pinhole.straighten(picture) is picture and notes == []
    assert pinhole.focal == 300.0 and pinhole.principal_point == (165.0, 100.0)


def test_cameras_of_other_pictures_are_refused() -> None:
    with pytest.raises(CaptureError, match="640 x 480, those of the video, upright, 480 x 640"):
        pinhole_of(LENS, (480, 640), "model", lambda text: None)
    with pytest.raises(CaptureError, match="bends lines too much"):
        wide = Lens(SIZE, (300.0, 300.0), (320.0, 240.0), (0.9, 0.0))
        pinhole_of(wide, SIZE, "model", lambda text: None)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"k3": 0.1}, "k3"),
        ({"fl_x": "wide"}, "fl_x"),
        ({"w": None}, "w is None"),
        ({"frames": [{"file_path": "a.png", "fl_x": 1.0}, {"file_path": "b.png"}]}, "2 different"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": (2 * np.eye(4)).tolist()}]}, "#0"),
        ({"frames": [{"transform_matrix": np.eye(4).tolist()}]}, "file_path"),
    ],
)
def test_transforms_that_cannot_be_used_say_why(
    tmp_path: Path, change: dict[str, object], what: str
) -> None:
    folder = _nerfstudio(tmp_path / "model", _views(2), **change)
    with pytest.raises(CaptureError, match=what) as caught:
        read_camera(folder)
    assert "transforms.json" in str(caught.value) and caught.value.remedy


@pytest.mark.parametrize(
    ("camera", "what"),
    [
        ("1 OPENCV_FISHEYE 640 480 1 2 3 4 5 6 7 8", "OPENCV_FISHEYE"),
        ("1 PINHOLE 640 480 600 600 320", "finite numbers"),
        ("1 PINHOLE 640 480 600 nan 320 240", "finite numbers"),
        ("2 PINHOLE 640 480 600 600 320 240", "different cameras"),
    ],
)
def test_models_that_cannot_be_used_say_why(tmp_path: Path, camera: str, what: str) -> None:
    with pytest.raises(CaptureError, match=what):
        read_camera(_colmap(tmp_path / "model", _views(2), camera))


def test_what_is_no_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"no transforms\.json and no cameras\.txt"):
        read_camera(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(b"x")
    with pytest.raises(CaptureError, match="binary model") as caught:
        read_camera(tmp_path)
    assert "model_converter" in caught.value.remedy


@pytest.mark.parametrize(
    "model", ["SIMPLE_PINHOLE 640 480 600 320 240", "PINHOLE 640 480 600 600 320 240"]
)
def test_a_lens_alone_is_read(tmp_path: Path, model: str) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {model}\n")
    camera = read_camera(tmp_path)
    assert camera.lens == Lens(SIZE, (600.0, 600.0), (320.0, 240.0))
    assert camera.camera_from_world == {}


def test_the_unit_is_found_from_a_hand_held_still() -> None:
    views = _views(20)
    generator = torch.Generator().manual_seed(1)
    place = torch.tensor([[0.2, -0.1, 0.6]])
    seen = apply_rigid(in_metres(views, 0.05), place.expand(20, 1, 3))[:, 0]
    noisy = seen + 0.01 * torch.randn(20, 3, generator=generator)
    assert metres_of_unit(views, seen) == pytest.approx(0.05, rel=1e-4)
    assert metres_of_unit(views, noisy) == pytest.approx(0.05, rel=0.1)
    wandering = seen + 0.2 * torch.randn(20, 3, generator=generator)
    with pytest.raises(CaptureError, match="the hand moved about as much") as caught:
        metres_of_unit(views, wandering)
    assert "`camera_unit`" in caught.value.remedy
    still = views[:1].expand(20, 4, 4)
    with pytest.raises(CaptureError, match="cannot be told"):
        metres_of_unit(still, noisy)


def test_a_pose_moves_to_other_axes_with_all_of_its_hand() -> None:
    rig = load_open_hand("778")
    shaped = rig.shaped(torch.ones(rig.shape_directions.shape[-1]))
    generator = torch.Generator().manual_seed(2)
    pose = HandPose(
        0.4 * torch.randn(4, 16, 3, generator=generator), torch.randn(4, 3, generator=generator)
    )
    views = _views(4)
    moved = pose.moved_to(views, shaped.rest_joints[0])
    for number in range(4):
        one = HandPose(pose.rotations[number], pose.translation[number])
        other = HandPose(moved.rotations[number], moved.translation[number])
        expected = apply_rigid(views[number], shaped.posed(one).vertices)
        assert torch.allclose(shaped.posed(other).vertices, expected, atol=1e-5)


def test_mirrored_cameras_see_the_mirrored_world() -> None:
    views, mirror = _views(3), torch.tensor([-1.0, 1.0, 1.0])
    points = torch.randn(3, 7, 3, generator=torch.Generator().manual_seed(3))
    seen = apply_rigid(views, points)
    assert torch.allclose(
        apply_rigid(mirror_rigid(views), points * mirror), seen * mirror, atol=1e-5
    )


def test_quaternions_are_the_rotations_that_they_come_from() -> None:
    turns = _views(6)[:, :3, :3].double()
    again = matrix_from_quaternion(-3 * quaternion_from_matrix(turns))
    assert torch.allclose(again, turns, atol=1e-6)
    assert torch.allclose(
        opencv_from_opengl(np.eye(4)), torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    )
