"""SOMA-X: what is written is posed by SOMA's own rules, and read back in every form."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from handavatar.capture.motion import Motion, read_motion, write_motion
from handavatar.capture.motion_files.soma import JOINTS, soma_arrays
from handavatar.cli import main
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import rotations_from_angles, sample_poses

SIDES = ("right", "left")
MIRROR = torch.tensor([-1.0, 1.0, 1.0])
FINGERS = {"thumb": "Thumb", "index": "Index", "middle": "Middle", "ring": "Ring"}


@pytest.fixture(scope="module")
def motion() -> Motion:
    rig, generator = load_open_hand(), torch.Generator().manual_seed(5)
    rotations = sample_poses(rig, 5, generator)
    rotations[:, 0] = torch.randn(5, 3, generator=generator)
    return Motion(24.0, rotations, 0.3 * torch.randn(5, 3, generator=generator))


def parents() -> list[int]:
    """Of SOMA's 25 joints: the wrist carries the first of every finger."""
    found = [0]
    for place, name in enumerate(JOINTS[1:], start=1):
        found.append(0 if name.endswith("1") else place - 1)
    return found


def posed(arrays: dict[str, np.ndarray]) -> torch.Tensor:
    """Axes of SOMA's joints in the world by plain forward kinematics; steps 25 3 3."""
    local = matrix_from_axis_angle(torch.from_numpy(arrays["poses"]).double())
    world = [local[:, 0]]
    for joint in range(1, len(JOINTS)):
        world.append(world[parents()[joint]] @ local[:, joint])
    return torch.stack(world, dim=1)


@pytest.mark.parametrize("side", SIDES)
def test_somas_bones_point_where_the_motions_do(side: str, motion: Motion) -> None:
    """A right joint's bone runs along its -x, a left one's along its +x: SOMA's own offsets."""
    rig = load_open_hand()
    arrays = soma_arrays(motion, rig, side)  # type: ignore[arg-type]
    assert arrays["joint_names"][0] == f"{side.title()}Hand" and len(JOINTS) == 25
    along = torch.tensor([-1.0, 0.0, 0.0] if side == "right" else [1.0, 0.0, 0.0]).double()
    directions = posed(arrays) @ along
    joints = rig.shaped().posed(HandPose(motion.rotations, motion.translations)).joints
    for finger, bones in FINGER_BONES.items():
        name = "Pinky" if finger == "little" else finger.title()
        first = 1 if finger == "thumb" else 2
        for step, (bone, child) in enumerate(pairwise(bones)):
            expected = torch.nn.functional.normalize(joints[:, child] - joints[:, bone], dim=-1)
            if side == "left":
                expected = expected * MIRROR
            found = directions[:, JOINTS.index(f"{name}{first + step}")]
            torch.testing.assert_close(found.float(), expected, atol=5e-3, rtol=0)
    places = torch.from_numpy(arrays["transl"])
    wrist = joints[:, 0] * (MIRROR if side == "left" else 1)
    torch.testing.assert_close(places, wrist, atol=1e-6, rtol=0)


@pytest.mark.parametrize("side", SIDES)
def test_fingers_bend_about_somas_hinges(side: str, motion: Motion) -> None:
    """Flexion turns about the joints' -y, so that no finger is written twisted."""
    rig = load_open_hand()
    angles = torch.zeros(1, 16, 3)
    angles[0, 2, 0] = 0.8
    bent = Motion(1.0, rotations_from_angles(rig, angles), torch.zeros(1, 3))
    turn = soma_arrays(bent, rig, side)["poses"][0, JOINTS.index("Index3")]  # type: ignore[arg-type]
    np.testing.assert_allclose(turn, [0.0, -0.8, 0.0], atol=2e-3)


