"""What is wrong with a file, or not said, is refused by name: what it is and what to do."""

import json
import os
import pickle
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from layout_files import (
    Truth,
    amass_arrays,
    arctic_fields,
    hamer_arrays,
    interhand_frames,
    make_truth,
    pca_arrays,
    save_pickle,
    save_pickled,
    smplx_arrays,
    wilor_mini_arrays,
    write_hawor,
    write_twin,
)

from handavatar.capture.motion import Motion
from handavatar.capture.motion_files import stored
from handavatar.capture.motion_files.soma import soma_arrays
from handavatar.cli import main
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.mano import read_mano
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.rigs import save_rig

BAD_DATA, NO_LICENCE = 3, 4
ABSOLUTE = ("--flat-hand-mean", "true", "--side", "right")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A home in which the right twin alone is imported, and the files of both."""
    made = tmp_path_factory.mktemp("refused")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HANDAVATAR_HOME", str(made / "home"))
        write_twin(made, "left")
        save_rig(read_mano(write_twin(made)))
        yield made


@pytest.fixture(scope="module")
def right(folder: Path) -> Truth:
    return make_truth(folder)


@pytest.fixture(scope="module")
def left(folder: Path) -> Truth:
    return make_truth(folder, "left")


@pytest.fixture
def refusal(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Converts a file, and gives the exit code and what is said of it; nothing may be written."""

    def convert(source: Path | dict[str, Any], *words: str, rig: str = "mano-right") -> str:
        if isinstance(source, dict):
            np.savez(tmp_path / "hand.npz", **source)
            source = tmp_path / "hand.npz"
        out = tmp_path / "motion.json"
        command = ["motion", "from", str(source), "--out", str(out), "--rig", rig, *words]
        code = main(command)
        said = capsys.readouterr().err
        assert code in (BAD_DATA, NO_LICENCE), said
        assert not out.exists()
        return f"{code} {said}"

    return convert


# --- what must be said ----------------------------------------------------------------------------


def test_a_left_hand_of_a_tracker_needs_its_name(refusal: Any, left: Truth, right: Truth) -> None:
    for arrays in (hamer_arrays(left), wilor_mini_arrays(left)):
        said = refusal(arrays, "--fps", "30")
        assert "--layout hamer, wilor or wilor-mini" in said
    unsided = hamer_arrays(right)
    del unsided["right"]
    assert "or one of an unknown side" in refusal(unsided, "--fps", "30")


def test_the_side_must_be_known_and_agree(
    refusal: Any, right: Truth, left: Truth, tmp_path: Path
) -> None:
    mean = ("--flat-hand-mean", "true")
    assert "it does not say which hand it is" in refusal(smplx_arrays(right), *mean)
    said = refusal(hamer_arrays(right), "--fps", "30", "--side", "left", "--layout", "hamer")
    assert "it holds a right hand, --side says left" in said
    assert "it holds both hands" in refusal(amass_arrays(right))
    both = save_pickled(tmp_path / "both.npy", arctic_fields(right) | arctic_fields(left))
    assert "it holds both hands" in refusal(both, "--fps", "30")
    odd = smplx_arrays(right) | {"is_rhand": np.array(0.5)}
    assert "is_rhand is neither 0 (left) nor 1 (right)" in refusal(odd, *mean)
    (tmp_path / "h" / "0").mkdir(parents=True)
    single = write_hawor(tmp_path, right) / "1" / "0_5.json"
    moved = tmp_path / "0_5.json"
    moved.write_bytes(single.read_bytes())
    assert "it does not say which hand it is" in refusal(moved, "--fps", "30")


def test_hands_of_both_sides_need_numbers_of_frames(
    refusal: Any, right: Truth, left: Truth
) -> None:
    one, other = hamer_arrays(right), hamer_arrays(left)
    both = {name: np.concatenate([one[name], other[name]]) for name in one}
    words = ("--layout", "hamer", "--side", "right", "--fps", "30")
    assert "add an array named frame" in refusal(both, *words)
    twice = {name: np.concatenate([one[name], one[name]]) for name in one}
    twice["frame"] = np.tile(np.arange(6), 2)
    assert "frame 0 holds two right hands" in refusal(twice, *words)


