"""What a program in Python hands in is refused by name where it enters, with what was expected."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
from conftest import bent_pose, camera_above, lit_frame

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.motion import Motion
from handavatar.edit import Edit, Paint
from handavatar.errors import ArgumentError
from handavatar.geometry.cameras import Camera
from handavatar.geometry.rotations import invert_rigid
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig


@pytest.fixture(autouse=True)
def as_for_a_user(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the type checks of the tests, which a user's program does not have."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


EYE = torch.eye(4)
FLAT = torch.zeros(16, 3)
FEW = RenderSettings(num_samples=4)


def camera(**changes: Any) -> Camera:
    facts = dict(focal=(80.0, 80.0), center=(8.0, 8.0), width=16, height=16, camera_from_world=EYE)
    return Camera(**{**facts, **changes})


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda: HandPose(FLAT.numpy(), torch.zeros(3)),
            r"`HandPose\.rotations`: found numpy\.ndarray of shape \(16, 3\), expected a "
            r"torch\.Tensor of floats, \(\.\.\., 16, 3\)\n.*torch\.from_numpy\(\.\.\.\)\.float\(\)",
        ),
        (lambda: HandPose(FLAT.tolist(), torch.zeros(3)), r"found list, .*\n.*torch\.as_tensor"),
        (lambda: HandPose(FLAT.long(), torch.zeros(3)), r"found a tensor of int64, .*\n.*float"),
        (lambda: HandPose(FLAT[:15], torch.zeros(3)), r"shape \(15, 3\), .*16, 3"),
        (lambda: HandPose(torch.zeros(48), torch.zeros(3)), r"shape \(48,\), .*16, 3"),
        (lambda: HandPose(FLAT, torch.zeros(4)), r"`HandPose\.translation`: .*\(4,\)"),
        (lambda: HandPose(FLAT[None], torch.zeros(3)), "one place for each hand"),
        (lambda: camera(camera_from_world=EYE.numpy()), r"`Camera\.camera_from_world`: .*ndarray"),
        (lambda: camera(camera_from_world=EYE[:3]), r"shape \(3, 4\), expected .*\(4, 4\)"),
        (lambda: camera(camera_from_world=EYE.long()), "a tensor of int64"),
        (lambda: camera(camera_from_world=torch.diag(torch.tensor([1, 1, -1.0, 1]))), "mirrored"),
        (lambda: camera(camera_from_world=1000 * EYE), "not rigid"),
        (lambda: camera(camera_from_world=EYE.T.roll(1, 0)), "not rigid"),
        (lambda: camera(camera_from_world=EYE * math.nan), "not rigid"),
        (lambda: camera(focal=80.0), r"`Camera\.focal`: found 80\.0, expected two"),
        (lambda: camera(focal=(-80.0, 80.0)), "above zero"),
        (lambda: camera(center=(math.nan, 8.0)), r"`Camera\.center`"),
        (lambda: camera(width=0), r"`Camera\.width`: found 0, expected a whole number"),
        (lambda: camera(height=16.5), r"`Camera\.height`"),
        (lambda: Edit(light_gain=-1), "`light_gain`: found -1, expected a number, at least 0"),
        (lambda: Edit(light_gain=math.nan), "`light_gain`: found nan"),
        (lambda: Edit(light_gain="2"), "`light_gain`: found 2"),
        (lambda: Edit(albedo_shift=0.1), "`albedo_shift`: found 0.1, expected three numbers"),
        (lambda: Edit(albedo_shift=(0.1, 0, math.inf)), "`albedo_shift`"),
        (lambda: Edit(lifted_bones=("thumb",)), r"`lifted_bones`: .*\nbones_named"),
        (lambda: Edit(lifted_bones=(16,)), "0 to 15"),
        (lambda: Edit(paint=torch.zeros(4, 3)), "`paint`: found torch.Tensor .*expected a Paint"),
        (lambda: Paint(torch.zeros(4, 4), torch.zeros(4)), r"`Paint\.colors`: .*\(any, 3\)"),
        (lambda: Paint(torch.zeros(4, 3), torch.zeros(5)), r"`Paint\.opacity`: .*\(4\)"),
        (lambda: Paint(np.zeros((4, 3)), torch.zeros(4)), r"`Paint\.colors`: .*numpy"),
        (lambda: RenderSettings(num_samples=0), "`num_samples`: found 0, expected 1 to 4096"),
        (lambda: RenderSettings(stop=math.nan), "`stop`: found nan"),
        (lambda: RenderSettings(edge_rays=0), "`edge_rays`"),
        (lambda: Motion(0.0, FLAT[None], torch.zeros(1, 3)), "`fps`: found 0"),
        (lambda: Motion(30.0, FLAT, torch.zeros(1, 3)), r"`Motion\.rotations`"),
        (lambda: Motion(30.0, FLAT[None], torch.zeros(2, 3)), r"`Motion\.translations`: .*\(1, 3"),
    ],
)
def test_a_value_that_cannot_be_is_refused_when_it_is_made(
    make: Callable[[], object], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        make()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"image": torch.zeros(16, 16, 3)}, r"`Frame\.image`: .*float32, expected .*uint8"),
        ({"image": torch.zeros(16, 8, 3, dtype=torch.uint8)}, r"`Frame\.image`: .*\(16, 8, 3\)"),
        ({"coverage": torch.ones(16, 16, dtype=torch.bool)}, r"`Frame\.coverage`: .*bool"),
        ({"known": torch.ones(16, 16)}, r"`Frame\.known`: .*float32"),
        ({"gain": torch.ones(1)}, r"`Frame\.gain`"),
        ({"camera": EYE}, r"`Frame\.camera`: .*expected a Camera"),
        ({"pose": FLAT}, r"`Frame\.pose`: .*expected a HandPose"),
    ],
)
def test_parts_of_a_frame_fit_together(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        replace(lit_frame(0, "train", size=16), **changes)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ((FLAT, camera_above(8)), "`pose`: found torch.Tensor .*expected a HandPose"),
        ((bent_pose(0), EYE), "`camera`: found torch.Tensor .*expected a Camera"),
        ((bent_pose(0), camera_above(8), 1.5), "`edit`: found float, expected a Edit"),
        ((HandPose(FLAT[None], torch.zeros(1, 3)), camera_above(8)), r"`pose\.rotations`: .*1, 16"),
        (
            (HandPose(FLAT.double(), torch.zeros(3).double()), camera_above(8)),
            r"`pose\.rotations`: found a tensor of float64, expected .*float32.*\n.*float32",
        ),
        (
            (bent_pose(0), replace(camera_above(8), camera_from_world=EYE.double())),
            r"`camera\.camera_from_world`: found a tensor of float64",
        ),
    ],
)
def test_a_picture_is_of_one_hand_and_one_camera(
    given: tuple[Any, ...], says: str, small_avatar: HandAvatar
) -> None:
    with pytest.raises(ArgumentError, match=says):
        small_avatar.render(*given)


@pytest.mark.parametrize("margin", [6 / 256, math.inf])
def test_an_inverted_camera_is_named(small_avatar: HandAvatar, margin: float) -> None:
    """As who takes camera-to-world for world-to-camera has it: a black picture without a word."""
    pose = replace(bent_pose(0), translation=torch.tensor([0.08, 0.0, 0.0]))
    settings = replace(FEW, mask_margin=margin)
    placed = EYE.clone()
    placed[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    placed[2, 3] = 0.5
    seen = camera(focal=(30.0, 30.0), camera_from_world=placed)
    assert float(small_avatar.render(pose, seen, settings=settings).alpha.max()) > 0.5
    inverted = replace(seen, camera_from_world=invert_rigid(placed))
    with pytest.raises(ArgumentError, match=r"`camera`: nothing of the hand is in(.|\n)*inverse"):
        small_avatar.render(pose, inverted, settings=settings)
    # Whoever looks elsewhere sees nothing, and may.
    aside = placed.clone()
    aside[0, 3] = 40.0
    away = small_avatar.render(pose, replace(seen, camera_from_world=aside), settings=settings)
    assert not bool(away.alpha.any())


def test_a_shape_has_as_many_coefficients_as_the_rig(rig: Rig) -> None:
    for given, says in (
        (torch.zeros(9), r"`coefficients`: found a tensor of shape \(9,\), expected .*10"),
        (np.zeros(10), "`coefficients`: found numpy.ndarray"),
        (torch.zeros(10).double(), "float64, expected .*float32"),
    ):
        with pytest.raises(ArgumentError, match=says):
            rig.shaped(given)
