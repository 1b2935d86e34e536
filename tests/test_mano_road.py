"""The whole road with a rig of MANO's layout: import, capture, train, save, load, render."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import TINY, camera_above, write_tiny_capture
from mano_files import write_mano
from safetensors import safe_open
from safetensors.torch import load_file

from handavatar import cli
from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.fitted_hand import HandFit, HandModel
from handavatar.capture.frames import read_capture
from handavatar.field.decoders import untrained_field
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import LicensedRigMissing
from handavatar.hand.rigs import load_rig
from handavatar.train.loop import METHODS, TrainOptions, train
from handavatar.train.prior_pictures import POSES

FEW = RenderSettings(num_samples=12)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HANDAVATAR_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_import_capture_train_save_load_render(
    home: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = write_mano(tmp_path / "MANO_RIGHT.pkl")
    assert cli.main(["rig", "import-mano", str(file), "--json"]) == 0
    imported = json.loads(capsys.readouterr().out)
    assert imported["high_resolution"] == {"vertices": 12337, "faces": 24608}
    assert Path(imported["file"]).parent == home / "rigs"
    assert cli.main(["rig", "info", "--rig", "mano-right", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["sha256"] == imported["sha256"] and shown["pose_directions"] == 135

    rig = load_rig("mano-right")
    folder = write_tiny_capture(tmp_path / "capture", "aab", rig=rig)
    assert read_capture(folder).rig_sha256 == rig.sha256
    monkeypatch.setitem(METHODS, "quick", replace(TINY, steps=2, warm_steps=1))
    run = train(TrainOptions(folder, tmp_path / "run", checkpoint_every=1, perceptual="substitute"))

    avatar = HandAvatar.load(run)
    assert avatar.base_rig.sha256 == rig.sha256 and avatar.base_rig.is_licensed
    frame = read_capture(folder).frame(2)
    rendering = avatar.render(frame.pose, camera_above(16), settings=FEW)
    assert float(rendering.alpha.max()) > 0.5
    again = tmp_path / "again.safetensors"
    avatar.save(again)
    for name, value in vars(
        HandAvatar.load(again).render(frame.pose, camera_above(16), settings=FEW)
    ).items():
        assert torch.equal(value, getattr(rendering, name)), name

    # What is MANO's stays at home; without it the avatar says where to get it.
    with safe_open(again, framework="pt") as stored:
        names = set(stored.keys())
        sizes = {tuple(stored.get_tensor(name).shape) for name in names}
    assert not [name for name in names if name.startswith(("rig.", "set."))]
    assert "avatar.illumination.position_codes" not in names
    assert not [size for size in sizes if 778 in size or 2 * 778 in size]
    Path(imported["file"]).unlink()
    with pytest.raises(LicensedRigMissing, match=r"mano-right[\s\S]*mano\.is\.tue\.mpg\.de"):
        HandAvatar.load(run)
    for words in (["train", str(folder)], ["evaluate", str(run)]):
        assert cli.main(words) == 4
        captured = capsys.readouterr()
        assert captured.out == "" and "handavatar rig import-mano" in captured.err


@pytest.mark.slow
def test_a_prior_learns_on_it_is_judged_and_pictured(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mano = write_mano(tmp_path / "MANO_RIGHT.pkl")
    assert cli.main(["rig", "import-mano", str(mano), "--json"]) == 0
    imported = json.loads(capsys.readouterr().out)
    out, folder = tmp_path / "prior.safetensors", tmp_path / "run"
    train_words = ["prior", "train", "--out", str(out), "--folder", str(folder), "--rounds", "0"]
    train_words += ["--steps", "2", "--points", "64", "--rig"]
    assert cli.main([*train_words, "mano-right"]) == 0
    assert f"--prior {out} --rig mano-right" in capsys.readouterr().out

    # Weights, and which rig; nothing of the rig, nor where it lies.
    with safe_open(out, framework="pt") as stored:
        facts, names = stored.metadata(), set(stored.keys())
    assert (facts["rig"], facts["rig_sha256"]) == ("mano-right", imported["sha256"])
    assert json.loads(facts["options"])["rig"] == f"mano-right ({imported['sha256'][:12]})"
    assert names == set(untrained_field("pair").state_dict())
    states = list(folder.glob("checkpoints/*/*.safetensors"))
    assert {path.stem for path in states} == {"model", "muon", "adam"}
    for path in [out, *states]:
        sizes = {size for value in load_file(path).values() for size in value.shape}
        assert 778 not in sizes and 1538 not in sizes, path

    # The file of the same rig continues the run; another rig does not.
    assert cli.main([*train_words, imported["file"]]) == 0
    assert str(home) not in (folder / "options.json").read_text()
    assert str(home) not in str(safe_open(out, framework="pt").metadata())
    assert cli.main([*train_words, "open-hand-778"]) == 3
    assert "other options: rig" in capsys.readouterr().err

    words = ["prior", "evaluate", "--prior", str(out), "--poses", "1", "--points", "64"]
    words += ["--rounds", "0", "--rig", "mano-right", "--json"]
    assert cli.main(words) == 0
    assert 0 <= json.loads(capsys.readouterr().out)["iou"] <= 1
    assert cli.main([*words, "--level", "778"]) == 3
    assert "found level 778, which the open hand alone has" in capsys.readouterr().err
    words = ["prior", "picture", "--resolution", "16", "--size", "16", "--rounds", "0"]
    assert cli.main([*words, "--rig", "mano-right", "--out", str(tmp_path / "pictures")]) == 0
    assert len(list((tmp_path / "pictures").glob("*.png"))) == len(POSES)
    for command in ("train", "evaluate"):
        assert cli.main(["prior", command, "--rig", "mano-left"]) == 4
        assert "handavatar rig import-mano" in capsys.readouterr().err


def test_a_missing_file_is_exit_4_and_a_hostile_one_exit_3(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "MANO_RIGHT.pkl"
    assert cli.main(["rig", "import-mano", str(path)]) == 4
    assert "mano.is.tue.mpg.de" in capsys.readouterr().err
    assert cli.main(["rig", "info", "--rig", "mano-left"]) == 4
    assert "import-mano" in capsys.readouterr().err
    path.write_bytes(b"cos\nsystem\n(X\x04\x00\x00\x00true tR.")
    assert cli.main(["rig", "import-mano", str(path)]) == 3
    assert "os.system" in capsys.readouterr().err
    assert not home.exists()
    # By its name it is a video; whoever read it would find that it is none.
    (tmp_path / "a.mp4").write_bytes(b"no video")
    words = ["capture", "video", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "c")]
    assert cli.main([*words, "--rig", "mano-right"]) == 4


def test_import_writes_where_it_is_told_and_nothing_else(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = write_mano(tmp_path / "MANO_LEFT.pkl", "left"), tmp_path / "left.safetensors"
    words = ["rig", "import-mano", str(file), "--out", str(out)]
    assert cli.main(words) == 0
    assert f"--rig {out}" in capsys.readouterr().out
    assert not home.exists() and load_rig(str(out)).name == "mano-left"
    assert cli.main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert cli.main([*words, "--overwrite", "--left-shape", "kept"]) == 0


def test_the_hand_that_is_fitted_to_a_video_has_its_pose_blend_shapes(
    home: Path, tmp_path: Path
) -> None:
    assert cli.main(["rig", "import-mano", str(write_mano(tmp_path / "MANO_RIGHT.pkl"))]) == 0
    rig = load_rig("mano-right")
    generator = torch.Generator().manual_seed(0)
    rotations = 0.5 * torch.randn(2, NUM_BONES, 3, generator=generator)
    shape = torch.randn(10, generator=generator)
    fit = HandFit(rotations, torch.rand(2, 3), shape, torch.tensor(6.0), torch.zeros(21, 3))
    expected = rig.shaped(shape).posed(HandPose(rotations, fit.translation)).vertices
    model = HandModel(rig)
    torch.testing.assert_close(model.all_vertices(fit), expected, atol=1e-6, rtol=0)
    chosen = torch.randint(778, (2, 7), generator=generator)
    torch.testing.assert_close(
        model.vertices(fit, chosen),
        torch.stack([expected[frame, chosen[frame]] for frame in range(2)]),
        atol=1e-6,
        rtol=0,
    )
