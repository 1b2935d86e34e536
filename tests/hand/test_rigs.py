"""Rigs are found by name, file and fingerprint, and a missing one says where to get it."""

from pathlib import Path

import pytest
import torch
from mano_files import write_mano
from safetensors import safe_open
from safetensors.torch import save_file

from handavatar.hand.mano import ManoModel, read_mano
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.rig import LicensedRigMissing, RigError
from handavatar.hand.rigs import find_rig, load_mano, load_rig, read_rig, rigs_folder, save_rig
from handavatar.jobs.files import FolderInUse


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HANDAVATAR_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ManoModel:
    return read_mano(write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl"))


def test_a_saved_rig_comes_back_whole(model: ManoModel, home: Path) -> None:
    path = save_rig(model)
    assert path.parent == home / "rigs" == rigs_folder()
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    found = read_rig(path)
    for name, value in vars(model.rig).items():
        if torch.is_tensor(value) and name in type(found).__dataclass_fields__:
            assert torch.equal(getattr(found, name), value), name
    assert torch.equal(found.vertex_sets["fingertips"], model.rig.vertex_sets["fingertips"])
    assert found.is_licensed and found.sha256 == model.rig.sha256
    with safe_open(path, framework="pt") as file:
        facts = file.metadata()
        assert torch.equal(file.get_tensor("hands_mean"), model.hands_mean)
    assert facts["side"] == "right" and "do not redistribute" in facts["licence"]
    assert facts["source_sha256"] == model.sha256 and facts["schema"] == "1"


def test_rigs_are_found_by_name_file_and_fingerprint(model: ManoModel, home: Path) -> None:
    path = save_rig(model)
    for rig in (load_rig("mano-right"), load_rig(str(path)), find_rig(model.rig.sha256, "x")):
        assert rig.sha256 == model.rig.sha256
    assert load_rig("open-hand").sha256 == load_open_hand().sha256
    small = load_open_hand("778")
    assert load_rig("open-hand-778").sha256 == find_rig(small.sha256, "x").sha256 == small.sha256
    assert save_rig(model) == path  # The same again is no conflict.
    (path.parent / "alien.safetensors").write_bytes(b"not a rig")
    assert load_rig("mano-right").name == "mano-right"


def test_the_open_hand_alone_has_levels(model: ManoModel, home: Path) -> None:
    path = save_rig(model)
    small = load_open_hand("778").sha256
    for reference in ("open-hand", "open-hand-778"):
        assert load_rig(reference, "778").sha256 == small
    assert load_rig("mano-right", "full").sha256 == model.rig.sha256
    for reference in ("mano-right", str(path)):
        with pytest.raises(RigError, match=r"found level 778, which the open hand[\s\S]*`level`"):
            load_rig(reference, "778")


def test_a_missing_rig_says_where_to_get_it(home: Path, tmp_path: Path) -> None:
    for reference in ("mano-right", str(tmp_path / "mano.safetensors")):
        with pytest.raises(LicensedRigMissing, match=r"mano.is.tue.mpg.de[\s\S]*import-mano"):
            load_rig(reference)
    with pytest.raises(LicensedRigMissing, match=r"ffffffffffff[\s\S]*import-mano"):
        find_rig("f" * 64, "mano-right")
    with pytest.raises(RigError, match="again with this version") as caught:
        find_rig("f" * 64, "open-hand")
    assert not isinstance(caught.value, LicensedRigMissing)


def test_an_unknown_reference_names_the_known_ones(model: ManoModel, home: Path) -> None:
    save_rig(model)
    with pytest.raises(RigError, match=r"open-hand, open-hand-778, mano-right"):
        load_rig("opnehand")
    with pytest.raises(RigError, match=r"import-mano .*MANO_RIGHT\.pkl"):
        load_rig("models/MANO_RIGHT.pkl")


def test_two_rigs_of_one_name_are_told_apart_by_their_files(model: ManoModel, home: Path) -> None:
    save_rig(model, rigs_folder() / "a.safetensors")
    save_rig(model, rigs_folder() / "b.safetensors")
    with pytest.raises(RigError, match=r"a\.safetensors, .*b\.safetensors"):
        load_rig("mano-right")


def test_a_file_is_not_replaced_unless_told(model: ManoModel, tmp_path: Path) -> None:
    path = tmp_path / "new" / "rig.safetensors"
    assert save_rig(model, path) == path
    with pytest.raises(FolderInUse, match="exists"):
        save_rig(model, path)
    save_rig(model, path, overwrite=True)
    with pytest.raises(FolderInUse, match="is no file"):
        save_rig(model, tmp_path, overwrite=True)
    assert [file.name for file in path.parent.iterdir()] == ["rig.safetensors"]


@pytest.mark.parametrize("damage", ["cut", "text", "changed", "lacking", "empty", "alien"])
def test_damaged_files_are_refused(model: ManoModel, tmp_path: Path, damage: str) -> None:
    path = save_rig(model, tmp_path / "rig.safetensors")
    content = path.read_bytes()
    with safe_open(path, framework="pt") as file:
        facts = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "text":
        path.write_text("not a rig")
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "changed":
        tensors["template_vertices"] = tensors["template_vertices"] + 0.001
        save_file(tensors, path, facts)
    elif damage == "lacking":
        save_file({n: t for n, t in tensors.items() if n != "skin_weights"}, path, facts)
    else:
        save_file(tensors, path, {"made_by": "somebody else"})
    with pytest.raises(RigError, match=r"rig\.safetensors"):
        read_rig(path)


def test_mean_pose_and_components_come_back_with_an_imported_rig(
    home: Path, tmp_path: Path
) -> None:
    """From the file itself, from the imported rig by its name, and from wherever it was put."""
    file = write_mano(tmp_path / "MANO_LEFT.pkl", "left")
    model = read_mano(file)
    save_rig(model)
    elsewhere = save_rig(model, tmp_path / "mine.safetensors")
    for reference in (str(file), "mano-left", str(elsewhere)):
        found = load_mano(reference)
        assert (found.side, found.left_shape, found.sha256) == ("left", "mirrored", model.sha256)
        assert torch.equal(found.hands_mean, model.hands_mean)
        assert torch.equal(found.hands_components, model.hands_components)
        assert found.rig.sha256 == model.rig.sha256
    with pytest.raises(LicensedRigMissing, match="rig mano-right: not imported"):
        load_mano("mano-right")
