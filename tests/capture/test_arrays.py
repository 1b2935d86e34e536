"""Arrays become a capture that holds them; what is no such array is refused by name."""

from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
from conftest import lit_frame

from handavatar.capture.arrays import (
    camera_from_matrices,
    capture_from_arrays,
    coverage_from_array,
    image_from_array,
)
from handavatar.capture.checks import CaptureError
from handavatar.capture.soundness import find_problems
from handavatar.errors import ArgumentError

FRAMES = [lit_frame(number, "train") for number in range(5)]


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users run it: what is wrong is refused by the library, not by the tests' type checks."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def _arrays(kind: str) -> dict[str, Any]:
    camera = FRAMES[0].camera
    (fx, fy), (cx, cy) = camera.focal, camera.center
    found = {
        "images": torch.stack([frame.image for frame in FRAMES]),
        "masks": torch.stack([frame.mask for frame in FRAMES]),
        "intrinsics": torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        "rotations": torch.stack([frame.pose.rotations for frame in FRAMES]),
        "translations": torch.stack([frame.pose.translation for frame in FRAMES]),
        "camera_from_world": torch.stack([frame.camera.camera_from_world for frame in FRAMES]),
    }
    if kind == "torch":
        found["images"] = found["images"].float() / 255
        return found | {"rotations": found["rotations"].requires_grad_()}
    arrays = {name: value.numpy().astype(value.numpy().dtype) for name, value in found.items()}
    # As programs turn pictures about: memory that runs backwards, and numbers of 64 bits.
    arrays["images"] = np.ascontiguousarray(arrays["images"][:, ::-1])[:, ::-1]
    arrays["masks"] = arrays["masks"].astype(np.uint8) * 255
    return arrays | {"rotations": arrays["rotations"].astype(np.float64)}


@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_arrays_come_back_from_the_capture(tmp_path: Path, kind: str) -> None:
    capture = capture_from_arrays(tmp_path / "c", **_arrays(kind))
    assert [record.split for record in capture.records] == ["train"] * 4 + ["test"]
    assert not capture.is_tracked and find_problems(capture.folder) == []
    for number, frame in enumerate(FRAMES):
        found = capture.frame(number)
        assert torch.equal(found.image, frame.image) and torch.equal(found.mask, frame.mask)
        torch.testing.assert_close(found.pose.rotations, frame.pose.rotations)
        torch.testing.assert_close(found.pose.translation, frame.pose.translation)
        torch.testing.assert_close(found.camera.camera_from_world, frame.camera.camera_from_world)
        assert found.camera.focal == pytest.approx(frame.camera.focal)
        assert found.time == pytest.approx(number / 30)
    with pytest.raises(CaptureError, match="not empty"):
        capture_from_arrays(tmp_path / "c", **_arrays(kind))


def test_what_is_said_beside_the_arrays_is_kept(tmp_path: Path) -> None:
    known = np.ones((5, 48, 48), bool)
    known[:, :4] = False
    said = {"splits": ["train", "test", "val", "train", "train"], "times": np.arange(5) / 10}
    said |= {"known": known, "shape_coefficients": np.linspace(-1, 1, 10), "confidence": 0.7}
    capture = capture_from_arrays(
        tmp_path / "c", **_arrays("torch"), **said, side="left", subject="me", licence="CC0-1.0"
    )
    assert capture.side == "left" and capture.is_tracked
    assert [record.split for record in capture.records] == said["splits"]
    assert torch.equal(capture.frame(1).known, torch.from_numpy(known[1]))
    assert capture.frame(4).time == pytest.approx(0.4)
    torch.testing.assert_close(capture.shape_coefficients, torch.linspace(-1, 1, 10))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("images", []),
        ("images[0]", torch.zeros(5, 3, 48, 48)),
        ("images[0]", torch.full((5, 48, 48, 3), 200.0)),
        ("images[0]", torch.full((5, 48, 48, 3), float("nan"))),
        ("images[0]", [[0]] * 5),
        ("masks", torch.zeros(4, 48, 48, dtype=torch.bool)),
        ("masks[0]", np.ones((5, 48, 48), np.uint8)),
        ("masks[0]", np.zeros((5, 48, 48, 1), bool)),
        ("Frame.coverage", np.zeros((5, 48, 40), bool)),
        ("intrinsics", torch.eye(4)),
        ("intrinsics", torch.tensor([[60.0, 1, 24], [0, 60, 24], [0, 0, 1]])),
        ("Camera.focal", torch.tensor([[0.0, 0, 24], [0, 60, 24], [0, 0, 1]])),
        ("rotations", torch.zeros(5, 48)),
        ("rotations", torch.zeros(5, 16, 3, dtype=torch.int32)),
        ("translations", torch.zeros(3)),
        ("camera_from_world", torch.eye(3)),
        ("Camera.camera_from_world", 2 * torch.eye(4)),
        ("splits", ["train"]),
        ("times", [0.0]),
        ("known", torch.zeros(2, 48, 48, dtype=torch.bool)),
        ("known[0]", torch.zeros(5, 48, 48)),
        ("shape_coefficients", torch.zeros(3)),
    ],
)
def test_what_is_no_such_array_is_refused_by_name(tmp_path: Path, name: str, value: Any) -> None:
    given = _arrays("torch") | {name.split("[")[0].replace("Frame.coverage", "masks"): value}
    if name.startswith("Camera."):
        key = {"Camera.focal": "intrinsics"}.get(name, "camera_from_world")
        given = _arrays("torch") | {key: value}
    with pytest.raises(ArgumentError) as caught:
        capture_from_arrays(tmp_path / "c", **given)
    assert caught.value.argument == name
    assert list(tmp_path.iterdir()) == []


def test_the_helpers_refuse_by_the_name_they_are_given() -> None:
    for work in (image_from_array, coverage_from_array):
        with pytest.raises(ArgumentError) as caught:
            work("mine", "picture.png")  # type: ignore[arg-type]
        assert caught.value.argument == "mine"
    with pytest.raises(ArgumentError, match="fx"):
        camera_from_matrices(torch.ones(3, 3), torch.eye(4), 4, 4)
