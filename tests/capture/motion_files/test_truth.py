"""Every layout, written from known poses, gives these poses back: the same vertices."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from layout_files import (
    FPS,
    MIRROR,
    Truth,
    amass_arrays,
    arctic_fields,
    hamer_arrays,
    interhand_frames,
    left_rig,
    make_truth,
    mean_pose,
    pca_arrays,
    save_pickle,
    save_pickled,
    smplx_arrays,
    wilor_mini_arrays,
    write_hawor,
    write_twin,
)
from mano_files import hand_fields

from handavatar.capture.motion import Motion, read_motion
from handavatar.capture.motion_files.trackers import is_hawor
from handavatar.cli import main
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.mano import read_mano
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.rigs import save_rig

SIDES = ("right", "left")
Writer = Callable[[Path, Truth], Path]


@pytest.fixture(scope="module", params=SIDES)
def truth(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return make_truth(tmp_path_factory.mktemp("mano"), request.param)


@pytest.fixture(scope="module", autouse=True)
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The twins of both sides, imported."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HANDAVATAR_HOME", str(folder))
        for side in SIDES:
            save_rig(read_mano(write_twin(folder, side)))
        yield folder / "rigs"


def convert(source: Path, *words: str, rig: str) -> Motion:
    out = source.parent / "motion.json"
    command = ["motion", "from", str(source), "--out", str(out), "--overwrite", "--rig", rig]
    assert main([*command, *words]) == 0
    return read_motion(out)


def largest_error(motion: Motion, truth: Truth) -> float:
    """Metres, of any vertex of any frame, the hand of the file's shape."""
    shaped = truth.model.rig.shaped(truth.betas.float())
    found = shaped.posed(HandPose(motion.rotations, motion.translations)).vertices
    return float((found - truth.vertices).norm(dim=-1).max())


def npz(arrays: Callable[[Truth], dict[str, np.ndarray]]) -> Writer:
    def write(folder: Path, truth: Truth) -> Path:
        np.savez(folder / "hand.npz", **arrays(truth))  # type: ignore[arg-type]
        return folder / "hand.npz"

    return write


def as_files(arrays: Callable[[Truth], dict[str, np.ndarray]]) -> Writer:
    """A file for each frame; 10 comes after 9."""

    def write(folder: Path, truth: Truth) -> Path:
        steps, many = len(truth.rotations), arrays(truth)
        (folder / "frames").mkdir()
        for step in range(steps):
            one = {name: v[step] if v.shape[:1] == (steps,) else v for name, v in many.items()}
            np.savez(folder / "frames" / f"clip_{step + 7}.npz", **one)  # type: ignore[arg-type]
        return folder / "frames"

    return write


def as_json(content: Callable[[Truth], dict]) -> Writer:
    def write(folder: Path, truth: Truth) -> Path:
        (folder / "hand.json").write_text(json.dumps(content(truth)))
        return folder / "hand.json"

    return write


def re_interhand(folder: Path, truth: Truth) -> Path:
    (folder / "params").mkdir()
    for number, hands in interhand_frames(truth)["0"].items():
        path = folder / "params" / f"{number}_{truth.side}.json"
        path.write_text(json.dumps(hands[truth.side]))
    return folder / "params"


def whole_pose(truth: Truth) -> dict[str, np.ndarray]:
    """All 48 numbers in one array."""
    arrays = smplx_arrays(truth)
    pose = np.concatenate([arrays.pop("global_orient"), arrays.pop("hand_pose")], axis=1)
    return arrays | {"pose": pose}


def relative_pose(truth: Truth) -> dict[str, np.ndarray]:
    return smplx_arrays(truth) | {"hand_pose": truth.relative().numpy()}


def as_lists(content: dict) -> dict:
    return {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in content.items()}


