"""``handavatar export``, from the words to the files."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from independent import Reading
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from handavatar import cli
from handavatar.avatar import CheckpointError, HandAvatar
from handavatar.capture.motion import gesture
from handavatar.export import rigged, run
from handavatar.export.run import ExportOptions, export_avatar
from handavatar.hand.pose import HandPose


@pytest.fixture(scope="module", autouse=True)
def quick_light() -> Any:
    """The mean light of one pose: what is tested here is not the light."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((rigged, "baked_textures"), (run, "baked_textures")):
            whole = getattr(module, name)
            patch.setattr(
                module, name, lambda *a, whole=whole, **k: whole(*a, **(k | {"light_poses": 1}))
            )
        yield


@pytest.fixture(scope="module")
def saved(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "avatar.safetensors"
    small_avatar.save(path)
    return path


@pytest.fixture(scope="module")
def left(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("left") / "avatar.safetensors"
    before = small_avatar.info
    small_avatar.info = before | {"side": "left"}
    try:
        small_avatar.save(path)
    finally:
        small_avatar.info = before
    return path


def _posed(avatar: HandAvatar, name: str) -> np.ndarray:
    pose = HandPose(gesture(avatar.base_rig, name), torch.zeros(3))
    with torch.no_grad():
        return avatar.personal(pose).posed(pose).vertices.numpy()


def test_a_glb_has_the_bones_the_motion_and_the_edit_that_were_asked_for(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["export", str(saved), "glb", "--out", str(tmp_path / "new" / "hand.glb")]
    words += ["--bones", "unity", "--texture-size", "64", "--motion", "pinch"]
    assert cli.main([*words, "--albedo-shift=-1,-1,-1"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "new" / "hand.glb")
    reading = Reading((tmp_path / "new" / "hand.glb").read_bytes())
    assert reading.names[0] == "RightHand"
    assert len(reading.gltf.animations) == 1
    assert reading.picture(0).max() == 0 and reading.picture(0).shape == (64, 64, 3)
    assert reading.gltf.asset.extras["handavatar"]["side"] == "right"
    assert os.listdir(tmp_path / "new") == ["hand.glb"]


def test_unlit_colours_need_no_light(saved: Path, tmp_path: Path) -> None:
    out = export_avatar(
        ExportOptions(saved, "glb", tmp_path / "a.glb", texture_size=32, unlit=True)
    )
    gltf = Reading(out.read_bytes()).gltf
    assert gltf.extensionsUsed == ["KHR_materials_unlit"]
    assert "KHR_materials_unlit" in gltf.materials[0].extensions
    assert gltf.materials[0].occlusionTexture is None and len(gltf.images) == 1


@pytest.mark.parametrize("side", ["right", "left"])
def test_ply_and_obj_are_the_posed_personal_surface_of_the_right_side(
    small_avatar: HandAvatar,
    saved: Path,
    left: Path,
    tmp_path: Path,
    side: str,
) -> None:
    source = {"right": saved, "left": left}[side]
    expected = _posed(small_avatar, "fist") * ([1, 1, 1] if side == "right" else [-1, 1, 1])
    for kind in ("ply", "obj"):
        out = export_avatar(
            ExportOptions(source, kind, tmp_path / f"hand.{kind}", texture_size=32, pose="fist")  # type: ignore[arg-type]
        )
        read = trimesh.load(out, process=False)
        corners = read.vertices[read.faces]
        wound = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (corners[:, 0] * wound).sum() > 0
        normals = read.vertex_normals[read.faces].mean(1)
        assert ((wound * normals).sum(1) > 0).mean() > 0.98
        order = np.sort(small_avatar.rig.faces.numpy(), axis=1)
        if kind == "ply":
            np.testing.assert_allclose(read.vertices, expected, atol=1e-6)
            assert np.array_equal(np.sort(read.faces, axis=1), order)
        np.testing.assert_allclose(
            corners.mean(1), expected[small_avatar.rig.faces].mean(1), atol=1e-6
        )
    assert sorted(os.listdir(tmp_path)) == ["hand.mtl", "hand.obj", "hand.ply", "hand.png"]


def test_a_left_avatar_becomes_a_left_glb(left: Path, tmp_path: Path) -> None:
    out = export_avatar(
        ExportOptions(left, "glb", tmp_path / "left.glb", bones="mano", texture_size=32)
    )
    reading = Reading(out.read_bytes())
    assert reading.names[0] == "left_wrist"
    # MANO's left hand: fingers along +x, thumb in front.
    assert reading.vertices[:, 0].max() > 0.1
    assert reading.placed()[15, 2, 3] > 0.03


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["glb", "--out", "hand.ply"], "ends in .glb"),
        (["ply", "--out", "hand.ply", "--motion", "pinch"], "PLY cannot move"),
        (["glb", "--out", "hand.glb", "--pose", "fist"], "animate it with --motion"),
        (["glb", "--out", "hand.glb", "--texture-size", "9"], "expected 16 to 8192"),
        (["glb", "--out", "hand.glb", "--albedo-shift", "red"], "three numbers"),
        (["obj", "--out", "there.obj"], "there.png exists"),
    ],
)
def test_words_that_contradict_each_other_are_refused_before_anything_is_read(
    words: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.png").write_bytes(b"mine")
    # By its name it may be an avatar; whoever read it would find that it is none.
    (tmp_path / "any.safetensors").write_bytes(b"no avatar")
    assert cli.main(["export", "any.safetensors", *words]) == 2
    assert message in capsys.readouterr().err
    assert sorted(os.listdir(tmp_path)) == ["any.safetensors", "there.png"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["glb", "--motion", "no-such-motion.json"], "no-such-motion.json"),
        (["ply", "--pose", "salute"], "there is no gesture 'salute'"),
    ],
)
def test_bad_data_is_named_and_nothing_is_written(
    words: list[str],
    message: str,
    saved: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / f"hand.{words[0]}"
    assert cli.main(["export", str(saved), words[0], "--out", str(out), *words[1:]]) == 3
    assert message in capsys.readouterr().err
    assert not os.listdir(tmp_path)


def test_an_avatar_that_is_not_finite_is_refused(saved: Path, tmp_path: Path) -> None:
    tensors = load_file(saved)
    tensors["avatar.albedo.codes"][3, 4] = torch.nan
    with safe_open(saved, framework="pt") as file:
        save_file(tensors, tmp_path / "broken.safetensors", file.metadata())
    with pytest.raises(CheckpointError, match="NaN"):
        export_avatar(ExportOptions(tmp_path / "broken.safetensors", "ply", tmp_path / "hand.ply"))
    assert os.listdir(tmp_path) == ["broken.safetensors"]


def test_what_lies_there_is_replaced_only_if_told_and_whole(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "hand.obj"
    for suffix in (".obj", ".mtl", ".png"):
        out.with_suffix(suffix).write_text("mine")
    options = ExportOptions(saved, "obj", out, texture_size=16)
    with pytest.raises(ValueError, match="exists"):
        export_avatar(options)
    again = ExportOptions(saved, "obj", out, texture_size=16, overwrite=True)
    written, whole = [], Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        written.append(path)
        if len(written) == 3:
            raise OSError(28, "No space left on device")
        return whole(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(OSError, match="No space"):
            export_avatar(again)
    assert {path.read_text() for path in tmp_path.iterdir()} == {"mine"}
    export_avatar(again)
    assert out.read_bytes().startswith(b"# metres")
    assert len(os.listdir(tmp_path)) == 3