def test_the_mean_pose_must_be_known_and_agree(refusal: Any, right: Truth, tmp_path: Path) -> None:
    said = refusal(smplx_arrays(right), "--side", "right")
    assert "say --flat-hand-mean true" in said and "InterHand2.6M" in said
    said = refusal(hamer_arrays(right), "--fps", "30", "--flat-hand-mean", "false")
    assert "count from the flat hand, --flat-hand-mean says false" in said
    path = save_pickled(tmp_path / "a.npy", arctic_fields(right))
    said = refusal(path, "--fps", "30", "--flat-hand-mean", "true")
    assert "count from MANO's mean pose, --flat-hand-mean says true" in said
    assert "no principal components" in refusal(amass_arrays(right), "--use-pca")
    matrices = smplx_arrays(right) | {"hand_pose": hamer_arrays(right)["hand_pose"]}
    said = refusal(matrices, "--layout", "mano", *ABSOLUTE)
    assert "holds matrices, whose mean pose cannot be told" in said


def test_mean_pose_and_components_need_the_users_own_file(
    refusal: Any, right: Truth, left: Truth, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the same side; the open hand needs one for MANO's rest pose."""
    relative = smplx_arrays(left) | {"hand_pose": left.relative().numpy()}
    told = ("--flat-hand-mean", "false", "--side", "left")
    said = refusal(relative, *told)
    assert said.startswith("4") and "count from MANO's mean pose" in said and "--mano" in said
    said = refusal(relative, *told, "--mano", str(folder / "MANO_RIGHT.pkl"))
    assert said.startswith("3") and "it is of the right hand, the motion of the left" in said
    monkeypatch.setenv("HANDAVATAR_HOME", str(folder / "nowhere"))
    said = refusal(hamer_arrays(right), "--fps", "30", rig="open-hand")
    assert said.startswith("4") and "its rest pose is another than that of open-hand" in said
    said = refusal(pca_arrays(right, True), "--use-pca", *ABSOLUTE, rig="open-hand")
    assert said.startswith("4") and "principal components" in said
    said = refusal(relative, *told, "--mano", str(folder / "none.pkl"), rig="open-hand")
    assert said.startswith("4") and "mano.is.tue.mpg.de" in said


def test_frames_a_second_must_be_known(refusal: Any, right: Truth) -> None:
    assert "say it with --fps" in refusal(hamer_arrays(right))
    bad = smplx_arrays(right) | {"fps": np.array(0.0)}
    assert "fps is 0" in refusal(bad, *ABSOLUTE)


def test_unknown_contents_are_named(refusal: Any, right: Truth, tmp_path: Path) -> None:
    assert "its layout is not known; it holds vertices" in refusal({"vertices": np.zeros((2, 3))})
    assert "there is no global_orient" in refusal(
        {"hand_pose": np.zeros((2, 45))}, "--layout", "hamer", "--fps", "30", "--side", "right"
    )
    short = amass_arrays(right)
    short["poses"] = short["poses"][:, :72]
    said = refusal(short, "--layout", "amass", "--side", "right")
    assert "poses has shape (6, 72), expected (frames, 156)" in said
    odd = smplx_arrays(right)
    odd["pose"] = np.zeros((6, 45))
    del odd["global_orient"], odd["hand_pose"]
    assert "pose has 45 values a frame, expected 48" in refusal(odd, *ABSOLUTE)
    frames = interhand_frames(right)
    path = tmp_path / "two.json"
    path.write_text(json.dumps(frames | {"1": frames["0"]}))
    said = refusal(path, "--layout", "interhand", "--fps", "30")
    assert "holds 2 captures" in said


# --- units, axes, angles --------------------------------------------------------------------------


def test_lengths_of_another_unit_are_refused(refusal: Any, right: Truth) -> None:
    arrays = wilor_mini_arrays(right)
    arrays["pred_cam_t_full"] = 1000 * arrays["pred_cam_t_full"]
    words = ("--fps", "30")
    said = refusal(arrays, *words)
    assert "m from the camera, expected 0.05 to 5 m" in said and "--focal" in said
    said = refusal(wilor_mini_arrays(right), *words, "--unit", "mm")
    assert "the hand is 0.006" in said and "its unit may be another: --unit cm" in said
    far = smplx_arrays(right)
    far["transl"] = 1000 * far["transl"]
    said = refusal(far, *ABSOLUTE)
    assert "m from the origin, expected 20 m at most" in said and "--unit cm or --unit mm" in said


def test_millimetres_of_hawor_are_named(refusal: Any, right: Truth, tmp_path: Path) -> None:
    path = write_hawor(tmp_path, right) / "1" / "0_5.json"
    content = json.loads(path.read_text())
    content["init_trans"] = (1000 * np.array(content["init_trans"])).tolist()
    path.write_text(json.dumps(content))
    said = refusal(path, "--fps", "30")
    assert "its unit may be another: --unit cm or --unit mm" in said


def test_hands_behind_the_camera_are_refused(refusal: Any, right: Truth) -> None:
    arrays = hamer_arrays(right)
    arrays["cam_t_full"][:, 2] *= -1
    said = refusal(arrays, "--fps", "30")
    assert "m behind the camera" in said and "--axes opengl" in said
    said = refusal(hamer_arrays(right), "--fps", "30", "--axes", "opengl")
    assert "m behind the camera" in said and "leave --axes out" in said


def test_a_focal_length_needs_the_one_of_the_file(refusal: Any, right: Truth) -> None:
    arrays = hamer_arrays(right)
    del arrays["img_size"]
    said = refusal(arrays, "--fps", "30", "--focal", "1500")
    assert "which focal length its depths belong to" in said


def test_crop_cameras_that_do_not_place_the_hand_are_refused(
    refusal: Any, right: Truth, left: Truth
) -> None:
    arrays = hamer_arrays(right)
    del arrays["cam_t_full"]
    arrays["pred_cam"] = np.ones((6, 3))
    said = refusal(arrays, "--fps", "30")
    assert "pred_cam is there without box_center, box_size" in said
    arrays["right"] = np.zeros(6)
    said = refusal(arrays, "--fps", "30", "--layout", "hamer")
    assert "may be of the mirrored picture or not" in said


def test_degrees_are_refused(refusal: Any, right: Truth) -> None:
    degrees = smplx_arrays(right)
    degrees["hand_pose"] = np.rad2deg(degrees["hand_pose"])
    assert "more than a full circle in radians" in refusal(degrees, *ABSOLUTE)


def test_matrices_that_are_no_rotations_are_refused(refusal: Any, right: Truth) -> None:
    scaled, mirrored = hamer_arrays(right), hamer_arrays(right)
    scaled["hand_pose"][2, 4] *= 1.1
    assert "the matrix at [2, 5] is no rotation" in refusal(scaled, "--fps", "30")
    mirrored["hand_pose"][1, 0, :, 0] *= -1
    assert "the matrix at [1, 1] mirrors" in refusal(mirrored, "--fps", "30")


# --- fingers that bend as no hand's do ------------------------------------------------------------


def test_matrices_for_row_vectors_are_named(refusal: Any, right: Truth) -> None:
    arrays = hamer_arrays(right)
    for name in ("global_orient", "hand_pose"):
        arrays[name] = arrays[name].swapaxes(-1, -2).copy()
    assert "its matrices are for row vectors: transpose them" in refusal(arrays, "--fps", "30")


def test_the_other_sides_parameters_are_named(refusal: Any, left: Truth, right: Truth) -> None:
    """Those of a left hand that was not mirrored, taken for a right one's, and the reverse."""
    wrong = hamer_arrays(right)
    sign = np.array([-1.0, 1.0, 1.0])
    for name in ("global_orient", "hand_pose"):
        wrong[name] = wrong[name] * sign[:, None] * sign
    said = refusal(wrong, "--fps", "30")
    assert "or a left one as another tracker describes it: --layout hamer, wilor" in said
    said = refusal(smplx_arrays(left), *ABSOLUTE)
    assert "if it is a left hand: --side left" in said


def test_a_mean_pose_that_was_left_out_or_added_twice_is_named(refusal: Any, right: Truth) -> None:
    """Where it can be seen: an opened hand without it, a closed one with it twice."""
    missing = smplx_arrays(right)
    missing["hand_pose"] = np.tile(-read_mean(right), (6, 1))
    said = refusal(missing, *ABSOLUTE)
    assert "if its poses count from MANO's mean pose" in said and "--flat-hand-mean false" in said
    fist = smplx_arrays(right)
    fist["hand_pose"] = np.tile([0.0, 0.0, 1.3], (6, 15)) * np.repeat([1, 1, 1, 1, 0.0], 9)
    said = refusal(fist, "--flat-hand-mean", "false", "--side", "right")
    assert "if its poses hold MANO's mean pose already" in said and "--flat-hand-mean true" in said


def read_mean(truth: Truth) -> np.ndarray:
    return truth.model.hands_mean.flatten().double().numpy()


def test_one_joint_bent_too_far_is_told(
    right: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    arrays = smplx_arrays(right)
    pose = arrays["hand_pose"].copy()
    pose[:, 3:6] = [0.0, 0.0, -0.8]
    arrays["hand_pose"] = pose
    np.savez(tmp_path / "odd.npz", **arrays)  # type: ignore[arg-type]
    words = ["--out", str(tmp_path / "m.json"), "--rig", "mano-right", *ABSOLUTE]
    assert main(["motion", "from", str(tmp_path / "odd.npz"), *words]) == 0
    assert "note: index2 is bent beyond its limits by 4" in capsys.readouterr().out


def test_fingers_that_do_not_move_are_told(
    right: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    arrays = amass_arrays(right)
    arrays["poses"][:, 111:] = arrays["poses"][:1, 111:]
    np.savez(tmp_path / "still.npz", **arrays)  # type: ignore[arg-type]
    words = ["--out", str(tmp_path / "m.json"), "--rig", "mano-right", "--side", "right"]
    assert main(["motion", "from", str(tmp_path / "still.npz"), *words]) == 0
    assert "note: the right hand's fingers do not move" in capsys.readouterr().out


# --- damaged and hostile files --------------------------------------------------------------------


def test_numbers_that_are_none_are_refused(refusal: Any, right: Truth) -> None:
    for value in (np.nan, np.inf):
        arrays = smplx_arrays(right)
        arrays["transl"] = arrays["transl"].copy()
        arrays["transl"][3, 1] = value
        assert "transl is NaN or infinite at [3, 1]" in refusal(arrays, *ABSOLUTE)


def test_lengths_that_differ_are_refused(refusal: Any, right: Truth) -> None:
    arrays = smplx_arrays(right)
    arrays["hand_pose"] = arrays["hand_pose"][:4]
    said = refusal(arrays, *ABSOLUTE)
    assert "the arrays differ in length: global_orient 6, hand_pose 4" in said
    arrays = hamer_arrays(right)
    arrays["cam_t_full"] = arrays["cam_t_full"][:5]
    assert "cam_t_full has 5 rows for 6 hands" in refusal(arrays, "--fps", "30")
    arrays = smplx_arrays(right)
    arrays["betas"] = np.zeros(4)
    assert "betas ends with 4 values, expected 10" in refusal(arrays, *ABSOLUTE)


def test_empty_files_are_refused(refusal: Any, right: Truth, tmp_path: Path) -> None:
    empty = {
        name: values[:0] if values.ndim == 2 else values
        for name, values in smplx_arrays(right).items()
    }
    assert "global_orient is empty" in refusal(empty, *ABSOLUTE)
    zeros = {name: np.zeros_like(values) for name, values in smplx_arrays(right).items()}
    zeros["fps"] = np.array(30.0)
    assert "no frame holds a hand: all 6 are zeros" in refusal(zeros, *ABSOLUTE)
    path = tmp_path / "cut.npz"
    np.savez(path, **smplx_arrays(right))  # type: ignore[arg-type]
    path.write_bytes(path.read_bytes()[:200])
    assert "not a whole npz file" in refusal(path, *ABSOLUTE)
    path = tmp_path / "none.npy"
    path.write_bytes(b"nothing")
    assert "not an npy file" in refusal(path, *ABSOLUTE)
    path = tmp_path / "none.json"
    path.write_text("[1, 2]")
    assert "holds no JSON object" in refusal(path, *ABSOLUTE)


class _Hostile:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (str(self.mark),))


def test_pickles_that_would_run_something_are_refused_and_run_nothing(
    refusal: Any, tmp_path: Path, right: Truth
) -> None:
    mark = tmp_path / "it-ran"
    hostile = {"right": _Hostile(mark)}
    said = refusal(save_pickled(tmp_path / "a.mano.npy", hostile), "--fps", "30")
    assert "mkdir, which has no place in it" in said
    said = refusal(save_pickle(tmp_path / "a.pkl", hostile), "--fps", "30")
    assert "mkdir, which has no place in it" in said
    objects = np.empty(1, dtype=object)
    objects[0] = _Hostile(mark)
    np.savez(tmp_path / "a.npz", hand_pose=objects)
    said = refusal(tmp_path / "a.npz", "--fps", "30")
    assert "hand_pose cannot be read without running a pickle" in said
    path = tmp_path / "list.pkl"
    path.write_bytes(pickle.dumps([1, 2]))
    assert "it holds no dictionary" in refusal(path, "--fps", "30")
    assert not mark.exists()


def test_arrays_of_several_objects_are_refused(refusal: Any, tmp_path: Path) -> None:
    objects = np.empty(2, dtype=object)
    objects[:] = [{"rot": np.zeros(3)}, {}]
    np.save(tmp_path / "two.npy", objects, allow_pickle=True)
    assert "expected one object in an array" in refusal(tmp_path / "two.npy", "--fps", "30")
    path = save_pickled(tmp_path / "text.npy", {"right": {"rot": [["a"], ["b", "c"]]}})
    assert "rot is a list whose rows differ in length" in refusal(path, "--fps", "30")
    np.save(tmp_path / "plain.npy", np.zeros((4, 48)))
    said = refusal(tmp_path / "plain.npy", "--fps", "30")
    assert "it holds one array without a name" in said


def test_files_too_large_are_refused(
    refusal: Any, right: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what they unpack to, before anything is unpacked."""
    monkeypatch.setattr(stored, "MAX_BYTES", 2 * 2**20)
    np.savez_compressed(tmp_path / "bomb.npz", hand_pose=np.zeros(2**20))
    assert (tmp_path / "bomb.npz").stat().st_size < 10_000
    assert "unpacks to more than 2 MB" in refusal(tmp_path / "bomb.npz", *ABSOLUTE)
    (tmp_path / "large.json").write_bytes(b" " * (2 * 2**20 + 1))
    assert "larger than 2 MB" in refusal(tmp_path / "large.json", *ABSOLUTE)


def test_files_of_torch_and_motions_themselves_are_named(refusal: Any, tmp_path: Path) -> None:
    path = tmp_path / "world_space_res.pth"
    path.write_bytes(b"PK")
    assert "are programs: save their arrays with numpy.savez" in refusal(path)
    path = tmp_path / "wave.json"
    path.write_text('{"schema": 1, "fps": 30, "rotations": [[1]], "translations": [[1]]}')
    assert "it is a motion file already" in refusal(path)


def test_folders_of_several_kinds_are_refused(refusal: Any, right: Truth, tmp_path: Path) -> None:
    folder = tmp_path / "many"
    folder.mkdir()
    np.savez(folder / "0.npz", **smplx_arrays(right))  # type: ignore[arg-type]
    (folder / "0.json").write_text("{}")
    assert "files of the kinds .json, .npz lie side by side" in refusal(folder, *ABSOLUTE)


def test_a_motion_is_not_longer_than_motions_are(refusal: Any, right: Truth) -> None:
    arrays = smplx_arrays(right) | {"fps": np.array(0.02)}
    said = refusal(arrays, *ABSOLUTE, "--fps", "1000")
    assert "100000 at most" in said


def test_turning_the_wrist_alone_does_not_count_as_bending(
    right: Truth, tmp_path: Path, folder: Path
) -> None:
    """A wrist in any orientation is a hand's; the check looks at fingers."""
    arrays = smplx_arrays(right)
    arrays["global_orient"] = np.tile([0.0, np.pi - 0.01, 0.0], (6, 1))
    np.savez(tmp_path / "turned.npz", **arrays)  # type: ignore[arg-type]
    words = ["--out", str(tmp_path / "m.json"), "--rig", "mano-right", *ABSOLUTE]
    assert main(["motion", "from", str(tmp_path / "turned.npz"), *words]) == 0
    found = json.loads((tmp_path / "m.json").read_text())["rotations"][0][0]
    expected = matrix_from_axis_angle(torch.tensor([0.0, np.pi - 0.01, 0.0]))
    torch.testing.assert_close(
        matrix_from_axis_angle(torch.tensor(found)), expected, atol=1e-5, rtol=0
    )


def _npy(shape: str) -> bytes:
    """An npy file of eight numbers that says that it has a shape."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(64)


@pytest.mark.parametrize("shape", ["(10000000000, 48)", "(3000000000,)", "(True,)", "(-1,)"])
def test_arrays_that_say_they_are_vast_are_damaged_files(
    shape: str, refusal: Any, tmp_path: Path
) -> None:
    """Numpy made room for them: "out of memory, ask for fewer pixels"."""
    (tmp_path / "a.npy").write_bytes(_npy(shape))
    assert "npy file" in refusal(tmp_path / "a.npy", *ABSOLUTE)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("poses.npy", _npy(shape))
    assert "not a whole npz file" in refusal(tmp_path / "a.npz", *ABSOLUTE)


def test_small_files_of_very_many_rows_are_refused(refusal: Any, tmp_path: Path) -> None:
    """Half a megabyte of packed zeros became 15 GB of matrices."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, poses=np.zeros((200_001, 48), bool))
    said = refusal(path, *ABSOLUTE, "--layout", "mano", "--side", "right", "--fps", "30")
    assert "200,001 rows" in said
    np.savez_compressed(path, poses=np.zeros(32_000_001, bool))
    said = refusal(path, *ABSOLUTE, "--layout", "mano", "--side", "right", "--fps", "30")
    assert "32,000,001 numbers" in said


def test_frames_are_numbered_by_plain_digits(refusal: Any, tmp_path: Path) -> None:
    for name in ("\u00b2", "9" * 5000):
        (tmp_path / "a.json").write_text(json.dumps({name: {"right": None, "left": None}}))
        assert refusal(tmp_path / "a.json", "--layout", "interhand", "--fps", "30")


def test_several_poses_in_one_frame_are_refused(right: Truth, refusal: Any, tmp_path: Path) -> None:
    frames = interhand_frames(right)
    hand = frames["0"]["1203"]["right"]
    hand["pose"] = [hand["pose"]] * 16
    (tmp_path / "a.json").write_text(json.dumps(frames))
    assert "frame 1203 holds 16 poses" in refusal(tmp_path / "a.json", "--fps", "30")


def test_places_of_soma_that_are_no_triples_are_refused(
    right: Truth, refusal: Any, tmp_path: Path
) -> None:
    motion = Motion(30.0, right.rotations.float(), right.places.float())
    arrays = soma_arrays(motion, load_open_hand(), "right")
    for places in (np.zeros((len(motion), 4)), np.zeros(1), np.zeros(())):
        np.savez(tmp_path / "a.npz", **(arrays | {"transl": places}))
        assert "transl has shape" in refusal(tmp_path / "a.npz")
