"""Files laid out as MANO's become rigs that pose as MANO does; others are refused with a reason."""

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mano_files import as_released, as_tensor, hand_fields, mirrored_fields, write_mano

from handavatar.hand import mano
from handavatar.hand.detail import subdivided
from handavatar.hand.mano import (
    FINGERTIPS,
    ManoModel,
    absolute_rotations,
    growth_agreement,
    read_mano,
)
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import divide_into_parts
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import LicensedRigMissing, PosedHand, Rig, RigError

MIRROR = torch.tensor([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> ManoModel:
    return read_mano(write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl"))


def _random_pose(count: int, seed: int = 3) -> HandPose:
    generator = torch.Generator().manual_seed(seed)
    return HandPose(
        0.7 * torch.randn(count, NUM_BONES, 3, generator=generator),
        torch.randn(count, 3, generator=generator),
    )


# --- what is read ---------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_every_array_comes_out_of_every_old_protocol(protocol: int, tmp_path: Path) -> None:
    model = read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl", protocol=protocol))
    fields, rig = hand_fields(), model.rig
    for name, values in (
        ("v_template", rig.template_vertices),
        ("shapedirs", rig.shape_directions),
        ("posedirs", rig.pose_directions),
        ("J_regressor", rig.joint_regressor),
        ("weights", rig.skin_weights),
        ("hands_mean", model.hands_mean.flatten()),
        ("hands_components", model.hands_components.flatten(1)),
    ):
        assert torch.equal(values, as_tensor(fields[name])), name
    assert torch.equal(rig.faces, torch.from_numpy(fields["f"].astype(np.int64)))
    assert (model.side, model.left_shape, rig.name) == ("right", "kept", "mano-right")
    assert rig.is_licensed and not load_open_hand().is_licensed


@pytest.mark.parametrize("protocol", [2, 4])
def test_a_file_that_was_saved_again_without_chumpy_is_read_too(
    protocol: int, tmp_path: Path, right: ManoModel
) -> None:
    fields = hand_fields() | {"bs_type": "lrotmin", "bs_style": "lbs"}
    path = tmp_path / "clean.pkl"
    path.write_bytes(pickle.dumps(fields, protocol))
    assert read_mano(path).rig.sha256 == right.rig.sha256


def test_what_is_derived_fits_the_hand(right: ManoModel) -> None:
    rig, like = right.rig, load_open_hand("778")
    assert len(rig.rim) == 16
    assert rig.vertex_sets["fingertips"].tolist() == list(FINGERTIPS.values())
    angles = (rig.joint_axes * like.joint_axes).sum(-1).clamp(-1, 1).arccos()
    # Made of the open hand, so the axes must come out as its own; only the last bones', whose ends
    # the open hand has inside the flesh and MANO on the skin, lean the other way by some degrees.
    is_last = torch.tensor([bone > 0 and bone % 3 == 0 for bone in range(NUM_BONES)])
    assert float(angles[~is_last].max()) < 0.002
    assert float(angles[is_last, 0].max()) < 0.1 and float(angles.max()) < 0.2
    frames = rig.joint_axes @ rig.joint_axes.transpose(-1, -2)
    torch.testing.assert_close(frames, torch.eye(3).expand(16, 3, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rig.joint_axes), torch.ones(16))
    assert float(rig.uv_coordinates.min()) >= 0 and float(rig.uv_coordinates.max()) <= 1
    assert rig.uv_faces.shape == rig.faces.shape
    # Back and palm do not share a place on the chart.
    halves = (rig.uv_coordinates[rig.uv_faces][..., 0] > 0.5).float().mean(-1)
    assert set(halves.tolist()) == {0.0, 1.0}


def test_its_parts_are_those_of_the_hand_it_was_made_of(tmp_path: Path) -> None:
    like, pose = load_open_hand("778"), HandPose(_random_pose(1).rotations[0], torch.zeros(3))
    none = np.zeros((778, 3, 135))
    rig = read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl", posedirs=none)).rig
    parts, own = divide_into_parts(rig), divide_into_parts(like)
    assert torch.equal(parts.vertex_labels.bincount(), own.vertex_labels.bincount())
    boxes = parts.boxes(rig.shaped().posed(pose), 0.01)
    expected = own.boxes(like.shaped().posed(pose), 0.01)
    # In the frames of the bones; in the world the wrist lies elsewhere.
    for name in ("lower", "upper", "cut_normal"):
        torch.testing.assert_close(
            getattr(boxes, name), getattr(expected, name), atol=1e-5, rtol=0, msg=name
        )
    clouds = parts.point_clouds(rig.shaped().posed(pose))
    assert bool((clouds[..., :3] > boxes.lower[:, None] - 0.03).all())
    assert bool((clouds[..., :3] < boxes.upper[:, None] + 0.03).all())


# --- the paper's counts, and pose blend shapes ----------------------------------------------------


def test_two_subdivisions_give_the_papers_counts(right: ManoModel) -> None:
    fine = subdivided(right.rig)
    assert (fine.num_vertices, len(fine.faces)) == (12_337, 24_608)
    sealed = fine.sealed(fine.template_vertices)
    assert (len(sealed), len(fine.sealed_faces)) == (12_338, 24_672)


def test_pose_blend_shapes_vanish_in_the_zero_pose_and_ignore_the_wrist(right: ManoModel) -> None:
    assert float(right.rig.pose_offsets(torch.zeros(NUM_BONES, 3)).abs().max()) == 0
    turned = torch.zeros(NUM_BONES, 3)
    turned[0] = torch.tensor([1.0, 2.0, 0.5])
    assert float(right.rig.pose_offsets(turned).abs().max()) == 0
    bent = _random_pose(2).rotations
    assert right.rig.pose_offsets(bent).shape == (2, 778, 3)
    assert float(right.rig.pose_offsets(bent).abs().max()) > 1e-3
    none = load_open_hand("778").pose_offsets(bent)
    assert none.shape == (2, 778, 3) and float(none.abs().max()) == 0


def test_pose_blend_shapes_agree_with_a_loop_over_bones_and_entries(right: ManoModel) -> None:
    scipy_rotations = pytest.importorskip("scipy.spatial.transform").Rotation
    rotations = _random_pose(1).rotations[0].double().numpy()
    directions = right.rig.pose_directions.double().numpy()
    expected = np.zeros((778, 3))
    for bone in range(1, NUM_BONES):
        change = scipy_rotations.from_rotvec(rotations[bone]).as_matrix() - np.eye(3)
        for row in range(3):
            for column in range(3):
                expected += change[row, column] * directions[..., 9 * (bone - 1) + 3 * row + column]
    found = right.rig.pose_offsets(torch.from_numpy(rotations).float())
    torch.testing.assert_close(found.double(), torch.from_numpy(expected), atol=1e-6, rtol=0)


def test_midpoints_move_as_the_mean_of_their_ends_before_skinning(right: ManoModel) -> None:
    fine, rotations = subdivided(right.rig, 1), _random_pose(1).rotations[0]
    coarse, added = right.rig.pose_offsets(rotations), fine.pose_offsets(rotations)
    edges = {
        tuple(sorted((f[k], f[(k + 1) % 3]))) for f in right.rig.faces.tolist() for k in range(3)
    }
    ends = torch.tensor(sorted(edges))
    torch.testing.assert_close(added[:778], coarse, atol=1e-7, rtol=0)
    torch.testing.assert_close(added[778:], coarse[ends].mean(1), atol=1e-7, rtol=0)


def test_gradients_reach_the_rotations_through_the_blend_shapes(right: ManoModel) -> None:
    rig = Rig(
        **{
            name: value.double() if torch.is_tensor(value) and value.is_floating_point() else value
            for name, value in vars(right.rig).items()
            if name in Rig.__dataclass_fields__
        }
    )
    rotations = _random_pose(1).rotations[0].double().requires_grad_()
    chosen = torch.tensor([0, 320, 744])
    assert torch.autograd.gradcheck(lambda r: rig.pose_offsets(r)[chosen], (rotations,))


def _with_smplx(fields: dict[str, Any], is_right: bool, shape: torch.Tensor, pose: HandPose) -> Any:
    smplx = pytest.importorskip("smplx")
    struct = pytest.importorskip("smplx.utils").Struct
    layer = smplx.MANO(
        model_path=str(Path(__file__).parent),
        data_struct=struct(**{name: np.asarray(values) for name, values in fields.items()}),
        use_pca=False,
        flat_hand_mean=True,
        is_rhand=is_right,
        batch_size=len(shape),
        dtype=torch.float64,
    )
    with torch.no_grad():
        return layer(
            betas=shape.double(),
            global_orient=pose.rotations[:, 0].double(),
            hand_pose=pose.rotations[:, 1:].flatten(1).double(),
            transl=pose.translation.double(),
        )


def test_posing_agrees_with_smplx(right: ManoModel) -> None:
    pose, shape = _random_pose(4), torch.randn(4, 10, generator=torch.Generator().manual_seed(1))
    theirs = _with_smplx(hand_fields(), True, shape, pose)
    ours = right.rig.shaped(shape).posed(pose)
    torch.testing.assert_close(ours.vertices.double(), theirs.vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(ours.joints.double(), theirs.joints[:, :16], atol=1e-5, rtol=0)


def test_the_open_hand_keeps_its_fingerprint_and_mano_counts_its_blend_shapes(
    right: ManoModel, tmp_path: Path
) -> None:
    # Captures that ship name it.
    expected = "e1218ff1247a437c55cf010b6e580e1d327e1a71bf85bb811684c24ea1ea7deb"
    assert load_open_hand().sha256 == expected
    for name in ("posedirs", "shapedirs"):
        other = write_mano(tmp_path / name, **{name: hand_fields()[name] * 1.01})
        assert read_mano(other).rig.sha256 != right.rig.sha256


# --- the left hand --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> ManoModel:
    return read_mano(write_mano(tmp_path_factory.mktemp("mano") / "MANO_LEFT.pkl", "left"))


def test_a_left_hand_becomes_the_right_hand_that_it_mirrors(
    left: ManoModel, right: ManoModel
) -> None:
    assert (left.side, left.rig.name, left.left_shape) == ("left", "mano-left", "mirrored")
    assert left.rig.sha256 == right.rig.sha256
    assert torch.equal(left.rig.shape_directions, right.rig.shape_directions)
    assert torch.equal(left.hands_mean, right.hands_mean)
    assert torch.equal(left.hands_components, right.hands_components)


def test_its_mirror_image_is_what_smplx_makes_of_the_left_file(left: ManoModel) -> None:
    """With the mended sign that everyone who uses the left hand applies to it."""
    pose, shape = _random_pose(3), torch.randn(3, 10, generator=torch.Generator().manual_seed(1))
    fields = hand_fields("left")
    fields["shapedirs"] = fields["shapedirs"] * np.array([[-1.0], [1.0], [1.0]])
    mirrored = HandPose(pose.rotations * -MIRROR, pose.translation * MIRROR)
    theirs = _with_smplx(fields, False, shape, mirrored)
    ours = left.rig.shaped(shape).posed(pose)
    torch.testing.assert_close(
        (ours.vertices * MIRROR).double(), theirs.vertices, atol=1e-5, rtol=0
    )


def test_a_left_hand_without_the_flaw_is_recognised(tmp_path: Path, right: ManoModel) -> None:
    sound = as_released(hand_fields("left", has_flaw=False))
    path = write_mano(tmp_path / "MANO_LEFT.pkl", "left", shapedirs=sound["shapedirs"])
    model = read_mano(path)
    assert model.left_shape == "kept"
    assert torch.equal(model.rig.shape_directions, right.rig.shape_directions)
    told = read_mano(path, "mirrored").rig.shape_directions
    assert torch.equal(told[:, 0], -right.rig.shape_directions[:, 0])


def test_growth_agrees_in_a_sound_hand_and_disagrees_with_the_wrong_sign() -> None:
    for level in ("full", "778"):
        rig = load_open_hand(level)  # type: ignore[arg-type]
        template, directions = rig.template_vertices.numpy(), rig.shape_directions.numpy()
        agreement = growth_agreement(template, directions)
        assert agreement > 0.2
        wrong = growth_agreement(template, directions * np.array([[-1.0], [1.0], [1.0]]))
        assert wrong == pytest.approx(-agreement, abs=1e-5)


def test_absolute_rotations_add_the_mean_to_the_fingers_alone(right: ManoModel) -> None:
    rotations = _random_pose(2).rotations
    absolute = absolute_rotations(rotations, right.hands_mean)
    assert torch.equal(absolute[:, 0], rotations[:, 0])
    torch.testing.assert_close(
        absolute[:, 1:] - rotations[:, 1:], right.hands_mean.expand(2, 15, 3)
    )
    smplx = pytest.importorskip("smplx")
    struct = pytest.importorskip("smplx.utils").Struct
    layer = smplx.MANO(
        model_path=str(Path(__file__).parent),
        data_struct=struct(**hand_fields()),
        use_pca=False,
        flat_hand_mean=False,
        batch_size=2,
        dtype=torch.float64,
    )
    with torch.no_grad():
        theirs = layer(
            global_orient=rotations[:, 0].double(), hand_pose=rotations[:, 1:].flatten(1).double()
        )
    ours: PosedHand = right.rig.shaped(torch.zeros(2, 10)).posed(
        HandPose(absolute, torch.zeros(2, 3))
    )
    torch.testing.assert_close(ours.vertices.double(), theirs.vertices, atol=1e-5, rtol=0)


# --- what is refused ------------------------------------------------------------------------------


def _changed(name: str, place: Any, value: float) -> Any:
    values = np.array(hand_fields()[name])
    values[place] = value
    return values


def _tree(**parents: int) -> np.ndarray:
    table = np.array(hand_fields()["kintree_table"], dtype=np.int64)
    for bone, parent in parents.items():
        table[0, int(bone[1:])] = parent
    return table


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no template": ({"v_template": None}, "lacks v_template"),
    "no pose blend shapes": ({"posedirs": None}, "lacks posedirs"),
    "no weights nor tree": ({"weights": None, "kintree_table": None}, "kintree_table, weights"),
    "777 vertices": ({"v_template": np.zeros((777, 3))}, "v_template: its shape is (777, 3)"),
    "SMPL's vertices": ({"v_template": np.zeros((6890, 3))}, "expected (778, 3)"),
    "9 shapes": ({"shapedirs": np.zeros((778, 3, 9))}, "shapedirs"),
    "207 pose directions": ({"posedirs": np.zeros((778, 3, 207))}, "expected (778, 3, 135)"),
    "24 bones": ({"weights": np.zeros((778, 24))}, "expected (778, 16)"),
    "a flat array": ({"f": np.zeros(4614, dtype=np.uint32)}, "expected (1538, 3)"),
    "NaN in the template": ({"v_template": _changed("v_template", (3, 1), np.nan)}, "NaN"),
    "infinity in posedirs": ({"posedirs": _changed("posedirs", (3, 1, 5), np.inf)}, "posedirs"),
    "NaN in the mean": ({"hands_mean": _changed("hands_mean", 4, np.nan)}, "hands_mean"),
    "beyond float32": ({"shapedirs": _changed("shapedirs", (0, 0, 0), 1e300)}, "above a million"),
    "a negative weight": (
        {"weights": _changed("weights", (0, slice(0, 2)), -0.5)},
        "nothing below 0",
    ),
    "weights that sum to 2": ({"weights": 2 * hand_fields()["weights"]}, "sums of 1"),
    "a bone without vertices": (
        {"weights": np.roll(np.eye(16)[hand_fields()["weights"].argmax(1) % 15], 0, axis=1)},
        "bone",
    ),
    "a regressor of halves": ({"J_regressor": hand_fields()["J_regressor"] / 2}, "expected 1"),
    "a face beyond the vertices": ({"f": _changed("f", (0, 0), 778)}, "vertices 0 to 778"),
    "faces of fractions": ({"f": hand_fields()["f"].astype(float)}, "expected integers"),
    "a hole in the mesh": ({"f": _changed("f", 700, 0)}, "f: "),
    "a bone on itself": ({"kintree_table": _tree(b3=3)}, "no tree: bone 3 hangs on 3"),
    "bones in a circle": ({"kintree_table": _tree(b1=3)}, "no tree: bone 1 hangs on 3"),
    "two roots": ({"kintree_table": _tree(b4=-1)}, "bone 4 hangs on -1"),
    "no root": ({"kintree_table": _tree(b0=5)}, "bone 0 hangs on bone 5"),
    "another tree": ({"kintree_table": _tree(b5=3)}, "bone 5 hangs on 3, expected 4"),
    "bones in another order": (
        {"kintree_table": np.array(hand_fields()["kintree_table"])[:, ::-1].copy()},
        "numbers the bones",
    ),
    "decimetres": ({"v_template": hand_fields()["v_template"] * 10}, "expected metres"),
    "other axes": ({"v_template": hand_fields()["v_template"][:, [1, 0, 2]]}, "MANO's axes"),
    "another order of vertices": ({"weights": hand_fields()["weights"][::-1].copy()}, "order"),
    "another kind of skinning": ({"bs_style": "dqbs"}, "bs_style is 'dqbs'"),
    "a number for a text": ({"bs_type": 3}, "expected text"),
    "a complex array": ({"hands_mean": np.zeros(45, dtype=complex)}, "expected numbers"),
    "an array of objects": ({"hands_mean": np.array([None] * 45)}, "expected numbers"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_file_that_is_no_hand_is_refused(name: str, tmp_path: Path) -> None:
    changes, expected = WRONG[name]
    path = write_mano(tmp_path / "MANO_RIGHT.pkl", **changes)
    with pytest.raises(RigError) as caught:
        read_mano(path)
    message = str(caught.value)
    assert expected in message and str(path) in message and "mano.is.tue.mpg.de" in message
    assert len(message.splitlines()) <= 6


def test_no_such_file_says_where_to_get_it(tmp_path: Path) -> None:
    with pytest.raises(LicensedRigMissing, match=r"no such file\n[\s\S]*mano.is.tue.mpg.de"):
        read_mano(tmp_path / "MANO_RIGHT.pkl")


def test_folders_archives_and_huge_files_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RigError, match="not a file"):
        read_mano(tmp_path)
    with zipfile.ZipFile(tmp_path / "mano.zip", "w") as archive:
        archive.writestr("MANO_RIGHT.pkl", b"")
    with pytest.raises(RigError, match="unpack it"):
        read_mano(tmp_path / "mano.zip")
    huge = tmp_path / "huge.pkl"
    huge.touch()
    os.truncate(huge, 2**40)  # A terabyte of holes.
    with pytest.raises(RigError, match="larger than 64 MB"):
        read_mano(huge)
    monkeypatch.setattr(mano, "_MAX_BYTES", 1000)
    with pytest.raises(RigError, match="larger than"):
        read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl"))


def test_mirroring_twice_is_the_hand_itself() -> None:
    fields = hand_fields()
    twice = mirrored_fields(mirrored_fields(fields, False), False)
    for name, values in fields.items():
        np.testing.assert_array_equal(np.asarray(twice[name]), np.asarray(values))