ABSOLUTE, RELATIVE = ("--flat-hand-mean", "true"), ("--flat-hand-mean", "false")
RATE = ("--fps", "30")
CASES: dict[str, tuple[Writer, tuple[str, ...], bool]] = {
    # Writer, what the user has to say, and whether the side must be said.
    "hamer": (npz(hamer_arrays), ("--layout", "hamer", *RATE), False),
    "wilor": (as_files(hamer_arrays), ("--layout", "wilor", *RATE), False),
    "wilor-mini": (npz(wilor_mini_arrays), ("--layout", "wilor-mini", *RATE), False),
    "wilor-mini files": (as_files(wilor_mini_arrays), ("--layout", "wilor-mini", *RATE), False),
    "hawor": (write_hawor, RATE, False),
    "smplx": (npz(smplx_arrays), ABSOLUTE, True),
    "smplx from the mean": (npz(relative_pose), RELATIVE, True),
    "whole pose": (npz(whole_pose), ABSOLUTE, True),
    "json": (as_json(lambda truth: as_lists(smplx_arrays(truth))), ABSOLUTE, True),
    "pkl": (lambda d, t: save_pickle(d / "h.pkl", smplx_arrays(t)), ABSOLUTE, True),
    "components": (npz(lambda t: pca_arrays(t, flat=True)), ("--use-pca", *ABSOLUTE), True),
    "components from the mean": (
        npz(lambda t: pca_arrays(t, flat=False)),
        ("--use-pca", *RELATIVE),
        True,
    ),
    "arctic": (lambda d, t: save_pickled(d / "s.mano.npy", arctic_fields(t)), RATE, False),
    "interhand": (as_json(interhand_frames), RATE, False),
    "re:interhand": (re_interhand, RATE, False),
}


@pytest.mark.parametrize("name", CASES)
def test_the_same_vertices_come_out(name: str, truth: Truth, tmp_path: Path) -> None:
    write, words, needs_side = CASES[name]
    told = ("--side", truth.side) if needs_side else ()
    motion = convert(write(tmp_path, truth), *words, *told, rig=f"mano-{truth.side}")
    assert (len(motion), motion.fps) == (len(truth.rotations), FPS)
    # Measured 1.3e-7: files hold single precision.
    assert largest_error(motion, truth) < 1e-5


def test_amass_gives_the_fingers_alone(truth: Truth, tmp_path: Path) -> None:
    path = npz(amass_arrays)(tmp_path, truth)
    motion = convert(path, "--side", truth.side, rig=f"mano-{truth.side}")
    assert motion.fps == 120
    still = truth.rotations.clone()
    still[:, 0] = 0
    expected = replace(truth, rotations=still, places=torch.zeros_like(truth.places))
    assert largest_error(motion, expected) < 1e-5


def test_truth_of_a_left_hand_is_what_a_left_mano_makes_of_the_file(tmp_path: Path) -> None:
    """Posed without any mirror but the last; otherwise the tests' own mirror would hide a fault."""
    made = make_truth(tmp_path, "left")
    sound = hand_fields("left", has_flaw=False)
    rig = left_rig(sound, made.model.rig)
    pose = HandPose(made.own_rotations.float(), made.own_places.float())
    vertices = rig.shaped(made.betas.float()).posed(pose).vertices
    torch.testing.assert_close(vertices * MIRROR.float(), made.vertices, atol=1e-5, rtol=0)


def test_truth_of_hamer_is_what_its_demo_draws(tmp_path: Path) -> None:
    """Vertices of a right hand, x times (2 right - 1), plus cam_t_full."""
    for side in SIDES:
        made = make_truth(tmp_path, side)
        arrays = hamer_arrays(made)
        pose = HandPose(made.rotations.float(), torch.zeros(len(made.rotations), 3))
        vertices = made.model.rig.shaped(made.betas.float()).posed(pose).vertices
        vertices[..., 0] *= float(2 * arrays["right"][0] - 1)
        vertices = vertices + torch.from_numpy(arrays["cam_t_full"]).float()[:, None]
        seen = vertices * MIRROR.float() if side == "left" else vertices
        torch.testing.assert_close(seen, made.vertices, atol=1e-5, rtol=0)


