"""The examples and the notebook run as a reader would run them, on a budget of seconds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from source_tree import TOP

from handavatar.avatar import HandAvatar
from handavatar.capture.motion import read_motion
from handavatar.edit import Edit
from handavatar.hand.pose import BONE_NAMES, FINGER_BONES
from handavatar.hand.pose_sampling import angles_from_rotations

EXAMPLES = TOP / "examples"
SIZE = 32
QUICKLY = (
    "from conftest import TINY; from handavatar.train.loop import METHODS; METHODS['quick'] = TINY"
)
"""Said before an example that trains: its method on a budget of seconds."""


def _run(program: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs Python in a folder of its own, with this checkout's package and the tests' modules."""
    here = {"PYTHONPATH": os.pathsep.join([str(TOP / "src"), str(TOP / "tests")])}
    return subprocess.run(
        [sys.executable, *program],
        cwd=folder,
        env=os.environ | here,
        text=True,
        capture_output=True,
        timeout=1800,  # Seconds are enough, unless the machine is busy with other things.
    )


def _run_example(name: str, folder: Path, *words: object, before: str = "pass") -> str:
    """What an example prints; its files go into ``examples-out`` of the folder by default."""
    path = str(EXAMPLES / name)
    code = f"{before}; import runpy, sys; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0])"
    program = [path] if before == "pass" else ["-c", code, path]
    done = _run([*program, *map(str, words)], folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _tiles(path: Path, size: int) -> np.ndarray:
    """A sheet as rows, columns, height, width, channels."""
    pixels = np.asarray(Image.open(path)).astype(np.int64)
    rows, columns = pixels.shape[0] // size, pixels.shape[1] // size
    assert pixels.shape == (rows * size, columns * size, 3)
    return pixels.reshape(rows, size, columns, size, 3).swapaxes(1, 2)


def _assert_shows_a_hand(tile: np.ndarray) -> None:
    """A part of the picture is lit, and the hand is whole: the border is black."""
    is_lit = tile.max(-1) > 25
    assert 0.03 < is_lit.mean() < 0.7
    assert not np.concatenate([is_lit[0], is_lit[-1], is_lit[:, 0], is_lit[:, -1]]).any()


@pytest.fixture(scope="module")
def saved(small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "avatar.safetensors"
    small_avatar.save(path)
    return path


@pytest.mark.slow
def test_the_first_avatar_is_trained_and_shown(tiny_capture: Path, tmp_path: Path) -> None:
    told = _run_example(
        "01_first_avatar.py", tmp_path, "--capture", tiny_capture, "--steps", 6, before=QUICKLY
    )
    out = tmp_path / "examples-out"
    assert "dB on the hand" in told and "first_avatar.png" in told
    avatar = HandAvatar.load(out / "run")
    assert avatar.info["subject"] == "tiny" and "view" in avatar.info
    (row,) = _tiles(out / "first_avatar.png", 48)
    assert len(row) == 4
    truth, rendered = row[0].max(-1) > 25, row[1].max(-1) > 25
    assert (truth & rendered).sum() / (truth | rendered).sum() > 0.6
    for tile in row:
        _assert_shows_a_hand(tile)


@pytest.mark.slow
def test_hands_are_posed_and_seen_from_three_sides(saved: Path, tmp_path: Path) -> None:
    _run_example("02_pose_a_hand.py", tmp_path, "--avatar", saved, "--size", SIZE)
    out = tmp_path / "examples-out"
    tiles = _tiles(out / "poses.png", SIZE)
    assert tiles.shape[:2] == (4, 3)
    flat = tiles.reshape(12, SIZE, SIZE, 3)
    for number, tile in enumerate(flat):
        _assert_shows_a_hand(tile)
        assert all((tile != other).any() for other in flat[:number])
    motion = read_motion(out / "poses.json")
    assert len(motion) == 4
    angles = angles_from_rotations(HandAvatar.load(saved).base_rig, motion.rotations[3]).rad2deg()
    ring = angles[list(FINGER_BONES["ring"]), 0]
    torch.testing.assert_close(ring, torch.tensor([70.0, 70.0, 65.0]), atol=1e-2, rtol=0)
    assert float(angles[BONE_NAMES.index("index1"), 1]) == pytest.approx(16.0, abs=1e-2)


@pytest.mark.slow
def test_each_edit_changes_what_it_says_and_nothing_else(saved: Path, tmp_path: Path) -> None:
    before = saved.read_bytes()
    _run_example("03_edit.py", tmp_path, "--avatar", saved, "--out", "o", "--size", SIZE)
    (row,) = _tiles(tmp_path / "o" / "edits.png", SIZE)
    plain, brighter, cooler, painted, lifted = row
    for tile in row:
        _assert_shows_a_hand(tile)
    is_hand = plain.max(-1) > 25
    is_outside = plain.max(-1) == 0
    for tile in row:  # What rounds to black may, brightened, round to one.
        assert tile[is_outside].max() <= 1
    # Each number is rounded: 1.4 times at most half a step is less than a step.
    assert np.abs(brighter - np.minimum(1.4 * plain, 255)).max() <= 1.5
    # Albedo that is clamped at 1 hides a shift; on the mean, blue comes and red goes.
    change = (cooler - plain)[is_hand].mean(0)
    assert change[2] > 5 and change[0] < 0 < change[1]
    is_painted = np.abs(painted - plain).max(-1) > 8
    assert 0.01 < is_painted[is_hand].mean() < 0.35
    is_green = painted.argmax(-1) == 1
    assert is_green[is_painted].mean() > 0.8
    assert np.abs(painted - plain)[~is_painted].mean() < 0.1
    # Untrained, a shadow may be brighter than none; it is the thumb's, so it is somewhere only.
    is_lifted = (lifted != plain).any(-1)
    assert 0.01 < is_lifted[is_hand].mean() < 0.6 and not is_lifted[is_outside].any()

    assert saved.read_bytes() == before
    original = HandAvatar.load(saved)
    edited = HandAvatar.load(tmp_path / "o" / "edited.safetensors")
    assert original.edit == Edit()
    assert edited.edit.albedo_shift == (-0.05, 0.05, 0.2) and edited.edit.light_gain == 1.0
    assert edited.edit.paint is not None and not edited.edit.lifted_bones
    for name, value in original.state_dict().items():
        assert torch.equal(value, edited.state_dict()[name]), name


@pytest.mark.slow
def test_files_for_other_programs_are_whole(saved: Path, tmp_path: Path) -> None:
    for _ in range(2):  # The second time it replaces what it made.
        told = _run_example("04_export.py", tmp_path, "--avatar", saved, "--texture-size", 32)
    out = tmp_path / "examples-out"
    assert {path.name for path in out.iterdir()} == {"hand.glb", "fist.ply", "joints.json"}
    content = (out / "hand.glb").read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert len(document["skins"][0]["joints"]) == 25 and len(document["animations"]) == 1
    assert len(trimesh.load(out / "hand.glb", force="mesh").vertices) > 700
    mesh = trimesh.load(out / "fist.ply", process=False)
    joints = json.loads((out / "joints.json").read_text(encoding="utf-8"))
    assert tuple(joints) == BONE_NAMES
    # Joints lie in the flesh of the same fist, the wrist's in the plane of its rim.
    places = np.array([joints[name] for name in BONE_NAMES[1:]])
    assert 0.08 < np.ptp(mesh.bounds, axis=0).max() < 0.15  # Metres.
    assert (places > mesh.bounds[0]).all()
    assert (places < mesh.bounds[1]).all()
    reach = np.linalg.norm(mesh.vertices - joints["wrist"], axis=1).max()
    assert f"reaches {100 * reach:.1f} cm" in told


@pytest.mark.slow
def test_without_an_avatar_they_say_who_makes_one(tmp_path: Path) -> None:
    done = _run([str(EXAMPLES / "03_edit.py")], tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip().endswith("run 01_first_avatar.py, or name one with --avatar")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_notebook_tells_the_whole_story(tiny_capture: Path, tmp_path: Path) -> None:
    notebook = json.loads((EXAMPLES / "hand_avatar.ipynb").read_text(encoding="utf-8"))
    sources = ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    small = iter(
        [f"capture=Path({str(tiny_capture)!r}), steps=6", "size=16", "size=16", "texture_size=16"]
    )
    asked = "options = Options()"
    cells = [
        source.replace(asked, f"options = Options({next(small)})") if asked in source else source
        for source in sources
    ]
    assert next(small, None) is None
    (tmp_path / "cells.py").write_text("\n".join([QUICKLY, *cells]), encoding="utf-8")
    done = _run(["cells.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    names = {path.name for path in (tmp_path / "examples-out").iterdir()}
    assert names == {
        *("run", "first_avatar.png", "poses.png", "poses.json", "edits.png"),
        *("edited.safetensors", "hand.glb", "fist.ply", "joints.json"),
    }
    for name in ("first_avatar.png", "poses.png", "edits.png"):
        assert f"{name}:" in done.stdout


@pytest.mark.slow
def test_the_first_avatar_is_trained_by_the_method_itself(
    tiny_capture: Path, tmp_path: Path
) -> None:
    told = _run_example("01_first_avatar.py", tmp_path, "--capture", tiny_capture, "--steps", 2)
    assert "dB on the hand" in told