def as_body(arrays: dict[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    """The hand within a body, whose joints turn their own way."""
    other = "Left" if side == "right" else "Right"
    names = ["Root", "Hips", *arrays["joint_names"], *(f"{other}Hand{j}" for j in JOINTS)]
    steps = len(arrays["poses"])
    rest = np.random.default_rng(0).standard_normal((steps, 27, 3))
    poses = np.concatenate([rest[:, :2], arrays["poses"], rest[:, 2:]], axis=1)
    return {n: v for n, v in arrays.items() if n != "hand_type"} | {
        "poses": poses,
        "joint_names": np.array(names),
    }


def relative_to_rest(arrays: dict[str, np.ndarray], keeps_root: bool = True) -> dict[str, Any]:
    """Poses that count from a T pose of any orientations: absolute = O_parent^T R O."""
    generator = torch.Generator().manual_seed(8)
    orient = matrix_from_axis_angle(torch.randn(25, 3, generator=generator).double())
    absolute = matrix_from_axis_angle(torch.from_numpy(arrays["poses"]).double())
    relative = orient[parents()] @ absolute @ orient.mT
    start = 0 if keeps_root else 1
    return arrays | {
        "poses": axis_angle_from_matrix(relative).numpy()[:, start:],
        "joint_names": arrays["joint_names"][start:],
        "joint_orient": orient.numpy(),
        "absolute_pose": np.array(False),
        "keep_root": np.array(keeps_root),
    }


def as_matrices(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    turns = matrix_from_axis_angle(torch.from_numpy(arrays["poses"]).double()).numpy()
    return arrays | {"poses": turns, "rotation_repr": np.array("matrix")}


def convert(arrays: dict[str, Any], folder: Path, *words: str) -> Motion:
    np.savez(folder / "soma.npz", **arrays)
    out = folder / "back.json"
    command = ["motion", "from", str(folder / "soma.npz"), "--out", str(out), "--overwrite"]
    assert main([*command, *words]) == 0
    return read_motion(out)


def assert_same_turns(found: torch.Tensor, expected: torch.Tensor, atol: float = 1e-4) -> None:
    torch.testing.assert_close(
        matrix_from_axis_angle(found), matrix_from_axis_angle(expected), atol=atol, rtol=0
    )


@pytest.mark.parametrize("side", SIDES)
def test_the_commands_write_and_read_back_the_same_motion(
    side: str, motion: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "wave.json", tmp_path / "wave.npz"
    write_motion(source, motion)
    assert main(["motion", "to", str(source), "--out", str(out), "--side", side]) == 0
    assert "5 steps at 24 a second" in capsys.readouterr().out
    assert main(["motion", "from", str(out), "--out", str(tmp_path / "back.json")]) == 0
    said = capsys.readouterr().out
    assert "taken for SOMA-X's npz" in said and "bones point where they did" in said
    back = read_motion(tmp_path / "back.json")
    assert back.fps == 24
    assert_same_turns(back.rotations, motion.rotations)
    torch.testing.assert_close(back.translations, motion.translations, atol=1e-6, rtol=0)
    shaped = load_open_hand().shaped()
    first, second = (
        shaped.posed(HandPose(m.rotations, m.translations)).vertices for m in (motion, back)
    )
    assert float((first - second).norm(dim=-1).max()) < 1e-4


@pytest.mark.parametrize("side", SIDES)
def test_every_form_of_a_file_is_read(side: str, motion: Motion, tmp_path: Path) -> None:
    arrays = soma_arrays(motion, load_open_hand(), side)  # type: ignore[arg-type]
    centimetres = arrays | {"transl": 100 * arrays["transl"], "unit": np.array("centimeters")}
    for form in (relative_to_rest(arrays), as_matrices(arrays), centimetres):
        back = convert(form, tmp_path)
        assert_same_turns(back.rotations, motion.rotations)
        torch.testing.assert_close(back.translations, motion.translations, atol=1e-5, rtol=0)


@pytest.mark.parametrize("side", SIDES)
def test_of_a_body_and_without_a_root_the_fingers_are_read(
    side: str, motion: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = soma_arrays(motion, load_open_hand(), side)  # type: ignore[arg-type]
    body = as_body(arrays, side)
    back = convert(body, tmp_path, "--side", side)
    assert "SOMA-X body: fingers alone" in capsys.readouterr().out
    assert_same_turns(back.rotations[:, 1:], motion.rotations[:, 1:])
    assert float(back.translations.abs().max()) == 0
    assert float(back.rotations[:, 0].abs().max()) == 0
    back = convert(relative_to_rest(arrays, keeps_root=False), tmp_path)
    assert_same_turns(back.rotations[:, 1:], motion.rotations[:, 1:])
    assert float(back.rotations[:, 0].abs().max()) == 0
    assert "metacarpals" not in capsys.readouterr().out


def test_metacarpals_that_bend_are_told(
    motion: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The finger behind one still points where it did."""
    arrays = soma_arrays(motion, load_open_hand(), "right")
    local = matrix_from_axis_angle(torch.from_numpy(arrays["poses"]).double())
    bent = matrix_from_axis_angle(torch.tensor([0.0, -0.2, 0.0]).double())
    first, second = (JOINTS.index(name) for name in ("Pinky1", "Pinky2"))
    local[:, second] = bent.mT @ local[:, second]
    local[:, first] = local[:, first] @ bent
    back = convert(arrays | {"poses": axis_angle_from_matrix(local).numpy()}, tmp_path)
    assert "metacarpals bend by up to 11 degrees" in capsys.readouterr().out
    assert_same_turns(back.rotations, motion.rotations)


def refused(
    arrays: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str], *words: str
) -> str:
    np.savez(folder / "bad.npz", **arrays)
    command = ["motion", "from", str(folder / "bad.npz"), "--out", str(folder / "m.json")]
    assert main([*command, *words]) == 3
    assert not (folder / "m.json").exists()
    return capsys.readouterr().err


def test_what_is_missing_or_contradicts_itself_is_refused(
    motion: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = soma_arrays(motion, load_open_hand(), "right")
    body = as_body(arrays, "right")
    relative = relative_to_rest(arrays)
    without = {name: value for name, value in relative.items() if name != "joint_orient"}
    few = arrays | {"poses": arrays["poses"][:, :20], "joint_names": arrays["joint_names"][:20]}
    unnamed = arrays | {"joint_names": np.array(["a"] * 25), "hand_type": np.array("")}
    for content, words, expected in (
        (body, (), "it holds both hands"),
        (without, (), "count from a T pose, which is not in it"),
        (few, (), "the joints RightHandPinky1"),
        (arrays, ("--side", "left"), "it holds a right hand, --side says left"),
        (arrays, ("--unit", "mm"), "its unit is meters, --unit says mm"),
        (arrays | {"unit": np.array("inches")}, (), "unit is 'inches'"),
        (arrays | {"hand_type": np.array("left")}, (), "hand_type is left, the joints are"),
        (arrays | {"rotation_repr": np.array("matrix")}, (), "rotation_repr 'matrix'"),
        (arrays | {"transl": 100 * arrays["transl"]}, (), "expected 20 m at most"),
        (arrays | {"poses": np.rad2deg(arrays["poses"])}, (), "more than a full circle"),
        (unnamed, (), "no joint is called LeftHand"),
    ):
        assert expected in refused(content, tmp_path, capsys, *words)


def test_a_motion_is_written_to_npz_alone(
    motion: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "wave.json"
    write_motion(source, motion)
    words = ["motion", "to", str(source), "--out", str(tmp_path / "wave.bvh"), "--side", "left"]
    assert main(words) == 3
    assert "SOMA-X's files end with .npz" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wave.json"]