def test_the_mean_pose_comes_from_the_file_that_is_named(
    truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without any imported rig, and for the open hand."""
    monkeypatch.setenv("HANDAVATAR_HOME", str(tmp_path / "empty"))
    source = npz(relative_pose)(tmp_path, truth)
    file = write_twin(tmp_path, truth.side)
    words = (*RELATIVE, "--side", truth.side, "--mano", str(file))
    motion = convert(source, *words, rig="open-hand-778")
    wrist = truth.model.rig.shaped(truth.betas.float()).rest_joints[0]
    # The open hand's wrist rests at its origin.
    torch.testing.assert_close(motion.translations, truth.places.float() + wrist, atol=2e-5, rtol=0)
    torch.testing.assert_close(
        matrix_from_axis_angle(motion.rotations),
        matrix_from_axis_angle(truth.rotations.float()),
        atol=0.004,
        rtol=0,
    )


def test_lengths_in_millimetres_and_opengl_axes(truth: Truth, tmp_path: Path) -> None:
    """Axes turn about the camera, MANO's translation moves the wrist: trap four."""
    arrays = smplx_arrays(truth)
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    root = turn @ matrix_from_axis_angle(truth.own_rotations[:, 0])
    places = (truth.own_places + truth.wrist) @ turn - truth.wrist
    arrays["global_orient"] = axis_angle_from_matrix(root).numpy()
    arrays["transl"] = 1000 * places.numpy()
    np.savez(tmp_path / "gl.npz", **arrays)  # type: ignore[arg-type]
    words = (*ABSOLUTE, "--side", truth.side, "--axes", "opengl", "--unit", "mm")
    motion = convert(tmp_path / "gl.npz", *words, rig=f"mano-{truth.side}")
    assert largest_error(motion, truth) < 1e-5


def test_depths_follow_the_true_focal_length(truth: Truth, tmp_path: Path) -> None:
    arrays = hamer_arrays(truth)
    arrays["cam_t_full"][:, 2] *= 5000 / 256 * 1920 / 1500
    np.savez(tmp_path / "far.npz", **arrays)  # type: ignore[arg-type]
    words = ("--layout", "hamer", *RATE, "--focal", "1500")
    motion = convert(tmp_path / "far.npz", *words, rig=f"mano-{truth.side}")
    assert largest_error(motion, truth) < 1e-5


def test_a_crop_camera_and_its_box_place_a_right_hand(tmp_path: Path) -> None:
    truth = make_truth(tmp_path)
    arrays, steps = hamer_arrays(truth), len(truth.rotations)
    place, focal = arrays.pop("cam_t_full"), 1400.0
    center = np.tile([700.0, 480.0], (steps, 1)) + np.arange(steps)[:, None]
    size = np.linspace(300.0, 360.0, steps)
    scale = 2 * focal / (place[:, 2] * size)
    shift = 2 * (center - np.array([960.0, 540.0])) / (scale * size)[:, None]
    arrays |= {
        "pred_cam": np.column_stack([scale, place[:, :2] - shift]),
        "box_center": center,
        "box_size": size,
        "focal_length": np.array(focal),
    }
    np.savez(tmp_path / "box.npz", **arrays)  # type: ignore[arg-type]
    motion = convert(tmp_path / "box.npz", *RATE, rig="mano-right")
    assert largest_error(motion, truth) < 1e-5


def test_frames_without_a_hand_are_bridged_and_told(
    truth: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = relative_pose(truth)
    for name in ("global_orient", "hand_pose", "transl"):
        arrays[name] = arrays[name].copy()
        arrays[name][[0, 2, 3]] = 0
    np.savez(tmp_path / "gaps.npz", **arrays)  # type: ignore[arg-type]
    words = (*RELATIVE, "--side", truth.side)
    motion = convert(tmp_path / "gaps.npz", *words, rig=f"mano-{truth.side}")
    assert "note: no hand in 2 of 5 frames: bridged" in capsys.readouterr().out
    assert len(motion) == 5
    seen = [0, 3, 4]
    torch.testing.assert_close(
        motion.translations[seen], truth.places[[1, 4, 5]].float(), atol=1e-6, rtol=0
    )
    middle = torch.lerp(truth.places[1], truth.places[4], 1 / 3).float()
    torch.testing.assert_close(motion.translations[1], middle, atol=1e-6, rtol=0)


def test_files_that_are_missing_in_a_folder_are_frames_without_a_hand(
    truth: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = as_files(hamer_arrays)(tmp_path, truth)
    (folder / "clip_9.npz").unlink()
    motion = convert(folder, "--layout", "hamer", *RATE, rig=f"mano-{truth.side}")
    assert len(motion) == 6
    assert "no hand in 1 of 6 frames" in capsys.readouterr().out
    kept = [0, 1, 3, 4, 5]
    torch.testing.assert_close(
        motion.translations[kept], truth.places[kept].float(), atol=1e-6, rtol=0
    )


def test_one_of_two_hands_is_taken_by_the_numbers_of_their_frames(tmp_path: Path) -> None:
    hands = {side: make_truth(tmp_path, side, seed=3) for side in SIDES}
    both = {
        name: np.concatenate([hamer_arrays(hand)[name] for hand in hands.values()])
        for name in hamer_arrays(hands["right"])
    }
    both["frame"] = np.concatenate([np.arange(6), np.arange(6)])
    np.savez(tmp_path / "both.npz", **both)  # type: ignore[arg-type]
    for side, hand in hands.items():
        words = ("--layout", "hamer", "--side", side, *RATE)
        motion = convert(tmp_path / "both.npz", *words, rig=f"mano-{side}")
        assert largest_error(motion, hand) < 1e-5


def test_files_are_numbered_as_hamer_names_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Picture and hand: pictures count, whichever number a hand had in them."""
    hands = {side: make_truth(tmp_path, side, seed=3) for side in SIDES}
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "000007_0.jpg").write_bytes(b"an overlay beside them")
    for step in range(6):
        for place, side in enumerate(SIDES if step % 2 else SIDES[::-1]):
            one = {n: v[step] for n, v in hamer_arrays(hands[side]).items()}
            np.savez(folder / f"{step + 7:06}_{place}.npz", **one)  # type: ignore[arg-type]
    for side, hand in hands.items():
        words = ("--layout", "hamer", "--side", side, *RATE)
        motion = convert(folder, *words, rig=f"mano-{side}")
        assert len(motion) == 6 and largest_error(motion, hand) < 1e-5
    assert "no hand in" not in capsys.readouterr().out


def test_a_left_hand_goes_to_the_open_hand_by_the_right_ones_rest_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rest poses are alike, mean poses are not looked at: any MANO file does. At twice the rate."""
    monkeypatch.setenv("HANDAVATAR_HOME", str(tmp_path / "right alone"))
    save_rig(read_mano(write_twin(tmp_path)))
    truth = make_truth(tmp_path, "left")
    path = npz(smplx_arrays)(tmp_path, truth)
    words = (*ABSOLUTE, "--side", "left", "--fps", "60")
    motion = convert(path, *words, rig="open-hand-778")
    assert "note: carried over to open-hand-778, bone by bone" in capsys.readouterr().out
    assert (len(motion), motion.fps) == (11, 60)
    shaped = load_open_hand("778").shaped()
    ours = shaped.posed(HandPose(motion.rotations[::2], motion.translations[::2])).joints
    mean = replace(truth, betas=torch.zeros(10).double(), places=truth.places)
    wrist = truth.model.rig.shaped(truth.betas.float()).rest_joints[0]
    theirs = mean.model.rig.shaped().posed(HandPose(truth.rotations.float(), truth.places.float()))
    moved = theirs.joints + wrist - mean.model.rig.shaped().rest_joints[0]
    torch.testing.assert_close(ours, moved, atol=1e-4, rtol=0)


def test_few_components_are_the_first_ones(
    truth: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Fifteen, as HOT3D has them; that they are components is told, not asked for."""
    coefficients = 0.2 * torch.randn(6, 15, generator=torch.Generator().manual_seed(2)).double()
    components = torch.from_numpy(hand_fields()["hands_components"])[:15]
    fingers = coefficients @ components + torch.from_numpy(mean_pose())
    rotations = torch.cat([truth.rotations[:, :1], fingers.unflatten(1, (15, 3))], dim=1)
    expected = replace(truth, rotations=rotations)
    arrays = smplx_arrays(expected) | {"hand_pose": coefficients.numpy()}
    np.savez(tmp_path / "few.npz", **arrays)  # type: ignore[arg-type]
    words = (*RELATIVE, "--side", truth.side)
    motion = convert(tmp_path / "few.npz", *words, rig=f"mano-{truth.side}")
    assert "note: 15 principal components of MANO's finger poses" in capsys.readouterr().out
    assert largest_error(motion, expected) < 1e-5


def test_the_wrist_of_the_files_own_shape_is_placed(tmp_path: Path) -> None:
    """Of a hand whose wrist moves with its shape."""
    directions = hand_fields()["shapedirs"] + 0.02 * np.array([[1.0], [-1.0], [2.0]])
    file = write_twin(tmp_path, shapedirs=directions)
    truth = make_truth(tmp_path)
    rig = read_mano(write_twin(tmp_path, shapedirs=directions)).rig
    wrist = rig.shaped(truth.betas.float()).rest_joints[0]
    assert float((wrist - rig.shaped().rest_joints[0]).norm()) > 5e-3
    words = (*ABSOLUTE, "--side", "right", "--mano", str(file))
    motion = convert(npz(smplx_arrays)(tmp_path, truth), *words, rig="open-hand-778")
    expected = truth.places.float() + wrist
    torch.testing.assert_close(motion.translations, expected, atol=2e-5, rtol=0)


def test_files_that_are_numbered_in_tens_are_successive_frames(
    truth: Truth, tmp_path: Path
) -> None:
    folder = as_files(hamer_arrays)(tmp_path, truth)
    for path in sorted(folder.iterdir(), reverse=True):
        path.rename(folder / f"picture{path.stem.split('_')[1]}0.npz")
    motion = convert(folder, "--layout", "hamer", *RATE, rig=f"mano-{truth.side}")
    assert len(motion) == 6 and largest_error(motion, truth) < 1e-5


def test_one_frame_is_a_motion_of_one_step(truth: Truth, tmp_path: Path) -> None:
    single = replace(truth, rotations=truth.rotations[:1], places=truth.places[:1])
    arrays = {name: values[0] for name, values in hamer_arrays(single).items()}
    np.savez(tmp_path / "one.npz", **arrays)  # type: ignore[arg-type]
    motion = convert(tmp_path / "one.npz", "--layout", "hamer", *RATE, rig=f"mano-{truth.side}")
    assert len(motion) == 1 and largest_error(motion, single) < 1e-5


def test_a_hand_that_is_not_placed_turns_where_it_rests(
    truth: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = hamer_arrays(truth)
    del arrays["cam_t_full"]
    np.savez(tmp_path / "hand.npz", **arrays)  # type: ignore[arg-type]
    words = ("--layout", "hamer", *RATE)
    motion = convert(tmp_path / "hand.npz", *words, rig=f"mano-{truth.side}")
    assert "note: the file does not place the hand" in capsys.readouterr().out
    unplaced = replace(truth, places=torch.zeros_like(truth.places))
    assert largest_error(motion, unplaced) < 1e-5


def test_chunks_of_hawor_come_one_after_another(truth: Truth, tmp_path: Path) -> None:
    halves = [
        replace(truth, rotations=truth.rotations[part], places=truth.places[part])
        for part in (slice(0, 3), slice(3, 6))
    ]
    write_hawor(tmp_path, halves[0], 40)
    folder = write_hawor(tmp_path, halves[1], 43)
    motion = convert(folder, *RATE, rig=f"mano-{truth.side}")
    assert largest_error(motion, truth) < 1e-5
    assert is_hawor(folder, {})
    (tmp_path / "pictures" / "0").mkdir(parents=True)
    (tmp_path / "pictures" / "0" / "notes.json").write_text("{}")
    assert not is_hawor(tmp_path / "pictures", {})
    single = folder / str(int(truth.side == "right")) / "43_45.json"
    motion = convert(single, *RATE, rig=f"mano-{truth.side}")
    assert largest_error(motion, halves[1]) < 1e-5
